"""`aqualvs calibrate lasers`: laser planes from a box of markers, or from a plane with a board."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from aqualvs.calibrate.common import (
    N_LASERS,
    WAVELENGTH_NM,
    Found,
    Tell,
    check_same_size,
    common_wavelength,
    find_targets,
    finish,
    medium_index,
    read_colour,
)
from aqualvs.calibration.detection.detection import detect_board, detect_markers
from aqualvs.calibration.lasers.calibrate import LaserOptions
from aqualvs.calibration.lasers.calibrate import calibrate_lasers as solve_lasers
from aqualvs.calibration.lasers.report import LaserCalibration, LaserFigures
from aqualvs.calibration.lasers.stripes_on_planes import (
    StripePoints,
    TargetSurfaces,
    board_surface,
    box_surfaces,
)
from aqualvs.calibration.lasers.views import LaserView
from aqualvs.calibration.targets.pose_files import picture_paths
from aqualvs.calibration.targets.target_files import load_board, load_box
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Laser, Rig, RigUncertainty
from aqualvs.optics.rigfile import check_rig_place, load_rig
from aqualvs.optics.rigschema import LASER_NM, LASER_NM_REMEDY
from aqualvs.optics.solved import (
    ASSUMED,
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
    LaserRow,
    Overlay,
    ParameterRow,
    PictureShot,
    ViewRow,
    expectations,
    facts,
    missed_rows,
    parameter_rows,
    residual_map,
)
from aqualvs.report.html import Card
from aqualvs.scanning.whole_picture import WholePictureOptions, find_stripes
from aqualvs.text import laser_colour

_DEG = 180.0 / math.pi
_SHOTS = 6


@dataclass(frozen=True, slots=True, kw_only=True)
class LasersRequest:
    """Request of `aqualvs calibrate lasers`, see its `--help`."""

    images: tuple[str, ...]
    rig: Path
    out: Path
    box: Path | None
    board: Path | None
    medium: str | None
    n_lasers: int | None
    names: tuple[str, ...] | None
    board_offset_mm: float
    refine: bool
    wavelength_nm: float | None = None


@dataclass(frozen=True, slots=True)
class _Target:
    """Target that the lasers shine on."""

    file: Path
    surfaces: TargetSurfaces
    found: Found
    n_medium: float


def calibrate_lasers(request: LasersRequest, tell: Tell) -> None:
    """Solve the lasers from pictures and write the rig and its report.

    Raises
    ------
    AqualvsError
        If a file, a picture or its content cannot be used.
    """
    check_rig_place(request.out)
    before = _coloured(load_rig(request.rig, need_lasers=False), request.wavelength_nm)
    wavelength_nm = _wavelength(request, before)
    target = _target(request, before)
    check_same_size(before, target.found)
    views = [
        LaserView(view, _stripes(path, view.name, wavelength_nm))
        for view, path in zip(target.found.views, target.found.paths, strict=True)
    ]
    in_air = abs(target.n_medium - before.n_air) < 1e-3
    result = solve_lasers(
        before,
        views,
        target.surfaces,
        options=LaserOptions(
            n_lasers=_expected(request, before),
            n_medium=target.n_medium if in_air or request.medium else None,
            refine=request.refine,
        ),
        uncertainty=_known(before, request, in_air=in_air),
    )
    if len(result.lasers) != len(before.lasers):
        result = replace(result, rig=_coloured(result.rig, wavelength_nm))
    rig = _noted(before, result, request, target)
    for warning in result.warnings:
        tell(f"note: {warning}")
    for figures, laser in zip(result.lasers, rig.lasers, strict=True):
        tell(_words(figures, laser))
    finish(
        rig,
        _page(before, rig, result, target, views, request),
        request.out,
        "lasers",
        tell,
        comments_of=request.rig,
    )


def _known(rig: Rig, request: LasersRequest, *, in_air: bool) -> RigUncertainty:
    """Return the camera's uncertainty, with defaults for numbers that were written by hand.

    This makes lasers and camera correlated, as they are found together. Priors of a refinement are
    the rig's own only, and an index that is only assumed is left to the water of the dive.
    """
    own = rig_uncertainty(rig)
    if request.refine:
        return own
    known = completed_uncertainty(rig)
    elsewhere = in_air or request.medium is not None
    left_out = {"n_water"} - set(own.names) if elsewhere else set()
    return known.only([name for name in known.names if name not in left_out])


def _coloured(rig: Rig, wavelength_nm: float | None) -> Rig:
    """Return the rig with lasers of this wavelength; unchanged if none is given."""
    if wavelength_nm is None:
        return rig
    return replace(
        rig, lasers=tuple(replace(laser, wavelength_nm=wavelength_nm) for laser in rig.lasers)
    )


def _wavelength(request: LasersRequest, rig: Rig) -> float | None:
    """Return the lasers' wavelength in nanometres from the first source that gives it."""
    given = request.wavelength_nm
    if given is not None and not LASER_NM[0] <= given <= LASER_NM[1]:
        raise OptionError(f"--wavelength-nm is {given:g}; {LASER_NM_REMEDY}")
    noted = rig.solved_from.get(WAVELENGTH_NM)
    if given is None and not rig.lasers and isinstance(noted, int | float):
        return float(noted)
    return common_wavelength(rig.lasers) if given is None else given


