"""PX4's ULog, read by pyulog. The layout is declared by the file, so it is checked before any data is taken in."""

from __future__ import annotations

import contextlib
import io
import struct
from pathlib import Path
from typing import Any

import numpy as np

from quadexp.errors import DataError, QuadexpError, missing_package
from quadexp.log.importers.px4 import TOPICS, read_topics
from quadexp.log.importers.raw import RawLog
from quadexp.log.store import first_line

LARGEST = 4 << 30  # bytes
MOST_DAMAGES = 2000  # places where the reader had to find its way again
MESSAGE = 1 << 16  # bytes a message can have at most
_SIZES = {"int8_t": 1, "uint8_t": 1, "bool": 1, "char": 1, "int16_t": 2, "uint16_t": 2, "int32_t": 4, "uint32_t": 4,
          "float": 4, "int64_t": 8, "uint64_t": 8, "double": 8}  # fmt: skip


ABOUT = "PX4"


def recognises(path: Path, head: bytes | None) -> int:
    return 2 * (head or b"").startswith(b"ULog\x01\x12\x35")


def read(path: Path, named: str) -> RawLog:
    """Streams of a ULog. Raises DataError where it is damaged beyond use or has no topic of a flight."""
    size = path.stat().st_size
    if size > LARGEST:
        raise DataError(f"{path}: {size / 2**30:.1f} GB; at most {LARGEST >> 30} GB are read: cut the log into pieces")
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            log = _reader(path)(str(path), TOPICS)
    except QuadexpError as error:
        raise DataError(f"{path}: {error}") from None
    except (struct.error, ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError, OSError) as error:
        raise DataError(f"{path}: not a ULog, or damaged ({type(error).__name__}: {first_line(error)})") from None
    except Exception as error:  # pyulog's own have no common ancestor of use
        raise DataError(f"{path}: {first_line(error)}") from None
    topics: dict[str, list[dict[str, np.ndarray]]] = {}
    for data in sorted(log.data_list, key=lambda one: one.multi_id):
        if "timestamp" in data.data and len(data.data["timestamp"]):
            topics.setdefault(data.name, []).append(data.data)
    if not topics:
        raise DataError(f"{path}: a ULog without data of {', '.join(TOPICS[-3:])}: truncated, or no flight was logged")
    parameters = {key: value for key, value in log.initial_parameters.items() if isinstance(value, (int, float))}
    raw = read_topics(path, topics, parameters)
    if log.file_corruption or "corruption" in printed.getvalue():
        raw.notes.append("the file is damaged in places: what could be read was")
    if log.dropouts:
        lost = sum(one.duration for one in log.dropouts) / 1000
        raw.notes.append(f"{len(log.dropouts)} dropouts of the logger, {lost:.2g} s in all")
    for key in ("ver_sw_release_str", "sys_name", "ver_hw"):
        if key in log.msg_info_dict:
            raw.about[key] = str(log.msg_info_dict[key])
    return raw


def _reader(path: Path) -> Any:
    """pyulog's class, refusing files that declare messages that cannot be, or that are damaged all over."""
    try:
        from pyulog import ULog
    except ImportError:
        raise missing_package(path, "pyulog", "logs") from None

    class Checked(ULog):
        damages = 0

        def _read_file_definitions(self) -> None:
            super()._read_file_definitions()
            check_formats({name: made.fields for name, made in self._message_formats.items()})

        def _check_packet_corruption(self, header: Any) -> bool:
            damaged = super()._check_packet_corruption(header)
            self.damages += damaged
            if self.damages > MOST_DAMAGES:
                raise DataError(f"damaged in more than {MOST_DAMAGES} places")
            return damaged

    return Checked


def check_formats(formats: dict[str, Any]) -> None:
    """Refuse a message whose declared size no message can have, or that contains itself. Raises DataError."""

    def size(name: str, above: tuple[str, ...]) -> int:
        if name in above:
            raise DataError(f"its format {name!r} contains itself")
        total = 0
        for kind, count, _ in formats[name]:
            if count < 0:
                raise DataError(f"its format {name!r} declares an array of {count}")
            inner = _SIZES.get(kind) or (size(kind, (*above, name)) if kind in formats else MESSAGE)
            total += inner * max(count, 1)
            if total > MESSAGE:
                raise DataError(f"its format {name!r} declares more than the {MESSAGE} bytes of a message")
        return total

    for name in formats:
        if name in TOPICS:
            size(name, ())
