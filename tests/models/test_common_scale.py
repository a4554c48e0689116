"""The thrust scale of each flight is distinguished from the lift and the drag of the speed it was flown
at."""

import numpy as np
import pytest

from quadexp.models.common_scale import with_common_scale
from quadexp.models.dataset import ResidualDataset

G, MASS = 9.81, 0.8


def dataset(scales, speeds, lift=0.0, drag=0.0, seed=0):
    """Flights at different speeds, each varying about its own; noise that lasts for 0.1 s."""
    rng = np.random.default_rng(seed)
    rows = []
    for index, (scale, speed) in enumerate(zip(scales, speeds, strict=True)):
        t = 0.01 * np.arange(3000)
        v_x, v_z = speed * np.sin(0.5 * t), 0.15 * speed * np.sin(0.9 * t + index)
        thrust = G + 0.1 * v_x**2 / (1 + speed) + 0.5 * rng.normal(size=len(t))
        noise = np.convolve(rng.normal(size=len(t) + 9), np.ones(10) / 10, "valid")
        a_z = scale * thrust + lift * v_x**2 - drag * v_z + 0.3 * noise
        rows.append(np.column_stack([np.full(len(t), index), v_x, 0 * t, v_z, MASS * thrust, a_z]))
    columns = dict(zip(("flight", "v_x", "v_y", "v_z", "thrust", "a_z"), np.concatenate(rows).T, strict=True))
    columns["flight"] = columns["flight"].astype(int)
    return ResidualDataset(columns, {"recorded": True, "vehicle": {"mass": MASS}})


def test_lift_is_no_battery():
    """Lift of 0.02 V^2 at up to 10 m/s: by itself, a scale of the fast flight of up to 0.1."""
    data = dataset([0.0, 0.0, 0.0], [1.0, 5.0, 10.0], lift=0.02, drag=0.3)
    common = with_common_scale(data)
    assert np.ptp(list(common.errors.values())) < 0.01
    wanted = 0.02 * data.columns["v_x"] ** 2
    left = common.dataset.columns["a_z"] - wanted + 0.3 * data.columns["v_z"]
    assert np.corrcoef(left, wanted)[0, 1] ** 2 < 0.01


@pytest.mark.parametrize("lift", [0.0, 0.02])
def test_scales_are_found_beside_lift(lift):
    scales = np.array([-0.05, 0.02, 0.03])
    common = with_common_scale(dataset(scales, [2.0, 5.0, 8.0], lift=lift, drag=0.2))
    found = np.array(list(common.errors.values()))
    assert found - found.mean() == pytest.approx(scales - scales.mean(), abs=0.008)
    assert common.variance == pytest.approx(np.var(scales, ddof=1) * common.level**2, rel=0.3)


def test_one_flight_keeps_its_rows():
    data = dataset([0.04], [5.0])
    common = with_common_scale(data)
    assert common.variance == 0.0 and np.array_equal(common.dataset.columns["a_z"], data.columns["a_z"])
