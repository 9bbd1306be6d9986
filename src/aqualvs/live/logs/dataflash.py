"""ArduPilot's dataflash logs (`.BIN`, and their text form `.log`), as the vehicle writes them.

Which record is read for what, and why:

- attitude and heading: `ATT`, the attitude that the autopilot flies by.
- depth: `CTUN.Alt`, the height that ArduSub flies by, from its filter, 0 at the surface. `POS`
  follows home when someone moves it; the filter's own `XKF1.PD` counts from where it started.
  `CTUN.BAlt` and `BARO.Alt` are the pressure sensor without filter; of several `BARO`, the one in
  the water is not the first, which sits in the hull.
- velocity: `XKF1` (`NKF1` of older firmware), of the first core.
- UTC: `GPS` (leap seconds of 2017 taken off), else `RTC`.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.logs import dataflash_records
from aqualvs.live.logs.dataflash_records import HEAD, Records
from aqualvs.live.logs.depth_choice import Candidate, choose_depth
from aqualvs.live.logs.signals import Interpolation, Signal, bearing_of, wrap
from aqualvs.live.logs.tlog import SUB_MODES
from aqualvs.live.logs.vehicle_log import VehicleLog

_WANTED = ("ATT", "CTUN", "POS", "XKF1", "NKF1", "BARO", "GPS", "RTC", "MODE", "ARM", "EV")
_GPS_EPOCH_S = 315964800.0
_LEAP_S = 18.0
_WEEK_S = 604800.0
_GPS_FIX = 3
_UTC_SIGMA_S = 1.0
"""A vehicle's clock is set once, to about the second."""
_ARMED_EVENT, _DISARMED_EVENT = 10, 11
_DEEPEST_M = 12000.0
_LARGEST_DEG = 720.0
"""Records have no checksum: damaged ones may hold any number."""

_Tables = Mapping[str, Mapping[str, FloatArray]]


def looks_like_dataflash(head: bytes) -> bool:
    """Return whether a file begins as a binary dataflash log; a damaged begin is forgiven."""
    return head.startswith(HEAD) or head.count(HEAD + b"\x80") >= 3


def looks_like_dataflash_text(head: bytes) -> bool:
    """Return whether a file begins as a dataflash log in text."""
    return head.startswith(b"FMT,") or b"\nFMT," in head


def read_dataflash(path: Path) -> VehicleLog:
    """Read a binary dataflash log.

    Raises
    ------
    SourceError
        If nothing that is wanted is in it.
    """
    records = dataflash_records.read_binary(path.read_bytes(), _WANTED)
    return _log(path, records, "dataflash", "bytes")


