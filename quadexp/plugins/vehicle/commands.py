"""Commands that bring a controller onto a vehicle: `quadexp export-controller`, `fly`. Only light modules are imported
at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Out, Overrides, command
from quadexp.errors import UsageError

HEADING = "Extend"


@command
def export_controller(
    overrides: Overrides = (),
    out: Out = Path("controller"),
    real: Annotated[Literal["double", "float"], Ask("Precision of its numbers.")] = "double",
    prefix: Annotated[str, Ask("Prefix of all public names.", "NAME")] = "qx",
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Write a controller as C that needs no library, with a proof that it flies as in the bench.

    The trajectory is the one that it is checked on; `make test` in the folder repeats the check.

    \b
    quadexp export-controller controller=gp_mpc model=models/gp trajectory=circle trajectory.speed=8 --out vehicle/gp
    quadexp export-controller controller=geometric adaptive=l1 --real float --prefix gl --out vehicle/geometric
    make -C vehicle/gp test
    """
    from quadexp.plugins.vehicle.export import export_controller as export

    folder = export(overrides, out, conf, real=real, prefix=prefix, force=force)
    size = sum(folder["files"].values())
    line = f"{len(folder['files'])} files, {size / 1e6:.1f} MB; make -C {folder['path']} test checks them"
    rows = [{"file": name, "bytes": count} for name, count in folder["files"].items()]
    return Answer(folder, rows, [line, Path(folder["path"])])


@command
def fly(
    target: Annotated[str, Ask("betaflight, or udp:HOST:PORT, where a PX4 sends to.", "TARGET")],
    overrides: Overrides = (),
    rates: Annotated[
        str, Ask("predicted, or inverse=X,Y,Z of its rate loop (1/s); betaflight: or inverse.", "RATES")
    ] = "predicted",
    thrust: Annotated[str, Ask("udp: hover=SHARE, full, or curve=FACTOR.", "MAP")] = "full",
    arm: Annotated[bool, Ask("udp: arm the vehicle.")] = False,
    vehicle_is_real: Annotated[bool, Ask("udp: allow addresses of other machines: a vehicle may move.")] = False,
    lockstep: Annotated[bool, Ask("udp: a state is one instant of the reference, for simulators that wait.")] = False,
    firmware: Annotated[Path | None, Ask("betaflight: its SITL, which you build.", "PROGRAM")] = None,
    rc_rate: Annotated[float, Ask("betaflight: rate of the radio's pulses (Hz); 0: with every command.", "HZ")] = 0.0,
    rc_steps: Annotated[int, Ask("betaflight: resolution of a stick's throw.", "COUNT")] = 1000,
    ahead: Annotated[float, Ask("betaflight: for which predicted rates are sent (s).", "TIME")] = 0.04,
    out: OptionalOut = None,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Fly through a flight stack: body rates and thrust out; the flight is written like any other.

    betaflight: its simulation build in lockstep, with the bench's plant; link=latency link.latency=0.02 is its radio.
    udp: an autopilot over MAVLink, which sends its state. It has met a stand-in only, never a real PX4: keep a hand on
    the kill switch.

    \b
    quadexp fly betaflight --firmware betaflight_4.6.0_SITL controller=gp_mpc model=models/gp horizon=precise
    quadexp fly betaflight controller=geometric --rates inverse
    quadexp fly udp:127.0.0.1:14540 controller=gp_mpc model=models/gp trajectory=circle trajectory.speed=4 --arm
    quadexp fly udp:127.0.0.1:14540 controller=geometric --rates inverse=25,25,10 --thrust hover=0.5
    """
    from quadexp.log.store import write_flight
    from quadexp.writer import check_output

    path = None if out is None else check_output(out, force=force)
    if target == "betaflight":
        if thrust != "full" or arm or vehicle_is_real or lockstep:
            raise UsageError("fly betaflight: --thrust, --arm, --vehicle-is-real, --lockstep are for udp")
        from quadexp.plugins.vehicle.betaflight.flight import Radio, fly_betaflight
        from quadexp.report.summary import flight_lines

        flight = fly_betaflight(overrides, conf, Radio(rc_rate, rc_steps, ahead, rates), firmware)
        about = flight.metadata
        record, lines = dict(about["row"]), [*flight_lines(about), f"firmware    {about['autopilot']}"]
    else:
        if firmware is not None or (rc_rate, rc_steps, ahead) != (0.0, 1000, 0.04):
            raise UsageError(f"fly {target}: --firmware, --rc-rate, --rc-steps, --ahead are for betaflight")
        from quadexp.plugins.vehicle.mavlink.session import Asked, fly_mavlink

        flight = fly_mavlink(target, overrides, conf, Asked(thrust, rates, arm, vehicle_is_real, lockstep))
        about, latency = flight.metadata, flight.metadata["latency_ms"]
        record = {"outcome": about["outcome"], "cause": about["cause"], "steps": len(flight), "latency_ms": latency}
        lines = [f"outcome     {about['outcome']} {about['cause']}".rstrip(), f"steps       {len(flight)}"]
        lines.append(f"answers     median {latency['p50']:.2f} ms, 99 % {latency['p99']:.2f} ms")
    written = [] if path is None else [write_flight(path, flight, force=force)]
    wrong = [] if about["outcome"] == "ok" else [about["cause"]]
    return Answer(record, [record], [*lines, *map(str, written)], failed=wrong)
