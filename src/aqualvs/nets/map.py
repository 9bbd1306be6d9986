"""A picture of the net wall, unrolled: fouling by colour, holes to scale, the vehicle's track.

Drawn without a display; Matplotlib is loaded only when a map is drawn.
"""

import importlib.util
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.tables import METRES_PER_DEGREE, UnrolledNet, fouling_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure


# Looks alike in all kinds of colour vision, from dark blue (clean) to yellow.
_COLOURS = "cividis"
_GREY, _PATH, _HOLE = "#c4c9cd", "#ffffff", "#d55e00"
_INK, _SEA = "#14222c", "#f4f7f8"
# Marker of the track's start: a square, which has no direction and is no hole.
_START = "s"
# Its keys are a type of their own in some versions of Matplotlib.
_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.edgecolor": "#8796a0",
    "axes.linewidth": 0.7,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    # Equal results give equal files.
    "svg.hashsalt": "aqualvs",
}


def draw_map(wall: UnrolledNet, paths: Sequence[Path]) -> bool:
    """Draw the map of a net; without a stretch the picture says so.

    The suffix of each path (`.png`, `.svg`, `.pdf`) selects its format. If Matplotlib is not
    installed, earlier maps are deleted, for they are of other results, and False is returned.
    Raises `OSError` if a file cannot be written.
    """
    if importlib.util.find_spec("matplotlib") is None:
        for path in paths:
            path.unlink(missing_ok=True)
        return False
    import matplotlib as mpl

    dpi = 160
    with mpl.rc_context(_STYLE):
        figure = _figure(wall)
        for path in paths:
            # A date would make equal maps differ.
            dated = {".svg": "Date", ".pdf": "CreationDate"}.get(path.suffix.lower())
            figure.savefig(path, dpi=dpi, metadata={dated: None} if dated else None)
    return True


def _figure(wall: UnrolledNet) -> "Figure":
    from matplotlib.figure import Figure

    width_in, panel_in = 11.0, 9.0
    if not wall.outlines:
        figure = Figure(figsize=(width_in, 2.0), facecolor="white")
        figure.text(0.5, 0.5, "no net was seen", ha="center", va="center")
        return figure
    low, high = _extent(wall)
    # A wall is cut into rows, so that none is a thin line: least height of a row for its width.
    min_ratio, max_rows = 0.13, 8
    wide, tall = high - low
    n_rows = 1 if wall.by_bearing else min(max(math.ceil(min_ratio * (wide / tall)), 1), max_rows)
    length = wide / n_rows
    ratio = 0.35 if wall.by_bearing else float(tall / length)
    # Greatest height and least width, in inches: a net passed up or down makes a narrower picture.
    tallest_in, narrowest_in = 8.0, 6.5
    height = min(panel_in * ratio, tallest_in)
    width = max(height / ratio + width_in - panel_in, narrowest_in)
    row_gap_in, around_in = 0.5, 1.0
    size = (width, n_rows * (height + row_gap_in) + around_in)
    figure = Figure(figsize=size, facecolor="white", layout="constrained")
    axes = figure.subplots(n_rows, 1, squeeze=False)[:, 0]
    shades = _shades(wall)
    for row, one in enumerate(axes):
        _draw(one, wall, shades)
        one.set_xlim(low[0] + row * length, low[0] + (row + 1) * length)
        one.set_ylim(low[1], high[1])
        _label_axes(one, wall, last=row == n_rows - 1)
        _label_holes(one, wall)
        _mark_bearings(one, wall, name=row == 0)
    _scale_bar(axes[0], wall, length)
    bearing = _single_bearing(wall)
    faces = "" if bearing is None else f", facing {bearing:.0f}°"
    title = f"Net wall unrolled{faces}, as seen from the vehicle"
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    _legend(figure, wall)
    # Height of the scale of colours on a small map.
    bar_in = 2.4
    if any(fouling_of(one) is not None for one in wall.stretches):
        share = min(1.0, bar_in / size[1] + 0.25)
        bar = figure.colorbar(shades, ax=list(axes), shrink=share, pad=0.015)
        bar.set_label("fouling: solidity\nbeyond the bare twine")
    return figure


