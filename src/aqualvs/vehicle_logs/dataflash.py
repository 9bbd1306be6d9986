"""ArduPilot's dataflash logs, binary (`.BIN`) and text (`.log`): their records and their signals.

A dataflash log describes itself: `FMT` records give the number, length, `struct`-like format and
columns of every other kind. Binary records start with 0xA3 0x95 and the number of their kind; they
have no checksum (https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html). Only
the wanted kinds are decoded.

Records read for each signal, with reasons:

- attitude and heading: `ATT`, the attitude that the autopilot controls.
- depth: `CTUN.Alt`, the filtered height that ArduSub controls, 0 at the surface. `POS` is relative
  to home, which may be moved; the filter's own `XKF1.PD` (`NKF1` of older firmware), of the first
  core, is relative to where it started.
  `CTUN.BAlt` and `BARO.Alt` are the unfiltered pressure sensor; of several `BARO`, the first is
  inside the hull, and another one in the water.
- UTC: `GPS` (leap seconds of 2017 subtracted), else `RTC`.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.vehicle_logs.tlog import choose_depth, damage_notes
from aqualvs.vehicle_logs.vehicle_log import (
    Found,
    Interpolation,
    Signal,
    VehicleLog,
    bearing_of,
    log_of,
    wrap,
)

HEAD = b"\xa3\x95"
_TYPES = {
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "M": ("u1", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
    "g": ("<f2", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "c": ("<i2", 0.01),
    "C": ("<u2", 0.01),
    "e": ("<i4", 0.01),
    "E": ("<u4", 0.01),
    "L": ("<i4", 1e-7),
    "n": ("S4", 0.0),
    "N": ("S16", 0.0),
    "Z": ("S64", 0.0),
    "a": ("S64", 0.0),
}
"""By format character: NumPy type, and factor on numbers (0 for text and arrays)."""


@dataclass(frozen=True, slots=True)
class Format:
    """Format of one kind of record, as its `FMT` record describes it."""

    name: str  # Kind, such as 'ATT'.
    length: int  # Bytes of a record, including its head of three.
    codes: str  # One format character for each column.
    columns: tuple[str, ...]  # Names of the columns.

    @property
    def dtype(self) -> np.dtype[np.void] | None:
        """NumPy type of a record without its head; None if the description is inconsistent."""
        if len(self.codes) != len(self.columns) or any(c not in _TYPES for c in self.codes):
            return None
        named = all(self.columns) and len(set(self.columns)) == len(self.columns)
        if not named or not self.columns:
            return None
        layout = np.dtype(
            [(name, _TYPES[code][0]) for name, code in zip(self.columns, self.codes, strict=True)]
        )
        return layout if layout.itemsize == self.length - 3 else None


class Records(NamedTuple):
    """Wanted records of a dataflash log."""

    # By kind, the columns; numbers as float64 in the units of the log's text form. Kinds without
    # records are missing. Each has `time_s`, seconds since the autopilot started.
    tables: Mapping[str, Mapping[str, FloatArray]]
    # Number of records of any kind.
    n_records: int
    # Sections without records: offset in the file and length in bytes (for text, line and lines).
    skipped: tuple[tuple[int, int], ...]
    # Number of wanted records with an impossible time, which are left out.
    n_bogus: int


def read_binary(data: bytes) -> Records:
    """Read the wanted kinds of records from a binary dataflash log."""
    places: dict[str, list[int]] = {name: [] for name in _WANTED}
    formats: dict[str, Format] = {}
    n_records, skipped = _scan(data, places, formats)
    octets = np.frombuffer(data, np.uint8)
    tables = {
        name: _decode(octets, np.array(starts, np.int64), formats[name])
        for name, starts in places.items()
        if starts
    }
    return _timed_records(tables, n_records, skipped)


def _scan(
    data: bytes, places: dict[str, list[int]], formats: dict[str, Format]
) -> tuple[int, list[tuple[int, int]]]:
    """Walk over the records; fill in offsets and formats of the wanted ones.

    Returns the number of records, and the sections without records.
    """
    # Number and length of the `FMT` record itself.
    fmt, fmt_length = 0x80, 89
    lengths: dict[int, int] = {fmt: fmt_length}
    lists: dict[int, list[int]] = {}
    skipped: list[tuple[int, int]] = []
    at, size, n_records, last = 0, len(data), 0, 0
    while at + 3 <= size:
        kind = data[at + 2]
        length = lengths.get(kind, 0) if data[at] == 0xA3 and data[at + 1] == 0x95 else 0
        if not length:
            # A record that lost bytes overlaps the next ones, so the search begins within it. If it
            # succeeds there, that record is damaged and dropped.
            found = _next_record(data, last + 1 if n_records else 0, lengths)
            begin = at if found is None or found >= at else last
            damaged = lists.get(data[last + 2]) if begin == last < at else None
            if damaged and damaged[-1] == last:
                damaged.pop()
            skipped.append((begin, (size if found is None else found) - begin))
            if found is None:
                return n_records, skipped
            last = at = found
            continue
        if at + length > size:
            break
        n_records += 1
        if kind == fmt:
            number, described = _format(data, at)
            if described.dtype is not None:
                lengths[number] = described.length
                if described.name in _WANTED:
                    formats[described.name] = described
                    lists[number] = places[described.name]
            elif described.length > 3 and number != fmt:
                lengths[number] = described.length
        elif kind in lists:
            lists[kind].append(at)
        last, at = at, at + length
    if at < size:
        skipped.append((at, size - at))
    return n_records, skipped


def _format(data: bytes, at: int) -> tuple[int, Format]:
    def text(start: int, length: int) -> str:
        return data[at + start : at + start + length].split(b"\0")[0].decode("ascii", "replace")

    columns = text(25, 64)
    return data[at + 3], Format(
        text(5, 4), data[at + 4], text(9, 16), tuple(columns.split(",")) if columns else ()
    )


def _next_record(data: bytes, start: int, lengths: Mapping[int, int]) -> int | None:
    """Return the offset of the next record that another, or the end of the file, follows."""
    at = data.find(HEAD, start)
    while at >= 0 and at + 3 <= len(data):
        length = lengths.get(data[at + 2], 0)
        end = at + length
        if length and (end == len(data) or data[end : end + 2] == HEAD):
            return at
        at = data.find(HEAD, at + 1)
    return None


def _decode(octets: np.ndarray, at: np.ndarray, form: Format) -> dict[str, FloatArray]:
    """Return the numeric columns of records of one format, at offsets `at`."""
    layout = form.dtype
    if layout is None:
        return {}
    rows = np.ascontiguousarray(octets[at[:, None] + 3 + np.arange(layout.itemsize)])
    table = rows.view(layout)[:, 0]
    return {
        name: table[name].astype(float) * _TYPES[code][1]
        for name, code in zip(form.columns, form.codes, strict=True)
        if _TYPES[code][1]
    }


def read_text(text: str) -> Records:
    """Read the wanted kinds of records from the text form of a dataflash log."""
    columns: dict[str, tuple[str, ...]] = {}
    rows: dict[str, list[list[float]]] = {}
    skipped: list[tuple[int, int]] = []
    lines = text.splitlines()
    for number, line in enumerate(lines, start=1):
        cells = re.split(r"\s*,\s*", line.strip())
        name = cells[0]
        if name == "FMT" and len(cells) > 5:
            columns[cells[3]] = tuple(cells[5:])
        elif name in _WANTED:
            if name not in columns or len(cells) != len(columns[name]) + 1:
                skipped.append((number, 1))
                continue
            rows.setdefault(name, []).append([_number(cell) for cell in cells[1:]])
    tables = {
        name: dict(zip(columns[name], np.array(found).T, strict=True))
        for name, found in rows.items()
    }
    return _timed_records(tables, len(lines), skipped)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _timed_records(
    tables: Mapping[str, dict[str, FloatArray]], n_records: int, skipped: list[tuple[int, int]]
) -> Records:
    """Add `time_s` to each table and leave out records whose time is impossible."""
    kept: dict[str, dict[str, FloatArray]] = {}
    n_bogus = 0
    # ArduSub before 3.4 wrote milliseconds.
    units = {"TimeUS": 1e-6, "TimeMS": 1e-3}
    for name, table in tables.items():
        column = next((one for one in units if one in table), None)
        if column is None:
            continue
        times = table[column] * units[column]
        valid = _plausible(times)
        n_bogus += int(np.count_nonzero(~valid))
        if valid.any():
            kept[name] = {one: values[valid] for one, values in table.items()}
            kept[name]["time_s"] = times[valid]
    return Records(kept, n_records, tuple(skipped), n_bogus)


def _plausible(times: FloatArray) -> BoolArray:
    """Return the mask of times near those of their neighbours in the file."""
    if len(times) <= 2:
        return np.isfinite(times)
    # Records have no checksum: times of damaged ones are far from the median of their neighbours.
    n_neighbours, max_deviation_s = 9, 10.0
    median = ndimage.median_filter(times, min(n_neighbours, len(times)), mode="nearest")
    near: BoolArray = np.isfinite(times) & (np.abs(times - median) <= max_deviation_s)
    return near


_WANTED = ("ATT", "CTUN", "POS", "XKF1", "NKF1", "BARO", "GPS", "RTC")

_Tables = Mapping[str, Mapping[str, FloatArray]]


def looks_like_dataflash(head: bytes) -> bool:
    """Return whether a file begins like a binary dataflash log, possibly damaged."""
    return head.startswith(HEAD) or head.count(HEAD + b"\x80") >= 3


def looks_like_dataflash_text(head: bytes) -> bool:
    """Return whether a file begins like a dataflash log in text."""
    return head.startswith(b"FMT,") or b"\nFMT," in head


def read_dataflash(path: Path) -> VehicleLog:
    """Read a binary dataflash log.

    Raises `SourceError` if it contains neither attitude nor depth.
    """
    records = read_binary(path.read_bytes())
    return _log(path, records, "dataflash", "bytes")


def read_dataflash_text(path: Path) -> VehicleLog:
    """Read a dataflash log in text.

    Raises `SourceError` if it contains neither attitude nor depth.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    return _log(path, read_text(text), "dataflash text", "lines")


