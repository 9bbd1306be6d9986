"""The numbers behind the charts, as plain data that `report.js` draws."""

from typing import Any

import numpy as np

from aqualvs.app.report_points import (
    QUALITY_EDGES,
    RESIDUAL_EDGES_MM,
    FramePoints,
    PointSummary,
    plane_of_posture,
)
from aqualvs.app.report_rig import LaserFacts
from aqualvs.app.report_run import Track
from aqualvs.app.report_series import (
    breaks,
    hover_places,
    interruptions,
    merged,
    rounded,
    stretch_end_s,
    stretch_words,
    stretches,
    thin,
)
from aqualvs.app.report_words import (
    LABEL_COLOURS,
    LABEL_WORDS,
    clock,
    laser_colour,
    reason_words,
    signed,
)
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.scanning.scan import Label

_PER_LINE = 2000
_COLUMNS = 1000
_PER_LASER = 500
_QUANTITIES = (
    ("range", "mm", 1e3, 2, 4.0),
    ("pitch", "°", 1.0, 3, 0.5),
    ("yaw", "°", 1.0, 3, 0.5),
)
_SYMBOLS = (
    *("circle", "square", "triangle-up", "star", "square-open", "x"),
    *("diamond", "circle-open"),
)

Json = dict[str, Any]


def posture_chart(track: Track, truth: FloatArray | None) -> Json:
    """Return range, pitch and yaw over time with their sigma, truth and the gaps."""
    scale, unit = time_unit(track)
    found = merged(stretches(track), track, _COLUMNS)
    return {
        "time_unit": unit,
        "measured": "measured",
        "strips": [_strip(track, track.posture, truth, column, scale) for column in range(3)],
        "span": rounded([track.time_s[0] * scale, track.time_s[-1] * scale], 4),
        "stretches": [_stretch(stretch, track, scale) for stretch in found],
    }


def error_chart(track: Track, truth: FloatArray) -> Json:
    """Return the error of range, pitch and yaw over time, to compare with the stated sigma."""
    scale, unit = time_unit(track)
    error = track.posture - truth
    strips = [_strip(track, error, None, column, scale) for column in range(3)]
    for strip in strips:
        strip["name"] += " error"
        strip["error"] = True
    span = rounded([track.time_s[0] * scale, track.time_s[-1] * scale], 4)
    return {
        "time_unit": unit,
        "measured": "error",
        "strips": strips,
        "span": span,
        "stretches": [],
    }


def plane_charts(
    points: PointSummary, track: Track, rows: list[int], lasers: list[LaserFacts]
) -> Json:
    """Return the points of the sample frames, each in the frame of its laser's plane."""
    frames = [_plane_frame(points, track, row, lasers) for row in rows]
    return {
        "frames": frames,
        "axes": [_plane_axes(frames, index) for index in range(len(lasers))],
        "known": [laser.known for laser in lasers],
        "basis": [_basis(laser) for laser in lasers],
    }


def cloud_chart(points: PointSummary, n_lasers: int, dome_radius_mm: float) -> Json:
    """Return the random target points of the dive by laser, in millimetres in `dome`."""
    xyz = 1e3 * points.cloud_in_dome
    mine = [xyz[points.cloud_laser == index] for index in range(n_lasers)]
    return {
        "lasers": [{axis: rounded(part[:, i], 1) for i, axis in enumerate("xyz")} for part in mine],
        "dome_radius_mm": None if np.isnan(dome_radius_mm) else dome_radius_mm,
    }


def quality_charts(points: PointSummary, track: Track, n_lasers: int) -> Json:
    """Return points per frame and laser and the residuals over time, and the histograms."""
    scale, unit = time_unit(track)
    time = track.time_s * scale
    counts = [points.on_target[:, index].astype(np.float64) for index in range(n_lasers)]
    rms, sigma = points.rms_mm(), 1e3 * track.sigma[:, 0]
    return {
        "time_unit": unit,
        "counts": [_line(time, values, thin(values, _PER_LINE), 0) for values in counts],
        "rms": _line(time, rms, thin(rms, _PER_LINE), 3),
        "sigma": _line(time, sigma, thin(sigma, _PER_LINE), 3),
        "residual": _residual_histogram(points.residual[:n_lasers]),
        "quality": _histogram(points.quality[:n_lasers], QUALITY_EDGES),
    }


def bare_chart(track: Track, bare: FloatArray, truth: FloatArray | None) -> Json:
    """Return the range with the dome's refraction and with a bare lens on the same pixels."""
    scale, unit = time_unit(track)
    lines = {"dome": track.posture[:, 0], "bare": bare[:, 0]}
    if truth is not None:
        lines["truth"] = truth[:, 0]
    drawn = {
        name: _line(track.time_s * scale, 1e3 * values, thin(values, _PER_LINE), 2)
        for name, values in lines.items()
    }
    return {"time_unit": unit, **drawn}


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


