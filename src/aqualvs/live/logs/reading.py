"""Reading a vehicle's log, whatever its format."""

from collections.abc import Callable
from pathlib import Path

from aqualvs.errors import SourceError
from aqualvs.live.logs.csv_log import read_csv_log
from aqualvs.live.logs.dataflash import (
    looks_like_dataflash,
    looks_like_dataflash_text,
    read_dataflash,
    read_dataflash_text,
)
from aqualvs.live.logs.mavlink_frames import looks_like_frames
from aqualvs.live.logs.tlog import read_tlog
from aqualvs.live.logs.vehicle_log import VehicleLog
from aqualvs.special_files import refuse_special

_HEAD_BYTES = 65536
_OTHERS = {
    b"ULog": "is a PX4 log (ULog); convert it to CSV with columns time_s, depth_m, heading_deg",
    b"\x89MCAP": "is an MCAP recording; export its MAVLink messages as .tlog",
    b"PK\x03\x04": "is a ZIP archive; unpack it first",
    b"\x1f\x8b": "is compressed with gzip; unpack it first",
}


def read_vehicle_log(path: str | Path) -> VehicleLog:
    """Read a vehicle's log; the format is told from the content, not from the name.

    Parameters
    ----------
    path : str or Path
        CSV table, MAVLink telemetry log (`.tlog`) or ArduPilot dataflash log (`.BIN`, or its text
        form `.log`).

    Returns
    -------
    log : VehicleLog
        Of a file that is cut short or damaged in places, what is readable; `log.notes` says what is
        not.

    Raises
    ------
    SourceError
        If the file cannot be read or holds neither depth nor heading; one line that names the
        file, the value and the remedy.
    """
    source = Path(path)
    refuse_special(source)
    head = _head(source)
    if not head:
        raise SourceError(f"{source}: is empty; give the log of the dive")
    log = _reader(head, source)(source)
    if log.depth is None and log.heading is None:
        raise SourceError(f"{source}: holds neither depth nor heading; give another log")
    return log


def _reader(head: bytes, path: Path) -> Callable[[Path], VehicleLog]:
    """Return what reads such a file."""
    if looks_like_dataflash(head):
        return read_dataflash
    if looks_like_dataflash_text(head):
        return read_dataflash_text
    for begin, remedy in _OTHERS.items():
        if head.startswith(begin):
            raise SourceError(f"{path}: {remedy}")
    if looks_like_frames(head):
        return read_tlog
    if b"\0" in head:
        raise SourceError(
            f"{path}: is no MAVLink telemetry log (.tlog), no dataflash log (.BIN) and no table "
            "(CSV); give one of these"
        )
    return read_csv_log


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; give the path of the vehicle's log") from None
    except IsADirectoryError:
        raise SourceError(f"{path}: is a folder; give the path of a log in it") from None
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror})") from None
