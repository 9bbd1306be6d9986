"""Position of the lens in the dome, from boards at known distances; the paper's figures 3 and 4."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from aqualvs.calibrate.common import detect_boards, picture_paths, read_grey
from aqualvs.calibration.camera.calibrate import CameraCalibration, camera
from aqualvs.calibration.dome.calibrate import dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions, dome_problem
from aqualvs.calibration.solver.bundle import rig_difference
from aqualvs.calibration.solver.result import DomeCalibration, rms_px
from aqualvs.calibration.targets.pose_files import BoardPose, load_poses, match_poses
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError
from aqualvs.experiments.experiment import (
    Column,
    DataColumns,
    Experiment,
    ExperimentResult,
    ExperimentRow,
    drawn,
    listed,
)
from aqualvs.experiments.laboratory import Laboratory, calibration_pictures
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.solved import rig_numbers
from aqualvs.report.figure_style import BLUE, DARK, GREY, ORANGE, PALE

_LENS, _TURN = ("lens_x", "lens_y", "lens_z"), ("rotation_x", "rotation_y", "rotation_z")
_PLANE = ("fx", "fy", "cx", "cy")
_PAPER_LENS = "3.0, 41.53, 3.0"
_PAPER_TURN = "2.51, 1.31, 11.36"
_PAPER_PLANE = "turned by -0.07°, -0.06°, -0.64°"


class _Setup(NamedTuple):
    """Noise of the boards' poses and corners, and the criterion."""

    reading_sigma: float = 0.2e-3  # Of a position read off the rail, in metres.
    # Noise of corners of real boards, by paper that is not flat and distortion of the print.
    corner_px: float = 0.1
    seed: int = 3
    bar_sigmas: float = 3.0


_SETUP = _Setup()


