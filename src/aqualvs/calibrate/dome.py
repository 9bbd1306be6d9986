"""`aqualvs calibrate dome`: position of the lens in its dome or behind its flat port."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from aqualvs.calibrate import common
from aqualvs.calibration.dome.calibrate import dome as solve_dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions
from aqualvs.calibration.solver.result import DomeCalibration
from aqualvs.calibration.targets.pose_files import BoardPose, load_poses, match_poses
from aqualvs.calibration.targets.targets import Board
from aqualvs.errors import OptionError, check_options
from aqualvs.optics.camera import POSE_PARAMETERS, parameter_names
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.rig import Rig, merged
from aqualvs.optics.rigfile import check_rig_place, load_rig
from aqualvs.optics.solved import (
    ASSUMED,
    SIGMAS,
    SolvedStep,
    completed_uncertainty,
    file_parameter_name,
    rig_uncertainty,
    with_step,
    with_uncertainty,
)
from aqualvs.optics.water import Dispersion
from aqualvs.report.calibration_material import CalibrationPage, expectations, facts, parameter_rows
from aqualvs.report.html import Card
from aqualvs.terminal import Echo


@dataclass(frozen=True, slots=True, kw_only=True)
class DomeRequest:
    """Request of `aqualvs calibrate dome`, see its `--help`."""

    images: tuple[str, ...]
    board: Path
    rig: Path
    out: Path
    poses: Path | None = None
    medium: str = "air"
    water_images: tuple[str, ...] = ()
    water_board: Path | None = None
    water_poses: Path | None = None
    inner_radius_mm: float | None = None
    thickness_mm: float | None = None
    n_acrylic: float | None = None
    port_distance_mm: float | None = None
    radius_tolerance_mm: float = 0.1
    thickness_tolerance_mm: float = 0.1
    acrylic_tolerance: float = 0.003
    distance_sigma_mm: float = 0.2
    shared_tilt_sigma_deg: float = 0.0
    refine_intrinsics: bool = True

    def __post_init__(self) -> None:
        """Raise `OptionError` for negative tolerances, and housings that cannot be."""
        _check_length("--inner-radius-mm", self.inner_radius_mm, 1.0, 2000.0)
        _check_length("--port-distance-mm", self.port_distance_mm, 0.1, 2000.0)
        # Zero is an infinitely thin housing.
        if self.thickness_mm != 0.0:
            _check_length("--thickness-mm", self.thickness_mm, 0.1, 200.0)
        if self.n_acrylic is not None and not 1.0 <= self.n_acrylic <= 3.0:
            raise OptionError(
                f"--n-acrylic {self.n_acrylic:g}: give a refractive index, 1 to 3; acrylic has 1.49"
            )
        tolerances = ("radius_tolerance_mm", "thickness_tolerance_mm", "acrylic_tolerance")
        sigmas = ("distance_sigma_mm", "shared_tilt_sigma_deg")
        check_options(self, *tolerances, *sigmas, least=0.0, wanted="0 or more")


def _check_length(option: str, length_mm: float | None, least: float, most: float) -> None:
    """Raise `OptionError` for a length that no housing has; it names the unit that may be meant."""
    if length_mm is None or least <= length_mm <= most:
        return
    if_metres = 1e3 * length_mm
    hint = f"; {if_metres:g} if metres are meant" if least <= if_metres <= most else ""
    raise OptionError(f"{option} {length_mm:g}: give millimetres, from {least:g} to {most:g}{hint}")


def calibrate_dome(
    pictures: common.Pictures,
    board: Board | str | Path,
    rig: Rig | str | Path,
    *,
    poses: str | Path | None = None,
    medium: str | float = "air",
    water_pictures: common.Pictures = (),
    water_board: Board | str | Path | None = None,
    water_poses: str | Path | None = None,
    options: DomeOptions | None = None,
) -> common.Calibration[DomeCalibration]:
    """Solve the lens's position in the dome and the camera's rotation, from boards outside it.

    For a flat port, solve its distance and tilt from boards in water at unknown poses.

    Parameters
    ----------
    pictures : iterable of str, Path or array, or a str or Path
        Files or pixels (grey, or blue, green, red), or one folder or pattern; of the size that the
        rig's camera has.
    board : Board, str or Path
        The board or its file.
    rig : Rig, str or Path
        Rig with intrinsics and a nominal dome or flat port, or its file.
    poses : str or Path, optional
        File with known distances or full poses of the boards.
    medium : str or float
        Medium outside the housing: "air", "water" (the rig's), or a refractive index.
    water_pictures, water_board, water_poses : optional
        Further pictures, taken in the rig's water; their board, if it is another one; their poses.
    options : DomeOptions, optional
        Tolerances of the housing, and of the boards' distances and tilt.

    Returns
    -------
    Calibration
        `solution` is a `DomeCalibration`.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    before = rig if isinstance(rig, Rig) else load_rig(rig, need_lasers=False)
    light_nm = common.lasers_wavelength(before)
    light = Dispersion.of(light_nm, before.n_air)
    # A camera sees the boards in green or white light, whatever the colour of the lasers.
    green = before.in_water(light.to_green(before.n_water))
    first = _board_set(
        pictures, board, poses, before, common.medium_index(medium, green, green.n_air)
    )
    sets = [first]
    if water_pictures:
        in_water = water_board or board
        sets.append(_board_set(water_pictures, in_water, water_poses, before, green.n_water))
    elif water_board is not None or water_poses is not None:
        raise OptionError("--water-images: missing; --water-board and --water-poses need them")
    known = rig_uncertainty(before)
    if not set(known.names) & set(before.lens.parameter_names):
        # Intrinsics that a user wrote by hand are not exact either.
        given = completed_uncertainty(before).only(before.lens.parameter_names)
        known = merged(known, given)
    found = tuple(one for one, _ in sets)
    with common.counting_missed(*found):
        seen = solve_dome(green, [one for _, one in sets], options or DomeOptions(), known)
    result = seen if light.ratio == 1.0 else _in_light(seen, light, light_nm, before)
    missed = {name: why for one in found for name, why in one.missed.items()}
    return common.Calibration(
        rig=_solved_rig(before, result),
        uncertainty=result.uncertainty,
        residuals_px={view.label: view.residuals for view in result.views},
        left_out=missed | result.left_out,
        notes=(*(note for one in found for note in one.notes), *result.findings),
        solution=result,
        found=found,
    )


def run_dome(request: DomeRequest, echo: Echo) -> None:
    """Calibrate the dome and write the rig and its report.

    Raises `AqualvsError` as `calibrate_dome`, or if an output cannot be written.
    """
    check_rig_place(request.out)
    rig = _with_housing(load_rig(request.rig, need_lasers=False), request)
    done = calibrate_dome(
        common.picture_paths(request.images),
        request.board,
        rig,
        poses=request.poses,
        medium=request.medium,
        water_pictures=common.picture_paths(request.water_images) if request.water_images else (),
        water_board=request.water_board,
        water_poses=request.water_poses,
        options=DomeOptions(
            inner_radius_sigma=request.radius_tolerance_mm / 1e3,
            thickness_sigma=request.thickness_tolerance_mm / 1e3,
            n_acrylic_sigma=request.acrylic_tolerance,
            distance_sigma=request.distance_sigma_mm / 1e3,
            shared_tilt_sigma=math.radians(request.shared_tilt_sigma_deg),
            refine_intrinsics=request.refine_intrinsics,
        ),
    )
    for line in common.summary(done):
        echo(line)
    common.finish(done.rig, _page(rig, done, request), request.out, "dome", echo, request.rig)


def _with_housing(rig: Rig, request: DomeRequest) -> Rig:
    """Return the rig with the housing's sizes from the options, which may add a dome or port."""
    radius, distance = request.inner_radius_mm, request.port_distance_mm
    if radius is not None and (distance is not None or rig.flat_port is not None):
        raise OptionError("--inner-radius-mm: of a dome, but the housing is a flat port")
    if distance is not None and rig.dome is not None:
        raise OptionError("--port-distance-mm: of a flat port, but the housing is a dome")
    size, thickness = radius if distance is None else distance, request.thickness_mm
    if rig.housing is None and (size is None or thickness is None):
        raise OptionError(
            f"{request.rig}: has no dome; give --inner-radius-mm (of a flat port "
            "--port-distance-mm) and --thickness-mm, or write 'dome: {inner_radius_mm: ..., "
            "thickness_mm: ..., n_acrylic: 1.49}' in it"
        )
    housing = rig.housing
    if housing is None:
        # Options give both sizes, see above; the index has a default.
        housing = Dome(1.0, 1.0, 1.49) if distance is None else FlatPort(1.0, 1.0, 1.49)
        if rig.is_air(rig.n_water):
            # A camera calibrated bare in air goes into the water with its housing.
            rig = rig.in_water(common.WATER_N)
    numbers = housing.numbers()
    # Radius or distance, thickness and index come first.
    given = ((size, 1e3), (thickness, 1e3), (request.n_acrylic, 1.0))
    for name, (value, per_unit) in zip(numbers, given, strict=False):
        if value is not None:
            numbers[name] = value / per_unit
    return replace(rig, housing=type(housing)(*numbers.values()))


def _board_set(
    pictures: common.Pictures,
    board: Board | str | Path,
    poses: str | Path | None,
    rig: Rig,
    n_medium: float,
) -> tuple[common.DetectedTargets, BoardSet]:
    """Return the boards found in one set of pictures, and the same as input of the solver."""
    # Its faults are found before the pictures are searched.
    rows = () if poses is None else load_poses(Path(poses))
    found = common.detect_boards(pictures, board)
    common.check_same_size(rig, found)
    given: tuple[BoardPose | None, ...] = ()
    if poses is not None:
        names = [view.name for view in found.views]
        given, notes = match_poses(rows, names, Path(poses), copies=found.copies)
        found = replace(found, pose_notes=notes)
    in_air = rig.is_air(n_medium)
    board_set = BoardSet(
        name="air" if in_air else "water",
        views=found.views,
        poses=given,
        n_medium=n_medium,
        sigma_medium=0.0 if in_air else rig_uncertainty(rig).sigmas.get("n_water", SIGMAS.n_water),
    )
    return found, board_set


def _in_light(
    seen: DomeCalibration, light: Dispersion, light_nm: float | None, before: Rig
) -> DomeCalibration:
    """Return a result for green light with the index for a wavelength in nm."""
    if "n_water" not in seen.uncertainty.names:
        return replace(seen, rig=seen.rig.in_water(before.n_water))
    rig, uncertainty = common.in_lasers_light(seen.rig, seen.uncertainty, light)
    remark = (
        f"water for the lasers' {light_nm:g} nm: n = {rig.n_water:.5f} ± "
        f"{uncertainty.sigmas['n_water']:.5f}, by the dispersion of water; the boards are seen in "
        "green or white light"
    )
    return replace(seen, rig=rig, uncertainty=uncertainty, findings=(*seen.findings, remark))


def _solved_rig(rig: Rig, result: DomeCalibration) -> Rig:
    """Return the solved rig with its covariance and a note of this step."""
    uncertainty = merged(rig_uncertainty(rig), result.uncertainty)
    solved = set(parameter_names(rig.camera())) - set(rig.lens.parameter_names)
    known = solved | set(rig_uncertainty(rig).names)
    assumed = [file_parameter_name(n) for n in result.uncertainty.names if n not in known]
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
    before: Rig, done: common.Calibration[DomeCalibration], request: DomeRequest
) -> CalibrationPage:
    rig, result = done.rig, done.solution
    sigmas = result.uncertainty.sigmas
    cards = [
        _place_card(rig, sigmas),
        Card("residual", f"{result.rms_px:.3f} px", "rms distance of corners"),
        Card("pictures", str(len(result.views)), f"{result.n_points:,} corners"),
    ]
    if result.cross_validation is not None:
        held = result.cross_validation
        bare = f"a bare lens: {held.bare_rms_px:.2f} px"
        cards.append(Card("held-out views", f"{held.dome_rms_px:.2f} px", bare))
    housing = () if rig.housing is None else rig.housing.parameter_names
    port_names = [name for name in housing if name in sigmas]
    names = [*POSE_PARAMETERS, *port_names, *rig.lens.parameter_names]
    what = "dome" if rig.flat_port is None else "flat port"
    return CalibrationPage(
        title=f"Calibration of the {what}",
        subtitle=f"Rig “{rig.name}”",
        cards=tuple(cards),
        warnings=(
            *(f"{name}: {why}" for name, why in done.left_out.items()),
            *(note for one in done.found for note in one.notes),
        ),
        words=result.findings,
        expectations=expectations(rig),
        parameters=parameter_rows(rig, result.uncertainty, names, before),
        residual_maps=(common.corner_residuals(result.views, rig.size_px),),
        views=common.corner_rows(result.views, done.left_out),
        facts=facts(
            ("rig before", str(request.rig)),
            ("board", str(request.board)),
            ("poses", str(request.poses or "unknown")),
        ),
    )


def _place_card(rig: Rig, sigmas: Mapping[str, float]) -> Card:
    """Return the card with the position of lens or port."""
    if rig.flat_port is not None:
        return Card(
            "flat port",
            f"{1e3 * rig.flat_port.distance:.2f} mm from the lens",
            f"± {1e3 * sigmas['port_distance']:.2f} mm",
        )
    lens = rig.dome_from_cam.translation
    return Card(
        "lens",
        f"{1e3 * lens[0]:.2f}, {1e3 * lens[1]:.2f}, {1e3 * lens[2]:.2f} mm",
        f"± {1e3 * max(sigmas.get(f'lens_{axis}', 0.0) for axis in 'xyz'):.2f} mm",
    )