def _extent(wall: UnrolledNet) -> tuple[FloatArray, FloatArray]:
    """Return the corners of the drawing, holes included, with a margin."""
    margin_share = 0.09
    holes = [
        middle + 0.5 * np.array(_drawn_size(wall, hole.extent)) * sign
        for hole, middle in zip(wall.holes, wall.holes_xy, strict=True)
        for sign in (-1.0, 1.0)
    ]
    corners = np.concatenate([*wall.outlines, *wall.path, np.reshape(holes, (-1, 2))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = margin_share * (high - low)
    if not wall.by_bearing:
        margin[:] = margin.min()
    return low - margin, high + margin


def _shades(wall: UnrolledNet) -> "ScalarMappable":
    min_scale = 0.1
    scale_step = 0.05
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    known = [value for value in map(fouling_of, wall.stretches) if value is not None]
    most = max([*known, min_scale])
    top = scale_step * math.ceil(most / scale_step - 1e-9)
    return ScalarMappable(Normalize(0.0, top), _COLOURS)


def _draw(axes: "Axes", wall: UnrolledNet, shades: "ScalarMappable") -> None:
    from matplotlib.patches import Ellipse, Polygon

    axes.set_facecolor(_SEA)
    # Where stretches overlap, the one with more frames is on top.
    pairs = zip(wall.stretches, wall.outlines, strict=True)
    for stretch, outline in sorted(pairs, key=lambda pair: pair[0].n_frames):
        fouling = fouling_of(stretch)
        colour = _GREY if fouling is None else shades.to_rgba(np.array([fouling]))[0]
        hatch = "////" if fouling is None else None
        axes.add_patch(
            Polygon(outline, facecolor=colour, edgecolor="white", linewidth=0.6, hatch=hatch)
        )
    # The vehicle's track is drawn thinner if there are more stretches than this.
    many, thin, thick = 40, 0.6, 1.2
    width = thin if len(wall.stretches) > many else thick
    for line in wall.path:
        axes.plot(*line.T, color=_INK, linewidth=2.0 * width, alpha=0.55, solid_capstyle="round")
        axes.plot(*line.T, color=_PATH, linewidth=width, marker="o", markersize=2.0 * width)
    start = wall.path[0][0]
    axes.plot(*start, marker=_START, color=_PATH, markeredgecolor=_INK, markersize=8)
    for hole, middle in zip(wall.holes, wall.holes_xy, strict=True):
        width, height = _drawn_size(wall, hole.extent)
        axes.add_patch(
            Ellipse(tuple(middle), width, height, facecolor="white", edgecolor=_HOLE, linewidth=1.8)
        )


def _drawn_size(wall: UnrolledNet, extent: tuple[float, float]) -> tuple[float, float]:
    """Return width and height of a hole in the units of the axes."""
    width = extent[0] / METRES_PER_DEGREE if wall.by_bearing else extent[0]
    return width, extent[1]


def _label_axes(axes: "Axes", wall: UnrolledNet, *, last: bool) -> None:
    if not wall.by_bearing:
        axes.set_aspect("equal")
    if wall.by_depth:
        axes.yaxis.set_major_formatter(lambda value, _: f"{-value:g}")
    axes.set_ylabel("depth, m" if wall.by_depth else "up from the start, m")
    if wall.by_bearing:
        axes.xaxis.set_major_formatter(lambda value, _: f"{value % 360.0:g}°")
    if last:
        axes.set_xlabel(
            "bearing of the net" if wall.by_bearing else "along the net to the right, m"
        )
    axes.grid(color="#dfe5e8", linewidth=0.6)
    axes.set_axisbelow(True)


def _label_holes(axes: "Axes", wall: UnrolledNet) -> None:
    """Write number and size of each hole beside its band, by turns above and below it."""
    begins = np.array([one.begin_s for one in wall.stretches])
    for i, (hole, middle) in enumerate(zip(wall.holes, wall.holes_xy, strict=True)):
        sign = 1.0 if i % 2 == 0 else -1.0
        band = wall.outlines[max(int(np.searchsorted(begins, hole.time_s, side="right")) - 1, 0)]
        rim = sign * 0.5 * _drawn_size(wall, hole.extent)[1]
        edge = sign * _to_the_edge(band, middle, sign)
        axes.annotate(
            f"{i + 1}: {1e3 * hole.diameter:.0f} mm",
            (middle[0], middle[1] + rim),
            xytext=(middle[0], middle[1] + (edge if abs(edge) > abs(rim) else rim) + sign * 0.01),
            ha="center",
            va="bottom" if sign > 0.0 else "top",
            fontsize=8.5,
            fontweight="bold",
            color=_HOLE,
            arrowprops={"arrowstyle": "-", "color": _HOLE, "linewidth": 1.0, "shrinkA": 0.0},
            annotation_clip=True,
            zorder=5,
        )


def _to_the_edge(band: FloatArray, middle: FloatArray, sign: float) -> float:
    """Return the distance of the edge of a band above (sign 1) or below (-1) a place in it."""
    begin, end = band, np.roll(band, -1, axis=0)
    spans = (begin[:, 0] - middle[0]) * (end[:, 0] - middle[0]) < 0.0
    share = (middle[0] - begin[spans, 0]) / (end[spans, 0] - begin[spans, 0])
    height = begin[spans, 1] + share * (end[spans, 1] - begin[spans, 1])
    return float((sign * (height - middle[1])).max(initial=0.0))


def _mark_bearings(axes: "Axes", wall: UnrolledNet, *, name: bool) -> None:
    """Put the net's bearing above the axes, where it grows or falls all along."""
    bearings = 7  # Bearings that are written above a row.
    places = [one for one in wall.places.middle if one.bearing is not None]
    if wall.by_bearing or len(places) < 2 or _single_bearing(wall) is not None:
        return
    along = np.array([one.along for one in places])
    bearing = np.rad2deg(np.array([one.bearing for one in places], np.float64))
    low, high = axes.get_xlim()
    inside = np.flatnonzero((along >= low) & (along <= high))
    if np.any(np.diff(along) <= 0.0) or not len(inside):
        return
    chosen = inside[np.unique(np.linspace(0, len(inside) - 1, bearings).round().astype(int))]
    top = axes.secondary_xaxis("top")
    top.set_xticks(along[chosen], [f"{bearing[i]:.0f}°" for i in chosen])
    if name:
        top.set_xlabel("bearing of the net", fontsize=8)
    top.tick_params(labelsize=8, color="#8796a0")


def _single_bearing(wall: UnrolledNet) -> float | None:
    """Return the bearing of a net that faces one way, in degrees."""
    known = [one.bearing for one in wall.places.middle if one.bearing is not None]
    if not known:
        return None
    turned = np.rad2deg(np.unwrap(known))
    # A bearing that changes less than this, in degrees, is given in the title.
    one_bearing = 4.0
    return float(np.mean(turned)) % 360.0 if np.ptp(turned) < one_bearing else None


def _scale_bar(axes: "Axes", wall: UnrolledNet, length: float) -> None:
    if wall.by_bearing:
        return
    step = 10.0 ** math.floor(math.log10(length / 5.0))
    size = max(share * step for share in (1.0, 2.0, 5.0) if share * step <= length / 5.0)
    words = f"{size:g} m" if size >= 1.0 else f"{1e3 * size:.0f} mm"
    (low, high), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    right, y = high - 0.015 * (high - low), bottom + 0.06 * (top - bottom)
    axes.plot([right - size, right], [y, y], color=_INK, linewidth=3.0, solid_capstyle="butt")
    axes.annotate(
        words,
        (right - 0.5 * size, y),
        xytext=(0.0, 3.0),
        textcoords="offset points",
        ha="center",
        va="bottom",
        bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.8},
    )


def _legend(figure: "Figure", wall: UnrolledNet) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    path = Line2D([], [], color=_INK, marker="o", markersize=3.5, markerfacecolor=_PATH)
    start, hole = (
        Line2D([], [], linestyle="", marker=mark, color=fill, markeredgecolor=edge, markersize=size)
        for mark, fill, edge, size in ((_START, _PATH, _INK, 8), ("o", "white", _HOLE, 9))
    )
    shown: dict[str, Line2D | Patch] = {"vehicle’s track": path, "its start": start}
    if wall.holes:
        shown["hole with its number, to scale"] = hole
    if any(fouling_of(one) is None for one in wall.stretches):
        shown["not measured"] = Patch(facecolor=_GREY, edgecolor="white", hatch="////")
    figure.legend(
        list(shown.values()), list(shown), loc="outside lower left", ncols=len(shown), frameon=False
    )
