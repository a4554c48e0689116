"""Which files are mutated, and which fast tests must notice; the ones that notice most come first."""

from fnmatch import fnmatch
from pathlib import Path

MECHANICS = (
    "tests/properties/test_mechanics.py",
    "tests/physics/test_rigid_body.py",
    "tests/properties/test_frames.py",
    "tests/properties/test_integrators.py",
    "tests/properties/test_symmetry.py",
)
AIR = ("tests/plugins/aerodynamics/test_blade_element.py", "tests/properties/test_blade_limits.py")
STEP = (
    "tests/control/mpc/test_riccati.py",
    "tests/control/mpc/test_step.py",
    "tests/control/mpc/test_active_set.py",
    "tests/properties/test_optimality.py",
    "tests/control/mpc/test_mpc.py",
    "tests/stress",
    "tests/properties/test_closed_loop.py",
)
JACOBIANS = ("tests/physics/test_sensitivity.py", "tests/properties/test_jacobians.py")
DELAYS = (
    "tests/plugins/remedies/delay",
    "tests/plugins/identification/test_identify_delays.py",
    "tests/plugins/remedies/test_delay_remedies.py",
)
RESIDUAL = (
    "tests/models/test_residuals.py", "tests/plugins/papers/test_blade_residual.py",
    "tests/plugins/aerodynamics/test_terms.py",
    "tests/properties/test_jacobians.py", "tests/plugins/papers/test_plant.py",
)  # fmt: skip