def _log(path: Path, records: Records, kind: str, unit: str) -> VehicleLog:
    """Return the vehicle log of decoded records."""
    tables = _first_core(records.tables)
    starts = [
        float(t["time_s"][0]) for name, t in tables.items() if name in ("ATT", "CTUN", "BARO")
    ]
    if not starts:
        raise SourceError(
            f"{path}: holds neither attitude nor depth in {records.n_records} records; give a log "
            "of a dive"
        )
    begin = min(starts)
    # Records have no checksum: damaged ones may contain any number. No sea is deeper.
    max_depth_m, max_angle_deg = 12000.0, 720.0
    candidates = [
        _signal(tables, begin, record, column, sign, max_depth_m)
        for record, column, sign in (
            ("CTUN", "Alt", -1.0),
            ("POS", "RelHomeAlt", -1.0),
            ("XKF1", "PD", 1.0),
            ("NKF1", "PD", 1.0),
            ("CTUN", "BAlt", -1.0),
        )
    ]
    pressure, _ = candidates[-1]
    depth, stuck = choose_depth([*candidates, _barometer(tables, begin)], pressure)
    found, degree = {"depth": depth}, math.radians(1.0)
    for name, column, interpolation in (
        ("heading", "Yaw", Interpolation.BEARING),
        ("roll", "Roll", Interpolation.ANGLE),
        ("pitch", "Pitch", Interpolation.ANGLE),
    ):
        found[name] = _signal(tables, begin, "ATT", column, degree, max_angle_deg, interpolation)
    utc, utc_from = _start_utc(tables, begin)
    # The vehicle's clock is set once, to about a second.
    utc_sigma_s = 1.0
    damage = damage_notes(records.skipped, unit, "records")
    if records.n_bogus:
        damage.append(f"{records.n_bogus} records have an impossible time and are left out")
    return log_of(
        path,
        kind,
        found,
        start_utc_s=utc,
        start_utc_sigma_s=None if utc is None else utc_sigma_s,
        utc_source="" if utc is None else utc_from,
        notes=tuple(n for n in (*damage, stuck) if n),
    )


