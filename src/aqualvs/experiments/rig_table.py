"""The rig of the experiments compared with the paper's; table 1, instead of figures 1 and 2."""

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aqualvs.errors import RigError
from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentResult,
    ExperimentRow,
    drawn,
    listed,
)
from aqualvs.experiments.laboratory import Laboratory, frames_of
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.optics.expected_error import visible_stripe
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.report.figure_style import BLUE, DARK, GREY, OURS, PAPER
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.simulation.scenario import Scenario, parse_scenario
from aqualvs.sources.base import bgr_of
from aqualvs.text import laser_colour

# Distance of the point ahead by which refraction is stated, in metres.
_FAR = 1.0

_CAPTION = (
    "Instead of figures 1 and 2: a frame of a net at 0.52 m, with the stripe of each laser on "
    "walls at 0.52 m (full), 0.3 and 1 m (dashed); and a section through the dome, true to scale, "
    "with refracted rays from the lens (blue) and straight ones (orange)."
)


@dataclass(frozen=True, slots=True)
class Bending:
    """R rays through the dome, from lens to water, in `dome`."""

    lens: FloatArray  # Shape (3,): position, metres.
    # Shape (R, 3): intersections with the dome's surfaces, metres.
    inner: FloatArray
    outer: FloatArray
    # Shape (R, 3): unit directions in the air inside, and in the water.
    straight: FloatArray
    water: FloatArray

    @property
    def bent(self) -> FloatArray:
        """Angle between air and water, radians, shape (R,)."""
        sine = np.linalg.norm(np.cross(self.straight, self.water), axis=-1)
        angle: FloatArray = np.arctan2(sine, np.sum(self.straight * self.water, axis=-1))
        return angle

    def missed_at(self, forward: float) -> FloatArray:
        """Return the distance (R,) from straight to refracted ray in the plane y = `forward`."""
        ends = []
        for start, direction in ((self.lens, self.straight), (self.outer, self.water)):
            reach = (forward - start[..., 1]) / direction[..., 1]
            ends.append(start + reach[..., None] * direction)
        off: FloatArray = np.linalg.norm(ends[1] - ends[0], axis=-1)
        return off


def bending(rig: Rig, pixels: FloatArray) -> Bending:
    """Trace pixels (R, 2) through a rig's dome.

    Raises `RigError` if the rig has no dome.
    """
    if rig.dome is None:
        raise RigError(f"rig {rig.name} has no dome; give one that has")
    lens = rig.dome_from_cam.translation
    straight, rays = rig.bare_camera().rays(pixels).directions, rig.camera().rays(pixels)
    along = straight @ lens
    reach = np.sqrt(along**2 - lens @ lens + rig.dome.inner_radius**2) - along
    inner = lens + reach[:, None] * straight
    return Bending(lens, inner, rays.origins, straight, rays.directions)


def band_shares(rig: Rig) -> list[float]:
    """Return the share of the picture in each laser's search band."""
    shares = []
    for search in plan_bands(rig, rig.camera()):
        along = rig.size_px[1] if search.axis is SearchAxis.ALONG_Y else rig.size_px[0]
        inside = np.maximum(search.highest - search.lowest + 1, 0).sum()
        shares.append(float(inside / (along * len(search.lowest))))
    return shares


def one_frame() -> Scenario:
    """Return a dive of one frame before a net."""
    facts = {
        "duration_s": 0.04,
        "motion": {"range_mm": 520, "pitch_deg": 3, "yaw_deg": -5},
        "net": {"bar_mm": 25, "twine_mm": 2.5},
    }
    return parse_scenario(facts, "rig", "rig")


