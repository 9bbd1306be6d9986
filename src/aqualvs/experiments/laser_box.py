"""Laser planes from a box of markers, and the remaining range error; the paper's figure 7."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aqualvs.calibrate.common import picture_paths, read_colour
from aqualvs.calibrate.lasers import LasersResult, calibrate_lasers
from aqualvs.calibration.lasers.checks import LaserCalibration, LaserFigures, like
from aqualvs.calibration.lasers.views import LaserView
from aqualvs.calibration.targets.target_files import load_box
from aqualvs.errors import CalibrationError
from aqualvs.experiments.experiment import (
    DataColumns,
    Experiment,
    ExperimentResult,
    ExperimentRow,
    drawn,
)
from aqualvs.experiments.laboratory import Laboratory, calibration_pictures, rig_without_lasers
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.expected_error import WallView, expected_posture_errors
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.report.figure_style import GREEN, GREY, OURS, PAPER, PURPLE, TRUTH
from aqualvs.text import laser_colour


class _Setup(NamedTuple):
    """Ranges of the walls in metres, and the criteria."""

    ranges: tuple[float, ...] = (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
    # Largest distance of a stripe point from the wall that it is on, in metres.
    near_wall: float = 4e-3
    bar_percent: float = 0.5
    bar_deg: float = 0.5
    bar_sigmas: float = 3.0


_SETUP = _Setup()


@dataclass(frozen=True, slots=True)
class PlaneError:
    """Error of an estimated laser plane."""

    # Angle between the normals, radians.
    angle: float
    sigma_angle: float
    # Estimate minus truth, metres.
    offset: float
    sigma_offset: float
    # The same for the plane by the paper's method.
    paper_angle: float
    paper_offset: float


@dataclass(frozen=True, slots=True)
class Remaining:
    """Remaining errors of a calibration on W walls square ahead, without noise."""

    ranges: FloatArray  # Shape (W,): true ranges, metres.
    # Shape (W, 3): of range, pitch and yaw, m and rad; the sigmas are those of the calibration.
    errors: FloatArray
    sigmas: FloatArray

    @property
    def percent(self) -> FloatArray:
        """Range error in per cent."""
        return 100.0 * self.errors[:, 0] / self.ranges


def plane_error(figures: LaserFigures, true: Plane) -> PlaneError:
    """Compare an estimated laser with its true plane."""
    found, paper = like(figures.laser.plane, true), like(figures.paper_plane, true)
    return PlaneError(
        angle=angle_between(found.normal, true.normal),
        sigma_angle=figures.sigma_normal,
        offset=found.offset - true.offset,
        sigma_offset=figures.sigma_offset,
        paper_angle=angle_between(paper.normal, true.normal),
        paper_offset=paper.offset - true.offset,
    )


def angle_between(a: FloatArray, b: FloatArray) -> float:
    """Return the angle between two unit vectors, accurate for small angles, too."""
    return float(2.0 * np.arcsin(min(0.5 * float(np.linalg.norm(a - b)), 1.0)))


def matched(found: Sequence[LaserFigures], lasers: Sequence[Laser]) -> list[LaserFigures]:
    """Return the estimated lasers in the order of the true ones.

    Raises `CalibrationError` if one of them is nearest to two true ones.
    """

    def apart(one: LaserFigures, laser: Laser) -> float:
        return angle_between(like(one.laser.plane, laser.plane).normal, laser.plane.normal)

    order = [min(range(len(found)), key=lambda i: apart(found[i], laser)) for laser in lasers]
    if len(set(order)) != len(lasers):
        raise CalibrationError(f"{len(found)} lasers found for {len(lasers)} true ones")
    return [found[i] for i in order]


def remaining(truth: Rig, found: Rig, ranges: Sequence[float] = _SETUP.ranges) -> Remaining:
    """Return the posture errors of an estimated rig on the pixels of the true one."""
    read = np.array([WallView.ahead(truth, far).measured_by(found) for far in ranges])
    expected = expected_posture_errors(found, rig_uncertainty(found), ranges)
    far = np.array(ranges)
    true = np.column_stack([far, np.zeros_like(far), np.zeros_like(far)])
    return Remaining(far, read - true, np.array([one.sigma_calibration for one in expected]))


def _run(laboratory: Laboratory) -> ExperimentResult:
    truth = laboratory.rig
    files = calibration_pictures(laboratory)
    solved = calibrate_lasers(
        picture_paths([files.box]),
        rig_without_lasers(laboratory),
        box=files.box_file,
        medium="air",
        n_lasers=len(truth.lasers),
    )
    figures = matched(solved.solution.lasers, truth.lasers)
    errors = [plane_error(f, laser.plane) for f, laser in zip(figures, truth.lasers, strict=True)]
    lasers = tuple(one.laser for one in figures)
    found = replace(solved.rig, lasers=lasers).in_water(truth.n_water)
    left = remaining(truth, found)
    angle, offset = max(e.angle for e in errors), max(abs(e.offset) for e in errors)
    return ExperimentResult(
        sentence=f"{len(solved.solution.views)} pictures of the box give the laser planes to "
        f"{np.rad2deg(angle):.3f}° and {1e3 * offset:.2f} mm; the remaining range error of "
        f"the whole calibration is {np.abs(left.percent).max():.3f} % at most, from 0.3 to 1 m.",
        findings=(*_plane_findings(truth, figures, errors), *_left_findings(left)),
        pictures=(
            drawn(*_BOX, 2.7, lambda f: _draw_box(f, laboratory, solved, errors)),
            drawn(*_LEFT, 2.3, lambda f: _draw_left(f, left)),
        ),
        series=_series(truth, errors, left),
        notes=(
            "Camera and dome are those solved from boards in air; the box is seen in air too, as "
            "in the paper, with all lasers on at once, the vehicle's pose unknown in every "
            "picture. The paper has one view of its box and states no accuracy.",
            "The paper's way (pose by distances in space, Eq. 32-33, then the pseudo-inverse, Eq. "
            "36) is computed from the same pictures for comparison.",
            "The remaining error is computed without noise: the true rig's pixels on walls square "
            "ahead, read by the calibrated rig. Averaging does not remove it.",
        ),
    )


def _plane_findings(
    truth: Rig, figures: Sequence[LaserFigures], errors: Sequence[PlaneError]
) -> tuple[ExperimentRow, ...]:
    rows = [
        ExperimentRow(
            what=f"laser '{laser.name}': normal off by (°), offset off by (mm)",
            paper=f"its way: {np.rad2deg(e.paper_angle):.3f}°, {1e3 * e.paper_offset:+.2f} mm",
            ours=f"{np.rad2deg(e.angle):.3f} ± {np.rad2deg(e.sigma_angle):.3f}°, "
            f"{1e3 * e.offset:+.2f} ± {1e3 * e.sigma_offset:.2f} mm ({one.n_points} points)",
        )
        for laser, one, e in zip(truth.lasers, figures, errors, strict=True)
    ]
    worst = max(max(e.angle / e.sigma_angle, abs(e.offset) / e.sigma_offset) for e in errors)
    return (
        *rows,
        ExperimentRow.at_most(
            "largest error of a plane, in standard deviations", worst, _SETUP.bar_sigmas, digits=1
        ),
    )


def _left_findings(left: Remaining) -> tuple[ExperimentRow, ...]:
    percent = float(np.abs(left.percent).max())
    degrees = float(np.rad2deg(np.abs(left.errors[:, 1:])).max())
    return (
        ExperimentRow.at_most(
            "range error that remains, 0.3 to 1 m, largest (%)",
            percent,
            _SETUP.bar_percent,
            digits=3,
        ),
        ExperimentRow.at_most(
            "pitch and yaw error that remains, largest (°)", degrees, _SETUP.bar_deg, digits=3
        ),
    )


def _series(truth: Rig, errors: Sequence[PlaneError], left: Remaining) -> tuple[DataColumns, ...]:
    planes = DataColumns(
        name="planes",
        columns={
            "laser": [laser.name for laser in truth.lasers],
            "angle_deg": np.rad2deg([e.angle for e in errors]),
            "sigma_angle_deg": np.rad2deg([e.sigma_angle for e in errors]),
            "offset_mm": 1e3 * np.array([e.offset for e in errors]),
            "sigma_offset_mm": 1e3 * np.array([e.sigma_offset for e in errors]),
            "paper_angle_deg": np.rad2deg([e.paper_angle for e in errors]),
            "paper_offset_mm": 1e3 * np.array([e.paper_offset for e in errors]),
        },
    )
    degrees, sigmas = np.rad2deg(left.errors), np.rad2deg(left.sigmas)
    remains = DataColumns(
        name="remaining",
        columns={
            "range_m": left.ranges,
            "range_error_mm": 1e3 * left.errors[:, 0],
            "sigma_range_mm": 1e3 * left.sigmas[:, 0],
            "pitch_error_deg": degrees[:, 1],
            "sigma_pitch_deg": sigmas[:, 1],
            "yaw_error_deg": degrees[:, 2],
            "sigma_yaw_deg": sigmas[:, 2],
        },
    )
    return planes, remains


_BOX = (
    "figure_7",
    "Compare figure 7: the box as the camera sees it, with the detected stripe points, coloured by "
    "laser, and the corners of its markers; and the errors of the estimated planes, ours with one "
    "standard deviation.",
)
_LEFT = (
    "remaining",
    "Remaining error of the calibration on walls square ahead, with two stated standard "
    "deviations; dashed: our criterion.",
)


def _draw_box(
    figure: Figure, laboratory: Laboratory, solved: LasersResult, errors: Sequence[PlaneError]
) -> None:
    files, view = calibration_pictures(laboratory), solved.views[0]
    picture, angles, offsets = figure.subplots(1, 3, width_ratios=(2.7, 1.0, 1.0))
    picture.imshow(read_colour(files.box / view.view.name)[..., ::-1])
    picture.plot(*view.view.pixels.T, ".", color="white", markersize=1.0)
    laser_of = _lasers_of(laboratory, solved.solution, view)
    for i in range(len(solved.rig.lasers)):
        points = view.stripes.pixels[laser_of == i]
        picture.plot(*points.T, ".", color=laser_colour(i), markersize=1.6)
    picture.set_axis_off()
    names = [laser.name for laser in laboratory.rig.lasers]
    _draw_errors(
        angles,
        names,
        np.rad2deg([(e.angle, e.sigma_angle, e.paper_angle) for e in errors]),
        "angle to the true plane (°)",
    )
    _draw_errors(
        offsets,
        names,
        1e3 * np.array([(e.offset, e.sigma_offset, e.paper_offset) for e in errors]),
        "offset, found − true (mm)",
    )
    angles.set_ylim(bottom=0.0)
    offsets.axhline(0.0, color=TRUTH, linewidth=0.8)
    figure.legend(*angles.get_legend_handles_labels(), loc="outside upper right", ncols=2)


def _draw_errors(axes: Axes, names: Sequence[str], table: FloatArray, title: str) -> None:
    """Draw our errors, their sigmas and the paper's errors, the columns of `table` (K, 3)."""
    place = np.arange(len(names))
    axes.errorbar(
        place - 0.12, table[:, 0], table[:, 1], fmt="o", color=OURS, markersize=4, label="ours"
    )
    axes.plot(place + 0.12, table[:, 2], "x", color=PAPER, label="the paper's way")
    axes.set_xticks(place, names)
    axes.set(xlim=(-0.6, len(names) - 0.4), ylabel=title)
    axes.grid(axis="x", visible=False)


