"""The emulated processors of benchmarks/embedded.py, where cross compiler and emulator are there."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from quadexp.plugins.vehicle.export import export_controller


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
