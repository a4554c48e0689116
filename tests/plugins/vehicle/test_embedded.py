"""The emulated processors of benchmarks/embedded.py, where cross compiler and emulator are there."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from benchmarks.embedded import NODES, condensed, linear_mpc
from quadexp.plugins.vehicle.export import export_controller


def test_the_condensed_cost_is_that_of_the_linear_mpc() -> None:
    mpc, rng = linear_mpc(), np.random.default_rng(0)
    H, F = condensed(mpc)
    first, inputs = rng.normal(size=12), rng.normal(size=(NODES, 4))

    def cost(u: np.ndarray) -> float:
        x, total = first, 0.0
        for now in u:
            x = mpc.A @ x + mpc.B @ now
            total += x @ mpc.Q @ x + now @ mpc.R @ now
        return float(total)

    u = inputs.ravel()
    assert u @ H @ u / 2 + F @ first @ u == pytest.approx(cost(inputs) - cost(0 * inputs), rel=1e-12)


@pytest.mark.parametrize("real", ["double", "float"])
def test_an_emulated_processor_gives_the_recorded_commands(tmp_path: Path, real: str) -> None:
    pytest.importorskip("unicorn")
    if shutil.which("arm-none-eabi-gcc") is None:
        pytest.skip("no arm-none-eabi-gcc")
    from benchmarks.embedded import measured

    export_controller(["controller=nominal_mpc", "trajectory=circle"], tmp_path / "c", real=real)
    row = measured(tmp_path / "c", "m7")
    assert row["apart"] < (1e-9 if real == "double" else 1e-3)  # N
    assert row["step"] < 390_000
    assert row["ram"] < (60_000 if real == "double" else 30_000)
    assert row["stack"] < 10_000
