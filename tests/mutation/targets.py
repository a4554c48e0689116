"""Which files are mutated, and which fast tests must notice; the ones that notice most come first."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path

MECHANICS = (
    "tests/properties/test_mechanics.py",
    "tests/dynamics/test_rigid_body.py",
    "tests/properties/test_frames.py",
    "tests/properties/test_integrators.py",
    "tests/properties/test_symmetry.py",
)
AIR = ("tests/dynamics/test_blade_element.py", "tests/properties/test_blade_limits.py")
STEP = (
    "tests/control/test_riccati.py",
    "tests/control/test_attitude_guard.py",
    "tests/control/test_step.py",
    "tests/control/test_active_set.py",
    "tests/control/test_dual_active_set.py",
    "tests/properties/test_optimality.py",
    "tests/control/test_mpc.py",
    "tests/stress",
    "tests/properties/test_closed_loop.py",
)
JACOBIANS = ("tests/dynamics/test_sensitivity.py", "tests/properties/test_jacobians.py")
RESIDUAL = ("tests/residual", "tests/properties/test_jacobians.py", "tests/plant/test_blade_element.py")

TARGETS: dict[str, tuple[str, ...]] = {
    "quadexp/rotation.py": MECHANICS,
    "quadexp/rotor.py": (*AIR, "tests/residual"),
    "quadexp/dynamics/rigid_body.py": MECHANICS,
    "quadexp/dynamics/integrator.py": MECHANICS,
    "quadexp/dynamics/scalars.py": JACOBIANS,
    "quadexp/dynamics/sensitivity.py": JACOBIANS,
    "quadexp/dynamics/drag.py": (*RESIDUAL, "tests/plant/test_simplified.py"),
    "quadexp/dynamics/motor.py": (*RESIDUAL, "tests/plant/test_simplified.py"),
    "quadexp/dynamics/blade_element.py": AIR,
    "quadexp/dynamics/aerodynamic_point.py": AIR,
    "quadexp/dynamics/induced_velocity.py": ("tests/dynamics/test_induced_velocity.py", *AIR),
    "quadexp/plant/simplified.py": (
        "tests/residual/test_contract.py",
        "tests/plant/test_simplified.py",
        "tests/properties/test_mechanics.py",
        "tests/properties/test_symmetry.py",
    ),
    "quadexp/plant/period.py": (
        "tests/plant/test_simplified.py",
        "tests/plant/test_blade_element.py",
        "tests/properties/test_mechanics.py",
    ),
    "quadexp/plant/blade_element*.py": (
        "tests/plant/test_blade_element_flight.py",
        "tests/plant/test_blade_element.py",
        "tests/properties/test_mechanics.py",
        "tests/properties/test_symmetry.py",
        "tests/properties/test_blade_limits.py",
    ),
    "quadexp/residual/*.py": (*RESIDUAL, "tests/dynamics/test_sensitivity.py"),
    "quadexp/control/step.py": STEP,
    "quadexp/control/attitude_error.py": STEP,
    "quadexp/control/subproblem.py": STEP,
    "quadexp/control/riccati*": ("tests/control/test_riccati.py", "tests/control/test_active_set.py"),
    "quadexp/residual/gp_sums.c": ("tests/residual/test_compiled_sums.py",),
    "quadexp/control/active_set.*": ("tests/control/test_active_set.py", "tests/control/test_step.py"),
    "quadexp/control/dual_active_set.py": ("tests/control/test_dual_active_set.py", "tests/control/test_active_set.py"),
    "quadexp/control/first_solve.py": ("tests/control/test_first_solve.py", *STEP),
    "quadexp/control/mpc.py": STEP[1:] + STEP[:1],
    "quadexp/trajectory/flat*.py": (
        "tests/trajectory/test_flat_map.py",
        "tests/trajectory/test_flatness.py",
        "tests/properties/test_flatness.py",
    ),
    "quadexp/trajectory/motion.py": (
        "tests/trajectory/test_motion.py",
        "tests/trajectory/test_flatness.py",
        "tests/properties/test_flatness.py",
    ),
    "quadexp/trajectory/air_step.py": ("tests/trajectory/test_air_step.py", "tests/trajectory/test_fixed_point.py"),
    "quadexp/identify/rls_step.py": ("tests/identify/test_rls.py", "tests/properties/test_identification.py"),
}
COMPILED = ("*.c", "quadexp/control/riccati.py")


def runs_compiled(file: str) -> bool:
    """Whether the tests of a mutated file must compile: the change is in C, or in what no interpreted code contains."""
    return any(fnmatch(file, pattern) for pattern in COMPILED)


def fast_tests(file: str, root: Path) -> list[str]:
    """Test files for a mutated file, those that exist."""
    for pattern, tests in TARGETS.items():
        if fnmatch(file, pattern):
            return [test for test in tests if (root / test).exists()]
    raise KeyError(file)


def target_files(root: Path) -> list[str]:
    """All files to mutate, by path in the repository."""
    found = {path.relative_to(root).as_posix(): None for pattern in TARGETS for path in sorted(root.glob(pattern))}
    return [name for name in found if not name.endswith("__init__.py")]
