"""Report of a design: tables, and two figures.

The figures show the errors over range and the stripes in the picture. Matplotlib is imported when a
figure is drawn, and only its Agg canvas, which needs no display.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table
from rich.text import Text

from aqualvs.check.finding import escaped, number_table, shutter_finding
from aqualvs.design.calibrated import INDEX_ERROR, OffsetCost
from aqualvs.design.changes import Change
from aqualvs.design.judge import PredictedErrors, predict, together
from aqualvs.design.settings import Design
from aqualvs.design.stripes import points_along
from aqualvs.geometry.arrays import BoolArray, FloatArray, runs_of
from aqualvs.report import html
from aqualvs.report.figure_style import BLUE, DARK, GREY, ORANGE, STYLE, new_canvas, save_figures
from aqualvs.results.files import replace_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def shown_ranges(working_range: tuple[float, float]) -> list[float]:
    """Return round ranges, in metres, from the nearest to the farthest."""
    near, far = (value * 1e3 for value in working_range)
    steps_mm = (10, 20, 50, 100, 200, 250, 500, 1000, 2000)
    max_rows = 6
    step = next((s for s in steps_mm if (far - near) / s <= max_rows - 2), far - near)
    first = math.floor(near / step) + 1
    inner = [step * i for i in range(first, math.ceil(far / step))]
    return [value * 1e-3 for value in (near, *inner, far)]


def predict_closely(design: Design) -> PredictedErrors:
    """Predict a design's errors at ranges close enough to show where its stripes are visible."""
    n_ranges = 181
    return predict(design, np.geomspace(*design.rig.working_range, n_ranges))


def summary(design: Design) -> list[str]:
    """Return the design in two or three lines; the third is on the shutter, if the rig has one."""
    rig = design.rig
    width, height = rig.size_px
    fov = 2.0 * math.degrees(math.atan(0.5 * width / rig.lens.fx))
    if rig.lens.model == "fisheye":
        fov = math.degrees(width / rig.lens.fx)
    x, y, z = (value * 1e3 for value in rig.dome_from_cam.translation.tolist())
    if rig.flat_port is not None:
        port = rig.flat_port
        housing = f"flat port {port.distance * 1e3:g} mm ahead, {port.thickness * 1e3:g} mm thick"
    elif rig.dome is None:
        housing = "bare lens"
    else:
        radius, thickness = rig.dome.inner_radius * 1e3, rig.dome.thickness * 1e3
        housing = f"dome {radius:g} mm + {thickness:g} mm"
    shutter = shutter_finding(rig)
    return [
        f"{rig.name}: {width}x{height} px, {fov:.0f} degrees across in air, {housing}, lens at "
        f"({x:g}, {y:g}, {z:g}) mm, water n = {rig.n_water:.4f}",
        f"net: bars of {design.net.bar * 1e3:g} mm, twine {design.net.twine * 1e3:g} mm: "
        f"{design.net.lit_share:.0%} of a stripe falls on it",
        *([] if shutter is None else [shutter.sentence]),
    ]


def verdict(design: Design, by_camera: Mapping[str, FloatArray]) -> tuple[str, bool]:
    """Return a sentence on whether a design meets its goals, and whether it does.

    The errors are those of a single frame on the net at the worst range, by noise and tolerances.
    `by_camera` is from `camera_errors`, at `shown_ranges`.
    """
    ranges = shown_ranges(design.rig.working_range)
    errors, goals = predict(design, ranges), design.goals
    near, far = (f"{1e3 * wall:.0f}" for wall in design.rig.working_range)
    closely = predict_closely(design)
    if not closely.valid.all():
        return f"No: from {near} to {far} mm there is {_posture_text(closely)}.", False
    systematic = np.hypot(errors.systematic_total, together(by_camera))
    sigma = np.hypot(errors.net, systematic)
    share, angle = sigma[:, 0] / ranges, sigma[:, 1:].max(axis=1)
    worst, tilted = int(share.argmax()), int(angle.argmax())
    fine = bool(share[worst] <= goals.range_share and angle[tilted] <= goals.angle)
    return (
        f"{'Yes: meets' if fine else 'No: misses'} its goals of {100.0 * goals.range_share:g} % "
        f"and {math.degrees(goals.angle):g} degrees from {near} to {far} mm. At worst one sigma is "
        f"{100.0 * share[worst]:.2g} % of range at {1e3 * ranges[worst]:.0f} mm and "
        f"{math.degrees(angle[tilted]):.2g} degrees at {1e3 * ranges[tilted]:.0f} mm "
        "(a net, one frame, noise and tolerances)."
    ), fine


def _posture_text(closely: PredictedErrors) -> str:
    """Return the ranges with a posture as text, for a design that lacks it at some."""
    if not closely.valid.any():
        return "no posture"
    return f"a posture only at {_interval(closely.ranges, closely.valid)} mm"


