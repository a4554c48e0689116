"""The compiled back end beside the virtual machine: same numbers, and nothing else in the process changes."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from quadexp.compile.backend import BufferedFunction, compiler, realise

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
