"""Reflections in a laser's plane as print-ready pictures, after figures 9, 13 and 14 of the paper.

Constantinou, Georgiades and Loizou, Robotics 2021, 10, 126. Matplotlib is asked for when a picture
is drawn, and only its Agg canvas: no display is needed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aqualvs.app.canvas import new_canvas
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.scanning.mesh import MeshFilterOptions, laser_plane_image, structuring_elements

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_DPI = 220
_PINK, _BLUE, _DARK, _GREY, _ZONE = "#f06fae", "#1f4fc8", "#23272e", "#8a8f98", "#e8f3ea"
# Width and height of a detail, in mm.
_DETAIL = (150.0, 75.0)
_RINGS = {"A": "#d55e00", "B": "#009e73", "C": "#7b3fb5"}
_STYLE: dict[Any, Any] = {
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.linewidth": 0.7,
    "legend.fontsize": 7.5,
}
# Stragglers beyond these quantiles do not set the scale of a picture.
_STRAGGLERS = 0.005
_NAMES = ("adaptive filter", "paper's filter")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflections:
    """What one laser lit in one frame, N points.

    Attributes
    ----------
    frame : int
    laser : str
        Its name.
    in_laser : array, shape (N, 2)
        Points in `laser`, in metres: x across, y forward.
    offset : float
        Distance of the laser's plane from the dome's centre, in metres.
    working_range : (float, float)
        Operational range zone, distances from the dome's centre in metres.
    usable : bool array, shape (N,)
        Points in that zone.
    adaptive, paper : bool array, shape (N,)
        Points that the two filters take for net.
    every_pixel : bool
        Whether the points are bright pixels, or centres of returns.
    """

    frame: int
    laser: str
    in_laser: FloatArray
    offset: float
    working_range: tuple[float, float]
    usable: BoolArray
    adaptive: BoolArray
    paper: BoolArray
    every_pixel: bool = False

    @property
    def noun(self) -> str:
        """Name of the points."""
        return "bright pixels" if self.every_pixel else "reflections"


FIGURES = ("figure_13", "figure_14", "laser_plane_image")
"""Names of the pictures."""


def draw_figures(reflections: Reflections, options: MeshFilterOptions, out: Path) -> list[Path]:
    """Write `figure_13.png`, `figure_14.png` and `laser_plane_image.png`.

    Parameters
    ----------
    reflections : Reflections
    options : MeshFilterOptions
        Of the paper's filter.
    out : Path
        Folder that exists.

    Returns
    -------
    list of Path

    Raises
    ------
    OSError
        If a picture cannot be written.
    """
    written = []
    for name, figure in drawn_figures(reflections, options).items():
        path = out / f"{name}.png"
        figure.savefig(path, dpi=_DPI)
        written.append(path)
    return written


def drawn_figures(reflections: Reflections, options: MeshFilterOptions) -> "dict[str, Figure]":
    """Return the same pictures by name, not yet written."""
    from matplotlib import rc_context

    with rc_context(_STYLE):
        return {
            "figure_13": _all_reflections(reflections, options),
            "figure_14": _filtered(reflections, options),
            "laser_plane_image": _binary_image(reflections, options),
        }


def _dots(axes: "Axes", xy: FloatArray, size: float, colour: str, label: str = "") -> None:
    axes.scatter(xy[:, 0], xy[:, 1], s=size, color=colour, linewidths=0, label=label, zorder=3)


def _all_reflections(r: Reflections, _: MeshFilterOptions) -> "Figure":
    """As figure 13: everything that the laser lit, and the zone in which it is believed."""
    xy = 1e3 * r.in_laser
    low, high = _span(xy, 0.08)
    near, far = (1e3 * distance for distance in r.working_range)
    low[1], high[1] = min(low[1], 0.85 * near), max(high[1], min(1.04 * far, 1.25 * high[1]))
    width, height = (high - low).tolist()
    # No narrower than the words below and above it.
    spare = max(0.5 * height - width, 0.0)
    low[0], high[0] = low[0] - 0.5 * spare, high[0] + 0.5 * spare
    tall = min(max(4.6 * height / (width + spare), 2.0), 5.6)
    figure = new_canvas(min(tall * (width + spare) / height + 1.0, 5.6), tall + 0.8)
    axes = figure.add_subplot()
    _zone(axes, r)
    _dots(axes, xy[r.usable], 2.5, _BLUE, f"{r.noun} in it ({int(r.usable.sum())})")
    if not r.usable.all():
        _dots(axes, xy[~r.usable], 2.5, _GREY, f"others ({int((~r.usable).sum())})")
    _plane_axes(axes, low, high)
    axes.set_title(f"{r.noun.capitalize()} of laser “{r.laser}” in its plane, frame {r.frame}")
    axes.legend(loc="lower left", markerscale=3.0, frameon=False)
    return figure


def _filtered(r: Reflections, options: MeshFilterOptions) -> "Figure":
    """As figure 14, for both filters side by side."""
    xy = 1e3 * r.in_laser[r.usable]
    low, high = _span(xy, 0.06)
    # Room for the legend, and no strip where all lies in one line.
    width, height = (high - low).tolist()
    spare = max(0.55 * width - 1.14 * height, 0.0)
    low[1], high[1] = low[1] - 0.5 * spare, high[1] + 0.14 * height + 0.5 * spare
    shape = min((high[1] - low[1]) / width, 1.3)
    figure = new_canvas(7.2, 3.3 * (shape + _DETAIL[1] / _DETAIL[0]) + 1.5)
    grid = figure.subplots(2, 2, height_ratios=[shape, _DETAIL[1] / _DETAIL[0]])
    view = _detail(1e3 * r.in_laser[r.adaptive | r.paper], xy)
    for column, (name, net) in enumerate(zip(_NAMES, (r.adaptive, r.paper), strict=True)):
        kept = 1e3 * r.in_laser[net & r.usable]
        axes = grid[0, column]
        _dots(axes, xy, 3.0, _PINK, f"all ({len(xy)})")
        _dots(axes, kept, 3.0, _BLUE, f"net ({len(kept)})")
        _plane_axes(axes, low, high)
        axes.add_patch(_box(*view))
        axes.set_title(f"({'ab'[column]}) {name}")
        axes.legend(loc="upper right", markerscale=2.5, ncols=2, frameon=False)
        detail = grid[1, column]
        _dots(detail, xy, 7.0, _PINK)
        _dots(detail, kept, 7.0, _BLUE)
        _plane_axes(detail, *view)
        detail.set_title(f"({'cd'[column]}) {name}, detail")
    figure.suptitle(
        f"Frame {r.frame}, laser “{r.laser}”; paper's filter: rdθ {1e3 * options.rd_theta:.3g}, "
        f"dd {1e3 * options.dd:.3g}, r_min {1e3 * options.r_min:.3g}, "
        f"r_max {1e3 * options.r_max:.3g} mm",
        fontsize=8.5,
    )
    return figure


def _binary_image(r: Reflections, options: MeshFilterOptions) -> "Figure":
    """Draw the laser-plane image (Eq. 41-42) with the structuring elements (figure 9) to scale."""
    figure = new_canvas(7.2, 4.0)
    left, right = figure.subplots(1, 2)
    xy = r.in_laser[r.usable]
    if not len(xy):
        left.set_title("no reflection in the operational range zone")
        return figure
    image, corner = laser_plane_image(xy, options.dd), 1e3 * xy.min(axis=0)
    dd = 1e3 * options.dd
    cells = np.unique(image.cells, axis=0)
    centres = corner + dd * (cells + 0.5)
    left.scatter(centres[:, 0], centres[:, 1], s=1.2, marker="s", color=_DARK, linewidths=0)
    _plane_axes(left, *_square(*_span(centres, 0.06)))
    columns, rows = image.lit.shape
    left.set_title(f"(a) Im: {columns} x {rows} cells of {dd:.3g} mm, {len(cells)} lit")
    middle = _typical(r, corner, dd)
    reach = 1.15 * dd * options.padding
    left.add_patch(_box(middle - reach, middle + reach))
    _cells(right, image.lit, corner, dd, middle, reach)
    _rings(right, options, middle, cells, corner)
    return figure


def _square(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a square window about a window."""
    half, middle = 0.5 * np.max(high - low), 0.5 * (low + high)
    return middle - half, middle + half


