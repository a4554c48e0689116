"""RotorPy's plant, flown, identified and exported, gives RotorPy's own numbers back."""

import pytest

from quadexp.experiment.evaluate import fly_one
from quadexp.parts.compose import compose
from quadexp.plugins.exchange.known import known_of
from quadexp.plugins.exchange.simulators import rotorpy
from quadexp.plugins.identification.vehicle_model import FitSettings, fit_vehicle_model
from tests.plugins.exchange.models import HUMMINGBIRD, VEHICLES

PLANT = ["vehicle=hummingbird", "plant=rotorpy", "controller=nominal_mpc", "trajectory=lemniscate"]


def test_flown_identified_exported():
    """Two flights of 10 and 16 s at 3 and 6 m/s, with neither noise nor what RotorPy's file says of the air."""
    flights = [fly_one(compose([*PLANT, f"trajectory.speed={speed}", f"seed={speed}"])) for speed in (3, 6)]
    settings = FitSettings(signal="rotor_speed", induced=False)
    model = fit_vehicle_model(flights, VEHICLES["hummingbird"], settings, names=["slow", "fast"], best="blade_element")
    numbers = rotorpy(known_of(VEHICLES["hummingbird"], model)).numbers
    for name in ("k_d", "k_z", "k_h", "k_eta", "c_Dx", "c_Dy"):
        assert numbers[name].value == pytest.approx(HUMMINGBIRD[name], rel=2e-3), name
        assert abs(numbers[name].value - HUMMINGBIRD[name]) < numbers[name].half_width, name