def _run(laboratory: Laboratory) -> ExperimentResult:
    rig = laboratory.rig
    width, height = rig.size_px
    # Rays of the drawing: rows of the picture, as shares of its height.
    shares = (0.0, 0.2, 0.45, 0.7, 1.0)
    rows = np.array(shares) * (height - 1)
    traced = bending(rig, np.column_stack([np.full_like(rows, rig.lens.cx), rows]))
    grid = np.stack(np.meshgrid(np.arange(0, width, 8.0), np.arange(0, height, 8.0)), axis=-1)
    everywhere = bending(rig, grid.reshape(-1, 2))
    bent = float(np.rad2deg(everywhere.bent.max()))
    missed = 1e3 * float(everywhere.missed_at(_FAR).max())
    return ExperimentResult(
        sentence=f"The rig stands in for the paper's: its lens sits "
        f"{1e3 * float(np.linalg.norm(traced.lens)):.1f} mm off the dome's centre, so that rays "
        f"bend by up to {bent:.1f}° on their way into the water, and a point 1 m ahead would be "
        f"{missed:.0f} mm off without refraction.",
        findings=_findings(rig, bent, missed),
        pictures=(drawn("figure_1_2", _CAPTION, 3.0, lambda f: _draw(f, laboratory, traced)),),
        series=(_series(traced),),
        notes=(
            "The paper gives the focal length in millimetres and no planes of its lasers; it is "
            "replaced by a rig in round numbers near table 1, whose ground truth is known.",
            "The paper turns the camera and, by a second set of angles, its image plane; here "
            "both are one rotation. Its axes are those of the dome: x right, y forward, z up.",
            "The band of the picture in which each laser is visible within the working range "
            "follows from the rig; these bands replace the areas that the paper draws by hand. "
            "They overlap: stripes are then assigned to lasers by direction and continuity.",
        ),
    )


def _findings(rig: Rig, bent: float, missed: float) -> tuple[ExperimentRow, ...]:
    assert rig.dome is not None
    lens, shell = rig.lens, rig.dome
    turn = rotvec_from_rotation(rig.dome_from_cam.rotation @ DOME_FROM_CAM_NOMINAL.T)
    place = 1e3 * rig.dome_from_cam.translation
    near, far = rig.working_range
    names = ", ".join(laser.name for laser in rig.lasers)
    bands = ", ".join(f"{100.0 * share:.0f}" for share in band_shares(rig))
    rows = (
        ("picture (px)", "720 × 576", " × ".join(map(str, rig.size_px))),
        ("focal length", "5.485 mm", f"{lens.fx:g}, {lens.fy:g} px"),
        ("dome, internal radius (mm)", "44.25", f"{1e3 * shell.inner_radius:.2f}"),
        ("dome, thickness (mm)", "5.75", f"{1e3 * shell.thickness:.2f}"),
        ("index of air", "1.0003", f"{rig.n_air:.4f}"),
        ("index of the acrylic", "1.4900", f"{shell.n_acrylic:.4f}"),
        ("index of the water", "1.3333", f"{rig.n_water:.4f}"),
        ("camera's rotation (rad)", "0.0438, 0.0229, 0.1982", listed(turn, 4)),
        ("lens in the dome (mm)", "3.0, 41.53, 3.0", listed(place, 2)),
        ("image plane, turned by (rad)", "-0.0012, -0.0011, -0.0112", "in the camera's rotation"),
        ("green line lasers", "3, planes not printed", f"{len(rig.lasers)}: {names}"),
        ("working range (mm)", "300-1000", f"{1e3 * near:.0f}-{1e3 * far:.0f}"),
        ("share of the picture that each laser's band takes (%)", "areas by hand", bands),
        ("rays bend by up to (°)", "", f"{bent:.1f}"),
        ("a point 1 m ahead, off by without refraction (mm)", "", f"{missed:.0f}"),
    )
    return tuple(ExperimentRow(what=what, paper=paper, ours=ours) for what, paper, ours in rows)


def _series(traced: Bending) -> DataColumns:
    columns = {
        "bent_deg": np.rad2deg(traced.bent),
        "missed_at_1_m_mm": 1e3 * traced.missed_at(_FAR),
    }
    for name, points in (("inner", traced.inner), ("outer", traced.outer)):
        columns.update({f"{name}_{axis}_mm": 1e3 * points[:, i] for i, axis in enumerate("xyz")})
    for name, way in (("air", traced.straight), ("water", traced.water)):
        columns.update({f"{name}_{axis}": way[:, i] for i, axis in enumerate("xyz")})
    return DataColumns(name="rays", columns=columns)


