"""Which model of the air predicts flights that it was not fitted to: one answer for `quadexp identify` and `fit`.

Linear drag, quadratic drag and the blade element without a rotor's radius (terms.py), each with the scale of the thrust
as a term, are fitted to all flights but some and predict these; of one flight each half. The flights have one scale of
the thrust (common_scale.py), since another battery is no question of the air. The simplest model is taken whose error
is within ALIKE of the least: what is as good with fewer numbers is also as good elsewhere.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadexp.errors import DataError
from quadexp.models.base import AXIS, rms
from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset
from quadexp.models.residual import VELOCITY
from quadexp.plugins.aerodynamics.terms import QUADRATIC, WITHOUT_RADIUS, Axes, fit_terms

ALIKE = 0.02  # of an error
MOST_ROWS = 20_000  # more are thinned evenly
MOST_FOLDS = 10  # flights that are held out one by one; each costs a fit
CANDIDATES: dict[str, Axes] = {  # the simplest first
    "linear": (("linear", "offset"), ("linear", "offset"), ("thrust", "linear")),
    "quadratic": QUADRATIC,
    "blade_element": WITHOUT_RADIUS,
}


def compare_drag(rows: ResidualDataset) -> list[dict[str, Any]]:
    """Records {model, rms (m/s^2), used}; of a model that some flights do not determine rms is None.

    rows: residual acceleration beyond a thrust curve. Raises DataError where they do not state the vehicle's mass.
    """
    mass = (rows.metadata.get("vehicle") or {}).get("mass")
    if not mass:
        raise DataError("the data set does not contain the vehicle's mass; collect it again")
    scaled = with_common_scale(rows).dataset
    scaled = scaled.rows(np.arange(0, scaled.n_rows, -(-scaled.n_rows // MOST_ROWS)))
    flight = scaled.columns["flight"]
    number = np.unique(flight, return_inverse=True)[1]
    fold = number % MOST_FOLDS
    if not number.any():
        fold = 2 * np.arange(len(number)) // max(len(number), 1)
    velocity, rotors = scaled.matrix(VELOCITY), scaled.rotor_thrusts / mass
    target = scaled.matrix(list(AXIS))
    records: list[dict[str, Any]] = []
    for kind, terms in CANDIDATES.items():
        error = np.empty_like(target)
        records.append({"model": kind, "rms": None, "used": False})
        try:
            for out in (fold == index for index in np.unique(fold)):
                kept = ~out
                model = fit_terms(
                    kind, terms, velocity[kept], rotors[kept], target[kept], flight[kept], flight[kept],
                    what=kind, intervals=False,
                )  # fmt: skip
                error[out] = target[out] - model.acceleration(velocity[out], rotors[out])
        except DataError:
            continue
        records[-1]["rms"] = rms(error)
    known = [record for record in records if record["rms"] is not None]
    least = min((record["rms"] for record in known), default=0.0)
    for record in known:
        if record["rms"] <= (1 + ALIKE) * least:
            record["used"] = True
            break
    return records


def chosen_drag(records: list[dict[str, Any]]) -> str | None:
    """The model that is taken, None where none could be compared."""
    return next((record["model"] for record in records if record["used"]), None)


def drag_line(records: list[dict[str, Any]]) -> str:
    """The comparison as text."""
    errors = [
        f"{record['model'].replace('_', ' ')} {'-' if record['rms'] is None else format(record['rms'], '.4f')}"
        for record in records
    ]
    chosen = chosen_drag(records)
    taken = "none is determined" if chosen is None else f"{chosen.replace('_', ' ')} is taken"
    return f"air, each flight left out, RMSE (m/s^2): {', '.join(errors)}; {taken}, the simplest within {ALIKE:.0%}"
