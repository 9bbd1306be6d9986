"""Vehicle logs of any format (`read_vehicle_log`), and the reader of CSV tables.

Columns of a table, in any order: `time_s` (seconds on any clock) or `time` (UTC, ISO 8601);
`depth_m`, positive down; `heading_deg`, clockwise from north; and optionally `roll_deg` and
`pitch_deg`. At least one of depth and heading is required. An empty cell is a missing value. Other
columns are ignored, but names that resemble these, or have another unit, are refused.
"""

import csv
import difflib
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from aqualvs.errors import SourceError, check_commas
from aqualvs.geometry.arrays import FloatArray
from aqualvs.special_files import refuse_special
from aqualvs.vehicle_logs.dataflash import (
    looks_like_dataflash,
    looks_like_dataflash_text,
    read_dataflash,
    read_dataflash_text,
)
from aqualvs.vehicle_logs.mavlink_frames import looks_like_frames
from aqualvs.vehicle_logs.tlog import read_tlog
from aqualvs.vehicle_logs.vehicle_log import (
    NETWORK_UTC_SIGMA_S,
    Found,
    Interpolation,
    Signal,
    VehicleLog,
    bearing_of,
    log_of,
    utc_seconds,
    wrap,
)

TIME_COLUMNS = ("time_s", "time")
VALUE_COLUMNS = ("depth_m", "heading_deg", "roll_deg", "pitch_deg")
_COLUMNS = TIME_COLUMNS + VALUE_COLUMNS
# Quantities by their names without unit, and units that other programs use.
_STEMS = {name.rsplit("_", 1)[0]: name for name in VALUE_COLUMNS} | {"yaw": "heading_deg"}
_UNITS = frozenset({"", "m", "cm", "mm", "ft", "deg", "rad", "degrees", "radians", "cdeg"})
# Largest plausible magnitudes, in these units.
_LARGEST = {"depth_m": 12000.0, "heading_deg": 720.0, "roll_deg": 360.0, "pitch_deg": 180.0}