def posture_words(track: Track, row: int) -> str:
    """Return the posture of a frame with its total sigma, or the refusal, in words."""
    if not track.valid[row]:
        return f"no posture: {reason_words(track.reasons[track.reason[row]])}"
    (r, p, y), (sr, sp, sy) = track.posture[row], track.sigma_total[row]
    return signed(
        f"range {1e3 * r:.1f}{_plus_minus(1e3 * sr, 1)} mm, "
        f"pitch {p:+.2f}{_plus_minus(sp, 2)}°, yaw {y:+.2f}{_plus_minus(sy, 2)}°"
    )


def _plus_minus(sigma: float, digits: int) -> str:
    return f" ± {sigma:.{digits}f}" if np.isfinite(sigma) else ""


def _strip(
    track: Track, posture: FloatArray, truth: FloatArray | None, column: int, scale: float
) -> Json:
    name, unit, factor, digits, least = _QUANTITIES[column]
    values, sigma = factor * posture[:, column], factor * track.sigma[:, column]
    total = factor * track.sigma_total[:, column]
    rows = thin(values, _PER_LINE)
    strip = {
        "name": name,
        "unit": unit,
        "x": rounded(track.time_s[rows] * scale, 4),
        "y": rounded(values[rows], digits),
        "sigma": rounded(sigma[rows], digits),
        "total": rounded(total[rows], digits),
        "frame": track.frame[rows].tolist(),
        "breaks": breaks(rows, interruptions(track)),
        "error": False,
    }
    true = None if truth is None else factor * truth[:, column]
    if true is not None:
        strip["truth"] = _line(track.time_s * scale, true, thin(true, _PER_LINE), digits)
    strip["axis"] = _strip_axis(values, total, true, least)
    return strip


def _strip_axis(
    values: FloatArray, sigma: FloatArray, truth: FloatArray | None, least: float
) -> list[float]:
    """Return limits that hold all values; a few huge sigma may stick out."""
    shown = values if truth is None else np.concatenate([values, truth])
    shown = shown[np.isfinite(shown)]
    if not len(shown):
        return [0.0, 1.0]
    known = sigma[np.isfinite(sigma)]
    reach = 2.0 * float(np.percentile(known, 90)) if len(known) else 0.0
    low, high = float(shown.min()) - reach, float(shown.max()) + reach
    pad = max(0.04 * (high - low), 0.5 * (least - (high - low)), 0.0)
    return [round(low - pad, 4), round(high + pad, 4)]


def _line(time: FloatArray, values: FloatArray, rows: IntArray, digits: int) -> Json:
    return {
        "x": rounded(time[rows], 4),
        "y": rounded(values[rows], digits),
        "breaks": breaks(rows, ~np.isfinite(values)),
    }


def _stretch(stretch: Any, track: Track, scale: float) -> Json:
    start, end = stretch_end_s(stretch, track)
    rows = slice(stretch.first, stretch.last + 1)
    refused = int((~track.valid[rows]).sum())
    count = f"{refused} frame{'s' if refused > 1 else ''}"
    whole = float(track.time_s[-1] - track.time_s[0])
    return {
        "from": round(start * scale, 4),
        "to": round(end * scale, 4),
        "hover": rounded([t * scale for t in hover_places(start, end, whole)], 4),
        "words": f"{stretch_words(stretch, track)} – {count} from {clock(start)}",
    }


def _plane_frame(points: PointSummary, track: Track, row: int, lasers: list[LaserFacts]) -> Json:
    frame = int(track.frame[row])
    mine = points.samples.get(frame)
    normal, distance = plane_of_posture(track.posture[row : row + 1])
    planes = [
        _in_plane(mine, index, laser) | _target_line(laser, normal[0], float(distance[0]))
        for index, laser in enumerate(lasers)
    ]
    words = f"frame {frame}, {track.time_s[row]:.2f} s: {posture_words(track, row)}"
    return {"words": words, "lasers": planes}


def _in_plane(points: FramePoints | None, index: int, laser: LaserFacts) -> Json:
    """Return a frame's points on one laser as x, y in its plane (mm) with their labels."""
    if points is None or not laser.known:
        return {"x": [], "y": [], "label": [], "used": []}
    mine = np.flatnonzero(points.laser == index)
    mine = mine[:: max(1, -(-len(mine) // _PER_LASER))]
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


def _plane_axes(frames: list[Json], index: int) -> Json:
    """Return limits that hold nearly all points of every sample frame, a little wider."""
    limits = {}
    for axis in "xy":
        values = [v for frame in frames for v in frame["lasers"][index][axis] if v is not None]
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
