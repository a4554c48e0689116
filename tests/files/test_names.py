"""Attacks by names: out of the output folder, through links, onto the terminal's next line."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from quadexp.errors import DataError, UsageError
from quadexp.log.store import read_flight, write_flight, write_table
from quadexp.models.checkpoint import load_model, save_model
from quadexp.names import NAMED, file_name, is_name
from quadexp.parts.compose import compose
from quadexp.reference.hover import Hover
from quadexp.requests import _flight_name, _results_name
from quadexp.sweeps.results import select
from tests.files.test_writer import drag
from tests.log.flights import straight_flight

HOSTILE = (
    "../../../x", "/etc/x", "..", ".", "", "a/../../b", "-rf", "~", ".hidden", "nul", "COM1.txt", "a\0b",
    "a\nb", "\x1b]0;owned\x07", "a\u2028b", "\u202etxt", "x" * 5000, "é" * 300, "a\\b", "a\u2215b", "con", " x ", "x.",
    "\ud800",
)  # fmt: skip


def lies_in(path: Path, folder: Path) -> bool:
    return path.parent == folder and Path(os.path.normpath(path)).parent == folder


@given(st.one_of(st.sampled_from(HOSTILE), st.text(max_size=400)))
def test_a_file_name_is_one_component(text):
    from quadexp.plugins.page.sweep_figures import SweepFigures

    made = file_name(text)
    assert Path(made).parts == (made,) and made.isprintable() and len(made.encode()) <= 140
    assert made == made.strip(" .") and not made.startswith("-") and made.upper() not in ("NUL", "CON", "COM1.TXT")
    assert lies_in(SweepFigures("out", None, "mean_error", 0.95).path(f"path_{text}"), Path("out/figures"))
    assert file_name(made) == made or made != text


@given(st.lists(st.text(max_size=30), min_size=2, max_size=8, unique=True))
def test_different_names_have_different_files(texts):
    assert len({file_name(text) for text in texts}) == len(texts)


@pytest.mark.parametrize("name", HOSTILE)
def test_what_is_written_lies_in_the_output_folder(name):
    """Names of a trajectory, an experiment, a tuned option: each is refused, or made a file name."""
    from quadexp.plugins.tune.preset import check_name

    trajectory = object.__new__(Hover)  # whose own check would refuse it
    vars(trajectory).update(vars(Hover()) | {"name": name})
    config = dataclasses.replace(compose([]), trajectory=trajectory)
    folder = Path("runs")
    for made in (_flight_name(config), _results_name([f"experiment={name}"], config, True)):
        assert lies_in(folder / f"{made}.parquet", folder)
    if name:
        try:
            check_name({"controller": "gp_mpc"}, name)
        except UsageError:
            return
        assert lies_in(folder / f"{name}.yaml", folder)


@pytest.mark.parametrize("name", [name for name in HOSTILE if not is_name(name)])
def test_a_name_is_one_printable_line(name, tmp_path):
    """Wherever it is read: from the configuration, a flight, a table of results, a checkpoint."""
    with pytest.raises(UsageError, match="one printable line"):
        Hover(name=name)
    if not name or "\ud800" in name:
        return
    flight = write_flight(tmp_path / "a.parquet", straight_flight(config={"trajectory": {"name": name}}))
    with pytest.raises(DataError, match="trajectory is not one printable line"):
        read_flight(flight)
    (tmp_path / "r" / "cells").mkdir(parents=True)
    row = dict.fromkeys((*NAMED, "key", "outcome"), np.array([name], object))
    write_table(tmp_path / "r" / "results.parquet", row, {}, "results")
    with pytest.raises(DataError, match="is not one printable line"):
        select(tmp_path / "r")
    model = replace(drag(), vehicle={"name": name, "fingerprint": "0"})
    with pytest.raises(DataError, match="vehicle is not one printable line"):
        load_model(save_model(tmp_path / "m", model))
