"""`aqualvs calibrate dome`: position of the lens in the dome and rotation of the camera."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from aqualvs.calibrate.common import (
    Found,
    Tell,
    check_same_size,
    corner_residuals,
    corner_rows,
    find_targets,
    finish,
    medium_index,
)
from aqualvs.calibration.detection.detection import detect_board
from aqualvs.calibration.dome.calibrate import dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions
from aqualvs.calibration.solver.result import DomeCalibration
from aqualvs.calibration.targets.pose_files import BoardPose, load_poses, match_poses, picture_paths
from aqualvs.calibration.targets.target_files import load_board
from aqualvs.errors import OptionError
from aqualvs.optics.camera import DOME_PARAMETERS, POSE_PARAMETERS, Dome
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import check_rig_place, load_rig
from aqualvs.optics.solved import (
    ASSUMED,
    N_WATER,
    SolvedStep,
    completed_uncertainty,
    file_parameter_name,
    merged,
    rig_uncertainty,
    with_step,
    with_uncertainty,
)
from aqualvs.report.calibration_material import (
    CalibrationPage,
    expectations,
    facts,
    parameter_rows,
)
from aqualvs.report.html import Card


@dataclass(frozen=True, slots=True, kw_only=True)
class DomeRequest:
    """Request of `aqualvs calibrate dome`, see its `--help`."""

    images: tuple[str, ...]
    board: Path
    rig: Path
    out: Path
    poses: Path | None
    medium: str
    water_images: tuple[str, ...]
    water_board: Path | None
    water_poses: Path | None
    inner_radius_mm: float | None
    thickness_mm: float | None
    n_acrylic: float | None
    radius_tolerance_mm: float
    thickness_tolerance_mm: float
    acrylic_tolerance: float
    distance_sigma_mm: float
    refine_intrinsics: bool


@dataclass(frozen=True, slots=True)
class _Shots:
    """One set of pictures with the boards found in them."""

    found: Found
    board_set: BoardSet
    notes: tuple[str, ...]


def calibrate_dome(request: DomeRequest, tell: Tell) -> None:
    """Solve the dome from pictures and write the rig and its report.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    check_rig_place(request.out)
    rig = _with_dome(load_rig(request.rig, need_lasers=False), request)
    shots = _all_shots(request, rig)
    known = rig_uncertainty(rig)
    if not set(known.names) & set(rig.lens.parameter_names):
        # Intrinsics that were written by hand are not exact either.
        given = completed_uncertainty(rig).only(rig.lens.parameter_names)
        known = merged(known, given)
    result = dome(rig, [one.board_set for one in shots], _options(request), known)
    solved = _noted(rig, result)
    for line in (*_summary(result, shots), *result.findings):
        tell(line)
    finish(
        solved,
        _page(rig, solved, result, shots, request),
        request.out,
        "dome",
        tell,
        comments_of=request.rig,
    )


def _summary(result: DomeCalibration, shots: Sequence[_Shots]) -> list[str]:
    """Return the numbers of pictures used and left out, the residual and the reasons."""
    n_pictures = sum(len(one.found.views) + len(one.found.missed) for one in shots)
    used = len(result.views)
    of = f" of {n_pictures}" if used < n_pictures else ""
    return [
        f"{used}{of} pictures, {result.n_points} corners, residual {result.rms_px:.3f} px (rms)",
        *(line for one in shots for line in (*one.found.remarks, *one.notes)),
    ]


def _with_dome(rig: Rig, request: DomeRequest) -> Rig:
    given = (request.inner_radius_mm, request.thickness_mm, request.n_acrylic)
    shell = rig.dome
    if shell is None and (given[0] is None or given[1] is None):
        raise OptionError(
            f"{request.rig}: has no dome; give --inner-radius-mm and --thickness-mm, or write "
            "'dome: {inner_radius_mm: ..., thickness_mm: ..., n_acrylic: 1.49}' in it"
        )
    old = shell or Dome(1.0, 1.0, 1.49)
    radius = old.inner_radius if given[0] is None else given[0] / 1e3
    thickness = old.thickness if given[1] is None else given[1] / 1e3
    return replace(rig, dome=Dome(radius, thickness, given[2] or old.n_acrylic))


def _options(request: DomeRequest) -> DomeOptions:
    return DomeOptions(
        inner_radius_sigma=request.radius_tolerance_mm / 1e3,
        thickness_sigma=request.thickness_tolerance_mm / 1e3,
        n_acrylic_sigma=request.acrylic_tolerance,
        distance_sigma=request.distance_sigma_mm / 1e3,
        refine_intrinsics=request.refine_intrinsics,
    )