def gain_text(design: Design, best: Design) -> str:
    """Return a sentence on the errors of `best` relative to a design's, where both have a posture.

    Errors are root mean squares in multiples of the goals, by noise and the tolerances of lasers
    and water, on walls and nets.
    """
    now, tilted = predict_closely(design), predict_closely(best)
    both = now.valid & tilted.valid
    if not both.any():
        return "With its lasers tilted best, its errors cannot be compared: no range has both."
    goals = np.full((np.count_nonzero(both), 3), design.goals.angle)
    goals[:, 0] = design.goals.range_share * now.ranges[both]

    def size(errors: PredictedErrors) -> float:
        squares = errors.wall**2 + errors.net**2 + 2.0 * errors.systematic_total**2
        return math.sqrt(float(np.mean(squares[both] / goals**2)))

    where = "" if both.all() else f", at {_interval(now.ranges, both)} mm"
    share = size(tilted) / size(now)
    return f"With its lasers tilted best, its errors are {share:.0%} of that{where}."


def lasers_table(design: Design, errors: PredictedErrors) -> Table:
    """Return the table of the lasers' mounts and of the ranges at which they are in the picture."""
    headings = ("x\nmm", "y\nmm", "z\nmm", "baseline\nmm", "stripe\ndeg", "tilt\ndeg")
    title = "Lasers: where, at what angles, at which ranges in the picture"
    table = number_table(title, "", *headings, "swing\ndeg", "seen\nmm", texts=[""])
    for mount, visible in zip(design.mounts, errors.visible, strict=True):
        place = [f"{value * 1e3 + 0.0:.0f}".replace("-0", "0", 1) for value in mount.position]
        angles = [_angle(mount.stripe), _angle(mount.tilt), _angle(mount.swing)]
        table.add_row(
            escaped(mount.name),
            *place,
            f"{mount.baseline * 1e3:.0f}",
            *angles,
            _interval(errors.ranges, visible),
        )
    return table


def _angle(angle: float) -> str:
    return f"{math.degrees(angle):.1f}".replace("-0.0", "0.0")


def _interval(ranges: FloatArray, visible: BoolArray) -> str:
    """Return the intervals of range at which a stripe is in the picture."""
    pieces = [f"{near * 1e3:.0f}-{far * 1e3:.0f}" for near, far in ranges[runs_of(visible)]]
    return ", ".join(pieces) or "nowhere"


_FROM, _ERRORS = "\nfrom", ("range\nmm", "\n%", "pitch\ndeg", "yaw\ndeg")


def error_table(errors: PredictedErrors, systematic: FloatArray, title: str) -> Table:
    """Return the table of one sigma of range, pitch and yaw by range.

    `systematic`, shape (W, 3): of all tolerances together, of camera, lasers and water.
    """
    points = "points on a wall,\nstrands on a net"
    names = ("range\nmm", _FROM, *_ERRORS, points)
    table = number_table(title, *names, texts=[_FROM, points])
    for i, wall in enumerate(errors.ranges):
        lines, strands = errors.stripes.lines[:, i], errors.strands[:, i]
        rows = (
            ("wall", errors.wall[i], _counts(lines)),
            ("net", errors.net[i], _counts(strands)),
            ("tolerances", systematic[i], ""),
        )
        for j, (name, sigma, points) in enumerate(rows):
            first = "" if j else f"{wall * 1e3:.0f}"
            table.add_row(first, name, *_cells(sigma, float(wall)), points)
    return table


def _counts(numbers: FloatArray) -> str:
    return " + ".join(f"{value:.0f}" for value in numbers)


def _cells(sigma: FloatArray, wall: float) -> Iterator[str]:
    values = sigma[0] * 1e3, 100.0 * sigma[0] / wall, *np.degrees(sigma[1:])
    return (_shown(float(value)) for value in values)


def _shown(value: float) -> str:
    if math.isnan(value):
        return "-"
    return f"{value:.3f}" if abs(value) < 9.995 else f"{value:.1f}"


def cause_table(causes: Mapping[str, FloatArray], i: int, wall: float) -> Table:
    """Return the table of posture errors by each tolerance at the i-th range, `wall` in metres."""
    title = f"Tolerances at {wall * 1e3:.0f} mm, one by one"
    table = number_table(title, _FROM, *_ERRORS, texts=[_FROM])
    for cause, sigma in causes.items():
        table.add_row(cause, *_cells(sigma[i], wall))
    return table


