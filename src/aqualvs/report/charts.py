"""Data of the charts in a run's report, as plain values that `report.js` draws.

Long series are thinned to what a screen can show; their gaps and extremes are kept. Consecutive
frames without a posture become one `Stretch`, with the commonest reasons in words.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray, runs_of
from aqualvs.report.points import (
    QUALITY_EDGES,
    RESIDUAL_EDGES_MM,
    FramePoints,
    PointSummary,
    plane_of_posture,
)
from aqualvs.report.run_data import LaserFacts, Track
from aqualvs.scanning.scan import Label
from aqualvs.text import (
    LABEL_COLOURS,
    LABEL_WORDS,
    clock,
    count_text,
    laser_colour,
    reason_text,
    signed,
)


@dataclass(frozen=True, slots=True)
class Stretch:
    """Consecutive frames without a posture, rows `first` to `last` of a track, both included."""

    first: int
    last: int


def rounded(values: ArrayLike, digits: int) -> list[Any]:
    """Return rounded numbers for JSON, None for NaN."""
    array = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(array)
    # Adding zero turns a rounded -0.0 into 0.0.
    numbers = np.round(np.where(finite, array, 0.0), digits) + 0.0
    shown = numbers.astype(np.int64).tolist() if digits == 0 else numbers.tolist()
    return [value if ok else None for value, ok in zip(shown, finite, strict=True)]


def thin(values: FloatArray, limit: int) -> IntArray:
    """Return at most `limit` rows of a series (N,), the least and greatest of every bucket.

    They ascend; rows that are NaN are never chosen, all others if they are few enough.
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

    `interrupted`, shape (N,): True for every row of the full series at which a line must not pass.
    """
    before = np.cumsum(interrupted)
    return [int(i) for i in np.flatnonzero(before[rows[1:]] > before[rows[:-1]])]


def interruptions(track: Track) -> BoolArray:
    """Return the rows without a posture, and those before which frames are missing altogether."""
    missing = np.zeros(len(track), dtype=np.bool_)
    if len(track) > 2:
        step = np.diff(track.time_s)
        missing[1:] = step > max(1.0, 5.0 * float(np.nanmedian(step)))
    return ~track.valid | missing


def stretches(track: Track) -> list[Stretch]:
    """Return every stretch without a posture, in order."""
    return [Stretch(first, last) for first, last in runs_of(~track.valid).tolist()]


def merge_stretches(found: list[Stretch], track: Track, columns: int) -> list[Stretch]:
    """Return stretches joined across gaps too narrow to see: below a column of the screen.

    `columns`: of the screen, across the dive; about as many stretches remain.
    """
    least = float(track.time_s[-1] - track.time_s[0]) / columns
    joined: list[Stretch] = []
    for stretch in found:
        gap_ends = float(track.time_s[stretch.first])
        if joined and gap_ends - stretch_span_s(joined[-1], track)[1] < least:
            joined[-1] = Stretch(joined[-1].first, stretch.last)
        else:
            joined.append(stretch)
    return joined


def stretch_text(stretch: Stretch, track: Track) -> str:
    """Return why a stretch has no posture, the commonest reason first."""
    rows = slice(stretch.first, stretch.last + 1)
    bad = track.reason[rows][~track.valid[rows]]
    counted = Counter(bad.tolist()).most_common(3)
    if len(counted) == 1:
        return reason_text(track.reasons[counted[0][0]])
    return ", ".join(f"{reason_text(track.reasons[code])} ({count})" for code, count in counted)


def reason_counts(track: Track) -> list[tuple[str, int]]:
    """Return the reasons of all refusals in words with their numbers of frames, commonest first."""
    counted: Counter[str] = Counter()
    for code, count in sorted(Counter(track.reason[~track.valid].tolist()).items()):
        counted[reason_text(track.reasons[code])] += count
    return counted.most_common()


def stretch_span_s(stretch: Stretch, track: Track) -> tuple[float, float]:
    """Return when a stretch starts and when the next posture, if any, ends it, in seconds."""
    after = min(stretch.last + 1, len(track) - 1)
    return float(track.time_s[stretch.first]), float(track.time_s[after])


_PER_LINE = 2000
_QUANTITIES = (("range", "mm", 1e3, 2, 4.0), ("pitch", "°", 1.0, 3, 0.5), ("yaw", "°", 1.0, 3, 0.5))
_SYMBOLS = (
    *("circle", "square", "triangle-up", "star", "square-open", "x"),
    *("diamond", "circle-open"),
)

Json = dict[str, Any]


def posture_chart(track: Track, truth: FloatArray | None) -> Json:
    """Return range, pitch and yaw over time with their sigma, truth and the gaps."""
    columns = 1000
    found = merge_stretches(stretches(track), track, columns)
    return _strip_chart(track, track.posture, truth, found)


def error_chart(track: Track, truth: FloatArray) -> Json:
    """Return the error of range, pitch and yaw over time, to compare with the stated sigma."""
    return _strip_chart(track, track.posture - truth, None, [], is_error=True)


def plane_charts(
    points: PointSummary, track: Track, rows: list[int], lasers: list[LaserFacts]
) -> Json:
    """Return the points of the sample frames, each in the frame of its laser's plane."""
    frames = [_plane_frame(points, track, row, lasers) for row in rows]
    return {
        "frames": frames,
        "axes": _plane_axes(frames),
        "known": [laser.known for laser in lasers],
        "basis": [_basis(laser) for laser in lasers],
    }


