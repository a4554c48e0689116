"""What can be asked of recorded flights, a function a request; see quadexp/requests.py."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from quadexp.parts.options import Folders


def identify(
    flights: Sequence[Path],
    out: Path,
    conf: Folders = None,
    *,
    chosen: Callable[[str, str], None] = lambda method, reason: None,
    method: str | None = None,
    vehicle: str | None = None,
    settings: Mapping[str, Any],
    figures: bool = True,
    figure: Path | None = None,
    force: bool = False,
) -> dict[str, Any]:
    """Identify a vehicle from its flights. chosen: is given the method that is taken, and why. settings: of the
    regression (vehicle_model.FitSettings). The report has `method`, `rows` (of one table), `lines`, and what this
    method gives."""
    from quadexp.experiment.vehicle_of import vehicle_named
    from quadexp.plugins.identification.identify import choose_method, identify_files, identify_flights

    named = None if vehicle is None else vehicle_named(vehicle, conf)
    choice = choose_method(flights, method, named)
    chosen(choice.method, choice.reason)
    if choice.method == "delays":
        from quadexp.plugins.identification.delays import identify_delays

        report = identify_delays(flights, named, conf, figure)
    elif choice.method == "torque":
        from quadexp.plugins.identification.torque import identify_torque

        report = identify_torque(flights, named, conf)
    elif choice.method == "rls":
        report = identify_files(flights, out, vehicle=named, conf=conf, force=force)
    else:
        from quadexp.plugins.identification.vehicle_model import FitSettings

        report = identify_flights(
            flights, out, named, FitSettings(**settings), force=force, figures=figures, conf=conf
        )  # fmt: skip
    return {"method": choice.method, **report}