@dataclass(frozen=True, slots=True)
class SolvedDome:
    """Results of the two calibration steps, with their inputs."""

    truth: Rig
    start: Rig  # Before the second step: lens at the dome's centre, camera straight ahead.
    start_poses: tuple[SE3, ...]  # Of the boards, as they best fit `start`.
    lens: CameraCalibration
    dome: DomeCalibration
    folder: Path  # Of the boards' pictures.

    @property
    def errors(self) -> dict[str, float]:
        """Estimate minus truth, by parameter of the rig, SI units."""
        names = (*_LENS, *_TURN, *_PLANE)
        off = rig_difference(self.truth, self.dome.rig, names)
        return dict(zip(names, off.tolist(), strict=True))

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviations that the calibration states."""
        return self.dome.uncertainty.sigmas


def solve_from_pictures(laboratory: Laboratory) -> SolvedDome:
    """Solve lens and dome from rendered pictures, with errors of 0.2 mm in the boards' distances.

    Raises `CalibrationError` if a picture does not show its board.
    """
    files = calibration_pictures(laboratory)
    truth = load_rig(files.rig)
    lens = camera(board_views(files.camera, files.board, _SETUP.seed + 1), truth.size_px)
    ahead = SE3(DOME_FROM_CAM_NOMINAL.copy(), np.zeros(3))
    start = replace(truth, lens=lens.lens, dome_from_cam=ahead, lasers=(), solved_from={})
    views = board_views(files.dome, files.rail_board, _SETUP.seed + 2)
    assert files.poses is not None
    rows = read_with_errors(load_poses(files.poses))
    given, _ = match_poses(rows, [view.name for view in views], files.poses)
    sets = [BoardSet(name="air", views=views, poses=given, n_medium=truth.n_air)]
    options = DomeOptions(
        distance_sigma=_SETUP.reading_sigma, distance_offset_sigma=_SETUP.reading_sigma
    )
    problem = dome_problem(start, sets, lens.uncertainty, options)
    return SolvedDome(
        truth=truth,
        start=problem.bundle.start.rig,
        start_poses=problem.bundle.start.poses,
        lens=lens,
        dome=dome(start, sets, options, lens.uncertainty),
        folder=files.dome,
    )


def board_views(folder: Path, board_file: Path, seed: int) -> tuple[View, ...]:
    """Detect a board in all pictures of a folder, and add the noise of real boards to its corners.

    Raises `CalibrationError` if a picture does not show it.
    """
    found = detect_boards(picture_paths([folder]), board_file)
    for name, why in found.missed.items():
        raise CalibrationError(f"{folder / name}: {why}")
    rng = np.random.default_rng(seed)
    return tuple(
        replace(view, pixels=view.pixels + rng.normal(0.0, _SETUP.corner_px, view.pixels.shape))
        for view in found.views
    )


def read_with_errors(rows: Sequence[BoardPose], seed: int = _SETUP.seed) -> tuple[BoardPose, ...]:
    """Return distances with the errors of a rail: 0.2 mm each, and 0.2 mm common to all."""
    rng = np.random.default_rng(seed)
    zero = rng.normal(0.0, _SETUP.reading_sigma)
    off = zero + rng.normal(0.0, _SETUP.reading_sigma, len(rows))
    return tuple(
        row if row.distance is None else replace(row, distance=row.distance + float(step))
        for row, step in zip(rows, off, strict=True)
    )


def start_residuals(solved: SolvedDome) -> list[FloatArray]:
    """Return measured minus predicted pixels (N, 2) of every view, before solving the dome."""
    seen = solved.start.in_water(solved.start.n_air).camera()
    return [
        fit.view.pixels - seen.project(pose.apply(fit.view.points))[0]
        for fit, pose in zip(solved.dome.views, solved.start_poses, strict=True)
    ]


def _run(laboratory: Laboratory) -> ExperimentResult:
    solved = solve_from_pictures(laboratory)
    before, after = start_residuals(solved), [fit.residuals for fit in solved.dome.views]
    before_px = rms_px(_finite(before))
    off = float(np.linalg.norm([solved.errors[name] for name in _LENS]))
    turned = float(np.linalg.norm([solved.errors[name] for name in _TURN]))
    return ExperimentResult(
        sentence=f"From {len(after)} boards in air the lens is found to {1e3 * off:.2f} mm and "
        f"the camera's rotation to {np.rad2deg(turned):.3f}°; the residual of "
        f"corners is then {solved.dome.rms_px:.2f} px, {before_px:.1f} px before.",
        findings=_findings(solved, before_px),
        pictures=(
            drawn("figure_3_4", _BOARDS_CAPTION, 2.9, lambda f: _draw_boards(f, solved)),
            drawn("residuals", _RESIDUALS_CAPTION, 2.9, lambda f: _draw_residuals(f, solved)),
        ),
        series=_series(solved, before, after),
        notes=(
            "The pictures are rendered through the dome, in air, with defocus and sensor noise, "
            "and the corners are found in them. As in the paper only the distance of a board from "
            "the dome's centre is given, here with 0.2 mm of error on each reading and 0.2 mm on "
            "all; every second board is tilted by up to 1.5°, which the solver does not know.",
            "The paper gives one set of parameters (Table 1) without uncertainties or residuals. "
            "As in the paper, radius, thickness and index of the dome are known in advance: "
            "pictures do not determine them separately.",
            "The paper turns the camera and, by a second set of angles, its image plane; these two "
            "are equivalent to a single rotation, which is given here, with focal lengths and "
            "centre of the image plane instead of the second.",
        ),
    )


def _findings(solved: SolvedDome, before_px: float) -> tuple[ExperimentRow, ...]:
    held = solved.dome.cross_validation
    worst = max(abs(solved.errors[n]) / solved.sigmas[n] for n in (*_LENS, *_TURN))
    found = (
        _vector("lens in the dome x, y, z (mm)", _PAPER_LENS, solved, _LENS, 1e3, 2),
        _vector("camera's rotation x, y, z (°)", _PAPER_TURN, solved, _TURN, 180.0 / np.pi, 3),
        _vector("image plane fx, fy, cx, cy (px)", _PAPER_PLANE, solved, _PLANE, 1.0, 1),
        ExperimentRow.at_most(
            "largest error of lens and rotation, in standard deviations",
            worst,
            _SETUP.bar_sigmas,
            digits=1,
        ),
        ExperimentRow(
            what="corners, rms distance before and after (px)",
            ours=f"{before_px:.2f} and {solved.dome.rms_px:.2f}",
        ),
    )
    if held is None:
        return found
    return (
        *found,
        ExperimentRow(
            what="corners of boards held out: with the dome, and best without it (px)",
            ours=f"{held.dome_rms_px:.3f} and {held.bare_rms_px:.3f}",
        ),
    )


def _vector(
    what: str, paper: str, solved: SolvedDome, names: Sequence[str], scale: float, digits: int
) -> ExperimentRow:
    true = scale * np.array([rig_numbers(solved.truth)[name] for name in names])
    off = scale * np.array([solved.errors[name] for name in names])
    sigma = scale * np.array([solved.sigmas[name] for name in names])
    found, right, spread = (listed(values, digits) for values in (true + off, true, sigma))
    return ExperimentRow(what=what, paper=paper, ours=f"{found} ± {spread} (truth {right})")


def _finite(residuals: Sequence[FloatArray]) -> FloatArray:
    both: FloatArray = np.concatenate(residuals)
    return both[np.isfinite(both).all(axis=1)]


def _series(
    solved: SolvedDome, before: Sequence[FloatArray], after: Sequence[FloatArray]
) -> tuple[DataColumns, ...]:
    names, true = (*_LENS, *_TURN, *_PLANE), rig_numbers(solved.truth)
    parameters = DataColumns(
        name="parameters",
        columns={
            "name": list(names),
            "truth": np.array([true[n] for n in names]),
            "found_minus_truth": np.array([solved.errors[n] for n in names]),
            "sigma": np.array([solved.sigmas[n] for n in names]),
        },
    )
    pixels = np.concatenate([fit.view.pixels for fit in solved.dome.views])
    first, last = np.concatenate(before), np.concatenate(after)
    corners: dict[str, Column] = {
        "board": [fit.label for fit in solved.dome.views for _ in range(len(fit.view))]
    }
    for name, table in (("{}_px", pixels), ("before_d{}_px", first), ("after_d{}_px", last)):
        corners |= {name.format(axis): table[:, k] for k, axis in enumerate("xy")}
    return parameters, DataColumns(name="corners", columns=corners)


_BOARDS_CAPTION = (
    "Compare figures 3 and 4: the visible parts of the boards in front of the dome, seen from the "
    "right, and one board through the dome, with the detected corners and those predicted by the "
    "solved rig."
)
_RESIDUALS_CAPTION = (
    "Corners of all boards, measured minus predicted: with the lens at the dome's centre, and as "
    "solved. The scales differ."
)


def _draw_boards(figure: Figure, solved: SolvedDome) -> None:
    side, picture = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    _draw_side(side, solved)
    _draw_picture(picture, solved)


def _draw_side(axes: Axes, solved: SolvedDome) -> None:
    """Draw boards, dome and lens in the dome's y-z plane, in millimetres."""
    for fit in solved.dome.views:
        x, y = fit.view.points[:, 0], fit.view.points[:, 1]
        middle = 0.5 * (x.min() + x.max())
        ends = np.array([[middle, y.min(), 0.0], [middle, y.max(), 0.0]])
        line = 1e3 * fit.dome_from_target.apply(ends)
        axes.plot(line[:, 1], line[:, 2], color=GREY, linewidth=1.6, solid_capstyle="butt")
    shell = solved.truth.dome
    assert shell is not None
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 60)
    for radius in (shell.inner_radius, shell.inner_radius + shell.thickness):
        axes.plot(1e3 * radius * np.cos(angle), 1e3 * radius * np.sin(angle), color=BLUE)
    lens = 1e3 * solved.dome.rig.dome_from_cam.translation
    axes.plot(lens[1], lens[2], "o", color=ORANGE, markersize=3.5)
    axes.plot(0.0, 0.0, "+", color=DARK, markersize=6)
    axes.annotate(
        "lens", (lens[1], lens[2]), (110, -230), arrowprops={"arrowstyle": "-", "color": ORANGE}
    )
    axes.set(aspect="equal", xlabel="y, forward of the dome's centre (mm)", ylabel="z, up (mm)")
    axes.set_title("boards moved away from the dome")


