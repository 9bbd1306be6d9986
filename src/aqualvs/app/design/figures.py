"""Two pictures of a design: errors over range, and where in the picture the stripes are.

Matplotlib is asked for when a picture is drawn, and only its Agg canvas: no display is needed.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aqualvs.app.canvas import new_canvas
from aqualvs.app.design.calibrated import camera_errors
from aqualvs.app.design.predict import predict, together
from aqualvs.app.design.settings import Design
from aqualvs.app.design.words import shown_ranges
from aqualvs.geometry.arrays import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ERRORS_PNG, PICTURE_PNG = "errors.png", "picture.png"

_DPI = 160
_BLUE, _ORANGE, _DARK, _GREY = "#1f4fc8", "#d55e00", "#23272e", "#8a8f98"
_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "grid.color": "#e4e6ea",
    "grid.linewidth": 0.6,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
}
# What the camera's tolerances make changes little with range.
_N_RANGES, _N_CAMERA, _N_ALONG = 60, 5, 40


def draw_figures(design: Design, out: Path) -> list[Path]:
    """Write `errors.png` and `picture.png`.

    Parameters
    ----------
    design : Design
        With its lasers tilted as they will be.
    out : Path
        Folder that exists.

    Raises
    ------
    OSError
        If a picture cannot be written.
    """
    from matplotlib import rc_context

    written = []
    with rc_context(_STYLE):
        for name, draw in ((ERRORS_PNG, _errors), (PICTURE_PNG, _picture)):
            draw(design).savefig(out / name, dpi=_DPI)
            written.append(out / name)
    return written


def _errors(design: Design) -> "Figure":
    """Range error in per cent, pitch and yaw in degrees, over range."""
    ranges = np.geomspace(*design.rig.working_range, _N_RANGES)
    told = predict(design, ranges)
    few = np.geomspace(*design.rig.working_range, _N_CAMERA)
    camera = together(camera_errors(design, few.tolist()))
    camera = np.stack([np.interp(ranges, few, column) for column in camera.T], axis=-1)
    systematic = np.hypot(told.systematic_total, camera)
    figure = new_canvas(7.2, 2.9)
    panels = figure.subplots(1, 3, sharex=True)
    kinds = (
        ("net, one frame", told.net, _ORANGE, "-"),
        ("wall, one frame", told.wall, _BLUE, "-"),
        ("tolerances", systematic, _DARK, "--"),
    )
    percent, degrees = 100.0 / ranges, np.full_like(ranges, 180.0 / np.pi)
    goal = 100.0 * design.goals.range_share, np.degrees(design.goals.angle)
    titles = ("range (%)", percent, goal[0]), ("pitch (deg)", degrees, goal[1])
    for i, (axes, (title, unit, wanted)) in enumerate(
        zip(panels, (*titles, ("yaw (deg)", degrees, goal[1])), strict=True)
    ):
        for name, sigma, colour, style in kinds:
            axes.plot(ranges * 1e3, sigma[:, i] * unit, style, color=colour, label=name)
        axes.axhline(wanted, color=_GREY, linewidth=0.8, linestyle=":", label="goal")
        axes.set_yscale("log")
        axes.set_title(f"one sigma of {title}", fontsize=9.0)
        axes.set_xlabel("range (mm)")
        axes.yaxis.set_major_formatter(_plain())
        axes.grid(True, which="both")
        axes.spines[["top", "right"]].set_visible(False)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def _plain() -> Any:
    from matplotlib.ticker import FuncFormatter

    return FuncFormatter(lambda value, _: f"{value:g}")


def _picture(design: Design) -> "Figure":
    """Draw the camera's picture with all stripes, coloured by range."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    width, height = design.rig.size_px
    figure = new_canvas(7.2, 5.6 * height / width + 0.6)
    axes = figure.subplots()
    near, far = design.rig.working_range
    norm, colours = LogNorm(near * 1e3, far * 1e3), colormaps["viridis_r"].resampled(256)
    ranges = np.array(shown_ranges((near, far)))
    for lines in _stripe_pixels(design, ranges):
        for wall, pixels in zip(ranges, lines, strict=True):
            axes.plot(*pixels.T, color=colours(norm(wall * 1e3)), linewidth=1.6)
    _label_lasers(axes, design, ranges)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    axes.set_xlabel("x (px)")
    axes.set_ylabel("y (px)")
    axes.grid(False)
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=axes, aspect=30)
    bar.set_ticks((ranges * 1e3).tolist(), labels=[f"{wall * 1e3:.0f}" for wall in ranges])
    bar.minorticks_off()
    bar.set_label("range of a wall square ahead (mm)")
    return figure


def _stripe_pixels(design: Design, ranges: FloatArray) -> FloatArray:
    """Pixels (L, W, N, 2) along every laser's visible stripe; NaN where there is none."""
    stripes = predict(design, ranges).stripes
    share = np.linspace(0.0, 1.0, _N_ALONG)
    begin, end = stripes.ends[..., :1], stripes.ends[..., 1:]
    place = begin + share * (end - begin)
    along = stripes.along[:, None, None, :]
    points = stripes.centre[:, :, None, :] + place[..., None] * along
    pixels, _ = design.rig.camera().project(points)
    return pixels


def _label_lasers(axes: "Axes", design: Design, ranges: FloatArray) -> None:
    """Name every laser beside a place of its nearest stripe that is far from the others' labels."""
    taken: list[FloatArray] = []
    for mount, lines in zip(design.mounts, _stripe_pixels(design, ranges), strict=True):
        seen = [line for line in lines if np.isfinite(line).all()]
        if not seen:
            continue
        inner = seen[0][_N_ALONG // 5 : -_N_ALONG // 5]
        room = [min((float(np.hypot(*(p - q))) for q in taken), default=0.0) for p in inner]
        spot = inner[int(np.argmax(room))]
        taken.append(spot)
        axes.annotate(
            mount.name,
            spot,
            ha="center",
            va="center",
            fontsize=8.0,
            color=_DARK,
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": _GREY, "lw": 0.5},
        )