def _all_shots(request: DomeRequest, rig: Rig) -> list[_Shots]:
    n_medium = medium_index(request.medium, rig, rig.n_air)
    first = _shots(request.images, request.board, request.poses, rig, n_medium)
    if not request.water_images:
        if request.water_board or request.water_poses:
            raise OptionError("--water-images: missing; --water-board and --water-poses need them")
        return [first]
    board = request.water_board or request.board
    return [first, _shots(request.water_images, board, request.water_poses, rig, rig.n_water)]


def _shots(
    images: Sequence[str], board_file: Path, poses_file: Path | None, rig: Rig, n_medium: float
) -> _Shots:
    board = load_board(board_file)
    rows = None if poses_file is None else load_poses(poses_file)
    paths = picture_paths(images)
    found = find_targets(
        paths, lambda path, image: detect_board(image, board, path.name), board_file.name
    )
    check_same_size(rig, found)
    given: tuple[BoardPose | None, ...] = ()
    notes: tuple[str, ...] = ()
    if rows is not None and poses_file is not None:
        given, notes = match_poses(rows, [view.name for view in found.views], poses_file)
    in_air = abs(n_medium - rig.n_air) < 1e-3
    board_set = BoardSet(
        name="air" if in_air else "water",
        views=found.views,
        poses=given,
        n_medium=n_medium,
        sigma_medium=0.0 if in_air else rig_uncertainty(rig).sigmas.get("n_water", N_WATER),
    )
    return _Shots(found, board_set, notes)


def _noted(rig: Rig, result: DomeCalibration) -> Rig:
    uncertainty = merged(rig_uncertainty(rig), result.uncertainty)
    names = set(rig_uncertainty(rig).names)
    solved = set(POSE_PARAMETERS) | set(DOME_PARAMETERS)
    assumed = [
        file_parameter_name(name) for name in result.uncertainty.names if name not in names | solved
    ]
    step = SolvedStep(
        pictures=len(result.views),
        points=result.n_points,
        rms_px=result.rms_px,
        extras={
            "media": [round(medium.n, 6) for medium in result.media],
            **({ASSUMED: assumed} if assumed else {}),
        },
    )
    return with_uncertainty(with_step(result.rig, "dome", step), uncertainty)


def _page(
    before: Rig, rig: Rig, result: DomeCalibration, shots: list[_Shots], request: DomeRequest
) -> CalibrationPage:
    sigmas = result.uncertainty.sigmas
    lens = rig.dome_from_cam.translation
    cards = [
        Card(
            "lens",
            f"{1e3 * lens[0]:.2f}, {1e3 * lens[1]:.2f}, {1e3 * lens[2]:.2f} mm",
            f"± {1e3 * max(sigmas.get(f'lens_{axis}', 0.0) for axis in 'xyz'):.2f} mm",
        ),
        Card("residual", f"{result.rms_px:.3f} px", "rms distance of corners"),
        Card("pictures", str(len(result.views)), f"{result.n_points:,} corners"),
    ]
    if result.held_back is not None:
        held = result.held_back
        cards.append(
            Card(
                "held-back views",
                f"{held.dome_rms_px:.2f} px",
                f"a bare lens: {held.bare_rms_px:.2f} px",
            )
        )
    missed = {name: why for one in shots for name, why in one.found.missed.items()}
    dome_names = [name for name in DOME_PARAMETERS if name in sigmas]
    return CalibrationPage(
        title="Calibration of the dome",
        subtitle=f"Rig “{rig.name}”",
        cards=tuple(cards),
        warnings=(
            *(f"{name}: {why}" for name, why in {**missed, **result.left_out}.items()),
            *(note for one in shots for note in (*one.found.notes, *one.notes)),
        ),
        words=result.findings,
        expectations=expectations(rig),
        parameters=parameter_rows(
            rig,
            result.uncertainty,
            [*POSE_PARAMETERS, *dome_names, *rig.lens.parameter_names],
            before,
        ),
        residual_maps=(corner_residuals(result.views, rig.size_px),),
        views=corner_rows(result.views, {**missed, **result.left_out}),
        facts=facts(
            ("rig before", str(request.rig)),
            ("board", str(request.board)),
            ("poses", str(request.poses or "unknown")),
        ),
    )