TARGETS: dict[str, tuple[str, ...]] = {
    "quadexp/physics/rotation.py": ("tests/physics/test_rotation.py", *MECHANICS),
    "quadexp/physics/rotor.py": (*AIR, "tests/plugins/papers/test_blade_residual.py"),
    "quadexp/plugins/aerodynamics/coefficients.py": (*AIR, "tests/plugins/papers/test_blade_residual.py"),
    "quadexp/physics/rigid_body.py": MECHANICS,
    "quadexp/physics/integrator.py": MECHANICS,
    "quadexp/physics/scalars.py": JACOBIANS,
    "quadexp/physics/sensitivity.py": JACOBIANS,
    "quadexp/physics/drag.py": (*RESIDUAL, "tests/world/test_simplified.py"),
    "quadexp/physics/motor.py": ("tests/physics/test_motor.py", *RESIDUAL, "tests/world/test_simplified.py"),
    "quadexp/plugins/aerodynamics/blade_element.py": AIR,
    "quadexp/plugins/aerodynamics/induced_velocity.py": ("tests/plugins/aerodynamics/test_induced_velocity.py", *AIR),
    "quadexp/world/simplified.py": (
        "tests/models/test_residuals.py",
        "tests/world/test_simplified.py",
        "tests/properties/test_mechanics.py",
        "tests/properties/test_symmetry.py",
    ),
    "quadexp/world/integrator.py": (
        "tests/world/test_simplified.py",
        "tests/plugins/papers/test_plant.py",
        "tests/properties/test_mechanics.py",
    ),
    "quadexp/plugins/papers/lei_li/plant*.py": (
        "tests/plugins/papers/test_plant.py",
        "tests/properties/test_mechanics.py",
        "tests/properties/test_symmetry.py",
        "tests/properties/test_blade_limits.py",
    ),
    "quadexp/plugins/remedies/online.py": ("tests/plugins/remedies/test_online.py",),
    "quadexp/plugins/remedies/adapt_block.c": ("tests/plugins/remedies/test_online.py",),
    "quadexp/plugins/neural/neural_*.c": ("tests/models/test_residuals.py", "tests/plugins/neural/test_neural.py"),
    "quadexp/models/residual.py": RESIDUAL,
    "quadexp/plugins/identification/inflow.py": RESIDUAL,
    "quadexp/plugins/aerodynamics/terms.py": RESIDUAL,
    "quadexp/models/linear_drag.py": (*RESIDUAL, "tests/models/test_linear_drag.py"),
    "quadexp/plugins/gaussian_process/gaussian_process.py": (
        *RESIDUAL,
        "tests/plugins/gaussian_process/test_gp_fit.py",
    ),
    "quadexp/plugins/neural/neural.py": (*RESIDUAL, "tests/plugins/neural/test_neural.py"),
    "quadexp/plugins/papers/lei_li/blade_element.py": (*RESIDUAL, "tests/plugins/papers/test_blade_fit.py"),
    "quadexp/plugins/remedies/observers/*.py": ("tests/plugins/remedies/test_observers.py",),
    "quadexp/control/delivered.py": (
        "tests/plugins/remedies/test_sent_commands.py",
        "tests/plugins/remedies/delay/test_prediction.py",
        "tests/plugins/remedies/test_observers.py",
    ),
    "quadexp/plugins/remedies/believed_world.py": (
        "tests/plugins/remedies/test_believed_world.py",
        "tests/plugins/remedies/test_observers.py",
    ),
    "quadexp/plugins/remedies/targets.py": (
        "tests/plugins/remedies/test_targets.py",
        "tests/plugins/remedies/test_believed_world.py",
        "tests/plugins/remedies/test_observers.py",
    ),
    "quadexp/plugins/remedies/online_mpc.py": ("tests/plugins/remedies/test_online_mpc.py",),
    "quadexp/plugins/identification/timing.py": DELAYS,
    "quadexp/plugins/identification/moments.py": DELAYS,
    "quadexp/plugins/remedies/delay/*.py": DELAYS,
    "quadexp/plugins/remedies/indi.py": ("tests/plugins/remedies/test_indi.py",),
    "quadexp/plugins/remedies/l1.py": ("tests/plugins/remedies/test_l1.py",),
    "quadexp/plugins/remedies/sent_commands.py": ("tests/plugins/remedies/test_sent_commands.py",),
    "quadexp/plugins/laws/allocation.py": (
        "tests/plugins/laws/test_allocation.py",
        "tests/plugins/laws/test_desaturation.py",
    ),
    "quadexp/plugins/laws/dfbc.py": ("tests/plugins/laws/test_dfbc.py",),
    "quadexp/control/laws/[!r]*.py": ("tests/control/laws",),
    "quadexp/control/mpc/step.py": STEP,
    "quadexp/control/mpc/attitude_error.py": STEP,
    "quadexp/control/mpc/node.py": STEP,
    "quadexp/control/mpc/interpreted.py": STEP,
    "quadexp/control/mpc/stages.*": STEP,
    "quadexp/control/mpc/riccati*": ("tests/control/mpc/test_riccati.py", "tests/control/mpc/test_active_set.py"),
    "quadexp/plugins/gaussian_process/gp_sums.c": ("tests/models/test_residuals.py",),
    "quadexp/control/mpc/active_set.*": ("tests/control/mpc/test_active_set.py", "tests/control/mpc/test_step.py"),
    "quadexp/control/mpc/first_solve.py": ("tests/control/mpc/test_first_solve.py", *STEP),
    "quadexp/control/mpc/mpc.py": STEP[1:] + STEP[:1],
    "quadexp/control/mpc/dead_time.py": ("tests/control/mpc/test_dead_time.py", "tests/control/mpc/test_motor_lead.py"),
    "quadexp/control/mpc/prediction.py": (
        "tests/control/mpc/test_dead_time.py",
        "tests/control/mpc/test_first_solve.py",
    ),
    "quadexp/plugins/margins/linear_loop.py": ("tests/plugins/margins/test_linear_loop.py",),
    "quadexp/plugins/margins/linearised.py": ("tests/plugins/margins/test_linear_loop.py",),
    "quadexp/plugins/margins/remembered.py": ("tests/plugins/margins/test_linear_loop.py",),
    "quadexp/reference/flat*.py": (
        "tests/reference/test_flat_map.py",
        "tests/reference/test_limits.py",
        "tests/reference/test_flatness.py",
        "tests/properties/test_flatness.py",
    ),
    "quadexp/reference/motion.py": (
        "tests/reference/test_limits.py",
        "tests/reference/test_flatness.py",
        "tests/properties/test_flatness.py",
    ),
    "quadexp/reference/air_step.py": ("tests/reference/test_flat_map.py", "tests/reference/test_fixed_point.py"),
    "quadexp/reference/traced.py": ("tests/reference/test_air_model.py",),
    "quadexp/experiment/flight.c": ("tests/experiment/test_compiled_flight.py",),
    "quadexp/control/*loop.*": ("tests/control/test_compiled_loop.py", "tests/experiment/test_compiled_flight.py"),
    "quadexp/plugins/papers/lei_li/rls.py": (
        "tests/plugins/papers/test_rls.py",
        "tests/properties/test_identification.py",
    ),
}
COMPILED = ("*.c", "quadexp/plugins/remedies/online.py", "quadexp/control/mpc/stages.py", "quadexp/reference/traced.py")


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