def _first_core(tables: _Tables) -> _Tables:
    """Return the tables with records of the first core only, where a filter has several."""
    kept = dict(tables)
    for name in ("XKF1", "NKF1"):
        table = tables.get(name, {})
        if "C" in table:
            kept[name] = {column: values[table["C"] == 0] for column, values in table.items()}
    return kept


def _signal(
    tables: _Tables,
    begin: float,
    record: str,
    column: str,
    unit: float,
    largest: float,
    interpolation: Interpolation = Interpolation.LINEAR,
) -> Found:
    """Return a column times its unit as a signal, None if it is missing, and its source.

    `begin` is log time 0. Numbers beyond `largest`, in the column's own unit, are left out.
    """
    table, source = tables.get(record, {}), f"{record}.{column}"
    if column not in table:
        return None, source
    values = unit * np.where(np.abs(table[column]) <= largest, table[column], np.nan)
    if interpolation is Interpolation.BEARING:
        values = bearing_of(values)
    elif interpolation is Interpolation.ANGLE:
        values = wrap(values)
    return Signal.from_samples(table["time_s"] - begin, values, interpolation), source


def _barometer(tables: _Tables, begin: float) -> Found:
    """Return the depth by the last barometer, which is the one in the water."""
    table = tables.get("BARO", {})
    if "Alt" not in table:
        return None, "BARO.Alt"
    number = table.get("I", np.zeros(len(table["Alt"])))
    outer = number == number.max()
    depth = Signal.from_samples(table["time_s"][outer] - begin, -table["Alt"][outer])
    return depth, f"BARO.Alt of sensor {number.max():.0f}"


def _start_utc(tables: _Tables, begin: float) -> tuple[float | None, str]:
    """Return the UTC of log time 0, and its source."""
    gps, rtc = tables.get("GPS", {}), tables.get("RTC", {})
    # 1980-01-06, leap seconds between GPS time and UTC since 2017, and least status of a 3D fix.
    gps_epoch_s, leap_s, week_s, gps_fix = 315964800.0, 18.0, 604800.0, 3
    if {"GWk", "GMS", "Status"} <= set(gps):
        fixed = (gps["Status"] >= gps_fix) & (gps["GWk"] > 0)
        if fixed.any():
            utc = gps_epoch_s + week_s * gps["GWk"] + gps["GMS"] * 1e-3 - leap_s
            return float(np.median((utc - gps["time_s"])[fixed])) + begin, "GPS.GWk, GMS"
    if "Epoch" in rtc and (rtc["Epoch"] > 0).any():
        ahead = rtc["Epoch"] * 1e-6 - rtc["time_s"]
        return float(np.median(ahead[rtc["Epoch"] > 0])) + begin, "RTC.Epoch"
    return None, ""