def offset_table(costs: Sequence[OffsetCost], ranges: Sequence[float]) -> Table:
    """Return the table of errors by offsets of the lens, at the nearest and the farthest range."""
    near, far = (f"{value * 1e3:.0f} mm" for value in (ranges[0], ranges[-1]))
    table = number_table(
        "Lens ahead of the dome's centre: range error",
        "offset\nmm",
        f"neglected\n{near}",
        f"\n{far}",
        f"in calibration too\n{near}",
        f"\n{far}",
        f"n +{INDEX_ERROR:g}\n{far}",
        "n known\nto +-",
    )
    for cost in costs:
        wide = cost.index_sigma
        table.add_row(
            f"{cost.offset * 1e3:g}",
            _percent(cost.neglected[0, 0] / ranges[0]),
            _percent(cost.neglected[-1, 0] / ranges[-1]),
            _percent(cost.calibrated[0, 0] / ranges[0]),
            _percent(cost.calibrated[-1, 0] / ranges[-1]),
            _percent(cost.index_error[-1, 0] / ranges[-1]),
            "not at all" if not wide < 0.1 else f"{wide:.1g}",
        )
    return table


def centring_text(design: Design, costs: Sequence[OffsetCost], ranges: Sequence[float]) -> str:
    """Return the errors by the design's centring tolerance without a calibration of the dome.

    Empty if that lens gives no posture at any of the ranges.
    """
    off = min(costs, key=lambda one: abs(one.offset - design.centring))
    if not np.isfinite([off.neglected, off.calibrated, off.aside]).any():
        return ""
    shares = _percents(off.neglected, ranges), _percents(off.calibrated, ranges)
    angles = np.degrees(off.aside[:, 2]).tolist()
    yaw = " and ".join("-" if math.isnan(angle) else f"{angle:+.2f}" for angle in angles)
    return (
        f"A lens that sits {off.offset * 1e3:g} mm off its place, if nobody calibrates the dome: "
        f"{shares[0]} of range, and {shares[1]} if the lasers are calibrated with the same "
        f"mistake; as much to the side turns yaw by {yaw} degrees "
        f"({' and '.join(f'{wall * 1e3:.0f}' for wall in ranges)} mm)."
    )


def _percents(errors: FloatArray, ranges: Sequence[float]) -> str:
    shares = (_percent(e / wall) for e, wall in zip(errors[:, 0], ranges, strict=True))
    return " and ".join(shares)


def _percent(share: float) -> str:
    return "-" if math.isnan(share) else f"{100.0 * share:+.2f} %".replace("-0.00", "+0.00")


def change_table(found: Sequence[Change]) -> Table:
    """Return the table of changes and their effects, the most helpful first."""
    names = ("\nchange", "\nall", "noise\nrange", "\nangle", "tolerances\nrange", "\nangle")
    title = "Change of the errors in per cent by a change of the rig, lasers tilted anew"
    table = number_table(title, *names, texts=["\nchange"])
    for words, *shares in found:
        table.add_row(words, *map(_change, shares))
    return table


def _change(share: float) -> str:
    if not math.isfinite(share):
        return "-"
    percent = round(100.0 * (share - 1.0))
    return f"{percent:+d}" if percent else "0"


def findings(design: Design, errors: PredictedErrors) -> list[str]:
    """Return findings: missing postures, stripes out of the picture, crossings."""
    lines = []
    if len(design.mounts) < 2:
        lines.append("One laser draws one line: no posture; add a second.")
    elif not errors.valid.all():
        lines.append(f"There is {_posture_text(errors)} in the working range.")
    for mount, visible in zip(design.mounts, errors.visible, strict=True):
        if not visible.all():
            where = f"in the picture at {_interval(errors.ranges, visible)} mm only"
            seen = f"is {where}" if visible.any() else "is never in the picture"
            lines.append(f"Laser '{mount.name}' {seen}; where it is not, its points are missing.")
    names = [mount.name for mount in design.mounts]
    pairs = [
        f"{names[i]} and {names[j]} at {_interval(errors.ranges, errors.crossing[i, j])} mm"
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if errors.crossing[i, j].any()
    ]
    if pairs:
        lines.append(
            f"Stripes cross in the picture: {'; '.join(pairs)}. The scanner leaves points near a "
            "crossing out."
        )
    return lines


ERRORS_PNG, PICTURE_PNG, DESIGN_HTML = "errors.png", "picture.png", "design.html"

# Ranges of the plotted errors; points along a drawn stripe.
_N_RANGES, _N_ALONG = 60, 40


def draw_figures(design: Design, by_camera: Mapping[str, FloatArray], out: Path) -> list[Path]:
    """Write `errors.png` and `picture.png` into a folder that exists.

    `design` has the final tilts of its lasers; `by_camera` is from `camera_errors`, at
    `shown_ranges`, and changes little with range. Raises `OSError` if a picture cannot be written.
    """
    from matplotlib import rc_context

    with rc_context(STYLE):
        figures = {"errors": _errors(design, by_camera), "picture": _picture(design)}
        return save_figures(figures, out, dpi=160)


