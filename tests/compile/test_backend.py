"""The compiled back end beside the virtual machine: same numbers, and nothing else in the process changes."""

import casadi as ca
import numpy as np
import pytest

from quadexp.compile.backend import BufferedFunction, compiler, realise, realise_together

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")


def smooth_function(shift: float) -> ca.Function:
    x = ca.MX.sym("x", 3, 2)
    return ca.Function("smooth", [x], [ca.exp(-x * x) + shift, ca.sum1(x)], ["x"], ["y", "total"])


def test_compiled_equals_interpreted(tmp_path, monkeypatch, rng):
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path))
    results = []
    x = rng.normal(size=(2, 3))
    for backend in ("interpreted", "compiled"):
        function = BufferedFunction(realise(smooth_function(0.5), backend))
        function.arguments["x"][...] = x
        function()
        results.append(np.hstack([function.results["y"].ravel(), function.results["total"].ravel()]))
    assert np.allclose(*results, rtol=1e-14)


def test_loading_compiled_code_leaves_subnormals_alone(tmp_path, monkeypatch):
    """Linked with -ffast-math, the library would flush them to zero in all that runs in the process afterwards."""
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path))
    realise(smooth_function(0.25), "compiled")
    smallest = np.array([5e-324, 1e-310])
    assert np.array_equal(smallest * np.ones(2), smallest) and smallest.all()


def test_the_library_is_compiled_once(tmp_path, monkeypatch):
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path))
    for _ in range(2):
        realise(smooth_function(0.125), "compiled")
    assert sorted(path.suffix for path in tmp_path.iterdir()) == [".sha256", ".so"]


def test_functions_that_differ_in_numbers_are_compiled_once(tmp_path, monkeypatch):
    """Each has its own numbers, also where another one is loaded beside it; whole ones belong to the structure."""
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path))
    x, at = ca.SX.sym("x"), 1.7
    numbers = [(0.1, 2.3), (0.3, -1e-7), (-0.7, 1e300 / 3)]
    functions = [BufferedFunction(realise(ca.Function("line", [x], [a * x + b]), "compiled")) for a, b in numbers]
    for function, (a, b) in zip(functions, numbers, strict=True):
        next(iter(function.arguments.values()))[...] = at
        function()
        assert np.isclose(next(iter(function.results.values())).item(), a * at + b, rtol=1e-15)
    assert len(list(tmp_path.glob("*.o"))) == 1 and len(list(tmp_path.glob("*.so"))) == 3
    realise(ca.Function("line", [x], [2 * x + 0.3]), "compiled")
    assert len(list(tmp_path.glob("*.o"))) == 2


def test_each_calls_it_at_every_point(tmp_path, monkeypatch, rng):
    """The first result at many values of the first argument; the other arguments stand."""
    monkeypatch.setenv("QUADEXP_CACHE", str(tmp_path))
    x, a = ca.MX.sym("x", 3), ca.MX.sym("a", 2)
    function = ca.Function("weighed", [x, a], [ca.vertcat(a[0] * x[1], a[1] + x[2]), x[0]], ["x", "a"], ["y", "z"])
    called = BufferedFunction(realise(function, "compiled"))
    called.arguments["a"][:] = 2.0, 5.0
    values = rng.normal(size=(7, 3))
    assert np.array_equal(called.each(values), np.stack([2.0 * values[:, 1], 5.0 + values[:, 2]], axis=1))
    assert np.array_equal(called.each(values[:, ::-1])[:, 1], 5.0 + values[:, 0])  # not contiguous
    for wrong in (values[:, :2], values[0]):
        with pytest.raises(ValueError, match="weighed: must be compiled, the values"):
            called.each(wrong)
    with pytest.raises(ValueError, match="must be compiled"):
        BufferedFunction(function).each(values)


@pytest.mark.parametrize("backend", ["compiled", "interpreted"])
def test_a_layer_without_functions_of_its_own_has_none_on_any_back_end(backend):
    """As of a prediction over no time: there is no library to be made."""
    assert realise_together([], backend) == []