def read_dataflash_text(path: Path) -> VehicleLog:
    """Read a dataflash log in text.

    Raises
    ------
    SourceError
        If nothing that is wanted is in it.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    return _log(path, dataflash_records.read_text(text, _WANTED), "dataflash text", "lines")


def _log(path: Path, records: Records, kind: str, unit: str) -> VehicleLog:
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
    depth, stuck = _depth(tables, begin)
    heading = _angle(tables, begin, "Yaw", Interpolation.BEARING)
    roll = _angle(tables, begin, "Roll", Interpolation.ANGLE)
    velocity, velocity_from = _velocity(tables, begin)
    armed, armed_from = _armed(tables, begin)
    utc, utc_from = _start_utc(tables, begin)
    sources = {
        "depth": depth.label if depth else "",
        "heading": "ATT.Yaw" if heading else "",
        "roll": "ATT.Roll" if roll else "",
        "pitch": "ATT.Pitch" if roll else "",
        "velocity_ned": velocity_from,
        "armed": armed_from,
        "start_utc_s": utc_from,
    }
    return VehicleLog(
        name=str(path),
        kind=kind,
        depth=depth.depth if depth else None,
        heading=heading,
        roll=roll,
        pitch=_angle(tables, begin, "Pitch", Interpolation.ANGLE),
        velocity_ned=velocity,
        armed=armed,
        modes=_modes(tables, begin),
        start_utc_s=utc,
        start_utc_sigma_s=None if utc is None else _UTC_SIGMA_S,
        sources={name: where for name, where in sources.items() if where},
        notes=tuple(n for n in (*_damage(records, unit), stuck) if n),
    )


def _first_core(tables: _Tables) -> _Tables:
    """Keep the first core of each filter, where a log has several."""
    kept = dict(tables)
    for name in ("XKF1", "NKF1"):
        table = tables.get(name)
        if table is not None and "C" in table:
            first = table["C"] == 0
            kept[name] = {column: values[first] for column, values in table.items()}
    return kept


def _damage(records: Records, unit: str) -> list[str]:
    notes = []
    if records.skipped:
        lost = sum(length for _, length in records.skipped)
        notes.append(
            f"{lost} {unit} are no records and are left out, the first at {unit[:-1]} "
            f"{records.skipped[0][0]}: the file is damaged or cut short"
        )
    if records.n_bogus:
        notes.append(f"{records.n_bogus} records have an impossible time and are left out")
    return notes


def _signal(
    tables: _Tables,
    begin: float,
    kind: str,
    column: str,
    scale: float = 1.0,
) -> Signal | None:
    table = tables.get(kind)
    if table is None or column not in table:
        return None
    values = scale * table[column]
    values = np.where(np.abs(values) <= _DEEPEST_M, values, np.nan)
    return Signal.from_samples(table["time_s"] - begin, values)


def _angle(
    tables: _Tables, begin: float, column: str, interpolation: Interpolation
) -> Signal | None:
    table = tables.get("ATT")
    if table is None or column not in table:
        return None
    angle = np.deg2rad(np.where(np.abs(table[column]) <= _LARGEST_DEG, table[column], np.nan))
    angle = bearing_of(angle) if interpolation is Interpolation.BEARING else wrap(angle)
    return Signal.from_samples(table["time_s"] - begin, angle, interpolation)


def _depth(tables: _Tables, begin: float) -> tuple[Candidate | None, str | None]:
    candidates = [
        Candidate(f"{kind}.{column}", _signal(tables, begin, kind, column, scale))
        for kind, column, scale in (
            ("CTUN", "Alt", -1.0),
            ("POS", "RelHomeAlt", -1.0),
            ("XKF1", "PD", 1.0),
            ("NKF1", "PD", 1.0),
            ("CTUN", "BAlt", -1.0),
        )
    ]
    pressure = candidates[-1].depth
    return choose_depth([*candidates, _barometer(tables, begin)], pressure)


def _barometer(tables: _Tables, begin: float) -> Candidate:
    table = tables.get("BARO")
    if table is None or "Alt" not in table:
        return Candidate("BARO.Alt", None)
    number = table.get("I", np.zeros(len(table["Alt"])))
    outer = number == number.max()
    label = f"BARO.Alt of sensor {number.max():.0f}"
    return Candidate(
        label, Signal.from_samples(table["time_s"][outer] - begin, -table["Alt"][outer])
    )


def _velocity(tables: _Tables, begin: float) -> tuple[Signal | None, str]:
    for name in ("XKF1", "NKF1"):
        table = tables.get(name)
        if table is None or not {"VN", "VE", "VD"} <= set(table):
            continue
        parts = np.stack([table["VN"], table["VE"], table["VD"]], axis=1)
        velocity = Signal.from_samples(table["time_s"] - begin, parts)
        if velocity is not None:
            return velocity, f"{name}.VN, VE, VD"
    return None, ""


def _armed(tables: _Tables, begin: float) -> tuple[Signal | None, str]:
    """Return the arming; it is logged at changes only, so a signal without gaps is made of it."""
    table = tables.get("ARM")
    if table is not None and "ArmState" in table:
        times, state, where = table["time_s"], table["ArmState"], "ARM.ArmState"
    else:
        table = tables.get("EV")
        if table is None or "Id" not in table:
            return None, ""
        told = (table["Id"] == _ARMED_EVENT) | (table["Id"] == _DISARMED_EVENT)
        times, where = table["time_s"][told], "EV.Id"
        state = (table["Id"][told] == _ARMED_EVENT).astype(float)
    signal = Signal.from_samples(times - begin, (state > 0.0).astype(float), Interpolation.HELD)
    if signal is None:
        return None, ""
    end = max(float(t["time_s"][-1]) for t in tables.values()) - begin
    if end > signal.time_s[-1]:
        signal = Signal(
            np.append(signal.time_s, end),
            np.append(signal.values, signal.values[-1]),
            signal.interpolation,
            np.inf,
        )
    return Signal(signal.time_s, signal.values, signal.interpolation, np.inf), where


def _modes(tables: _Tables, begin: float) -> tuple[tuple[float, str], ...]:
    table = tables.get("MODE")
    if table is None:
        return ()
    numbers = table.get("ModeNum", table.get("Mode"))
    if numbers is None:
        return ()
    return tuple(
        (float(time) - begin, SUB_MODES.get(int(number), f"mode {number:.0f}"))
        for time, number in zip(table["time_s"], numbers, strict=True)
        if np.isfinite(number)
    )


def _start_utc(tables: _Tables, begin: float) -> tuple[float | None, str]:
    gps = tables.get("GPS")
    if gps is not None and {"GWk", "GMS", "Status"} <= set(gps):
        fixed = (gps["Status"] >= _GPS_FIX) & (gps["GWk"] > 0)
        if fixed.any():
            utc = _GPS_EPOCH_S + _WEEK_S * gps["GWk"] + gps["GMS"] * 1e-3 - _LEAP_S
            return float(np.median((utc - gps["time_s"])[fixed])) + begin, "GPS.GWk, GMS"
    rtc = tables.get("RTC")
    if rtc is not None and "Epoch" in rtc:
        known = rtc["Epoch"] > 0
        if known.any():
            ahead = rtc["Epoch"] * 1e-6 - rtc["time_s"]
            return float(np.median(ahead[known])) + begin, "RTC.Epoch"
    return None, ""
