"""One clock for a telemetry log: the autopilot's, through reboots, with its place in UTC."""

import datetime
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.live.logs.mavlink_frames import Table

_BOOT = "time_boot_ms"
_REBOOT_S = 2.0
_BLOCK_S = 30.0
"""A tether delays some message by next to nothing in so long a time."""
_CLOCK_STEP_S = 1.0
_UTC_SIGMA_S = 2.0
"""A computer whose clock the network sets is right to well below this."""
_FIRST_BELIEVED = datetime.datetime(1990, 1, 1, tzinfo=datetime.UTC).timestamp()


@dataclass(frozen=True, slots=True)
class TelemetryClock:
    """Log time of every message.

    Attributes
    ----------
    at : array, shape (n,)
        Places in the file of the messages that the clock rests on.
    log_s : array, shape (n,)
        Their log time.
    boot_at : array, shape (k,)
        Place in the file from which each run of the autopilot counts.
    boot_s : array, shape (k,)
        Log time at which each run began.
    start_utc_s, start_utc_sigma_s : float or None
        UTC of log time 0, and how far to trust it.
    notes : tuple of str
        Reboots, and steps of the computer's clock.
    """

    at: IntArray
    log_s: FloatArray
    boot_at: IntArray
    boot_s: FloatArray
    start_utc_s: float | None
    start_utc_sigma_s: float | None
    notes: tuple[str, ...]

    def of(self, table: Table) -> FloatArray:
        """Return the log time of a table's messages.

        A message without time of its own takes it from its neighbours in the file.
        """
        if _BOOT not in (table.payload.dtype.names or ()) or not len(self.boot_at):
            between: FloatArray = np.interp(table.at, self.at, self.log_s)
            return between
        run = np.maximum(np.searchsorted(self.boot_at, table.at, side="right") - 1, 0)
        return table.payload[_BOOT] / 1e3 + self.boot_s[run]


def telemetry_clock(tables: Mapping[str, Table]) -> TelemetryClock:
    """Return the clock of an autopilot's messages; there must be at least one."""
    timed = [t for t in tables.values() if _BOOT in (t.payload.dtype.names or ())]
    if not timed:
        table = max(tables.values(), key=lambda t: len(t.at))
        received = table.received_us / 1e6
        none = np.zeros(0)
        return _with_utc(table, received - received[0], none.astype(np.int64), none, ())
    table = max(timed, key=lambda t: len(t.at))
    boot, received = table.payload[_BOOT] / 1e3, table.received_us / 1e6
    firsts = np.concatenate([[0], 1 + np.flatnonzero(np.diff(boot) < -_REBOOT_S)])
    starts = [-float(boot[0])]
    for before, first, end in zip(firsts, firsts[1:], [*firsts[2:], len(boot)], strict=False):
        # The fastest messages to either side tell how much time passed in between.
        old = slice(max(before, first - 100), first)
        new = slice(first, min(end, first + 100))
        gone = np.min(received[new] - boot[new]) - np.min(received[old] - boot[old])
        starts.append(starts[-1] + float(gone))
    notes = (f"the autopilot restarted {len(firsts) - 1} times",) if len(firsts) > 1 else ()
    boot_at, boot_s = table.at[firsts].copy(), np.array(starts)
    boot_at[0] = 0
    run = np.searchsorted(boot_at, table.at, side="right") - 1
    return _with_utc(table, boot + boot_s[run], boot_at, boot_s, notes)


def _with_utc(
    table: Table, log_s: FloatArray, boot_at: IntArray, boot_s: FloatArray, notes: tuple[str, ...]
) -> TelemetryClock:
    """Place log time 0 in UTC by the messages that were received with the least delay."""
    behind = table.received_us / 1e6 - log_s
    firsts = np.flatnonzero(np.diff(np.floor(log_s / _BLOCK_S), prepend=-np.inf))
    least = np.minimum.reduceat(behind, firsts)
    start, sigma = float(np.median(least)), _UTC_SIGMA_S
    if start < _FIRST_BELIEVED:
        return TelemetryClock(table.at, log_s, boot_at, boot_s, None, None, notes)
    steps = np.diff(least)
    large = np.flatnonzero(np.abs(steps) > _CLOCK_STEP_S)
    if len(large):
        sigma = max(sigma, float(np.ptp(least)))
        when = log_s[firsts[large[0] + 1]]
        notes = (
            *notes,
            f"the recording computer's clock was set by {steps[large[0]]:+.1f} s at about "
            f"{when:.0f} s of the log",
        )
    return TelemetryClock(table.at, log_s, boot_at, boot_s, start, sigma, notes)