def _cells(
    axes: "Axes", lit: BoolArray, corner: FloatArray, dd: float, middle: FloatArray, reach: float
) -> None:
    """Lit cells around a place, each as large as it is."""
    extent = (corner[0], corner[0] + dd * lit.shape[0], corner[1], corner[1] + dd * lit.shape[1])
    from matplotlib.colors import ListedColormap

    axes.imshow(
        lit.T,
        origin="lower",
        extent=extent,
        cmap=ListedColormap(["white", _DARK]),
        vmin=0,
        vmax=1,
        interpolation="nearest",
    )
    _plane_axes(axes, middle - reach, middle + reach)


def _rings(
    axes: "Axes", options: MeshFilterOptions, middle: FloatArray, cells: Any, corner: FloatArray
) -> None:
    """Draw the regions A, B and C as circles, and count the lit cells in each of them."""
    from matplotlib.patches import Circle

    half, dd = 1e3 * options.rd_theta / 2.0, 1e3 * options.dd
    outer = {
        "A": half,
        "B": max(1e3 * options.r_min - half, half),
        "C": 1e3 * options.r_max + half,
    }
    at = np.rint((middle - corner) / dd - 0.5).astype(np.int64)
    offset = cells - at + options.padding
    near = np.all((offset >= 0) & (offset <= 2 * options.padding), axis=1)
    for (name, radius), element in zip(outer.items(), structuring_elements(options), strict=True):
        count = int(np.count_nonzero(element[offset[near, 0], offset[near, 1]]))
        axes.add_patch(
            Circle(
                (float(middle[0]), float(middle[1])),
                radius,
                fill=False,
                edgecolor=_RINGS[name],
                linewidth=1.2,
                label=f"{name}: to {radius:.3g} mm, {count} cells lit",
            )
        )
    dg = options.dg_theta
    axes.set_title(
        f"(b) regions around a cell; it is kept if A holds\n{-(-dg // 2)} to {dg} lit cells, "
        f"A and B up to {dg}, C {-(-3 * dg // 2)} to {2 * dg}"
    )
    axes.legend(loc="lower left", framealpha=0.9, edgecolor="none")


