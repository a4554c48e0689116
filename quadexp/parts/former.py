"""What earlier versions called otherwise (docs/migrating.md): keys and options are refused by name with what stands for
them today; the former way to name what an option stands for, `defaults: [/schema/GROUP/NAME@_here_, _self_]`, is read
for one release, with a note.
"""

from __future__ import annotations

import re
from pathlib import Path

from quadexp.errors import UsageError
from quadexp.messages import note

FORMER_TARGET = "_former_"  # key of a node: the class that stands for a user's part of the former form

_HOSTS = "start `dask scheduler` and `dask worker` on the hosts, and give engine=dask engine.address=tls://HEAD:PORT"
_TLS = "what is started here is always encrypted, and engine.address says by tls:// or tcp:// whether it is"
_DASK = "give Dask's own settings, DASK_DISTRIBUTED__COMM__TLS__CA_FILE and others (docs/scaling.md)"
_JOBS = "engine=jobs 'engine.options={{{}}}'"

_DELAYS = "remedies=auto finds delays in flight; `quadexp identify --method delays FLIGHT` finds them in a flight"

FORMER = {
    "delay=identified": _DELAYS,
    "delay.after": _DELAYS,
    "delay.assumed": _DELAYS,
    "remedies=unknown_delays": "remedies=auto",
    "remedies=unknown_vehicle": "remedies=auto; its observer and INDI by keys: docs/migrating.md",
    "remedies=all": "remedies=auto; delays that are known are told as docs/delays.md does, all together",
    "engine=slurm": "engine=jobs (engine.system=slurm), and what its queue takes in engine.options",
    "engine.tls": _TLS,
    "engine.hosts": _HOSTS,
    "engine.remote_python": _HOSTS,
    "engine.queue": _JOBS.format("queue: NAME"),
    "engine.account": _JOBS.format("account: NAME"),
    "engine.walltime": _JOBS.format("walltime: HH:MM:SS"),
    "engine.job_memory": _JOBS.format("memory: 3GB"),
    "engine.directives": _JOBS.format("job_extra_directives: [...]"),
    "engine.prologue": _JOBS.format("job_script_prologue: [...]"),
    "engine.shared": _JOBS.format("shared_temp_directory: FOLDER"),
    "engine.interface": _JOBS.format("interface: ib0"),
    "plant.payload": "payload=fixed payload.mass=KG; on plant=blade_element also plant.schedule=[{t: 0, payload: KG}]",
    "gp.split": "whole flights are held out, always",
    "gp.alternatives": "fit again with other gp.features.a_x=[..], whose verdict says what they are worth",
    "gp.max_exact_rows": "gp.method=subset gp.inducing=ROWS",
    "nn.device": "networks train on the CPU",
    "engine.tls_ca": _DASK,
    "engine.tls_cert": _DASK,
    "engine.tls_key": _DASK,
    "engine.python": _JOBS.format("python: PATH"),
}

# Former names that no option has today, and their classes; any other is that of the option of the same name.
FORMER_CLASSES = {
    "vehicle/rigid": "physics.vehicle.Vehicle",
    "plant/custom": "experiment.former_parts.FormerPlant",
    "link/none": "parts.part.Nothing",
    "actuator/motors": "world.actuator.Actuator",
    "battery/circuit": "world.battery.Battery",
    "sensor/accelerometer": "world.sensors.Sensors",
    "trajectory/custom": "experiment.former_parts.FormerTrajectory",
    "trajectory/lei_li_circle": "reference.lei_li.LeiLiCircle",
    "trajectory/rectangle": "reference.lei_li.Rectangle",
    "controller/mpc": "control.mpc.part.MPC",
    "controller/feedback": "control.feedback.controller.Feedback",
    "controller/cascade": "control.laws.cascade.Cascade",
    "controller/custom": "experiment.former_parts.FormerController",
    "controller/custom_residual_mpc": "experiment.former_parts.FormerResidualMPC",
    "collect/flights": "experiment.collect_settings.CollectConfig",
    "gp/sparse": "models.gaussian_process.GPConfig",
    "drag/linear": "models.linear_drag.DragConfig",
    "nn/mlp": "models.neural.NNConfig",
}
_SCHEMA = re.compile(r"/schema/(\w+/\w+)@_here_")


def refuse_former(text: str, where: str = "") -> None:
    """UsageError where a key, or GROUP=OPTION, is of an earlier version. where: the file that says so."""
    if text in FORMER:
        raise UsageError(f"{where}{text}: is no more; instead: {FORMER[text]}")


def former_name(default: str, file: Path) -> str:
    """GROUP/NAME of the former form, "" for another entry of `defaults`. Says once for a file what replaces it."""
    match = _SCHEMA.fullmatch(default)
    if match is None:
        return ""
    note(f"{file}: defaults: [{default}] is the former form of `_target_: MODULE.CLASS` (docs/migrating.md)")
    return match[1]