def _draw_picture(axes: Axes, solved: SolvedDome) -> None:
    fit = solved.dome.views[len(solved.dome.views) // 3]
    axes.imshow(read_grey(solved.folder / fit.view.name), cmap="gray", vmin=0, vmax=255)
    found, said = fit.view.pixels, fit.view.pixels - fit.residuals
    axes.plot(*found.T, "o", color=ORANGE, markersize=3.2, fillstyle="none", markeredgewidth=0.5)
    axes.plot(*said.T, ".", color=BLUE, markersize=1.4)
    axes.set_title(f"{len(found)} corners, rms {fit.rms_px:.2f} px")
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.set_xlabel("orange rings: found; blue dots: predicted")


def _draw_residuals(figure: Figure, solved: SolvedDome) -> None:
    after = [fit.residuals for fit in solved.dome.views]
    before = start_residuals(solved)
    pixels = np.concatenate([fit.view.pixels for fit in solved.dome.views])
    titles = ("lens at the dome's centre", "lens as solved")
    panels = figure.subplots(1, 2, sharey=True)
    for axes, residuals, title in zip(panels, (before, after), titles, strict=True):
        _draw_arrows(axes, pixels, np.concatenate(residuals), solved.truth.size_px)
        axes.set_title(f"{title}: {rms_px(_finite(residuals)):.2g} px rms")
    panels[0].set_ylabel("y (px)")


def _draw_arrows(
    axes: Axes, pixels: FloatArray, residuals: FloatArray, size_px: tuple[int, int]
) -> None:
    """Draw about 700 of the residuals as arrows, enlarged so that they can be seen."""
    fine = np.flatnonzero(np.isfinite(residuals).all(axis=1))
    fine = fine[:: max(1, len(fine) // 700)]
    typical = rms_px(residuals[fine])
    unit = float(f"{2.0 * typical:.0e}")
    scale = 30.0 / typical
    quiver = axes.quiver(
        *pixels[fine].T,
        *(scale * residuals[fine].T),
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=BLUE,
        width=0.0022,
    )
    axes.quiverkey(quiver, 0.84, -0.16, scale * unit, f"{unit:g} px", labelpos="E")
    axes.set(xlim=(0, size_px[0]), ylim=(size_px[1], 0), aspect="equal", xlabel="x (px)")
    axes.set_facecolor("white")
    axes.grid(color=PALE)


EXPERIMENT = Experiment(
    title="Calibrating the dome from boards",
    paper="section 2.2, table 1, figures 3 and 4",
    about="Boards at measured distances in air, seen through the dome, give the position of the "
    "lens in it and the rotation of the camera; intrinsics come from boards without the dome.",
    run=_run,
)
