"""The loops over the stages, compiled and interpreted: the step written out, for any horizon, form and model."""

import ctypes
import threading

import numpy as np
import pytest

from quadexp.compile.backend import compiler, linked_library
from quadexp.control.mpc.mpc import stages_of
from quadexp.control.mpc.node import Form, linearise_function
from quadexp.control.mpc.settings import MPCSettings
from quadexp.control.mpc.stages import CompiledStages, lanes_source, node_source, stages_source
from quadexp.control.mpc.step import Step, array_shapes
from quadexp.models.residual import no_residual
from tests.control.mpc.unrolled import unrolled
from tests.models.residuals import RESIDUALS, make_residual, with_rotors
from tests.slow import slow
from tests.states import random_state, with_rotor_count

FORMS = {
    "published": {},
    "body": {"attitude_error": "body"},
    "world": {"attitude_error": "world"},
    "lag": {"lag": True},
    "deviation": {"deviation": True},
    "disturbed": {"disturbed": True},
    "all": {"attitude_error": "body", "lag": True, "deviation": True, "disturbed": True},
}
compiled = pytest.mark.skipif(compiler() is None, reason="no C compiler")
BACKENDS = ["interpreted", pytest.param("compiled", marks=compiled)]


def pose(step: Step, vehicle, theta: np.ndarray, rng: np.random.Generator) -> None:
    """A guess and a reference of any attitudes and speeds, far from each other and from the limits of the thrust."""
    a, settings, n = step.arguments, MPCSettings(terminal_weight=1.5), vehicle.n_rotors
    nodes, m = len(a["U"]), step.form.states

    def states(count: int) -> np.ndarray:
        bodies = np.array([random_state(rng) for _ in range(count)])
        return np.hstack([bodies, rng.uniform(1, 9, (count, m - 13))])

    a["X"][...], a["X_ref"][...], a["x0"][...] = states(nodes + 1), states(len(a["X_ref"])), states(1)[0]
    a["X"][:, 3:7] *= rng.choice([0.2, 1.0, 3.0], (nodes + 1, 1))  # lengths on both sides of their limits
    a["U"][...], a["U_ref"][...] = rng.uniform(1, 9, (nodes, n)), rng.uniform(1, 9, a["U_ref"].shape)
    share = rng.uniform(0.2, 2.0, (nodes, 1))
    weight, a["theta"][...] = np.r_[settings.state_weight(), np.zeros(m - 13)], theta
    a["Q"][...], a["Q_end"][...] = share * weight, 1.5 * weight
    a["R"][...] = share * np.mean(settings.thrust_weight(vehicle))
    a["u_min"][...], a["u_max"][...] = 0.5, 12.0
    a["dt"][...], a["shift"][...] = rng.uniform(0.02, 0.1, nodes), rng.uniform(0.1, 0.9, nodes)
    for name, value in (("tau", 0.03), ("first_share", 0.3), ("disturbance", rng.normal(size=6))):
        if a[name].size:
            a[name][...] = value


def assert_written_out(step: Step, vehicle, residual, form: dict, rng, trials: int = 3) -> None:
    """Relative to the size of each result: over a long horizon from a poor guess they grow."""
    for _ in range(trials):
        pose(step, vehicle, residual.theta, rng)
        step()
        for name, expected in unrolled(vehicle, residual, step.arguments, **form).items():
            scale = max(1.0, np.abs(expected).max())
            assert np.abs(step.results[name] - expected).max() < 1e-8 * scale, name


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("nodes", [2, 5, 10, 20, 100])
def test_any_horizon(vehicle, rng, backend, nodes):
    residual = make_residual("gp_per_axis", vehicle)
    step = Step(stages_of(vehicle, residual, backend), nodes)
    assert_written_out(step, vehicle, residual, {}, rng)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("form", FORMS)
def test_any_form(vehicle, rng, backend, form):
    residual = make_residual("linear_drag", vehicle)
    step = Step(stages_of(vehicle, residual, backend, **FORMS[form]), 7)
    assert_written_out(step, vehicle, residual, FORMS[form], rng)


def cached_function(vehicle, residual, *flags: str, **structure) -> CompiledStages:
    """The compiled form with further flags, and with lanes where it has them, which tests are flown without."""
    form = Form(vehicle.n_rotors, len(residual.theta), **structure)
    linearise = linearise_function(vehicle, residual, form, scalar=True)
    sources = [node_source([linearise]), stages_source(form), lanes_source(linearise)]
    return CompiledStages(form, linked_library("mpc", *((source, flags) for source in sources if source is not None)))


# Of every kind of model the one with most features, and those with other sources of C.
DIFFERENT = ("none", "gp_weighed", "blade_element_plant", "neural", "sum")


@compiled
@pytest.mark.parametrize("name", [*DIFFERENT, *slow(*(name for name in RESIDUALS if name not in DIFFERENT))])
def test_any_model(vehicle, rng, name):
    """Those in lanes, and those that choose between numbers; with thrusts as states and a disturbance."""
    vehicle = with_rotors(vehicle) if name.startswith("blade") else vehicle
    residual = make_residual(name, vehicle)
    step = Step(cached_function(vehicle, residual, lag=True, disturbed=True), 10)
    assert_written_out(step, vehicle, residual, {"lag": True, "disturbed": True}, rng)


