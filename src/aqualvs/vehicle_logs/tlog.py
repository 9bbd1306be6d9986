"""MAVLink telemetry logs (`.tlog`) of ground stations: signals, choice of the depth, and the clock.

Messages read for each signal, with reasons:

- attitude and heading: `ATTITUDE`, which has the autopilot's time and the highest rate. If it is
  missing, heading from `GLOBAL_POSITION_INT` (hundredths of a degree), then `VFR_HUD` (whole
  degrees).
- depth: `GLOBAL_POSITION_INT.relative_alt`, height above home, which ArduSub sets at the surface.
  `VFR_HUD.alt` is above mean sea level and 0 without a home; `AHRS2.altitude` is that of the backup
  estimator, in centimetres. `SCALED_PRESSURE2`, the outer sensor, gives changes only, because the
  log does not contain the pressure at the surface. `choose_depth` takes the first that changes.

`TelemetryClock` gives all messages times of the autopilot's clock, across reboots, and its UTC.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.vehicle_logs.mavlink_frames import SelectedMessages, Table, read_frames
from aqualvs.vehicle_logs.vehicle_log import (
    FIRST_BELIEVED_UTC_S,
    NETWORK_UTC_SIGMA_S,
    Found,
    Interpolation,
    Signal,
    VehicleLog,
    bearing_of,
    log_of,
)


def damage_notes(skipped: Sequence[tuple[int, int]], unit: str, what: str) -> list[str]:
    """Return a note on unreadable sections of a file, if any; `skipped`: offsets and lengths."""
    if not skipped:
        return []
    lost = sum(length for _, length in skipped)
    return [
        f"{lost} {unit} are no {what} and are left out, the first at {unit[:-1]} "
        f"{skipped[0][0]}: the file is damaged or cut short"
    ]


def choose_depth(
    candidates: Sequence[Found], pressure_depth: Signal | None
) -> tuple[Found, str | None]:
    """Return the first candidate with a changing depth, and a note on one that is stuck.

    A filter without an origin reports a constant instead of the depth, although the pressure
    changes. `pressure_depth`: depth by the outer pressure, up to a constant.
    """
    dived = 0.0 if pressure_depth is None else _span(pressure_depth)
    note = None
    # Shortest dive, in metres, that shows it, and share of it below which a candidate is stuck.
    min_dive_m, stuck_share = 0.5, 0.1
    for depth, source in candidates:
        if depth is None:
            continue
        if dived <= min_dive_m or _span(depth) >= stuck_share * dived:
            return (depth, source), note
        note = note or (
            f"{source} stands still while the pressure changes by {dived:.1f} m of water; not used"
        )
    return (None, ""), note


def _span(depth: Signal) -> float:
    low, high = np.percentile(depth.values, (1.0, 99.0))
    return float(high - low)


_BOOT = "time_boot_ms"


@dataclass(frozen=True, slots=True)
class TelemetryClock:
    """Clock of a telemetry log, which gives the log time of every message."""

    at: IntArray  # Shape (n,): offsets in the file of the messages that define the clock.
    log_s: FloatArray  # Shape (n,): their log time.
    boot_at: IntArray  # Shape (k,): offset in the file at which each run of the autopilot begins.
    boot_s: FloatArray  # Shape (k,): log time at which each run began.
    # UTC of log time 0, and its standard deviation; None if unknown.
    start_utc_s: float | None
    start_utc_sigma_s: float | None
    # On reboots, and steps of the computer's clock.
    notes: tuple[str, ...]

    def of(self, table: Table) -> FloatArray:
        """Return the log time of a table's messages.

        That of messages without a time stamp is interpolated between their neighbours in the file.
        """
        if _BOOT not in (table.payload.dtype.names or ()) or not len(self.boot_at):
            return np.interp(table.at, self.at, self.log_s)
        run = np.maximum(np.searchsorted(self.boot_at, table.at, side="right") - 1, 0)
        return table.payload[_BOOT] / 1e3 + self.boot_s[run]


def telemetry_clock(tables: Mapping[str, Table]) -> TelemetryClock:
    """Return the clock of an autopilot's messages; there must be at least one."""
    timed = [t for t in tables.values() if _BOOT in (t.payload.dtype.names or ())]
    table = max(timed or tables.values(), key=lambda t: len(t.at))
    received = table.received_us / 1e6
    if not timed:
        none = np.zeros(0)
        return _with_utc(table, received - received[0], none.astype(np.int64), none, ())
    boot = table.payload[_BOOT] / 1e3
    # A larger step back, in seconds, is a reboot.
    reboot_s = 2.0
    firsts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(boot) < -reboot_s)])
    starts = [-float(boot[0])]
    for before, first, end in zip(firsts, firsts[1:], [*firsts[2:], len(boot)], strict=False):
        # The messages with the least delay on either side give the time in between.
        old = slice(max(before, first - 100), first)
        new = slice(first, min(end, first + 100))
        elapsed = np.min(received[new] - boot[new]) - np.min(received[old] - boot[old])
        starts.append(starts[-1] + float(elapsed))
    notes = (f"the autopilot restarted {len(firsts) - 1} times",) if len(firsts) > 1 else ()
    boot_at, boot_s = table.at[firsts].copy(), np.array(starts)
    boot_at[0] = 0
    run = np.searchsorted(boot_at, table.at, side="right") - 1
    return _with_utc(table, boot + boot_s[run], boot_at, boot_s, notes)


