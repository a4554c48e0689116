"""A part is one class whose fields are its keys. The program's own parts and a user's are found in the same way."""

import pytest

from quadexp.errors import QuadexpError, UsageError
from quadexp.experiment.build import build_trajectory
from quadexp.experiment.identity import digest, flight_entropy, flight_identity, flight_record
from quadexp.parts.compose import compose, expand
from quadexp.parts.options import OptionFiles
from quadexp.parts.part import Part
from quadexp.parts.schema import PARTS, REMEDIES, WORLD
from tests.deleted import needs

OWN = """
from dataclasses import dataclass
from typing import Annotated
from quadexp.parts.settings import Setting
from quadexp.reference.base import TrajectoryPart
from quadexp.reference.hover import Hover

@dataclass(frozen=True, kw_only=True)
class Wait(TrajectoryPart):
    length: Annotated[float, Setting("length of the flight", "(0, 100]", "s")] = 1.0

    def build(self, vehicle):
        return Hover(duration=self.length)

class Plain:
    pass

def function(): return Hover()
"""


@pytest.fixture
def own(tmp_path, request):
    """A folder with the part of a module of its own."""
    name = f"parts_{request.node.name.partition('[')[0]}"
    (tmp_path / "trajectory").mkdir()
    (tmp_path / f"{name}.py").write_text(OWN)

    def option(target, text="", option="wait"):
        target = f"{name}.{target}" if "." not in target else target
        (tmp_path / "trajectory" / f"{option}.yaml").write_text(f"_target_: {target}\n{text}")
        return tmp_path

    return option


def test_a_class_and_an_option_are_a_part(own):
    folder = own("Wait", "length: 2.5\n")
    config = compose(["trajectory=wait"], folder)
    assert config.trajectory.name == "wait" and build_trajectory(config.trajectory).duration == 2.5
    assert [c.config.trajectory.length for c in expand(["trajectory=wait", "trajectory.length=1,2"], folder)] == [1, 2]
    with pytest.raises(UsageError, match=r"trajectory.length=200\.?0?: must be in \(0, 100\] s"):
        compose(["trajectory=wait", "trajectory.length=200"], folder)
    with pytest.raises(UsageError, match="trajectory.lenght: no such key; did you mean trajectory.length"):
        compose(["trajectory=wait", "trajectory.lenght=2"], folder)
    module = type(config.trajectory).__module__
    assert {*flight_identity(config).inputs} == {"trajectory class", f"trajectory module {module}"}


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("Plain", "Plain: is no part: it must be a class derived from"),
        ("function", "function: is no part"),
        ("Absent", "has no class or function 'Absent'"),
        ("quadexp.world.gust.Gust", "is a part of wind, not of trajectory"),
        ("quadexp.writer.write_text", "is no part"),
        ("os.system", "there is no module os in"),
    ],
)
def test_nothing_else_is_named(own, target, message):
    with pytest.raises(QuadexpError, match=message):
        compose(["trajectory=wait"], own(target))
    with pytest.raises(UsageError, match="trajectory._target_: no such key"):  # and never on the command line
        compose([f"trajectory._target_={target}"])


@needs()
def test_the_shipped_ones_go_the_same_way():
    files = OptionFiles()
    assert {*WORLD, *REMEDIES} < set(PARTS)
    for group in PARTS:
        parts = files.parts(group)
        assert parts.keys() == set(files.options(group)), group
        for part in parts.values():
            assert issubclass(part, Part) and part.prefix in ("", f"{group}.") and part.__doc__


def test_what_decides_a_flight_is_what_it_was():
    """Hashes and noise of flights that were stored before parts had classes of their own."""
    assert str(flight_entropy(compose([]))) == ENTROPY
    for overrides, expected in RECORDS.items():
        assert digest(flight_record(compose(overrides.split()))) == expected, overrides


ENTROPY = "107783315644506835894151"
RECORDS = {
    "controller=nominal_mpc": "f9769f63de10883ec073",
    "controller=gp_mpc": "cfb9afe2d74d307a2f25",
    "controller=rls_feedback": "f24abb9473bc95cf0100",
    "controller=online_mpc": "be5c0efa56cca3739537",
    "plant=blade_element": "c8044704020005b7758a",
    "trajectory=random": "02b0d2398ecd5901a8ac",
    "world=everything": "a2bf3a4664d96ec6bf1e",
    "remedies=wind": "2519ffef468055718a4d",
    "vehicle=lei_li": "9814de0e5171c30113ac",
    "trajectory=ellipse": "706a41b5b3fc364a272a",
}