def read_csv_log(path: Path) -> VehicleLog:
    """Read a table of depth and heading.

    Raises `SourceError` with one line that names the file, the line, the value and the remedy.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise SourceError(f"{path}: is not text; save the table as CSV in UTF-8") from None
    rows = _rows(text, path)
    if len(rows) < 2:
        raise SourceError(
            f"{path}: holds no rows; write 'time_s,depth_m,heading_deg' and a line for each time"
        )
    names = [cell.strip() for cell in rows[0][1]]
    _check_columns(names, path)
    ignored = [name for name in names if name and name not in _COLUMNS]
    notes = (f"columns not used: {', '.join(ignored)}",) if ignored else ()
    if len(rows) > 2 and len(rows[-1][1]) < len(names):
        # An interrupted recording ends within a line.
        notes = (*notes, f"line {rows[-1][0]}, the last, is cut short and left out")
        del rows[-1]
    table, start_utc_s = _table(names, rows[1:], path)
    return _log(path, table, start_utc_s, notes)


def _rows(text: str, path: Path) -> list[tuple[int, list[str]]]:
    """Return the lines that are not empty, with their numbers."""
    reader = csv.reader(text.splitlines())
    try:
        return [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as fault:
        raise SourceError(f"{path}: line {reader.line_num}: {fault}; fix the line") from None


def _check_columns(names: list[str], path: Path) -> None:
    check_commas(names, path, SourceError)
    for name in names:
        if name in _COLUMNS and names.count(name) > 1:
            raise SourceError(f"{path}: column {name} appears twice; keep one")
    if not set(TIME_COLUMNS) & set(names):
        _refuse_near_misses(names, TIME_COLUMNS, path)
        raise SourceError(
            f"{path}: has no column of times; add time_s in seconds, or time in UTC (ISO 8601)"
        )
    if set(TIME_COLUMNS) <= set(names):
        raise SourceError(f"{path}: has time_s and time; keep one, so that there is one clock")
    missing = [name for name in VALUE_COLUMNS if name not in names]
    _refuse_near_misses(names, missing, path)
    if "depth_m" in missing and "heading_deg" in missing:
        raise SourceError(f"{path}: has neither depth_m nor heading_deg; add at least one of them")


def _refuse_near_misses(names: list[str], wanted: tuple[str, ...] | list[str], path: Path) -> None:
    """Refuse a column that resembles a missing one, or has another unit."""
    for name in names:
        if name in _COLUMNS:
            continue
        plain = name.lower().strip()
        stem, _, unit = plain.partition("_")
        meant = _STEMS.get(stem) if unit in _UNITS else None
        close = difflib.get_close_matches(plain, wanted, n=1, cutoff=0.85)
        target = meant or (close[0] if close else None)
        if target in wanted:
            raise SourceError(
                f"{path}: column {name!r} is not known; write it as {target}, in that unit"
            )


def _table(
    names: list[str], rows: list[tuple[int, list[str]]], path: Path
) -> tuple[dict[str, FloatArray], float | None]:
    """Return the columns as numbers (NaN for empty cells), and the UTC of the first row."""
    wanted = [(i, name) for i, name in enumerate(names) if name in _COLUMNS]
    filled: dict[str, list[float]] = {name: [] for _, name in wanted}
    for line, row in rows:
        if len(row) != len(names):
            raise SourceError(
                f"{path}: line {line} has {len(row)} values for {len(names)} columns; fix the line"
            )
        for i, name in wanted:
            filled[name].append(_number(name, row[i].strip(), path, line))
    table = {name: np.array(values) for name, values in filled.items()}
    lines = [line for line, _ in rows]
    start = None
    if "time" in table:
        start = float(table["time"][0])
        table["time_s"] = table.pop("time") - start
    _check_times(table["time_s"], lines, path)
    if "depth_m" in table:
        _check_depths(table["depth_m"], lines, path)
    return table, start


def _number(name: str, cell: str, path: Path, line: int) -> float:
    """Return the number in a cell, or seconds since 1970 for the column time; NaN if empty."""
    if name == "time":
        try:
            return utc_seconds(cell)
        except ValueError:
            raise SourceError(
                f"{path}: line {line}: time is {cell!r}; write UTC as 2026-05-31T12:00:00.250Z, "
                "or give seconds in a column time_s"
            ) from None
    if not cell:
        if name == "time_s":
            raise SourceError(f"{path}: line {line} has no time_s; write one in every row")
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        raise SourceError(
            f"{path}: line {line}: {name} is {cell!r}; write a plain number"
        ) from None
    if math.isnan(value) and name != "time_s":
        return value
    if not math.isfinite(value) or abs(value) > _LARGEST.get(name, math.inf):
        unit = name.rsplit("_", 1)[1]
        raise SourceError(
            f"{path}: line {line}: {name} is {cell!r}; write the value in {unit}, or leave it empty"
        )
    return value


def _check_times(time_s: FloatArray, lines: list[int], path: Path) -> None:
    back = np.flatnonzero(np.diff(time_s) < 0.0)
    if len(back):
        i = int(back[0])
        raise SourceError(
            f"{path}: line {lines[i + 1]}: the time goes back by {time_s[i] - time_s[i + 1]:g} s; "
            "sort the rows by time, or cut the file there"
        )


def _check_depths(depth_m: FloatArray, lines: list[int], path: Path) -> None:
    known = depth_m[np.isfinite(depth_m)]
    # Waves and the zero of the sensor explain smaller heights above the surface.
    min_depth_m = -2.0
    if len(known) and np.median(known) < min_depth_m:
        i = int(np.nanargmin(depth_m))
        raise SourceError(
            f"{path}: line {lines[i]}: depth_m is {depth_m[i]:g}, above the surface; write depths "
            "positive down"
        )


def _log(
    path: Path, table: dict[str, FloatArray], start_utc_s: float | None, notes: tuple[str, ...]
) -> VehicleLog:
    """Return the vehicle log of a table; repeated times are left out."""
    time_s = table["time_s"]
    repeated = int(np.count_nonzero(np.diff(time_s) == 0.0))
    if repeated:
        notes = (*notes, f"{repeated} rows repeat the time of the row before and are left out")

    found: dict[str, Found] = {}
    for column in VALUE_COLUMNS:
        if column not in table:
            continue
        values, interpolation = table[column], Interpolation.LINEAR
        if column == "heading_deg":
            values, interpolation = bearing_of(np.deg2rad(values)), Interpolation.BEARING
        elif column != "depth_m":
            values, interpolation = wrap(np.deg2rad(values)), Interpolation.ANGLE
        signal = Signal.from_samples(time_s, values, interpolation)
        found[column.rsplit("_", 1)[0]] = signal, f"column {column}"
    return log_of(
        path,
        "csv",
        found,
        start_utc_s=start_utc_s,
        start_utc_sigma_s=None if start_utc_s is None else NETWORK_UTC_SIGMA_S,
        notes=notes,
    )


_OTHERS = {
    b"ULog": "is a PX4 log (ULog); convert it to CSV with columns time_s, depth_m, heading_deg",
    b"\x89MCAP": "is an MCAP recording; export its MAVLink messages as .tlog",
    b"PK\x03\x04": "is a ZIP archive; unpack it first",
    b"\x1f\x8b": "is compressed with gzip; unpack it first",
}


def read_vehicle_log(path: str | Path) -> VehicleLog:
    """Read a vehicle's log; the content determines the format, not the name.

    `path`: CSV table, MAVLink telemetry log (`.tlog`) or ArduPilot dataflash log (`.BIN`, or its
    text form `.log`). Of a truncated or damaged file, the readable part is returned; `log.notes`
    describes the rest. Raises `SourceError` if the file cannot be read or holds neither depth nor
    heading; one line that names the file, the value and the remedy.
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
    """Return the function that reads a file with this beginning."""
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
    """Return the first bytes of a file, by which its format is recognised."""
    head_bytes = 65536
    try:
        with path.open("rb") as file:
            return file.read(head_bytes)
    except FileNotFoundError:
        raise SourceError(f"{path}: no such file; give the path of the vehicle's log") from None
    except IsADirectoryError:
        raise SourceError(f"{path}: is a folder; give the path of a log in it") from None
    except OSError as fault:
        raise SourceError(f"{path}: cannot be read ({fault.strerror})") from None
