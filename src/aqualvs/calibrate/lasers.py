"""`aqualvs calibrate lasers`: laser planes from a box of markers, or from a plane with a board."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aqualvs.calibrate import common
from aqualvs.calibrate.uncalibrated_stripes import find_stripes
from aqualvs.calibration.detection.detection import detect_markers
from aqualvs.calibration.lasers.calibrate import LaserOptions
from aqualvs.calibration.lasers.calibrate import calibrate_lasers as solve_lasers
from aqualvs.calibration.lasers.checks import LaserCalibration, LaserFigures
from aqualvs.calibration.lasers.stripes_on_planes import TargetSurfaces, board_surface, box_surfaces
from aqualvs.calibration.lasers.views import LaserView, corners_in_lasers_light
from aqualvs.calibration.targets.target_files import load_box
from aqualvs.calibration.targets.targets import Board, MarkerSet
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import IntArray
from aqualvs.optics.rig import LASER_PARAMETERS, Laser, Rig, RigUncertainty, merged
from aqualvs.optics.rigfile import check_rig_place, load_rig
from aqualvs.optics.rigschema import LASER_NM, LASER_NM_REMEDY
from aqualvs.optics.solved import (
    ASSUMED,
    SolvedStep,
    assumptions,
    completed_uncertainty,
    file_parameter_name,
    rig_uncertainty,
    with_step,
    with_uncertainty,
)
from aqualvs.optics.water import Dispersion
from aqualvs.report.calibration_material import (
    CalibrationPage,
    LaserRow,
    Overlay,
    PictureShot,
    ViewRow,
    expectations,
    facts,
    missed_rows,
    parameter_rows,
    residual_map,
)
from aqualvs.report.html import Card
from aqualvs.terminal import Echo
from aqualvs.text import count_text, laser_colour


@dataclass(frozen=True, slots=True, kw_only=True)
class LasersRequest:
    """Request of `aqualvs calibrate lasers`, see its `--help`."""

    images: tuple[str, ...]
    rig: Path
    out: Path
    box: Path | None = None
    board: Path | None = None
    medium: str | None = None
    n_lasers: int | None = None
    names: tuple[str, ...] | None = None
    board_offset_mm: float = 0.0
    refine: bool = False
    wavelength_nm: float | None = None


class _Target(NamedTuple):
    """Target that the lasers shine on."""

    name: str  # In messages.
    surfaces: TargetSurfaces
    found: common.DetectedTargets
    n_medium: float  # Refractive index outside the dome, for green or white light.
    marker_ids: IntArray | None = None  # Shape (M,): of a box's markers, as in its file.


@dataclass(frozen=True, slots=True, kw_only=True)
class LasersResult(common.Calibration[LaserCalibration]):
    """Result of `calibrate_lasers`."""

    n_medium: float  # Refractive index outside the dome in the pictures, for the lasers' light.
    # Corners and stripes of every picture in which the target was found.
    views: tuple[LaserView, ...]


def calibrate_lasers(
    pictures: common.Pictures,
    rig: Rig | str | Path,
    *,
    box: MarkerSet | str | Path | None = None,
    board: Board | str | Path | None = None,
    medium: str | float | None = None,
    n_lasers: int | None = None,
    names: Sequence[str] | None = None,
    board_offset: float = 0.0,
    refine: bool = False,
    wavelength_nm: float | None = None,
) -> LasersResult:
    """Solve the lasers' planes from pictures of a box or board that they shine on.

    Parameters
    ----------
    pictures : iterable of str, Path or array, or a str or Path
        Files or pixels (blue, green, red), or one folder or pattern; of the size that the rig's
        camera has.
    rig : Rig, str or Path
        Rig with camera and dome, or its file; its lasers, if any, give names and order.
    box : MarkerSet, str or Path, optional
        Markers with the planes that they and the stripes are on, or their file.
    board : Board, str or Path, optional
        Instead of a box: the board on the surface that the stripes are on, or its file.
    medium : str, float or None
        Medium outside the dome: "air", "water" (the rig's), or a refractive index; None for the
        one in the box's file, else the rig's water.
    n_lasers : int, optional
        Number of lasers switched on; by default the rig's.
    names : sequence of str, optional
        Names of the lasers.
    board_offset : float
        Thickness of the board above the surface, in metres.
    refine : bool
        Whether to solve the camera's uncertain parameters too.
    wavelength_nm : float, optional
        Wavelength of the lasers; by default the rig's.

    Returns
    -------
    LasersResult
        `solution` is a `LaserCalibration`.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    before = rig if isinstance(rig, Rig) else load_rig(rig, need_lasers=False)
    before = _with_wavelength(before, wavelength_nm)
    wavelength_nm = _wavelength(wavelength_nm, before)
    # A camera sees the target in green or white light, whatever the colour of the lasers.
    light = Dispersion.of(wavelength_nm, before.n_air)
    green = before.in_water(light.to_green(before.n_water))
    target = _detected(pictures, green, box, board, medium, board_offset)
    n_green, n_medium = target.n_medium, light.from_green(target.n_medium)
    common.check_same_size(before, target.found)
    views = tuple(
        LaserView(view, find_stripes(common.read_colour(picture), wavelength_nm))
        for view, picture in zip(target.found.views, target.found.pictures, strict=True)
    )
    seen = views
    if n_green != n_medium:
        cameras = before.in_water(n_green).camera(), before.in_water(n_medium).camera()
        seen = tuple(corners_in_lasers_light(one, *cameras) for one in views)
    elsewhere = medium is not None or before.is_air(n_medium)
    if n_lasers is None:
        n_lasers = _planned_count(before) if names is None else len(names)
    with common.counting_missed(target.found):
        result = solve_lasers(
            before,
            seen,
            target.surfaces,
            options=LaserOptions(
                n_lasers=n_lasers, n_medium=n_medium if elsewhere else None, refine=refine
            ),
            uncertainty=_camera_uncertainty(before, refine=refine, elsewhere=elsewhere),
        )
    misplaced = [] if target.marker_ids is None else _misplaced(target.marker_ids, views, result)
    result = replace(result, warnings=(*_assumed(before), *misplaced, *result.warnings))
    if len(result.lasers) != len(before.lasers):
        result = replace(result, rig=_with_wavelength(result.rig, wavelength_nm))
    solved = _solved_rig(before, result, target.name, n_medium)
    return LasersResult(
        rig=solved if names is None else _with_names(solved, names),
        uncertainty=result.uncertainty,
        residuals_px={one.name: one.corner_residuals_px for one in result.views},
        left_out={**target.found.missed, **result.left_out},
        notes=(*target.found.notes, *result.warnings),
        solution=result,
        found=(target.found,),
        n_medium=n_medium,
        views=views,
    )


def run_lasers(request: LasersRequest, echo: Echo) -> None:
    """Calibrate the lasers and write the rig and its report.

    Raises `AqualvsError` as `calibrate_lasers`, or if an output cannot be written.
    """
    check_rig_place(request.out)
    before = load_rig(request.rig, need_lasers=False)
    done = calibrate_lasers(
        common.picture_paths(request.images),
        before,
        box=request.box,
        board=request.board,
        medium=request.medium,
        n_lasers=request.n_lasers,
        names=request.names,
        board_offset=request.board_offset_mm / 1e3,
        refine=request.refine,
        wavelength_nm=request.wavelength_nm,
    )
    for warning in done.solution.warnings:
        echo(f"note: {warning}")
    for found in done.found:
        for remark in found.remarks:
            echo(remark)
    for figures, laser in zip(done.solution.lasers, done.rig.lasers, strict=True):
        echo(_laser_text(figures, laser))
    page = _page(before, done, request)
    common.finish(done.rig, page, request.out, "lasers", echo, request.rig)


def _camera_uncertainty(rig: Rig, *, refine: bool, elsewhere: bool) -> RigUncertainty:
    """Return the camera's uncertainty, with default sigmas for parameters without their own.

    The solver propagates it to the lasers, which correlates lasers and camera. A refinement takes
    only the rig's own covariance as its prior. If the pictures were taken `elsewhere`, not in the
    rig's water, the default sigma of the water's index does not concern them.
    """
    own = rig_uncertainty(rig)
    if refine:
        return own
    known = completed_uncertainty(rig)
    left_out = elsewhere and "n_water" not in own.names
    return known.only([name for name in known.names if not (left_out and name == "n_water")])


def _assumed(rig: Rig) -> list[str]:
    """Return remarks on numbers of camera, housing and water that no calibration determined."""
    # The lasers are this step's.
    solved_here = {f"{laser.name}:{LASER_PARAMETERS[0]}" for laser in rig.lasers}
    remarks = []
    for one in assumptions(rig):
        if "n_water" in one.uncertainty.names:
            remarks.append(
                f"the water's index {rig.n_water:.4f} was not calibrated, and counts as known to "
                f"{one.words}; fresh water has 1.334 to 1.336, the sea 1.340 to 1.343: run "
                "'aqualvs calibrate water' next, by pictures or by temperature and salinity"
            )
        elif solved_here.isdisjoint(one.uncertainty.names):
            remarks.append(
                f"the {one.what} was not calibrated, and counts as known to {one.words}; wrong by "
                "more, it spoils the lasers: run the steps before this one"
            )
    return remarks


def _with_wavelength(rig: Rig, wavelength_nm: float | None) -> Rig:
    """Return the rig with this wavelength for all lasers; unchanged if None."""
    if wavelength_nm is None:
        return rig
    return replace(
        rig, lasers=tuple(replace(laser, wavelength_nm=wavelength_nm) for laser in rig.lasers)
    )


def _wavelength(given: float | None, rig: Rig) -> float | None:
    """Return the wavelength in nanometres: as given, else the lasers', else the planned one."""
    if given is not None:
        if not LASER_NM[0] <= given <= LASER_NM[1]:
            raise OptionError(f"--wavelength-nm is {given:g}; {LASER_NM_REMEDY}")
        return given
    return common.lasers_wavelength(rig)


def _planned_count(rig: Rig) -> int | None:
    """Return the planned number of lasers of a rig without lasers; None otherwise."""
    planned = rig.solved_from.get(common.N_LASERS)
    return planned if isinstance(planned, int) and not rig.lasers else None


def _detected(
    pictures: common.Pictures,
    rig: Rig,
    box: MarkerSet | str | Path | None,
    board: Board | str | Path | None,
    medium: str | float | None,
    board_offset: float,
) -> _Target:
    """Find the box or board in the pictures; return it with its surfaces and the medium."""
    if (box is None) == (board is None):
        raise OptionError("--box or --board: give one of them, the file of what the lasers hit")
    if box is not None:
        markers, n_nominal = (box, None) if isinstance(box, MarkerSet) else load_box(box)
        surfaces = box_surfaces(markers.planes, markers.points())
        default = rig.n_water
        if n_nominal is not None:
            # Air or the rig's own water, whichever is nearer to the index in the box's file.
            default = min((rig.n_air, rig.n_water), key=lambda n: abs(n - n_nominal))
        found = common.detect_targets(
            pictures,
            lambda one, image: detect_markers(image, markers, one),
            common.path_text(box, "the box"),
        )
        n_medium = common.medium_index(medium, rig, default)
        return _Target(common.named(box, "the box"), surfaces, found, n_medium, markers.ids)
    assert board is not None
    found = common.detect_boards(pictures, board)
    n_medium = common.medium_index(medium, rig, rig.n_water)
    surface = board_surface(thickness=board_offset)
    return _Target(common.named(board, "the board"), surface, found, n_medium)


def _misplaced(
    marker_ids: IntArray, views: Sequence[LaserView], result: LaserCalibration
) -> list[str]:
    """Return a note on every marker that most pictures leave out, because others contradict it."""
    # Least pictures that leave it out, and least share of those that show it.
    min_pictures, min_share = 2, 0.5
    used = {one.name: one.corners.ids[one.corner_inliers] for one in result.views}
    seen, left_out = np.zeros((2, len(marker_ids)), np.int64)
    for one in views:
        if one.view.name not in used:
            continue
        n_seen = np.bincount(one.view.ids // 4, minlength=len(marker_ids))
        n_used = np.bincount(used[one.view.name] // 4, minlength=len(marker_ids))
        seen += n_seen > 0
        left_out += 2 * n_used < n_seen
    wrong = (left_out >= min_pictures) & (left_out > min_share * seen)
    return [
        f"marker {marker_ids[i]}: left out of {left_out[i]} of {seen[i]} pictures, where it does "
        "not fit the others; check its place and number in the box's file"
        for i in np.flatnonzero(wrong)
    ]


def _solved_rig(before: Rig, result: LaserCalibration, target: str, n_medium: float) -> Rig:
    """Return the solved rig with its covariance and a note of this step."""
    old = rig_uncertainty(before)
    new = [name for name in result.uncertainty.names if name not in old.names]
    assumed = [file_parameter_name(name) for name in new if ":" not in name]
    step = SolvedStep(
        pictures=len(result.views),
        points=sum(figures.n_points for figures in result.lasers),
        rms_px=float(np.sqrt(np.mean([figures.rms_px**2 for figures in result.lasers]))),
        extras={
            "target": target,
            "n_medium": round(n_medium, 6),
            "surfaces": sorted({s for figures in result.lasers for s in figures.surfaces}),
            "refined": result.refined,
            **({ASSUMED: assumed} if assumed else {}),
        },
    )
    noted = with_step(result.rig, "lasers", step)
    return with_uncertainty(noted, merged(old, result.uncertainty))


def _with_names(rig: Rig, names: Sequence[str]) -> Rig:
    """Return the rig with its lasers renamed, also in the names of its covariance."""
    lasers = rig.lasers
    if len(names) != len(lasers) or len(set(names)) != len(names):
        raise OptionError(
            f"--names {','.join(names)}: {len(names)} for {len(lasers)} lasers; give each a name "
            "of its own"
        )
    new = {laser.name: name for laser, name in zip(lasers, names, strict=True)}
    lasers = tuple(replace(laser, name=new[laser.name]) for laser in lasers)
    return with_uncertainty(replace(rig, lasers=lasers), rig_uncertainty(rig).renamed(new))


def _laser_text(figures: LaserFigures, laser: Laser) -> str:
    return (
        f"laser '{laser.name}': normal ± {math.degrees(figures.sigma_normal):.3f} deg, offset "
        f"{1e3 * laser.plane.offset:.2f} ± {1e3 * figures.sigma_offset:.2f} mm, residual "
        f"{figures.rms_px:.2f} px, {figures.n_points} points; seen on {', '.join(figures.surfaces)}"
    )


def _laser_row(figures: LaserFigures, laser: Laser, before: Rig) -> LaserRow:
    return LaserRow(
        name=laser.name,
        normal=laser.plane.normal,
        offset_mm=1e3 * laser.plane.offset,
        sigma_normal_deg=math.degrees(figures.sigma_normal),
        sigma_offset_mm=1e3 * figures.sigma_offset,
        rms_px=figures.rms_px,
        rms_mm=1e3 * figures.rms,
        n_points=figures.n_points,
        surfaces=", ".join(figures.surfaces),
        model=figures.sheet,
        moved=_moved(laser, before),
    )


def _moved(laser: Laser, before: Rig) -> str:
    old = next((other for other in before.lasers if other.name == laser.name), None)
    if old is None:
        return ""
    cosine = abs(float(old.plane.normal @ laser.plane.normal))
    shift = 1e3 * (abs(laser.plane.offset) - abs(old.plane.offset))
    return f"{math.degrees(math.acos(min(cosine, 1.0))):.3f}°, {shift:+.2f} mm"


def _page(before: Rig, done: LasersResult, request: LasersRequest) -> CalibrationPage:
    rig, result, found = done.rig, done.solution, done.found[0]
    target = request.box or request.board
    assert target is not None
    used = {one.name for one in result.views}
    seen = zip(done.views, found.pictures, strict=True)
    shown = (_shot(view, picture) for view, picture in seen if view.view.name in used)
    rows = [
        ViewRow(
            name=one.name,
            n_points=one.n_corners,
            rms_px=one.rms_corners_px,
            remark=f"stripes: {one.n_stripe_points} points, {one.rms_stripes_px:.2f} px; pose by "
            f"the paper's cost differs by {math.degrees(one.pose_angle):.3f}°, "
            f"{1e3 * one.pose_shift:.2f} mm",
        )
        for one in result.views
    ]
    worst = max(figures.sigma_normal for figures in result.lasers)
    known = rig_uncertainty(rig)
    refined = [name for name in known.names if ":" not in name]
    each = list(zip(result.lasers, rig.lasers, strict=True))
    # Pictures on the page, each with its corners and stripes drawn over it.
    n_shots = 6
    return CalibrationPage(
        title="Calibration of the lasers",
        subtitle=f"Rig “{rig.name}”, {target.name}, index outside {done.n_medium:.4f}",
        cards=(
            Card("lasers", str(len(rig.lasers)), f"in {count_text(len(result.views), 'picture')}"),
            Card("normals known to", f"{math.degrees(worst):.3f}°", "one sigma, the worst laser"),
            Card(
                "stripes",
                f"{max(f.rms_px for f in result.lasers):.2f} px",
                "rms residual, the worst laser",
            ),
        ),
        warnings=(
            *result.warnings,
            *(f"{name}: {why}" for name, why in result.left_out.items()),
            *found.remarks,
        ),
        words=tuple(_laser_text(*one) for one in each),
        expectations=expectations(rig),
        lasers=tuple(_laser_row(*one, before) for one in each),
        parameters=parameter_rows(rig, known, refined, before) if result.refined else (),
        residual_maps=(
            residual_map(
                "Corners of the target",
                rig.size_px,
                [one.corners for one in result.views],
                [one.corner_residuals_px for one in result.views],
                [one.corner_inliers for one in result.views],
            ),
        ),
        views=(*rows, *missed_rows(found.missed)),
        # Pictures are not kept in memory: those on the page are read again.
        pictures=tuple(islice(shown, n_shots)),
        facts=facts(("rig before", str(request.rig)), ("target", str(target))),
    )


def _shot(view: LaserView, picture: common.Picture) -> PictureShot:
    return PictureShot(
        caption=view.view.name,
        image=common.read_colour(picture),
        points=(
            Overlay(pixels=view.view.pixels, colour="#ff9800", kind="circle", label="corners"),
            Overlay(
                pixels=view.stripes.pixels[::3], colour=laser_colour(0), kind="dot", label="stripes"
            ),
        ),
    )