_FIGURES = {
    ERRORS_PNG: "Predicted errors over range: noise of one frame, tolerances, and the goals",
    PICTURE_PNG: "The camera’s picture with all stripes, coloured by range",
}


def write_page(
    path: Path,
    name: str,
    first: str,
    parts: Sequence[str | Table],
    pictures: Sequence[Path],
    *,
    fine: bool,
    tilted: bool = False,
) -> None:
    """Write a design's page: the verdict, the figures, and what the terminal shows.

    `name` is the rig's, `pictures` are from `draw_figures`, and `fine` is whether the goals are
    met. `tilted`: the figures show the rig with its lasers tilted best, unlike the verdict.
    Sentences among `parts` belong to the table before them. Raises `OSError` if it cannot be
    written.
    """
    lead: list[str] = []
    sections: list[tuple[str, html.Raw, list[str]]] = []
    for part in parts:
        if isinstance(part, Table):
            sections.append((str(part.title or ""), _as_html(part), []))
        else:
            (sections[-1][2] if sections else lead).append(part)
    of = "; lasers tilted best" if tilted else ""
    content = {
        "title": name,
        "subtitle": "predicted before it is built",
        "verdict": first,
        "fine": fine,
        "lead": lead,
        "figures": [
            (html.data_url(one.read_bytes(), "png"), _FIGURES[one.name] + of) for one in pictures
        ],
        "tables": sections,
    }
    replace_text(path, html.page("design.html", content))


_LEADING_MINUS = re.compile(r"^-(?=\d)")


def _as_html(table: Table) -> html.Raw:
    """Return a table of the terminal as one of a page."""

    def plain(cell: Any) -> str:
        return Text.from_markup(str(cell)).plain.replace("\n", " ").strip()

    head, group = [], ""
    for column in table.columns:
        first, _, second = str(column.header).rpartition("\n")
        # A column of numbers without its own heading shares that of the previous one.
        group = first if first or column.justify != "right" else group
        unit = ", " if group and second in ("mm", "%", "deg") else " "
        head.append(plain(f"{group}{unit}{second}").replace(", deg", ", °"))
    cells = [
        [_LEADING_MINUS.sub("−", plain(cell)) for cell in column.cells] for column in table.columns
    ]
    right = [i for i, column in enumerate(table.columns) if i and column.justify == "right"]
    return html.table(head, zip(*cells, strict=True), texts=min(right))


def _errors(design: Design, by_camera: Mapping[str, FloatArray]) -> "Figure":
    """Draw the range error in per cent, and pitch and yaw errors in degrees, over range."""
    ranges = np.geomspace(*design.rig.working_range, _N_RANGES)
    errors = predict(design, ranges)
    few = shown_ranges(design.rig.working_range)
    camera = np.stack([np.interp(ranges, few, by) for by in together(by_camera).T], axis=-1)
    systematic = np.hypot(errors.systematic_total, camera)
    figure = new_canvas(7.2, 2.9)
    panels = figure.subplots(1, 3, sharex=True)
    kinds = (
        ("net, one frame", errors.net, ORANGE, "-"),
        ("wall, one frame", errors.wall, BLUE, "-"),
        ("tolerances", systematic, DARK, "--"),
    )
    percent, degrees = 100.0 / ranges, np.full_like(ranges, 180.0 / np.pi)
    goal = 100.0 * design.goals.range_share, np.degrees(design.goals.angle)
    titles = ("range (%)", percent, goal[0]), ("pitch (deg)", degrees, goal[1])
    for i, (axes, (title, unit, wanted)) in enumerate(
        zip(panels, (*titles, ("yaw (deg)", degrees, goal[1])), strict=True)
    ):
        for name, sigma, colour, style in kinds:
            axes.plot(ranges * 1e3, sigma[:, i] * unit, style, color=colour, label=name)
        axes.axhline(wanted, color=GREY, linewidth=0.8, linestyle=":", label="goal")
        axes.set_yscale("log")
        axes.set_title(f"one sigma of {title}", fontsize=9.0)
        axes.set_xlabel("range (mm)")
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.grid(True, which="both")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


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
    """Return pixels (L, W, N, 2) along every laser's visible stripe; NaN if there is none."""
    stripes = predict(design, ranges).stripes
    share = np.linspace(0.0, 1.0, _N_ALONG)
    begin, end = stripes.ends[..., :1], stripes.ends[..., 1:]
    place = begin + share * (end - begin)
    points = points_along(stripes.centre, stripes.along, place)
    pixels, _ = design.rig.camera().project(points)
    return pixels


def _label_lasers(axes: "Axes", design: Design, ranges: FloatArray) -> None:
    """Label each laser at a point of its nearest stripe that is far from the other labels."""
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
            color=DARK,
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": GREY, "lw": 0.5},
        )