def _expected(request: LasersRequest, rig: Rig) -> int | None:
    """Return the number of lasers by request or by the rig's notes; None for the rig's own."""
    if request.n_lasers is not None:
        return request.n_lasers
    if request.names is not None:
        return len(request.names)
    noted = rig.solved_from.get(N_LASERS)
    return noted if isinstance(noted, int) and not rig.lasers else None


def _target(request: LasersRequest, rig: Rig) -> _Target:
    paths = picture_paths(request.images)
    if (request.box is None) == (request.board is None):
        raise OptionError("--box or --board: give one of them, the file of what the lasers hit")
    if request.box is not None:
        markers, n_nominal = load_box(request.box)
        surfaces = box_surfaces(markers.planes, markers.points())
        default = rig.n_water if n_nominal is None else _nearer(n_nominal, rig)
        found = find_targets(
            paths, lambda path, image: detect_markers(image, markers, path.name), request.box.name
        )
        n_medium = medium_index(request.medium, rig, default)
        return _Target(request.box, surfaces, found, n_medium)
    assert request.board is not None
    board = load_board(request.board)
    found = find_targets(
        paths, lambda path, image: detect_board(image, board, path.name), request.board.name
    )
    n_medium = medium_index(request.medium, rig, rig.n_water)
    surface = board_surface(thickness=request.board_offset_mm / 1e3)
    return _Target(request.board, surface, found, n_medium)


def _nearer(n_nominal: float, rig: Rig) -> float:
    """Return air or the rig's own water, whichever is nearer to the index in the box's file."""
    return min((rig.n_air, rig.n_water), key=lambda n: abs(n - n_nominal))


def _stripes(path: Path, name: str, wavelength_nm: float | None) -> StripePoints:
    found = find_stripes(read_colour(path), WholePictureOptions(wavelength_nm=wavelength_nm))
    return StripePoints(name, found.pixels, found.across, found.chain, found.sigma_px)


def _noted(before: Rig, result: LaserCalibration, request: LasersRequest, target: _Target) -> Rig:
    names = request.names
    lasers = result.rig.lasers
    old = rig_uncertainty(before)
    assumed = [name for name in result.uncertainty.names if ":" not in name]
    assumed = [file_parameter_name(name) for name in assumed if name not in old.names]
    step = SolvedStep(
        pictures=len(result.views),
        points=sum(figures.n_points for figures in result.lasers),
        rms_px=float(np.sqrt(np.mean([figures.rms_px**2 for figures in result.lasers]))),
        extras={
            "target": target.file.name,
            "n_medium": round(target.n_medium, 6),
            "surfaces": sorted({s for figures in result.lasers for s in figures.surfaces}),
            "refined": result.refined,
            **({ASSUMED: assumed} if assumed else {}),
        },
    )
    noted = with_step(result.rig, "lasers", step)
    noted = with_uncertainty(noted, merged(old, result.uncertainty))
    if names is None:
        return noted
    if len(names) != len(lasers) or len(set(names)) != len(names):
        raise OptionError(
            f"--names {','.join(names)}: {len(names)} for {len(lasers)} lasers; give each a name "
            "of its own"
        )
    return _renamed(noted, names)