def cloud_chart(points: PointSummary, track: Track, n_lasers: int, dome_radius_mm: float) -> Json:
    """Return the random target points of the dive by laser, in millimetres in the target's frame.

    With the least and the greatest range, between which the dome was.
    """
    xyz = 1e3 * points.cloud_in_target
    mine = [xyz[points.cloud_laser == index] for index in range(n_lasers)]
    ranges = 1e3 * track.posture[track.valid, 0]
    return {
        "lasers": [{axis: rounded(part[:, i], 0) for i, axis in enumerate("xyz")} for part in mine],
        "dome_mm": rounded([ranges.min(), ranges.max()], 0) if len(ranges) else None,
        "dome_radius_mm": None if np.isnan(dome_radius_mm) else dome_radius_mm,
    }


def quality_charts(points: PointSummary, track: Track, n_lasers: int) -> Json:
    """Return points per frame and laser and the residuals over time, and the histograms."""
    scale, unit = time_unit(track)
    time = track.time_s * scale
    counts = points.on_target[:, :n_lasers].T.astype(np.float64)
    return {
        "time_unit": unit,
        "counts": [_line(time, values, 0) for values in counts],
        "rms": _line(time, points.rms_mm(), 3),
        "sigma": _line(time, 1e3 * track.sigma[:, 0], 3),
        "residual": _residual_histogram(points.residual[:n_lasers]),
        "quality": _histogram(points.quality[:n_lasers], QUALITY_EDGES),
    }


def bare_chart(track: Track, bare: FloatArray, truth: FloatArray | None) -> Json:
    """Return the range with the dome's refraction and with a bare lens on the same pixels."""
    scale, unit = time_unit(track)
    lines = {"dome": track.posture[:, 0], "bare": bare[:, 0]}
    if truth is not None:
        lines["truth"] = truth[:, 0]
    time = track.time_s * scale
    return {"time_unit": unit, **{name: _line(time, 1e3 * one, 2) for name, one in lines.items()}}


def laser_list(names: list[str]) -> list[Json]:
    """Return the lasers' names and colours."""
    return [{"name": name, "colour": laser_colour(i)} for i, name in enumerate(names)]


def label_list() -> list[Json]:
    """Return the labels' words, colours and symbols, in the order of `Label`."""
    return [
        {"name": LABEL_WORDS[label], "colour": LABEL_COLOURS[label], "symbol": _SYMBOLS[label]}
        for label in Label
    ]


def time_unit(track: Track) -> tuple[float, str]:
    """Return the factor from seconds and the unit that suits the length of a dive."""
    return (1.0, "s") if track.time_s[-1] < 300.0 else (1.0 / 60.0, "min")


