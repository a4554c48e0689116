"""`quadexp animate`: the pictures show the vehicles where the flights have them."""

import numpy as np
import pytest
from PIL import Image

from quadexp.errors import UsageError
from quadexp.log.schema import Flight
from quadexp.log.store import write_flight
from quadexp.plugins.page.animation import animate
from quadexp.report.style import HUES
from tests.log.flights import straight_flight


def flight(tmp_path, controller, offset, samples=60):
    """Along a straight line, aside of its reference by a constant offset (m)."""
    made = straight_flight(samples)
    for axis, distance in zip("xyz", offset, strict=True):
        made.columns[f"p_{axis}"] = made[f"p_{axis}"] + distance
    metadata = {**made.metadata, "controller": controller, "trajectory": "line"}
    return write_flight(tmp_path / f"{controller}.parquet", Flight(made.columns, metadata))


def centre(image, colour, box):
    """Mean (x, y) of the pixels of a colour inside a box, in pixels."""
    pixels = np.asarray(image.convert("RGB"), int)[box[1] : box[3], box[0] : box[2]]
    near = np.abs(pixels - [int(colour[i : i + 2], 16) for i in (1, 3, 5)]).sum(axis=2) < 40
    return np.argwhere(near).mean(axis=0)[::-1]


@pytest.mark.parametrize("rate", [7, 45])
def test_it_is_in_real_time(tmp_path, rate):
    """A GIF counts time in hundredths of a second: at no frame is it further off than half of one."""
    paths = [flight(tmp_path, "nominal_mpc", (0.3, 0.0, 0.0)), flight(tmp_path, "gp_mpc", (0.0, 0.0, 0.0))]
    made = animate(paths, tmp_path / "a.gif", rate=rate, begin=0.1, end=0.4)
    shown = []
    with Image.open(made["path"]) as image:
        assert image.n_frames == made["frames"] == int(0.3 * rate + 1)
        for k in range(image.n_frames - 1):
            image.seek(k)
            image.load()
            shown.append(image.info["duration"])
    wanted = 1000 / rate * np.arange(1, made["frames"])
    assert np.abs(np.cumsum(shown) - wanted).max() <= 5 + 1e-6


def test_the_vehicles_are_to_scale_and_where_they_were(tmp_path):
    """In the window beside the reference: one 0.3 m to the right of the other, whose centre is the reference."""
    paths = [flight(tmp_path, "nominal_mpc", (0.3, 0.0, 0.0)), flight(tmp_path, "gp_mpc", (-0.3, 0.0, 0.0))]
    made = animate(paths, tmp_path / "a.gif", rate=10, end=0.5)
    with Image.open(made["path"]) as image:
        image.seek(3)
        frame = image.convert("RGB")
    window = (frame.width * 6 // 10, 20, frame.width, frame.height * 72 // 100)
    grey, blue = (centre(frame, HUES[hue], window) for hue in ("grey", "blue"))
    assert grey[0] > blue[0] + 40 and abs(grey[1] - blue[1]) < 6
    middle = (grey + blue) / 2
    assert abs(middle[0] - 0.5 * (window[2] - window[0])) < 30


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"out": "a.mp4"}, "must end in .gif"),
        ({"rate": 0.5}, r"--rate 0.5: must be in \[1, 50\]"),
        ({"begin": 50.0}, "0 frames from 50"),
    ],
)
def test_what_cannot_be_drawn_is_one_line_and_no_file(tmp_path, given, message):
    path = flight(tmp_path, "gp_mpc", (0.0, 0.0, 0.0))
    out = tmp_path / given.pop("out", "a.gif")
    with pytest.raises(UsageError, match=message):
        animate([path], out, **given)
    assert not out.exists()


def test_flights_of_different_references_are_refused(tmp_path):
    paths = [flight(tmp_path, "nominal_mpc", (0.3, 0.0, 0.0)), flight(tmp_path, "gp_mpc", (0.0, 0.0, 0.0))]
    other = straight_flight(60, (0.0, 0.0, 0.0))
    other.columns["ref_p_y"] = other["ref_p_y"] + 1.0
    write_flight(paths[1], Flight(other.columns, other.metadata))
    with pytest.raises(UsageError, match=r"gp_mpc.parquet: follows another reference than .*nominal_mpc.parquet"):
        animate(paths, tmp_path / "a.gif")


@pytest.mark.parametrize("ratio", [4.0, 0.6])
def test_flights_at_different_control_rates_follow_one_reference(tmp_path, ratio):
    """Also where few of their samples are at the same times."""
    turning = straight_flight(60)
    for name, of in (("p_x", np.cos), ("p_y", np.sin)):
        turning.columns[f"ref_{name}"] = turning.columns[name] = 5 * of(2 * turning.t)
    slow = write_flight(tmp_path / "slow.parquet", turning)
    at = np.arange(0.0, turning.t[-1] + 1e-9, (turning.t[1] - turning.t[0]) / ratio)
    columns = {name: np.interp(at, turning.t, values) for name, values in turning.columns.items()}
    for name, of in (("ref_p_x", np.cos), ("ref_p_y", np.sin)):
        columns[name] = 5 * of(2 * at)
    fast = write_flight(tmp_path / "fast.parquet", Flight(columns, {**turning.metadata, "controller": "gp_mpc"}))
    assert animate([slow, fast], tmp_path / "a.gif", rate=10)["frames"] > 2