def _renamed(rig: Rig, names: Sequence[str]) -> Rig:
    """Return the rig with its lasers renamed, in its uncertainty too."""
    uncertainty = rig_uncertainty(rig)
    new = {laser.name: name for laser, name in zip(rig.lasers, names, strict=True)}
    lasers = tuple(replace(laser, name=new[laser.name]) for laser in rig.lasers)
    called = tuple(
        f"{new[owner]}:{what}" if colon else name
        for name in uncertainty.names
        for owner, colon, what in [name.rpartition(":")]
    )
    return with_uncertainty(replace(rig, lasers=lasers), replace(uncertainty, names=called))


def _words(figures: LaserFigures, laser: Laser) -> str:
    return (
        f"laser '{laser.name}': normal ± {_DEG * figures.sigma_normal:.3f} deg, offset "
        f"{1e3 * laser.plane.offset:.2f} ± {1e3 * figures.sigma_offset:.2f} mm, residual "
        f"{figures.rms_px:.2f} px, {figures.n_points} points on {', '.join(figures.surfaces)}"
    )


def _laser_row(figures: LaserFigures, laser: Laser, before: Rig) -> LaserRow:
    return LaserRow(
        name=laser.name,
        normal=laser.plane.normal,
        offset_mm=1e3 * laser.plane.offset,
        sigma_normal_deg=_DEG * figures.sigma_normal,
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
    return f"{_DEG * math.acos(min(cosine, 1.0)):.3f}°, {shift:+.2f} mm"


def _page(
    before: Rig,
    rig: Rig,
    result: LaserCalibration,
    target: _Target,
    views: Sequence[LaserView],
    request: LasersRequest,
) -> CalibrationPage:
    used = {one.name for one in result.views}
    rows = [
        ViewRow(
            name=one.name,
            n_points=one.n_corners,
            rms_px=one.rms_corners_px,
            remark=f"stripes: {one.n_stripe_points} points, {one.rms_stripes_px:.2f} px; pose by "
            f"the paper's cost differs by {_DEG * one.pose_angle:.3f}°, "
            f"{1e3 * one.pose_shift:.2f} mm",
        )
        for one in result.views
    ]
    worst = max(figures.sigma_normal for figures in result.lasers)
    return CalibrationPage(
        title="Calibration of the lasers",
        subtitle=f"Rig “{rig.name}”, {target.file.name}, index outside {target.n_medium:.4f}",
        cards=(
            Card("lasers", str(len(rig.lasers)), f"in {len(result.views)} pictures"),
            Card("normals known to", f"{_DEG * worst:.3f}°", "one sigma, the worst laser"),
            Card(
                "stripes",
                f"{max(f.rms_px for f in result.lasers):.2f} px",
                "rms residual, the worst laser",
            ),
        ),
        warnings=(*result.warnings, *result.left_out, *target.found.remarks),
        words=tuple(
            _words(figures, laser) for figures, laser in zip(result.lasers, rig.lasers, strict=True)
        ),
        expectations=expectations(rig),
        lasers=tuple(
            _laser_row(figures, laser, before)
            for figures, laser in zip(result.lasers, rig.lasers, strict=True)
        ),
        parameters=_refined_rows(before, rig) if result.refined else (),
        residual_maps=(
            residual_map(
                "Corners of the target",
                rig.size_px,
                [_corners_of(one.name, one.corners_px) for one in result.views],
                [one.corner_residuals_px for one in result.views],
                [one.corner_inliers for one in result.views],
            ),
        ),
        views=(*rows, *missed_rows(target.found.missed)),
        pictures=tuple(
            _shot(view, path)
            for view, path in zip(views, target.found.paths, strict=True)
            if view.view.name in used
        )[:_SHOTS],
        facts=facts(("rig before", str(request.rig)), ("target", str(target.file))),
    )


def _refined_rows(before: Rig, rig: Rig) -> tuple[ParameterRow, ...]:
    uncertainty = rig_uncertainty(rig)
    names = [name for name in uncertainty.names if ":" not in name]
    return parameter_rows(rig, uncertainty, names, before)


def _corners_of(name: str, pixels: FloatArray) -> View:
    return View(name, np.arange(len(pixels)), np.zeros((len(pixels), 3)), pixels)


def _shot(view: LaserView, path: Path) -> PictureShot:
    return PictureShot(
        caption=view.view.name,
        image=read_colour(path),
        points=(
            Overlay(pixels=view.view.pixels, colour="#ff9800", kind="circle", label="corners"),
            Overlay(
                pixels=view.stripes.pixels[::3], colour=laser_colour(0), kind="dot", label="stripes"
            ),
        ),
    )