def _typical(r: Reflections, corner: FloatArray, dd: float) -> FloatArray:
    """Centre (mm) of a lit cell amid the net: of one that the paper keeps, if it keeps any."""
    for wanted in (r.paper & r.usable, r.adaptive & r.usable, r.usable):
        if wanted.any():
            xy = 1e3 * r.in_laser[wanted]
            # Light in the middle of its strand: near the median of what is nearest to the middle.
            nearest = xy[np.argmin(np.linalg.norm(xy - np.median(xy, axis=0), axis=1))]
            strand = xy[np.linalg.norm(xy - nearest, axis=1) < 5.0]
            place: FloatArray = np.median(strand, axis=0)
            break
    snapped: FloatArray = corner + dd * (np.floor((place - corner) / dd) + 0.5)
    return snapped


def _zone(axes: "Axes", r: Reflections) -> None:
    """Shade where the laser's plane lies in the operational range, about the dome's foot."""
    from matplotlib.patches import Annulus

    near, far = (float(np.sqrt(max(d * d - r.offset**2, 0.0))) for d in r.working_range)
    if not np.isfinite(far):
        return
    words = "operational range zone, {:.0f}–{:.0f} mm".format(*(1e3 * d for d in r.working_range))
    ring = Annulus((0.0, 0.0), 1e3 * far, 1e3 * (far - near), label=words)
    ring.set(facecolor=_ZONE, edgecolor="#7da58a")
    axes.add_patch(ring)


def _plane_axes(axes: "Axes", low: FloatArray, high: FloatArray) -> None:
    axes.set_xlim(float(low[0]), float(high[0]))
    axes.set_ylim(float(low[1]), float(high[1]))
    axes.set_aspect("equal")
    axes.set_xlabel("x in the laser's plane (mm)")
    axes.set_ylabel("y, forward (mm)")
    axes.grid(True, color="#d9dce1", linewidth=0.4)
    axes.set_axisbelow(True)


def _span(xy: FloatArray, margin: float) -> tuple[FloatArray, FloatArray]:
    """Lower and upper corner of nearly all points, with a margin; one square metre of nothing."""
    if not len(xy):
        return np.array([-500.0, 0.0]), np.array([500.0, 1000.0])
    low = np.quantile(xy, _STRAGGLERS, axis=0)
    high = np.quantile(xy, 1.0 - _STRAGGLERS, axis=0)
    extra = margin * np.maximum(high - low, 50.0)
    return low - extra, high + extra


def _detail(net: FloatArray, others: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the window that shows most of the net, wide enough for several meshes."""
    xy = net if len(net) else others
    half = 0.5 * np.array(_DETAIL)
    if not len(xy):
        return -half, half
    inside = [np.count_nonzero(np.all(np.abs(xy - at) < half, axis=1)) for at in xy]
    middle = xy[int(np.argmax(inside))]
    return middle - half, middle + half


def _box(low: FloatArray, high: FloatArray) -> Any:
    from matplotlib.patches import Rectangle

    width, height = (high - low).tolist()
    return Rectangle(
        (float(low[0]), float(low[1])), width, height, fill=False, edgecolor=_DARK, linewidth=0.8
    )