def _with_utc(
    table: Table, log_s: FloatArray, boot_at: IntArray, boot_s: FloatArray, notes: tuple[str, ...]
) -> TelemetryClock:
    """Return the clock with the UTC of log time 0, by the messages with the least delay."""
    delayed = table.received_us / 1e6 - log_s
    # Long enough that at least one message has almost no delay.
    block_s = 30.0
    firsts = np.flatnonzero(np.diff(np.floor(log_s / block_s), prepend=-np.inf))
    least = np.minimum.reduceat(delayed, firsts)
    start, sigma = float(np.median(least)), NETWORK_UTC_SIGMA_S
    if start < FIRST_BELIEVED_UTC_S:
        return TelemetryClock(table.at, log_s, boot_at, boot_s, None, None, notes)
    steps = np.diff(least)
    # Larger changes are no delays: the computer's clock was set.
    clock_step_s = 1.0
    large = np.flatnonzero(np.abs(steps) > clock_step_s)
    if len(large):
        sigma = max(sigma, float(np.ptp(least)))
        when = log_s[firsts[large[0] + 1]]
        notes = (
            *notes,
            f"the recording computer's clock was set by {steps[large[0]]:+.1f} s at about "
            f"{when:.0f} s of the log",
        )
    return TelemetryClock(table.at, log_s, boot_at, boot_s, start, sigma, notes)


DEPTH_FIELDS = (
    ("GLOBAL_POSITION_INT", "relative_alt", -1e-3),
    ("VFR_HUD", "alt", -1.0),
    ("AHRS2", "altitude", -1.0),
)
"""Messages, fields and scales of the depth in metres, the best first."""
PRESSURE_FIELD = ("SCALED_PRESSURE2", "press_abs", 100.0 / (1025.0 * 9.80665))
"""The same of the outer pressure, which gives changes of the depth."""

_Tables = Mapping[str, Table]


def read_tlog(path: Path) -> VehicleLog:
    """Read a telemetry log.

    Raises `SourceError` if it has no depth or attitude from an autopilot.
    """
    frames = read_frames(path.read_bytes())
    source, others = _autopilot(frames, path)
    own = {name: table[table.source == source] for name, table in frames.tables.items()}
    tables = {name: table for name, table in own.items() if len(table.at)}
    clock = telemetry_clock(tables)
    candidates = [
        (_signal(tables, clock, message, field, scale), f"{message}.{field}")
        for message, field, scale in DEPTH_FIELDS
    ]
    depth, stuck = choose_depth(candidates, _signal(tables, clock, *PRESSURE_FIELD))
    found = {"depth": depth, "heading": _heading(tables, clock)}
    for name in ("roll", "pitch"):
        angle = _signal(tables, clock, "ATTITUDE", name, interpolation=Interpolation.ANGLE)
        found[name] = angle, f"ATTITUDE.{name}"
    damage = damage_notes(frames.skipped, "bytes", "messages")
    if frames.n_failed:
        damage.append(f"{frames.n_failed} messages have a wrong checksum and are left out")
    return log_of(
        path,
        "tlog",
        found,
        start_utc_s=clock.start_utc_s,
        start_utc_sigma_s=clock.start_utc_sigma_s,
        notes=tuple(n for n in (others, *damage, *clock.notes, stuck) if n),
    )


def _autopilot(frames: SelectedMessages, path: Path) -> tuple[int, str | None]:
    """Return the sender whose messages to read, and a note if there are several vehicles."""
    beats = frames.tables.get("HEARTBEAT")
    senders: set[int] = set()
    # MAV_AUTOPILOT_INVALID and MAV_TYPE_GCS.
    no_autopilot, ground_station = 8, 6
    if beats is not None:
        kind, autopilot = beats.payload["type"], beats.payload["autopilot"]
        senders = set(beats.source[(kind != ground_station) & (autopilot != no_autopilot)])
    others = [table.source for name, table in frames.tables.items() if name != "HEARTBEAT"]
    sources = np.concatenate(others) if others else np.zeros(0, np.int64)
    if not senders:
        # A part of a longer log may lack heartbeats; autopilots are component 1.
        senders = {int(source) for source in np.unique(sources) if source % 256 == 1}
    counts = {int(source): int(np.count_nonzero(sources == source)) for source in senders}
    if not counts or not max(counts.values()):
        raise SourceError(
            f"{path}: no depth or attitude from an autopilot in {frames.n_frames} messages; "
            "give the log of the vehicle's own connection"
        )
    best = max(counts, key=lambda source: counts[source])
    systems = sorted({source >> 8 for source, n in counts.items() if n})
    if len(systems) == 1:
        return best, None
    named = ", ".join(str(system) for system in systems)
    return best, f"vehicles {named} speak; {best >> 8} is read, which speaks most"


def _signal(
    tables: _Tables,
    clock: TelemetryClock,
    message: str,
    field: str,
    scale: float = 1.0,
    interpolation: Interpolation = Interpolation.LINEAR,
) -> Signal | None:
    """Return a scaled field of a message as a signal; None if it is missing."""
    table = tables.get(message)
    if table is None:
        return None
    values: FloatArray = scale * table.payload[field].astype(float)
    if interpolation is Interpolation.BEARING:
        values = bearing_of(values)
    return Signal.from_samples(clock.of(table), values, interpolation)


def _heading(tables: _Tables, clock: TelemetryClock) -> Found:
    """Return the heading from the best message that has it, and its source."""
    known, table = dict(tables), tables.get("GLOBAL_POSITION_INT")
    unknown_heading = 65535
    if table is not None:
        known["GLOBAL_POSITION_INT"] = table[table.payload["hdg"] != unknown_heading]
    for message, field, unit, precision in (
        ("ATTITUDE", "yaw", 1.0, ""),
        ("GLOBAL_POSITION_INT", "hdg", math.radians(0.01), ""),
        ("VFR_HUD", "heading", math.radians(1.0), " (whole degrees)"),
    ):
        heading = _signal(known, clock, message, field, unit, Interpolation.BEARING)
        source = f"{message}.{field}{precision}"
        if heading is not None:
            break
    return heading, source
