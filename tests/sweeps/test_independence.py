"""Results do not depend on workers, order, interruption or process: nobody who flew before or beside is noticed."""

import random

import pytest

from quadexp.compile.backend import compiler
from quadexp.parts.compose import expand
from quadexp.sweeps.engine import LocalEngine
from quadexp.sweeps.sweep import SweepInterrupted, SweepRequest, run_sweep
from tests.experiment.same import same_results

# Controllers that learn in flight keep the most between two steps, and a worker flies many cells with one of each.
LEARNING = ["vehicle=lei_li", "plant=blade_element", "controller=rls_feedback,rls_mpc"]
KNOWING = ["controller=nominal_mpc,perfect_mpc"]
SHORT = ["trajectory=step", "trajectory.duration=0.3", "trajectory.step_time=0.1", "seed=range(3)"]
COMPILED = pytest.param((KNOWING, "compiled", 6), marks=pytest.mark.skipif(compiler() is None, reason="no C compiler"))


# Noise differs by seed and knowledge by controller; the blade-element plant has no noise.
@pytest.fixture(scope="module", params=[(LEARNING, "interpreted", 2), COMPILED])
def flown(request, tmp_path_factory):
    """The cells, and what one worker made of them in the order of the plan."""
    who, backend, errors = request.param
    cells = expand([*SHORT, *who, f"controller.backend={backend}", f"plant.backend={backend}"])
    alone = run_sweep(cells, tmp_path_factory.mktemp("alone") / "r", SweepRequest(engine=LocalEngine(1)))
    assert not alone.not_flown and len({row["mean_error"] for row in alone.rows}) == errors
    return cells, alone


def test_workers(flown, tmp_path):
    cells, alone = flown
    same_results(alone, run_sweep(cells, tmp_path / "r", SweepRequest(engine=LocalEngine(2))))


def test_order_and_this_process(flown, tmp_path):
    cells, alone = flown
    shuffled = random.Random(1).sample(cells, len(cells))
    run_sweep(shuffled, tmp_path / "r", SweepRequest(isolate=False))
    again = run_sweep(cells, tmp_path / "r")
    assert again.flown == 0
    same_results(alone, again)


def test_interruption(flown, tmp_path):
    cells, alone = flown

    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(SweepInterrupted, match=f"of {len(cells)} done; run the same command to continue"):
        run_sweep(cells, tmp_path / "r", SweepRequest(engine=LocalEngine(2), progress=stop))
    rest = run_sweep(cells, tmp_path / "r", SweepRequest(engine=LocalEngine(2)))
    assert 0 <= rest.flown <= len(cells) - 3
    same_results(alone, rest)