def _draw(figure: Figure, laboratory: Laboratory, traced: Bending) -> None:
    view, section = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    rig = laboratory.rig
    frame = frames_of(laboratory.dive(one_frame()))[0]
    view.imshow(bgr_of(frame)[..., ::-1])
    for i, sheet in enumerate(sheets_of(rig)):
        _draw_stripes(view, rig, sheet, i)
    width, height = rig.size_px
    view.set(xlim=(0, width), ylim=(height, 0))
    view.set_axis_off()
    view.legend(loc="upper center", bbox_to_anchor=(0.5, -0.02), ncols=3)
    _draw_section(section, rig, traced)


def _draw_stripes(axes: Axes, rig: Rig, sheet: Sheet, i: int) -> None:
    """Draw a laser's stripes on walls square ahead, as a full line for the second wall."""
    # Ranges, metres.
    walls = (0.3, 0.52, 1.0)
    for far in walls:
        pixels = visible_stripe(rig.camera(), sheet, far).pixels
        full = far == walls[1]
        axes.plot(
            *pixels.T,
            "-" if full else "--",
            color=laser_colour(i),
            linewidth=1.2 if full else 0.9,
            label=rig.lasers[i].name if full else None,
        )


def _draw_section(axes: Axes, rig: Rig, traced: Bending) -> None:
    """Draw the dome's y-z plane, in millimetres; rays are seen along x."""
    assert rig.dome is not None
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 120)
    edge = 1e3 * np.stack([np.cos(angle), np.sin(angle)])
    inner, outer = rig.dome.inner_radius * edge, rig.dome.outer_radius * edge
    axes.fill(
        np.concatenate([inner[0], outer[0][::-1]]),
        np.concatenate([inner[1], outer[1][::-1]]),
        color=GREY,
        alpha=0.45,
        linewidth=0.0,
    )
    drawn_mm = 135.0
    for i in range(len(traced.inner)):
        start, bend, leave = 1e3 * traced.lens, 1e3 * traced.inner[i], 1e3 * traced.outer[i]
        reach = (drawn_mm - start[1]) / traced.straight[i, 1]
        on = start + reach * traced.straight[i]
        axes.plot([bend[1], on[1]], [bend[2], on[2]], ":", color=PAPER, linewidth=1.0)
        reach = (drawn_mm - leave[1]) / traced.water[i, 1]
        end = leave + reach * traced.water[i]
        way = np.array([start, bend, leave, end])
        axes.plot(way[:, 1], way[:, 2], color=OURS)
    axes.plot(1e3 * traced.lens[1], 1e3 * traced.lens[2], "o", color=DARK, markersize=3.5)
    axes.plot(0.0, 0.0, "+", color=DARK, markersize=7)
    _, y, z = (1e3 * traced.lens).tolist()
    axes.annotate(
        "lens L",
        (y, z),
        (12, 22),
        color=DARK,
        fontsize=7.5,
        arrowprops={"arrowstyle": "-", "color": DARK, "linewidth": 0.6},
    )
    axes.text(4, -7, "centre S'", color=DARK, fontsize=7.5)
    axes.text(16, -62, "acrylic", color=GREY, fontsize=7.5)
    axes.text(88, -66, "water", color=BLUE, fontsize=7.5)
    axes.set(aspect="equal", xlim=(-6, drawn_mm), ylim=(-72, 72))
    axes.set(xlabel="y, forward (mm)", ylabel="z, up (mm)")


EXPERIMENT = Experiment(
    title="The rig",
    paper="table 1, figures 1 and 2",
    about="The simulated rig of all experiments, unless stated otherwise: camera, dome and lasers "
    "like the paper's.",
    run=_run,
)
