"""Long series made short enough to draw, with their gaps and extremes kept."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.app.report_run import Track
from aqualvs.app.report_words import reason_words
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive frames without a posture, rows `first` to `last` of a track, both included."""

    first: int
    last: int


def rounded(values: ArrayLike, digits: int) -> list[Any]:
    """Return numbers for JSON, rounded, None where there is none."""
    array = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(array)
    # Adding zero turns a rounded -0.0 into 0.0.
    numbers = np.round(np.where(finite, array, 0.0), digits) + 0.0
    shown = numbers.astype(np.int64).tolist() if digits == 0 else numbers.tolist()
    return [value if ok else None for value, ok in zip(shown, finite, strict=True)]


def thin(values: FloatArray, limit: int) -> IntArray:
    """Return at most `limit` rows of a series, the least and greatest of every bucket.

    Parameters
    ----------
    values : array, shape (N,)
        NaN rows are never chosen.

    Returns
    -------
    rows : int array, ascending
        All finite rows if they are few enough.
    """
    finite = np.flatnonzero(np.isfinite(values))
    if len(finite) <= limit:
        return finite
    width = -(-len(values) // (limit // 2))
    padded = np.pad(values, (0, -len(values) % width), constant_values=np.nan)
    buckets = padded.reshape(-1, width)
    known = np.isfinite(buckets)
    start = np.arange(len(buckets)) * width
    low = start + np.where(known, buckets, np.inf).argmin(axis=1)
    high = start + np.where(known, buckets, -np.inf).argmax(axis=1)
    rows = np.sort(np.concatenate([low, high])[np.tile(known.any(axis=1), 2)])
    first_of_each = np.append(True, np.diff(rows) > 0)
    return np.asarray(rows[first_of_each])


def breaks(rows: IntArray, interrupted: BoolArray) -> list[int]:
    """Return the positions in `rows` after which a drawn line must be lifted.

    Parameters
    ----------
    rows : int array, ascending
    interrupted : bool array, shape (N,)
        True for every row of the full series at which a line must not pass.
    """
    before = np.cumsum(interrupted)
    return [int(i) for i in np.flatnonzero(before[rows[1:]] > before[rows[:-1]])]


def interruptions(track: Track) -> BoolArray:
    """Return the rows without a posture, and those before which frames are missing altogether."""
    missing = np.zeros(len(track), dtype=np.bool_)
    if len(track) > 2:
        step = np.diff(track.time_s)
        missing[1:] = step > max(1.0, 5.0 * float(np.nanmedian(step)))
    interrupted: BoolArray = ~track.valid | missing
    return interrupted


def stretches(track: Track) -> list[Stretch]:
    """Return every stretch without a posture, in order."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~track.valid).astype(np.int8), [0]])))
    return [Stretch(int(a), int(b) - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def merged(found: list[Stretch], track: Track, columns: int) -> list[Stretch]:
    """Return stretches joined across gaps too narrow to see, so that about `columns` remain.

    Parameters
    ----------
    found : list of Stretch
        In order.
    columns : int
        A gap is too narrow below this fraction of the dive: a column of the screen.
    """
    least = float(track.time_s[-1] - track.time_s[0]) / columns
    joined: list[Stretch] = []
    for stretch in found:
        gap_ends = float(track.time_s[stretch.first])
        if joined and gap_ends - stretch_end_s(joined[-1], track)[1] < least:
            joined[-1] = Stretch(joined[-1].first, stretch.last)
        else:
            joined.append(stretch)
    return joined


def stretch_words(stretch: Stretch, track: Track) -> str:
    """Return why a stretch has no posture, the commonest reason first."""
    rows = slice(stretch.first, stretch.last + 1)
    bad = track.reason[rows][~track.valid[rows]]
    counted = Counter(bad.tolist()).most_common(3)
    if len(counted) == 1:
        return reason_words(track.reasons[counted[0][0]])
    return ", ".join(f"{reason_words(track.reasons[code])} ({count})" for code, count in counted)


def reason_counts(track: Track) -> list[tuple[str, int]]:
    """Return the reasons of all refusals in words with their numbers of frames, commonest first."""
    counted: Counter[str] = Counter()
    for code, count in sorted(Counter(track.reason[~track.valid].tolist()).items()):
        counted[reason_words(track.reasons[code])] += count
    return counted.most_common()


def stretch_end_s(stretch: Stretch, track: Track) -> tuple[float, float]:
    """Return when a stretch starts and when the next posture, if any, ends it, in seconds."""
    after = min(stretch.last + 1, len(track) - 1)
    return float(track.time_s[stretch.first]), float(track.time_s[after])


def hover_places(start: float, end: float, whole: float) -> Iterator[float]:
    """Yield places along a stretch, close enough for a pointer to hit one: 300 to a full width."""
    steps = max(1, int(300 * (end - start) / whole)) if whole > 0.0 else 1
    for i in range(steps + 1):
        yield start + (end - start) * i / steps
