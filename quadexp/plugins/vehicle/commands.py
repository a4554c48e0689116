"""Commands that bring a controller onto a vehicle: `quadexp export-controller`, `fly`. Only light modules are imported
at the top."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from quadexp.cli.command import Answer, Ask, Conf, Force, OptionalOut, Out, Overrides, command

HEADING = "Extend"


@command
def export_controller(
    overrides: Overrides = (),
    out: Out = Path("controller"),
    real: Annotated[Literal["double", "float"], Ask("Precision of its numbers.")] = "double",
    prefix: Annotated[str, Ask("Of all names that a program around it sees.", "NAME")] = "qx",
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

    made = export(overrides, out, conf, real=real, prefix=prefix, force=force)
    size = sum(made["files"].values())
    line = f"{len(made['files'])} files, {size / 1e6:.1f} MB; make -C {made['path']} test checks them"
    rows = [{"file": name, "bytes": count} for name, count in made["files"].items()]
    return Answer(made, rows, [line, Path(made["path"])])


@command
def fly(
    target: Annotated[str, Ask("udp:HOST:PORT, where the autopilot sends to.", "TARGET")],
    overrides: Overrides = (),
    thrust: Annotated[str, Ask("hover=SHARE, full, or curve=FACTOR.", "MAP")] = "full",
    rates: Annotated[str, Ask("predicted, or inverse=X,Y,Z: gains of its rate loop (1/s).", "RATES")] = "predicted",
    arm: Annotated[bool, Ask("Arm it, too.")] = False,
    vehicle_is_real: Annotated[bool, Ask("Addresses off this machine are meant: a vehicle may move.")] = False,
    lockstep: Annotated[bool, Ask("Every state is one instant of the reference: for simulators that wait.")] = False,
    out: OptionalOut = None,
    conf: Conf = (),
    force: Force = False,
) -> Answer:
    """Fly an autopilot over MAVLink: its state in, body rates and thrust out; the flight is written like any other.

    It has met a stand-in autopilot only, never a real PX4. Keep a hand on the kill switch.

    \b
    quadexp fly udp:127.0.0.1:14540 controller=gp_mpc model=models/gp trajectory=circle trajectory.speed=4 --arm
    quadexp fly udp:127.0.0.1:14540 controller=geometric --rates inverse=25,25,10 --thrust hover=0.5
    """
    from quadexp.log.store import write_flight
    from quadexp.plugins.vehicle.mavlink.session import Asked, fly_mavlink
    from quadexp.writer import check_output

    path = None if out is None else check_output(out, force=force)
    asked = Asked(thrust, rates, arm, vehicle_is_real, lockstep)
    flight = fly_mavlink(target, overrides, conf, asked)
    written = [] if path is None else [write_flight(path, flight, force=force)]
    about = flight.metadata
    latency = about["latency_ms"]
    record = {"outcome": about["outcome"], "cause": about["cause"], "steps": len(flight), "latency_ms": latency}
    lines = [f"outcome     {about['outcome']} {about['cause']}".rstrip(), f"steps       {len(flight)}"]
    lines += [f"answers     median {latency['p50']:.2f} ms, 99 % {latency['p99']:.2f} ms", *map(str, written)]
    wrong = [] if about["outcome"] == "ok" else [about["cause"]]
    return Answer(record, [record | latency], lines, failed=wrong)
