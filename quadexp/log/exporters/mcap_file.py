"""A flight as MCAP: JSON messages with Foxglove's well-known schemas, and every column as it is.

    /pose, /reference/pose     foxglove.PoseInFrame         world ENU, body FLU
    /tf                        foxglove.FrameTransform      world -> body
    /path, /reference/path     foxglove.PosesInFrame        once, at the start
    /flight                    quadexp.Sample               all columns of the flight, units in the schema
    metadata "quadexp"         the flight's record, as JSON

Time is nanoseconds from the start of the flight.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

import numpy as np

from quadexp import __version__
from quadexp.errors import missing_package
from quadexp.log.schema import Flight, describe
from quadexp.writer import written

PATH_POINTS = 2000

_STAMP = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_NUMBERS = {
    name: {"type": "object", "properties": {axis: {"type": "number"} for axis in axes}}
    for name, axes in (("vector", "xyz"), ("quaternion", "xyzw"))
}
_POSE = {"type": "object", "properties": {"position": _NUMBERS["vector"], "orientation": _NUMBERS["quaternion"]}}
_TEXT = {"type": "string"}
SCHEMAS = {
    "foxglove.PoseInFrame": {"timestamp": _STAMP, "frame_id": _TEXT, "pose": _POSE},
    "foxglove.PosesInFrame": {"timestamp": _STAMP, "frame_id": _TEXT, "poses": {"type": "array", "items": _POSE}},
    "foxglove.FrameTransform": {
        "timestamp": _STAMP, "parent_frame_id": _TEXT, "child_frame_id": _TEXT,
        "translation": _NUMBERS["vector"], "rotation": _NUMBERS["quaternion"],
    },
}  # fmt: skip


def write(flight: Flight, path: Path, *, force: bool = True) -> dict[str, Path]:
    """Write the file; UsageError where the package is missing."""
    try:
        importlib.import_module("mcap")
    except ImportError:
        raise missing_package("--to mcap", "mcap", "viz") from None
    from mcap.writer import Writer

    with written(path, force=force) as file:
        writer = Writer(file)
        writer.start(profile="", library=f"quadexp {__version__}")
        channels = {
            topic: writer.register_channel(topic, "json", _schema(writer, name, properties))
            for topic, name, properties in _channels(flight)
        }

        def send(topic: str, time: float, message: dict[str, Any]) -> None:
            nanoseconds = round(1e9 * time)
            data = json.dumps(message, allow_nan=False).encode()
            writer.add_message(channels[topic], log_time=nanoseconds, data=data, publish_time=nanoseconds)

        times, start = flight.t.tolist(), float(flight.t[0])
        poses = {"": _poses(flight, ""), "/reference": _poses(flight, "ref_")}
        poses = {prefix: made for prefix, made in poses.items() if made}
        for prefix, made in poses.items():
            every = -(-len(made) // PATH_POINTS)
            send(f"{prefix}/path", start, _framed(start) | {"poses": made[::every]})
        names = list(flight.columns)
        rows = zip(*(_finite(flight[name]) for name in names), strict=True)
        for k, (time, row) in enumerate(zip(times, rows, strict=True)):
            send("/flight", time, dict(zip(names, row, strict=True)))
            for prefix, made in poses.items():
                send(f"{prefix}/pose", time, _framed(time) | {"pose": made[k]})
            pose = poses[""][k]
            send(
                "/tf",
                time,
                {
                    "timestamp": _stamp(time), "parent_frame_id": "world", "child_frame_id": "body",
                    "translation": pose["position"], "rotation": pose["orientation"],
                },
            )  # fmt: skip
        writer.add_metadata("quadexp", {"record": json.dumps(flight.metadata, sort_keys=True)})
        writer.finish()
    return {"mcap": path}


def _channels(flight: Flight) -> list[tuple[str, str, dict[str, Any]]]:
    """Topic, schema name and properties of every channel."""
    columns = {}
    for name in flight.columns:
        column = describe(name)
        words = [column.description, f"[{column.unit or '1'}{', ' + column.frame if column.frame else ''}]"]
        columns[name] = {"type": ["number", "null"], "description": " ".join(filter(None, words))}
    prefixes = ["", "/reference"] if "ref_p_x" in flight.columns else [""]
    framed = [(f"{p}/pose", "foxglove.PoseInFrame") for p in prefixes]
    framed += [(f"{p}/path", "foxglove.PosesInFrame") for p in prefixes] + [("/tf", "foxglove.FrameTransform")]
    return [(topic, name, SCHEMAS[name]) for topic, name in framed] + [("/flight", "quadexp.Sample", columns)]


def _schema(writer: Any, name: str, properties: dict[str, Any]) -> int:
    data = json.dumps({"title": name, "type": "object", "properties": properties}).encode()
    return writer.register_schema(name, "jsonschema", data)


def _poses(flight: Flight, prefix: str) -> list[dict[str, Any]]:
    if f"{prefix}p_x" not in flight.columns:
        return []
    position = flight.stack([f"{prefix}p_{axis}" for axis in "xyz"]).tolist()
    attitude = flight.stack([f"{prefix}q_{axis}" for axis in "xyzw"]).tolist()
    return [
        {"position": dict(zip("xyz", p, strict=True)), "orientation": dict(zip("xyzw", q, strict=True))}
        for p, q in zip(position, attitude, strict=True)
    ]


def _framed(time: float) -> dict[str, Any]:
    return {"timestamp": _stamp(time), "frame_id": "world"}


def _stamp(time: float) -> dict[str, int]:
    return dict(zip(("sec", "nsec"), divmod(round(1e9 * time), 1_000_000_000), strict=True))


def _finite(values: np.ndarray) -> list[Any]:
    """JSON has no NaN: null stands for it."""
    finite = np.isfinite(values).tolist()
    return [value if good else None for value, good in zip(values.tolist(), finite, strict=True)]
