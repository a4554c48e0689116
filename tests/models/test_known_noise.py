"""The noise that a world states is what remains of the targets when the plant's own equations are taken away."""

import numpy as np
import pytest

from quadexp.log.schema import Flight
from quadexp.models.dataset import known_noise, residual_dataset
from quadexp.models.residual import OUTPUTS
from quadexp.physics.state import ATTITUDE, N_STATE, RATE, STATE_COLUMNS, VELOCITY
from quadexp.world import PlantEffects, SimplifiedPlant

DT, SAMPLES = 0.02, 4000


def hovering(vehicle, rng, effects, *, velocity=0.0, rate=0.0, attitude=0.0):
    """Samples, each one period from rest under nearly hovering thrusts, in pairs: a transition each; and its truth."""
    plant = SimplifiedPlant(vehicle, effects, backend="interpreted")
    state, u = np.zeros((2 * SAMPLES, N_STATE)), np.empty((2 * SAMPLES, vehicle.n_rotors))
    for k in range(0, 2 * SAMPLES, 2):
        x = np.r_[np.zeros(3), 1, np.zeros(9)]
        u[k] = u[k + 1] = vehicle.hover_thrust * rng.uniform(0.9, 1.1, vehicle.n_rotors)
        state[k], state[k + 1] = x, plant.advance(x, u[k], DT, rng)[0]
    state[:, VELOCITY] += velocity * rng.standard_normal((len(state), 3))
    state[:, RATE] += rate * rng.standard_normal((len(state), 3))
    state[:, ATTITUDE][:, 1:] += attitude / 2 * rng.standard_normal((len(state), 3))
    columns = {"t": np.arange(len(state)) * DT, "segment": np.arange(len(state)) // 2}
    columns |= {name: state[:, i] for i, name in enumerate(STATE_COLUMNS)}
    columns |= {f"u_{i}": u[:, i] for i in range(vehicle.n_rotors)}
    return Flight(columns, {"vehicle": {"name": vehicle.name, "fingerprint": vehicle.fingerprint}}), plant


@pytest.mark.parametrize(
    "told",
    [{}, {"velocity": 0.03, "rate": 0.05}, {"attitude": 0.01}],
    ids=["process noise", "velocity and rate", "attitude"],
)
def test_what_the_plant_does_not_explain_is_the_known_noise(vehicle, rng, told):
    effects = PlantEffects(
        (0.0,) * 3, (0.0,) * 3, motor_noise_density=5e-4, force_noise_density=0.02, torque_noise_density=0.001,
        motor_loss=0.05,
    )  # fmt: skip
    flight, plant = hovering(vehicle, rng, effects, **told)
    data = residual_dataset([flight], vehicle)
    features = ["v_x", "v_y", "v_z", "w_x", "w_y", "w_z", "u_0", "u_1", "u_2", "u_3"]
    left = data.matrix(OUTPUTS) - plant.residual()(data.matrix(features))
    world = {
        "plant": {
            "kind": "simplified",
            "motor_noise_density": 5e-4,
            "force_noise_density": 0.02,
            "torque_noise_density": 0.001,
        },
        "estimator": {f"{name}_noise": told.get(name, 0.0) for name in ("velocity", "rate", "attitude")},
    }
    known = known_noise(data, vehicle, [world], of_estimate=True)
    assert known is not None and data.n_rows == SAMPLES
    assert np.sqrt(np.mean(left**2, axis=0)) == pytest.approx(list(known.values()), rel=0.05)
    blind = known_noise(data, vehicle, [world], of_estimate=False)
    assert told or blind == known


def test_what_states_no_noise_is_not_guessed(vehicle, rng):
    flight, _ = hovering(vehicle, rng, PlantEffects.none())
    data = residual_dataset([flight], vehicle)
    assert known_noise(data, vehicle, [{"plant": {"kind": "custom"}}], of_estimate=True) is None
    filtered = {"plant": {"kind": "simplified"}, "estimator": {"name": "eskf"}}
    assert known_noise(data, vehicle, [filtered], of_estimate=True) is None
    assert known_noise(data, vehicle, [filtered], of_estimate=False) is not None