def posture_text(track: Track, row: int) -> str:
    """Return the posture of a frame with its total sigma, or the refusal, in words."""
    if not track.valid[row]:
        return f"no posture: {reason_text(track.reasons[track.reason[row]])}"
    (r, p, y), (sr, sp, sy) = track.posture[row], track.sigma_total[row]
    return signed(
        f"range {1e3 * r:.1f}{_plus_minus(1e3 * sr, 1)} mm, "
        f"pitch {p:+.2f}{_plus_minus(sp, 2)}°, yaw {y:+.2f}{_plus_minus(sy, 2)}°"
    )


def _plus_minus(sigma: float, digits: int) -> str:
    return f" ± {sigma:.{digits}f}" if np.isfinite(sigma) else ""


def _strip_chart(
    track: Track,
    posture: FloatArray,
    truth: FloatArray | None,
    gaps: list[Stretch],
    *,
    is_error: bool = False,
) -> Json:
    scale, unit = time_unit(track)
    return {
        "time_unit": unit,
        "measured": "error" if is_error else "measured",
        "strips": [_strip(track, posture, truth, i, scale, is_error) for i in range(3)],
        "span": rounded([track.time_s[0] * scale, track.time_s[-1] * scale], 4),
        "stretches": [_stretch(stretch, track, scale) for stretch in gaps],
    }


def _strip(
    track: Track,
    posture: FloatArray,
    truth: FloatArray | None,
    column: int,
    scale: float,
    is_error: bool,
) -> Json:
    name, unit, factor, digits, least = _QUANTITIES[column]
    values, sigma = factor * posture[:, column], factor * track.sigma[:, column]
    total = factor * track.sigma_total[:, column]
    rows = thin(values, _PER_LINE)
    strip = {
        "name": f"{name} error" if is_error else name,
        "unit": unit,
        "x": rounded(track.time_s[rows] * scale, 4),
        "y": rounded(values[rows], digits),
        "sigma": rounded(sigma[rows], digits),
        "total": rounded(total[rows], digits),
        "frame": track.frame[rows].tolist(),
        "breaks": breaks(rows, interruptions(track)),
        "error": is_error,
    }
    true = None if truth is None else factor * truth[:, column]
    if true is not None:
        strip["truth"] = _line(track.time_s * scale, true, digits)
    # Sigmas of errors are drawn about zero.
    strip["axis"] = _strip_axis(values, total, np.zeros(1) if is_error else true, least)
    return strip


def _strip_axis(
    values: FloatArray, sigma: FloatArray, others: FloatArray | None, least: float
) -> list[float]:
    """Return limits that hold all values and others; a few huge sigma may stick out."""
    shown = values if others is None else np.concatenate([values, others])
    shown = shown[np.isfinite(shown)]
    if not len(shown):
        return [0.0, 1.0]
    known = sigma[np.isfinite(sigma)]
    reach = 2.0 * float(np.percentile(known, 90)) if len(known) else 0.0
    low, high = float(shown.min()) - reach, float(shown.max()) + reach
    pad = max(0.04 * (high - low), 0.5 * (least - (high - low)), 0.0)
    return [round(low - pad, 4), round(high + pad, 4)]


def _line(time: FloatArray, values: FloatArray, digits: int) -> Json:
    rows = thin(values, _PER_LINE)
    return {
        "x": rounded(time[rows], 4),
        "y": rounded(values[rows], digits),
        "breaks": breaks(rows, ~np.isfinite(values)),
    }


def _stretch(stretch: Stretch, track: Track, scale: float) -> Json:
    start, end = stretch_span_s(stretch, track)
    count = count_text(int((~track.valid[stretch.first : stretch.last + 1]).sum()), "frame")
    whole = float(track.time_s[-1] - track.time_s[0])
    # Close enough for a pointer to hit one: 300 to a full width.
    steps = max(1, int(300 * (end - start) / whole)) if whole > 0.0 else 1
    hover = [(start + (end - start) * i / steps) * scale for i in range(steps + 1)]
    return {
        "from": round(start * scale, 4),
        "to": round(end * scale, 4),
        "hover": rounded(hover, 4),
        "words": f"{stretch_text(stretch, track)} – {count} from {clock(start)}",
    }


