"""Files and noise of versions in which vehicle.thrust_coefficient had the name static_thrust."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict

import numpy as np

from quadexp.experiment.build import build_vehicle
from quadexp.experiment.identity import digest, flight_entropy, flight_record
from quadexp.experiment.vehicle_of import own_vehicle
from quadexp.log.schema import Flight
from quadexp.parts.compose import compose


def with_former_name(record):
    return {("static_thrust" if key == "thrust_coefficient" else key): value for key, value in record.items()}


def test_the_fingerprint_is_that_of_earlier_checkpoints():
    vehicle = build_vehicle(compose(["vehicle=lei_li"]).vehicle)
    physics = {key: value for key, value in with_former_name(asdict(vehicle)).items() if key != "name"}
    assert vehicle.fingerprint == hashlib.sha256(json.dumps(physics, sort_keys=True).encode()).hexdigest()[:12]


def test_the_noise_is_that_of_earlier_flights():
    config = compose(["vehicle=lei_li", "seed=3"])
    record = flight_record(config)
    parts = []
    for group in ("vehicle", "plant", "trajectory"):
        aside = ("name", "backend", "allow_infeasible", "lost_distance", "lift", "path")  # lift came later
        parts.append({k: v for k, v in with_former_name(record[group]).items() if k not in aside and v is not None})
    assert flight_entropy(config) == int(digest(["noise", *parts, 3]), 16)


def test_an_earlier_flight_still_describes_its_vehicle():
    config = compose(["vehicle=lei_li"])
    metadata = {"config": {"vehicle": with_former_name(asdict(config.vehicle))}}
    assert own_vehicle(Flight({"t": np.zeros(1)}, metadata)) == build_vehicle(config.vehicle)