def _lasers_of(laboratory: Laboratory, result: LaserCalibration, view: LaserView) -> IntArray:
    """Return the index of the laser of each stripe point by the solution; -1 for none."""
    markers, _ = load_box(calibration_pictures(laboratory).box_file)
    pose = next(v.dome_from_target for v in result.views if v.name == view.view.name)
    rays = result.rig.in_water(result.rig.n_air).camera().rays(view.stripes.pixels)
    normals = np.array([plane.normal for plane in markers.planes.values()])
    offsets = np.array([plane.offset for plane in markers.planes.values()])
    off = []
    for one in result.lasers:
        plane = one.laser.plane
        reach = (plane.offset - rays.origins @ plane.normal) / (rays.directions @ plane.normal)
        points = pose.inverse().apply(rays.origins + reach[:, None] * rays.directions)
        off.append(np.abs(points @ normals.T - offsets).min(axis=1))
    nearest: IntArray = np.argmin(off, axis=0)
    return np.where(np.min(off, axis=0) < _SETUP.near_wall, nearest, -1)


def _draw_left(figure: Figure, left: Remaining) -> None:
    ranges, angles = figure.subplots(1, 2)
    share = np.column_stack([left.percent, 100.0 * left.sigmas[:, 0] / left.ranges])
    _draw_band(ranges, left.ranges, share, OURS, "range")
    degrees = np.rad2deg(np.stack([left.errors[:, 1:], left.sigmas[:, 1:]], axis=-1))
    _draw_band(angles, left.ranges, degrees[:, 0], PURPLE, "pitch")
    _draw_band(angles, left.ranges, degrees[:, 1], GREEN, "yaw")
    for axes, bar, title in (
        (ranges, _SETUP.bar_percent, "range error (%)"),
        (angles, _SETUP.bar_deg, "angle error (°)"),
    ):
        axes.axhline(0.0, color=TRUTH, linewidth=0.8)
        for level in (-bar, bar):
            axes.axhline(level, color=GREY, linewidth=0.9, linestyle="--")
        axes.set(xlabel="distance of the wall (m)", ylabel=title, ylim=(-1.3 * bar, 1.3 * bar))
        axes.legend(loc="upper left", bbox_to_anchor=(0.0, 0.92), ncols=2)


def _draw_band(axes: Axes, ranges: FloatArray, table: FloatArray, colour: str, name: str) -> None:
    """Draw errors and two sigmas, the columns of `table` (W, 2), over the distance."""
    error, sigma = table.T
    axes.fill_between(
        ranges, error - 2.0 * sigma, error + 2.0 * sigma, color=colour, alpha=0.15, linewidth=0.0
    )
    axes.plot(ranges, error, "o-", color=colour, markersize=3, label=name)


EXPERIMENT = Experiment(
    title="Calibrating the lasers in a box",
    paper="section 3.3, figure 7",
    about="An open box with markers on four planes, the vehicle in front of it: the markers give "
    "its pose, and the stripes on known planes give the planes of the lasers.",
    run=_run,
)