def _plane_frame(points: PointSummary, track: Track, row: int, lasers: list[LaserFacts]) -> Json:
    frame = int(track.frame[row])
    mine = points.samples.get(frame)
    normal, distance = plane_of_posture(track.posture[row : row + 1])
    planes = [
        _in_plane(mine, index, laser) | _target_line(laser, normal[0], float(distance[0]))
        for index, laser in enumerate(lasers)
    ]
    words = f"frame {frame}, {track.time_s[row]:.2f} s: {posture_text(track, row)}"
    return {"words": words, "lasers": planes}


def _in_plane(points: FramePoints | None, index: int, laser: LaserFacts) -> Json:
    """Return a frame's points on one laser as x, y in its plane (mm) with their labels."""
    if points is None or not laser.known:
        return {"x": [], "y": [], "label": [], "used": []}
    mine = np.flatnonzero(points.laser == index)
    per_laser = 300
    mine = mine[:: max(1, -(-len(mine) // per_laser))]
    origin, e_x, e_y = laser.frame()
    local = points.points_in_dome[mine] - origin
    return {
        "x": rounded(1e3 * local @ e_x, 1),
        "y": rounded(1e3 * local @ e_y, 1),
        "label": points.label[mine].tolist(),
        "used": points.used[mine].astype(int).tolist(),
    }


def _target_line(laser: LaserFacts, normal: FloatArray, distance: float) -> Json:
    """Return a x + b y = c, the target plane seen in the laser's plane, in millimetres."""
    if not (laser.known and np.isfinite(distance)):
        return {}
    origin, e_x, e_y = laser.frame()
    line = [normal @ e_x, normal @ e_y, 1e3 * (distance - normal @ origin)]
    return {"line": rounded(line, 5)}


def _plane_axes(frames: list[Json]) -> Json:
    """Return limits that hold nearly all points of every laser and sample frame, a little wider."""
    limits = {}
    drawn = [laser for frame in frames for laser in frame["lasers"]]
    for axis in "xy":
        values = [v for laser in drawn for v in laser[axis] if v is not None]
        low, high = np.percentile(values, [2, 98]) if values else (0.0, 1000.0)
        pad = 0.06 * (high - low) + 5.0
        limits[axis] = rounded([low - pad, high + pad], 1)
    return limits


def _basis(laser: LaserFacts) -> Json | None:
    if not laser.known:
        return None
    origin, e_x, e_y = laser.frame()
    return {"origin": rounded(1e3 * origin, 3), "x": rounded(e_x, 7), "y": rounded(e_y, 7)}


def _histogram(counts: IntArray, edges: FloatArray) -> Json | None:
    """Return a histogram by laser, empty ends cut off; None if all of it is empty."""
    used = np.flatnonzero(counts.sum(axis=0))
    if not len(used):
        return None
    part = slice(used[0], used[-1] + 1)
    centres = 0.5 * (edges[:-1] + edges[1:])
    return {
        "x": rounded(centres[part], 4),
        "step": round(float(edges[1] - edges[0]), 4),
        "lasers": counts[:, part].tolist(),
    }


def _residual_histogram(counts: IntArray) -> Json | None:
    """Return the middle 99 % of the residuals in about 60 bins."""
    total = counts.sum(axis=0)
    if not total.any():
        return None
    share = np.cumsum(total) / total.sum()
    middle = len(total) // 2
    low, high = int(np.searchsorted(share, 0.005)), int(np.searchsorted(share, 0.995))
    reach = max(10, middle - low, high + 1 - middle)
    width = max(1, round(reach / 30))
    n_bins = min(-(-reach // width), middle // width)
    cut = slice(middle - n_bins * width, middle + n_bins * width)
    binned = counts[:, cut].reshape(len(counts), -1, width).sum(axis=2)
    return _histogram(binned, RESIDUAL_EDGES_MM[cut.start : cut.stop + 1 : width])
