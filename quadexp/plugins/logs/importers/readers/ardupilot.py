"""ArduPilot's data-flash log (.BIN), read by pymavlink: messages of its first estimator and IMU, NED and FRD to ENU and
FLU. https://ardupilot.org/copter/docs/logmessages.html

    XKF1, NKF1   PN PE PD, VN VE VD          position, velocity of the estimator's first core (C = 0)
    ATT          Roll Pitch Yaw (deg)        attitude
    IMU          GyrX .., AccX ..            rate, specific force of the first IMU (I = 0)
    RCOU         C1 .. C14 (us)              commands of the outputs whose SERVOn_FUNCTION is a motor (33 and on)
    BAT          Volt
"""

from __future__ import annotations

import contextlib
import io
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadexp.errors import DataError, missing_package
from quadexp.log.store import first_line
from quadexp.plugins.logs.importers.raw import RawLog, sorted_stream
from quadexp.plugins.logs.importers.readers.ulog import QUAD_X, turned

ABOUT = "ArduPilot; needs [ardupilot]"
FIRST_MOTOR = 33  # SERVOn_FUNCTION of motor 1
ESTIMATORS = ("XKF1", "NKF1")  # the first that is there
FIELDS = {
    "position": (ESTIMATORS, ("PN", "PE", "PD")),
    "velocity": (ESTIMATORS, ("VN", "VE", "VD")),
    "attitude": (("ATT",), ("Roll", "Pitch", "Yaw")),
    "rate": (("IMU",), ("GyrX", "GyrY", "GyrZ")),
    "acceleration": (("IMU",), ("AccX", "AccY", "AccZ")),
    "battery_voltage": (("BAT",), ("Volt",)),
}
KINDS = sorted({*ESTIMATORS, "ATT", "BAT", "IMU", "PARM", "RCOU"})


def recognises(path: Path, head: bytes | None) -> bool:
    return (head or b"").startswith(b"\xa3\x95\x80")


def read(path: Path, named: str) -> RawLog:
    """Streams of a log. Raises DataError where it is damaged, or has none of these messages."""
    try:
        from pymavlink import DFReader
    except ImportError:
        raise missing_package(path, "pymavlink", "ardupilot") from None
    rows: dict[str, list[dict[str, Any]]] = defaultdict(list)
    try:
        with contextlib.redirect_stderr(io.StringIO()):  # a line for each byte that is no message
            file = DFReader.DFReader_binary(str(path), zero_time_base=True)
            while (message := file.recv_match(type=KINDS)) is not None:
                row = message.to_dict()
                if row.get("C", 0) == 0 and row.get("I", row.get("Instance", 0)) == 0:
                    rows[row["mavpackettype"]].append(row)
    except Exception as error:  # damage raises what it likes
        raise DataError(f"{path}: damaged ({type(error).__name__}: {first_line(error)})") from None
    parameters = {str(row["Name"]): float(row["Value"]) for row in rows["PARM"]}
    motors = []
    outputs = {parameters.get(f"SERVO{i}_FUNCTION"): f"C{i}" for i in range(1, 15)}
    for motor in range(FIRST_MOTOR, FIRST_MOTOR + 8):
        if motor in outputs:
            motors.append(outputs[motor])
    log = RawLog("ardupilot", {}, "ardupilot")
    for name, (messages, fields) in {**FIELDS, "motor_command": (("RCOU",), motors)}.items():
        table = []
        for row in next((rows[kind] for kind in messages if rows[kind]), []):
            if all(field in row for field in fields):
                table.append([row["TimeUS"], *(row[field] for field in fields)])
        if len(table) < 2 or not fields:
            continue
        t, values = np.split(np.array(table, float), [1], axis=1)
        if name == "attitude":
            values = Rotation.from_euler("ZYX", values[:, ::-1], degrees=True).as_quat(scalar_first=True)
        if name == "motor_command":
            low = parameters.get("MOT_PWM_MIN", 1000.0) or 1000.0
            high = parameters.get("MOT_PWM_MAX", 2000.0) or 2000.0
            values = (values - low) / (high - low)
            log.layout = QUAD_X if len(motors) == 4 else None  # motors 1 to 4 of frame X
        log.streams[name] = turned(name, sorted_stream(path, name, 1e-6 * t[:, 0], values, log.notes))
    if not log.streams:
        raise DataError(f"{path}: none of the messages {', '.join(KINDS)}")
    return log
