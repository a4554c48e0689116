"""The former way to name what an option stands for, `defaults: [/schema/GROUP/NAME@_here_, _self_]`, for one release.

Each such name is a configuration of Hydra that says `_target_` (option_files.py warns); the ones called custom name
parts of users that are no subclass of Part: see quadexp/experiment/former_parts.py.
"""

from __future__ import annotations

from quadexp.parts.part import TARGET

FORMER = "_former_"  # key of a node: the class that stands for a part of the former form

_CLASSES = """
vehicle/rigid physics.vehicle.Vehicle
plant/simplified world.simplified.Simplified
plant/from_model world.from_model.FromModel
plant/blade_element world.blade_element.BladeElement
plant/rotorpy world.rotorpy.RotorPy
plant/drone_models world.drone_models.DroneModels
plant/custom experiment.former_parts.FormerPlant
truth/nominal world.true_vehicle.TrueVehicle
payload/none parts.part.Nothing
payload/fixed world.true_vehicle.FixedPayload
payload/slung world.slung_load.SlungLoad
wind/none parts.part.Nothing
wind/constant world.constant_wind.ConstantWind
wind/gust world.gust.Gust
wind/dryden world.dryden.Dryden
wind/file world.wind_record.WindFromFile
external/none parts.part.Nothing
external/push world.disturbance.Disturbance
link/ideal parts.part.Nothing
link/latency world.link.Latency
actuator/motors world.actuator.Actuator
battery/none parts.part.Nothing
battery/circuit world.battery.Battery
health/rotor_loss world.rotor_loss.RotorLoss
ground/none parts.part.Nothing
ground/cheeseman_bennett world.ground.GroundEffect
sensor/accelerometer world.accelerometer.AccelerometerPart
sensor/imu_mocap world.inertial.ImuMocap
sensor/imu_gnss world.inertial.ImuGnss
estimator/none world.stated_estimate.StatedEstimate
estimator/eskf world.navigation.Navigation
trajectory/circle reference.circle.Circle
trajectory/ellipse reference.ellipse.Ellipse
trajectory/lemniscate reference.lemniscate.Lemniscate
trajectory/random reference.random_polynomial.RandomPolynomial
trajectory/hover reference.hover.Hover
trajectory/step reference.step.Step
trajectory/file reference.from_file.FileTrajectory
trajectory/rectangle reference.rectangle.Rectangle
trajectory/lei_li_circle reference.lei_li_circle.LeiLiCircle
trajectory/custom experiment.former_parts.FormerTrajectory
controller/mpc control.mpc.part.MPC
controller/feedback control.feedback.controller.Feedback
controller/dfbc control.dfbc.controller.FlatnessBased
controller/rls_mpc control.mpc.rls_mpc.RLSMPC
controller/sum_mpc control.mpc.part.SumMPC
controller/online_mpc control.mpc.online_mpc.OnlineMPC
controller/geometric control.laws.geometric.Geometric
controller/cascade control.laws.cascade.Cascade
controller/raptor control.laws.raptor.Raptor
controller/rotorpy_se3 control.laws.rotorpy_se3.RotorPySE3
controller/custom experiment.former_parts.FormerController
controller/custom_residual_mpc experiment.former_parts.FormerResidualMPC
observer/none parts.part.Nothing
observer/disturbance control.observers.disturbance.DisturbanceObserver
observer/wind control.observers.wind.WindObserver
adaptive/none parts.part.Nothing
adaptive/l1 control.l1.L1
inner/none parts.part.Nothing
inner/indi control.indi.loop.INDIPart
delay/none parts.part.Nothing
delay/strapdown control.delay.strapdown.StrapdownPart
delay/prediction control.delay.prediction.PredictionPart
delay/identified control.delay.identified.IdentifiedPart
collect/flights experiment.collect_settings.CollectConfig
gp/sparse models.settings.GPConfig
drag/linear models.settings.DragConfig
nn/mlp models.settings.NNConfig
engine/local sweeps.engine_settings.EngineConfig
engine/dask sweeps.engine_settings.DaskConfig
engine/jobs sweeps.engine_settings.JobsConfig
"""


def former_nodes() -> dict[tuple[str, str], dict[str, str]]:
    """(group, name) -> what the former name stands for."""
    found = {}
    for line in _CLASSES.strip().splitlines():
        name, _, path = line.partition(" ")
        group, _, kind = name.partition("/")
        found[group, kind] = {FORMER if kind.startswith("custom") else TARGET: f"quadexp.{path}"}
    return found
