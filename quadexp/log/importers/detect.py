"""Which format a file is in, by its content, not by its name."""

from __future__ import annotations

from pathlib import Path

from quadexp.errors import DataError, UsageError

MAGIC = {
    b"ULog\x01\x12\x35": "ulog",
    b"\x89HDF\r\n\x1a\n": "hdf5",
    b"PAR1": "parquet",
    b"\x89MCAP0\r\n": "mcap",
    b"#ROSBAG V": "rosbag",
    b"SQLite format 3\x00": "rosbag",
    b"RRF2": "rerun",
    b"RRIO": "rerun",
}
TEXT_SHARE = 0.97  # of the first bytes that must be printable for a file to be text


def detect(path: Path) -> str:
    """ "ulog", "hdf5", "parquet", "mcap", "rosbag", "rerun", "px4csv" (a folder), or "text".

    Raises UsageError where there is no such file, DataError where it is empty or in none of these formats.
    """
    if path.is_dir():
        return _folder(path)
    try:
        with open(path, "rb") as file:
            head = file.read(4096)
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror})") from None
    if not head:
        raise DataError(f"{path}: the file is empty")
    for magic, name in MAGIC.items():
        if head.startswith(magic):
            return name
    if head.startswith(b"version https://git-lfs"):
        raise DataError(f"{path}: a pointer of Git LFS, not the log itself: fetch it with `git lfs pull`")
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise DataError(f"{path}: text in UTF-16; save it as UTF-8")
    printable = sum(byte in b"\t\n\r" or 32 <= byte < 127 or byte >= 160 for byte in head)
    if b"\x00" in head or printable < TEXT_SHARE * len(head):
        raise DataError(f"{path}: neither a ULog, HDF5, Parquet, MCAP, rosbag nor text")
    return "text"


def _folder(path: Path) -> str:
    if (path / "metadata.yaml").is_file():
        return "rosbag"
    if any(path.glob("*_vehicle_*_0.csv")):
        return "px4csv"
    raise DataError(
        f"{path}: a folder, but neither a ROS 2 bag (metadata.yaml) nor topics of PX4 (*_vehicle_attitude_0.csv)"
    )
