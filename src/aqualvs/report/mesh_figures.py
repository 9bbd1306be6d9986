"""`aqualvs figures`: reflections in a laser's plane and the mesh filter, from a run's folder.

The print-ready pictures follow figures 9, 13 and 14 of the paper (Constantinou, Georgiades and
Loizou, Robotics 2021, 10, 126): what a laser lit in one frame (13), what each mesh filter keeps of
it (14), and the laser-plane image (Eq. 41-42) with the structuring elements (9) to scale.
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Annulus, Circle, Rectangle
from pyarrow import parquet

from aqualvs.errors import OptionError, SourceError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.nets.target_file import target_dict
from aqualvs.optics.rigfile import rig_from_mapping
from aqualvs.report.figure_style import BLUE, DARK, GREY, PINK, STYLE, new_canvas, save_figures
from aqualvs.report.run_data import LaserFacts, lasers_of, mapping, read_run_file, working_range_m
from aqualvs.results.files import Claim, writing
from aqualvs.results.folder import POINTS_PARQUET, check_run_files
from aqualvs.results.points import stored_batches
from aqualvs.scanning.laser_bands import plan_bands
from aqualvs.scanning.paper.detector import PaperFilter
from aqualvs.scanning.paper.mesh_filter import (
    MeshFilterOptions,
    laser_frame,
    laser_plane_image,
    mesh_filter,
    structuring_elements,
)
from aqualvs.scanning.scan import Label
from aqualvs.terminal import Echo

_ZONE = "#e8f3ea"


_RINGS = {"A": "#d55e00", "B": "#009e73", "C": "#7b3fb5"}
_NAMES = ("adaptive filter", "paper's filter")


@dataclass(frozen=True, slots=True, kw_only=True)
class Reflections:
    """Points that one laser lit in one frame, N of them."""

    frame: int
    laser: str  # Its name.
    in_laser: FloatArray  # Shape (N, 2): points in `laser`, in metres: x across, y forward.
    offset: float  # Distance of the laser's plane from the dome's centre, in metres.
    # Operational range zone, distances from the dome's centre in metres.
    working_range: tuple[float, float]
    # Shape (N,): points in that zone.
    usable: BoolArray
    # Shape (N,): points that the two filters take for net.
    adaptive: BoolArray
    paper: BoolArray
    # Whether the points are bright pixels, or centres of returns.
    every_pixel: bool = False

    @property
    def noun(self) -> str:
        """Name of the points."""
        return "bright pixels" if self.every_pixel else "reflections"


FIGURES = ("figure_13", "figure_14", "laser_plane_image")
"""Names of the pictures."""


def draw_figures(reflections: Reflections, options: MeshFilterOptions) -> dict[str, Figure]:
    """Return the same pictures by name, not yet written."""
    with rc_context(STYLE):
        return {
            "figure_13": _all_reflections(reflections),
            "figure_14": _filtered(reflections, options),
            "laser_plane_image": _binary_image(reflections, options),
        }


def _dots(axes: Axes, xy: FloatArray, size: float, colour: str, label: str = "") -> None:
    axes.scatter(xy[:, 0], xy[:, 1], s=size, color=colour, linewidths=0, label=label, zorder=3)


def _all_reflections(r: Reflections) -> Figure:
    """Draw figure 13: all points that the laser lit, and the zone in which they are accepted."""
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
    _dots(axes, xy[r.usable], 2.5, BLUE, f"{r.noun} in it ({int(r.usable.sum())})")
    if not r.usable.all():
        _dots(axes, xy[~r.usable], 2.5, GREY, f"others ({int((~r.usable).sum())})")
    _plane_axes(axes, low, high)
    axes.set_title(f"{r.noun.capitalize()} of laser “{r.laser}” in its plane, frame {r.frame}")
    axes.legend(loc="lower left", markerscale=3.0, frameon=False)
    return figure


def _filtered(r: Reflections, options: MeshFilterOptions) -> Figure:
    """Draw figure 14 for both filters side by side."""
    xy = 1e3 * r.in_laser[r.usable]
    low, high = _span(xy, 0.06)
    # Room for the legend, and no strip where all lies in one line.
    width, height = (high - low).tolist()
    spare = max(0.55 * width - 1.14 * height, 0.0)
    low[1], high[1] = low[1] - 0.5 * spare, high[1] + 0.14 * height + 0.5 * spare
    size = np.array([150.0, 75.0])  # Of a detail, in mm.
    shapes = [min((high[1] - low[1]) / width, 1.3), size[1] / size[0]]
    figure = new_canvas(7.2, 3.3 * sum(shapes) + 1.5)
    grid = figure.subplots(2, 2, height_ratios=shapes)
    view = _detail(1e3 * r.in_laser[r.adaptive | r.paper], xy, 0.5 * size)
    for column, (name, net) in enumerate(zip(_NAMES, (r.adaptive, r.paper), strict=True)):
        kept = 1e3 * r.in_laser[net & r.usable]
        axes = grid[0, column]
        _dots(axes, xy, 3.0, PINK, f"all ({len(xy)})")
        _dots(axes, kept, 3.0, BLUE, f"net ({len(kept)})")
        _plane_axes(axes, low, high)
        axes.add_patch(_box(*view))
        axes.set_title(f"({'ab'[column]}) {name}")
        axes.legend(loc="upper right", markerscale=2.5, ncols=2, frameon=False)
        detail = grid[1, column]
        _dots(detail, xy, 7.0, PINK)
        _dots(detail, kept, 7.0, BLUE)
        _plane_axes(detail, *view)
        detail.set_title(f"({'cd'[column]}) {name}, detail")
    figure.suptitle(
        f"Frame {r.frame}, laser “{r.laser}”; paper's filter: rdθ {1e3 * options.rd_theta:.3g}, "
        f"dd {1e3 * options.dd:.3g}, r_min {1e3 * options.r_min:.3g}, "
        f"r_max {1e3 * options.r_max:.3g} mm",
        fontsize=8.5,
    )
    return figure


def _binary_image(r: Reflections, options: MeshFilterOptions) -> Figure:
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
    left.scatter(centres[:, 0], centres[:, 1], s=1.2, marker="s", color=DARK, linewidths=0)
    low, high = _span(centres, 0.06)
    half, middle = 0.5 * np.max(high - low), 0.5 * (low + high)
    _plane_axes(left, middle - half, middle + half)
    columns, rows = image.lit.shape
    left.set_title(f"(a) Im: {columns} x {rows} cells of {dd:.3g} mm, {len(cells)} lit")
    middle = _typical(r, corner, dd)
    reach = 1.15 * dd * options.padding
    left.add_patch(_box(middle - reach, middle + reach))
    _cells(right, image.lit, corner, dd, middle, reach)
    _rings(right, options, middle, cells, corner)
    return figure


def _cells(
    axes: Axes, lit: BoolArray, corner: FloatArray, dd: float, middle: FloatArray, reach: float
) -> None:
    """Draw the lit cells around a place to scale."""
    extent = (corner[0], corner[0] + dd * lit.shape[0], corner[1], corner[1] + dd * lit.shape[1])
    two = ListedColormap(["white", DARK])
    axes.imshow(lit.T, two, vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    _plane_axes(axes, middle - reach, middle + reach)


def _rings(
    axes: Axes, options: MeshFilterOptions, middle: FloatArray, cells: Any, corner: FloatArray
) -> None:
    """Draw the regions A, B and C as circles, and count the lit cells in each of them."""
    half, dd = 1e3 * options.rd_theta / 2.0, 1e3 * options.dd
    outer = {"A": half, "B": max(1e3 * options.r_min - half, half), "C": 1e3 * options.r_max + half}
    at = np.rint((middle - corner) / dd - 0.5).astype(np.int64)
    offset = cells - at + options.padding
    near = np.all((offset >= 0) & (offset <= 2 * options.padding), axis=1)
    for (name, radius), element in zip(outer.items(), structuring_elements(options), strict=True):
        count = int(np.count_nonzero(element[offset[near, 0], offset[near, 1]]))
        ring = Circle((float(middle[0]), float(middle[1])), radius, fill=False, linewidth=1.2)
        ring.set(edgecolor=_RINGS[name], label=f"{name}: to {radius:.3g} mm, {count} cells lit")
        axes.add_patch(ring)
    dg = options.dg_theta
    axes.set_title(
        f"(b) regions around a cell; it is kept if A holds\n{-(-dg // 2)} to {dg} lit cells, "
        f"A and B up to {dg}, C {-(-3 * dg // 2)} to {2 * dg}"
    )
    axes.legend(loc="lower left", framealpha=0.9, edgecolor="none")


def _typical(r: Reflections, corner: FloatArray, dd: float) -> FloatArray:
    """Return the centre (mm) of a lit cell amid the net, if possible one that the paper keeps."""
    tried = (r.paper & r.usable, r.adaptive & r.usable, r.usable)
    xy = 1e3 * r.in_laser[next(wanted for wanted in tried if wanted.any())]
    # Light in the middle of its strand: near the median of what is nearest to the middle.
    nearest = xy[np.argmin(np.linalg.norm(xy - np.median(xy, axis=0), axis=1))]
    place: FloatArray = np.median(xy[np.linalg.norm(xy - nearest, axis=1) < 5.0], axis=0)
    return corner + dd * (np.floor((place - corner) / dd) + 0.5)


def _zone(axes: Axes, r: Reflections) -> None:
    """Shade where the laser's plane lies in the operational range, about the dome's foot."""
    near, far = (float(np.sqrt(max(d * d - r.offset**2, 0.0))) for d in r.working_range)
    if not np.isfinite(far):
        return
    words = "operational range zone, {:.0f}–{:.0f} mm".format(*(1e3 * d for d in r.working_range))
    ring = Annulus((0.0, 0.0), 1e3 * far, 1e3 * (far - near), label=words)
    ring.set(facecolor=_ZONE, edgecolor="#7da58a")
    axes.add_patch(ring)


def _plane_axes(axes: Axes, low: FloatArray, high: FloatArray) -> None:
    axes.set_xlim(float(low[0]), float(high[0]))
    axes.set_ylim(float(low[1]), float(high[1]))
    axes.set_aspect("equal")
    axes.set_xlabel("x in the laser's plane (mm)")
    axes.set_ylabel("y, forward (mm)")
    axes.grid(True, color="#d9dce1", linewidth=0.4)
    axes.set_axisbelow(True)


def _span(xy: FloatArray, margin: float) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a box around nearly all points, with a margin; 1 m² without any."""
    if not len(xy):
        return np.array([-500.0, 0.0]), np.array([500.0, 1000.0])
    # Stragglers beyond these quantiles do not set the scale of a picture.
    low, high = np.quantile(xy, [0.005, 0.995], axis=0)
    extra = margin * np.maximum(high - low, 50.0)
    return low - extra, high + extra