@compiled
@pytest.mark.parametrize("rotors", [5, 8, *slow(6)])
def test_any_number_of_rotors(vehicle, rng, rotors):
    vehicle = with_rotor_count(vehicle, rotors)
    residual, form = no_residual(vehicle), FORMS["all"]
    step = Step(stages_of(vehicle, residual, "compiled", **form), 6)
    assert_written_out(step, vehicle, residual, form, rng)


@compiled
@pytest.mark.parametrize("flag", ["-O3", "-mno-avx", *slow("-mno-avx512f", "-O0")])
def test_narrower_registers_and_none(vehicle, rng, flag):
    residual = make_residual("gp_per_axis", vehicle)
    assert_written_out(Step(cached_function(vehicle, residual, flag), 10), vehicle, residual, {}, rng)


@compiled
def test_the_type_of_numbers_is_a_parameter(vehicle, rng):
    """In single precision the same step, to its rounding."""
    residual, nodes = make_residual("linear_drag", vehicle), 10
    exact = Step(stages_of(vehicle, residual, "compiled"), nodes)
    pose(exact, vehicle, residual.theta, rng)
    exact.arguments["X"][...] = exact.arguments["X_ref"][...] = exact.arguments["x0"]
    exact()
    single = cached_function(vehicle, residual, "-DREAL=float")
    arrays = [
        {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
        for shapes in array_shapes(single.form, nodes)
    ]
    for name, values in exact.arguments.items():
        arrays[0][name][...] = values
    prepare, feedback, bounded = single.on(*arrays)
    prepare(), feedback()
    scale = np.abs(exact.results["U_new"]).max()
    assert np.abs(arrays[1]["U_new"] - exact.results["U_new"]).max() < 1e-3 * scale
    exact.bounded(), bounded()
    assert arrays[1]["bounded_checks"][0] == exact.results["bounded_checks"][0] == 1
    assert np.abs(arrays[1]["bounded_U"] - exact.results["bounded_U"]).max() < 0.1


@compiled
def test_one_library_for_all_horizons(vehicle, rng):
    """Steps of two horizons in turn, on the same functions, leave each other alone; another model is another object."""
    residual = make_residual("linear_drag", vehicle)
    stages = stages_of(vehicle, residual, "compiled")
    steps = [Step(stages, nodes) for nodes in (6, 30, 6)]
    for step in steps:
        pose(step, vehicle, residual.theta, rng)
    for name, array in steps[2].arguments.items():
        array[...] = steps[0].arguments[name]
    for step in steps:
        step()
    steps[1]()
    assert all(np.array_equal(array, steps[2].results[name]) for name, array in steps[0].results.items())


@compiled
def test_threads_have_arrays_of_their_own(vehicle, rng):
    """Two steps at once, a thousand times, with the bits that each has alone."""
    residual = make_residual("gp_per_axis", vehicle)
    stages = stages_of(vehicle, residual, "compiled")
    code = ctypes.CDLL(str(stages.library))  # which lets other threads run meanwhile
    wrong = []

    def fly(seed: int) -> None:
        step = Step(stages, 10 + seed)
        pose(step, vehicle, residual.theta, np.random.default_rng(seed))
        step(), step.bounded()
        alone = {name: array.copy() for name, array in step.results.items()}
        for _ in range(1000):
            for name in ("mpc_prepare", "mpc_feedback", "mpc_bounded"):
                getattr(code, name)(*(ctypes.c_void_p(array.ctypes.data) for array in step.prepare.for_c.arrays), 0)
            wrong.extend(name for name, array in alone.items() if not np.array_equal(array, step.results[name]))

    threads = [threading.Thread(target=fly, args=(seed,)) for seed in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not wrong


BROKEN = [("X", 14), ("X", 70), ("X", 13 * 9 + 4), ("X", 13 * 10 + 1), ("U", 3), ("U", 39), ("x0", 8), ("theta", 1)]
BROKEN += [("X_ref", 40), ("X_ref", 135), ("U_ref", 30), ("Q", 60), ("R", 39), ("Q_end", 4), ("dt", 9), ("shift", 2)]


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize(("name", "place"), BROKEN)
def test_what_is_not_finite_is_seen(vehicle, rng, backend, name, place):
    """Though -ffast-math lets the compiler assume that there is no such number: a step from one, wherever it is, is not
    taken for an answer; and the next step is as if there had not been one."""
    residual = make_residual("linear_drag", vehicle)
    step = Step(stages_of(vehicle, residual, backend), 10)
    pose(step, vehicle, residual.theta, rng)
    step()
    answer = step.results["U_new"].copy()
    sound = step.arguments[name].copy()
    for value in (np.nan, np.inf, -np.inf):
        step.arguments[name].flat[place] = value
        step()
        assert not np.isfinite(step.results["checks"][0] + step.results["checks"][1])
        step.arguments[name][...] = sound
        step()
        assert np.array_equal(step.results["U_new"], answer)


def test_the_source_that_is_compiled_contains_all_of_it():
    """So the key of the cache, a hash of it, knows what changes the library; each form has a text of its own."""
    texts = [stages_source(Form(4, 0, **form)) for form in FORMS.values()]
    assert all('#include "' not in text and "mpc_bounded" in text for text in texts)
    assert len({*texts}) == len(texts) - 1  # the axes of the attitude's error are the model's