def _detail(net: FloatArray, others: FloatArray, half: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the window of half a size (2,) that shows most of the net."""
    xy = net if len(net) else others
    if not len(xy):
        return -half, half
    inside = [np.count_nonzero(np.all(np.abs(xy - at) < half, axis=1)) for at in xy]
    middle = xy[int(np.argmax(inside))]
    return middle - half, middle + half


def _box(low: FloatArray, high: FloatArray) -> Any:
    width, height = (high - low).tolist()
    corner = (float(low[0]), float(low[1]))
    return Rectangle(corner, width, height, fill=False, edgecolor=DARK, linewidth=0.8)


_COLUMNS = ["x_m", "y_m", "z_m", "label"]
_PIXEL_COLUMNS = ["u_px", "v_px", "width_px", "label"]
# Frames have numbers of 32 bits, lasers of 8.
_LASERS = 1 << 8


def figures(
    folder: Path,
    out: Path,
    echo: Echo,
    *,
    frame: int | None = None,
    laser: str | None = None,
    target: Path | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Draw figures 13 and 14 of the paper, and its laser-plane image, from a run's folder.

    A run with the threshold detector is shown by all its bright pixels, others by the centres of
    their returns. Options are those of `aqualvs figures`, see its `--help`. Returns the paths of
    what was written.

    Raises `SourceError` if the folder holds no points, or the rig is not on record; `OptionError`
    if the frame or laser has no points, or the run has already dropped what its filter rejected;
    `OutputError` if the pictures cannot be written.
    """
    check_run_files(folder)
    run, problem = read_run_file(folder)
    if problem:
        raise SourceError(f"{folder}: {problem} Give the folder of a run that has one.")
    facts = _lasers(folder, run)
    options = _paper_options(folder, run, target)
    points = folder / POINTS_PARQUET
    if not points.is_file():
        raise SourceError(
            f"{points}: is not there; give the folder of a run (aqualvs report completes one that "
            "was killed)"
        )
    try:
        names = [one.name for one in facts]
        chosen = _candidates(points, *_count(points), names, frame, laser)
        shown = (_read(points, one, facts[one[1]], run, options) for one in chosen)
        reflections = max(shown, key=_worth)
    except (pa.ArrowInvalid, OSError, KeyError) as fault:
        why = " ".join(str(fault).split())
        raise SourceError(f"{points}: cannot be read ({why}); run again") from fault
    files = [out / f"{name}.png" for name in FIGURES]
    with Claim("figures", files, overwrite=overwrite), writing(out):
        written = save_figures(draw_figures(reflections, options), out, dpi=220)
    for line in _summary(reflections):
        echo(line)
    for path in written:
        echo(f"figure: {path}")
    return written


def _lasers(folder: Path, run: Mapping[str, Any]) -> list[LaserFacts]:
    known = lasers_of(mapping(run, "rig"))
    if not known or not all(np.isfinite(one.offset) for one in known):
        raise SourceError(f"{folder / 'run.yaml'}: holds no lasers; run again with a whole rig")
    return known


def _paper_options(folder: Path, run: Mapping[str, Any], target: Path | None) -> MeshFilterOptions:
    if mapping(mapping(run, "options"), "scanner").get("mesh_filter"):
        raise OptionError(
            f"{folder}: the run used --mesh-filter paper, which drops rejected points; run once "
            "more without it (the figures apply the filter themselves)"
        )
    return MeshFilterOptions() if target is None else target_dict(str(target)).mesh_filter


def _count(points: Path) -> tuple[Counter[int], Counter[int]]:
    """Count net and all reflections by frame times `_LASERS` plus laser, with little memory."""
    n_net, n_all = Counter[int](), Counter[int]()
    for batch in stored_batches(points, 1 << 16, ("frame", "laser", "label")):
        frame = batch["frame"].to_numpy().astype(np.int64)
        keys = frame * _LASERS + batch["laser"].to_numpy()
        n_net.update(keys[_is_net(batch["label"])].tolist())
        n_all.update(keys.tolist())
    return n_net, n_all


def _is_net(label: Any) -> BoolArray:
    net = Label.NET.name.lower()
    return np.array([name == net for name in label.to_pylist()], np.bool_)


def _candidates(
    points: Path,
    n_net: Counter[int],
    n_all: Counter[int],
    names: list[str],
    frame: int | None,
    laser: str | None,
) -> list[tuple[int, int]]:
    """Return frames and lasers that show most of both, the best first, among those asked for."""
    if laser is not None and laser not in names:
        raise OptionError(f"--laser {laser}: no such laser; the rig has {', '.join(names)}")
    lasers = range(len(names)) if laser is None else [names.index(laser)]
    asked = [key for key in n_all if key % _LASERS in lasers and frame in (None, key // _LASERS)]
    if not asked:
        wanted = [f"--frame {frame}"] * (frame is not None) + [f"--laser {laser}"] * bool(laser)
        raise OptionError(f"{' '.join(wanted) or points}: no point there; choose another")
    # What shows only one of both shows nothing; of equals the fullest.
    asked.sort(key=lambda key: (min(n_net[key], n_all[key] - n_net[key]), n_all[key]))
    # So many of the fullest are looked at.
    candidates = 16
    return [divmod(key, _LASERS) for key in asked[::-1][:candidates]]


def _worth(r: Reflections) -> float:
    """Return how much a picture would show: pieces of net, and what else is in the zone.

    A stripe along one strand shows no mesh, however long it is.
    """
    x = np.sort(r.in_laser[r.adaptive & r.usable, 0])
    strand_gap = 4e-3  # Distance of pieces of net, in metres.
    pieces = np.count_nonzero(np.diff(x) > strand_gap)
    return float(pieces * np.sqrt(1.0 + np.count_nonzero(r.usable & ~r.adaptive)))


def _read(
    points: Path,
    chosen: tuple[int, int],
    laser: LaserFacts,
    run: Mapping[str, Any],
    options: MeshFilterOptions,
) -> Reflections:
    plane = Plane(laser.normal, laser.offset)
    near, far = working_range_m(run["rig"]) or (0.0, np.inf)
    detector = mapping(mapping(mapping(run, "options"), "scanner"), "detector")
    every_pixel = detector.get("kind") == "threshold"
    table = parquet.read_table(
        points.absolute(),
        columns=_PIXEL_COLUMNS if every_pixel else _COLUMNS,
        filters=[("frame", "==", chosen[0]), ("laser", "==", chosen[1])],
    )
    if every_pixel:
        in_dome, adaptive, paper = _pixels(table, chosen[1], run, options)
    else:
        in_dome = _columns(table, "x_m", "y_m", "z_m")
        adaptive = _is_net(table["label"])
        paper = mesh_filter(in_dome, plane, options, working_range=(near, far))
    distance = np.linalg.norm(in_dome, axis=1)
    return Reflections(
        frame=chosen[0],
        laser=laser.name,
        in_laser=np.ascontiguousarray(laser_frame(plane).apply(in_dome)[:, :2]),
        offset=laser.offset,
        working_range=(near, far),
        usable=(distance >= near) & (distance <= far),
        adaptive=adaptive,
        paper=paper,
        every_pixel=every_pixel,
    )


def _pixels(
    table: Any, laser: int, run: Mapping[str, Any], options: MeshFilterOptions
) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Return the bright pixels of a run with the threshold detector.

    Return them in `dome`, shape (N, 3), and which of them each filter takes for net.
    """
    rig = rig_from_mapping(run["rig"], source_name="run.yaml")
    camera = rig.camera()
    papers = PaperFilter(rig, camera, plan_bands(rig, camera), options, every_pixel=True)
    centres, width = _columns(table, "u_px", "v_px"), _columns(table, "width_px")[:, 0]
    found = papers.apply(centres, width, np.full(len(width), laser))
    return found.points_in_dome, _is_net(table["label"])[found.source], found.on_mesh


def _columns(table: Any, *names: str) -> FloatArray:
    return np.stack([table[name].to_numpy() for name in names], axis=-1).astype(np.float64)


def _summary(r: Reflections) -> list[str]:
    both = int(np.count_nonzero(r.adaptive & r.paper))
    return [
        f"frame {r.frame}, laser {r.laser}: {len(r.in_laser)} {r.noun}, "
        f"{int(r.usable.sum())} of them in the working range",
        f"net by the adaptive filter: {int(r.adaptive.sum())}; by the paper's: "
        f"{int(r.paper.sum())}, {both} of them the same",
    ]
