"""`aqualvs check new.yaml --against old.yaml`: changes between two rigs, and their consequence.

Two rigs are compared number by number, for example before and after maintenance. Each difference
has a sigma from the covariances of both rigs, which separates changes from chance. The consequence
is the posture to a wall that the old rig would measure if the new one is right.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.special import chdtri, ndtr

from aqualvs.calibration.solver.bundle import rig_difference as step_between
from aqualvs.check.finding import escaped, number_table, share_plane
from aqualvs.errors import RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import POSE_PARAMETERS, Housing
from aqualvs.optics.expected_error import WallView
from aqualvs.optics.lens import Lens
from aqualvs.optics.rig import (
    LASER_PARAMETERS,
    Laser,
    Rig,
    RigUncertainty,
    laser_parameter_names,
    tangent_basis,
)
from aqualvs.optics.rigfile import dated_copies, load_rig
from aqualvs.optics.sheet import sheet_in
from aqualvs.optics.shutter import Shutter
from aqualvs.optics.solved import file_parameter_name, rig_numbers, rig_uncertainty, solved_steps
from aqualvs.text import sentence

SIGNIFICANT = 5.0
"""Sigmas above which a change is significant."""

# Largest rounding, in radians, of rotations that are read back from a file.
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True)
class RigDifference:
    """Changes of the numbers that two rigs share."""

    names: tuple[str, ...]  # As in `RigUncertainty.names`; lasers by their names in the old rig.
    change: FloatArray  # Shape (P,): new minus old, SI units and radians.
    # Shape (P, P): of `change`; zero where neither rig states an uncertainty.
    covariance: FloatArray

    def of(self, name: str) -> float:
        """Return the change of one number; 0 if the rigs do not share it."""
        return float(self.change[self.names.index(name)]) if name in self.names else 0.0

    def sigma(self, name: str) -> float:
        """Return the standard deviation of one change; 0 if unknown."""
        if name not in self.names:
            return 0.0
        i = self.names.index(name)
        return float(np.sqrt(max(self.covariance[i, i], 0.0)))

    def sigmas(self, names: Sequence[str]) -> float | None:
        """Return the Mahalanobis distance by which some numbers have changed together.

        None if a number has changed whose sigma is not known.
        """
        rows = [self.names.index(name) for name in names if name in self.names]
        change, covariance = self.change[rows], self.covariance[np.ix_(rows, rows)]
        if not change.any():
            return 0.0
        size = np.sqrt(np.diag(covariance))
        known = size > 0.0
        if change[~known].any():
            return None
        scaled, size = change[known] / size[known], size[known]
        correlation = covariance[np.ix_(known, known)] / np.outer(size, size)
        values, vectors = np.linalg.eigh(correlation)
        # No combination of numbers is taken to be known better than this share of their variances.
        min_value = 1e-4
        return float(np.linalg.norm(scaled @ vectors / np.sqrt(np.maximum(values, min_value))))

    def has_moved(self, names: Sequence[str]) -> bool | None:
        """Return whether some numbers have changed significantly; None if not known.

        The probability of a false alarm is that of `SIGNIFICANT` sigmas of a single number,
        regardless of how many numbers there are.
        """
        distance = self.sigmas(names)
        if distance is None:
            return None
        limit = chdtri(max(len(names), 1), 2.0 * ndtr(-SIGNIFICANT))
        return distance > float(np.sqrt(limit))


def rig_difference(
    new: Rig, old: Rig, new_uncertainty: RigUncertainty, old_uncertainty: RigUncertainty
) -> RigDifference:
    """Compare two rigs number by number.

    Parameters
    ----------
    new, old : Rig
        Intrinsics are compared if both have the same lens model and number of coefficients, lasers
        if both have one of that name.
    new_uncertainty, old_uncertainty : RigUncertainty
        Of each rig. Numbers that are equal to the last bit come from the same calibration, so that
        their errors are common to both and cancel; all others are taken as independent.
    """
    changes = _camera_changes(new, old)
    bases: dict[str, FloatArray] = {}
    for theirs, ours in _shared_lasers(new, old):
        change, bases[ours.name] = _laser_change(theirs, ours)
        changes |= dict(zip(laser_parameter_names(ours), change.tolist(), strict=False))
    names = tuple(changes)
    change = np.array([*changes.values()])
    same = change == 0.0
    covariance = _conditional(old_uncertainty.of(names), same)
    basis = np.eye(len(names))
    for laser, own in bases.items():
        rows = [names.index(f"{laser}:{name}") for name in LASER_PARAMETERS]
        basis[np.ix_(rows, rows)] = own
    covariance += _conditional(basis @ new_uncertainty.of(names) @ basis.T, same)
    return RigDifference(names, change, covariance)


def _camera_changes(new: Rig, old: Rig) -> dict[str, float]:
    """Return the changes of pose, housing, media and intrinsics that both rigs have, by name."""
    names: tuple[str, ...] = POSE_PARAMETERS
    if new.housing is not None and type(new.housing) is type(old.housing):
        names += (*new.housing.numbers(), "n_air", "n_water")
    if same_lens_model(new, old):
        names += old.lens.parameter_names
    changes = dict(zip(names, step_between(old, new, names).tolist(), strict=True))
    small = {n: 0.0 for n in POSE_PARAMETERS[3:] if abs(changes[n]) < _ROUNDING}
    return changes | small


def _with_all_coefficients(rig: Rig, other: Rig) -> Rig:
    """Return a rig with as many distortion coefficients as another; those left out are 0."""
    n_more = len(other.lens.distortion) - len(rig.lens.distortion)
    if n_more <= 0 or rig.lens.model != other.lens.model:
        return rig
    distortion = (*rig.lens.distortion, *[0.0] * n_more)
    return replace(rig, lens=replace(rig.lens, distortion=distortion))


def same_lens_model(new: Rig, old: Rig) -> bool:
    """Return whether the intrinsics of two rigs can be compared number by number."""
    return (
        new.lens.model == old.lens.model
        and new.size_px == old.size_px
        and new.lens.parameter_names == old.lens.parameter_names
    )


def _laser_change(new: Laser, old: Laser) -> tuple[FloatArray, FloatArray]:
    """Return the step from the old plane to the new one, and the change of basis of small steps.

    The step is (tilt_1, tilt_2, offset) as `moved_plane` takes it. The matrix (3, 3) expresses a
    small step from the new plane, in its own `tangent_basis`, as one from the old plane.
    """
    plane, sign = new.plane, 1.0
    if plane.normal @ old.plane.normal < 0.0:
        plane, sign = Plane(-plane.normal, -plane.offset), -1.0
    basis = tangent_basis(old.plane.normal)
    # `moved_plane` adds tangents to the normal: a step is the tangent of the angle.
    tilt = basis @ plane.normal / max(float(plane.normal @ old.plane.normal), 1e-6)
    tilt[np.abs(tilt) < _ROUNDING] = 0.0
    old_from_new = np.zeros((3, 3))
    old_from_new[:2, :2] = sign * basis @ tangent_basis(new.plane.normal).T
    old_from_new[2, 2] = sign
    return np.array([*tilt, plane.offset - old.plane.offset]), old_from_new


def _conditional(covariance: FloatArray, same: BoolArray) -> FloatArray:
    """Return the covariance given that the numbers marked by `same` have no error."""
    if not same.any():
        return covariance
    size = np.sqrt(np.diag(covariance))
    size[size == 0.0] = 1.0
    scaled = covariance / np.outer(size, size)
    across = scaled[np.ix_(~same, same)]
    common = np.linalg.pinv(scaled[np.ix_(same, same)], hermitian=True)
    rest: FloatArray = np.zeros_like(covariance)
    rest[np.ix_(~same, ~same)] = scaled[np.ix_(~same, ~same)] - across @ common @ across.T
    rest *= np.outer(size, size)
    return rest


# Longest time between the steps of one calibration, which take a day's work; two calibrations are
# days or months apart.
_PAUSE = timedelta(hours=12)
# Range of the wall by which consequences are stated.
_WALL_M = 0.6
# Changes that matter to a dive, by about 0.1 % of range or 0.1 degrees: position of the lens,
# rotation of the camera (rad), focal length and principal point;
_LENS_M, _TURN, _FOCAL_SHARE, _CENTRE_PX = 5e-4, math.radians(0.1), 0.002, 2.0
# sizes and index of the housing, and index of the water;
_SHELL_M, _ACRYLIC, _INDEX = 2e-4, 5e-3, 1e-3
# tilt of a flat port, which bends a ray by about a quarter of it;
_PORT_TILT = math.radians(0.2)
# tilt of a laser plane, and its distance at the wall.
_TILT, _SHIFT_M = math.radians(0.05), 3e-4

# Factors from SI units to the unit at the end of a name in a rig file.
_SCALES = {"mm": 1e3, "deg": math.degrees(1.0)}


@dataclass(frozen=True, slots=True)
class ComparedPart:
    """A part of a rig and its change."""

    name: str  # In the verdict.
    # The change in words, "moved by 0.4 mm", and its absence, "stayed".
    change: str
    unchanged: str
    # Size of the change in sigmas; None if no sigma is known.
    sigmas: float | None
    # Whether the change is significant, or, without sigmas, large enough to matter.
    moved: bool
    # Whether the change is large enough to show in a dive.
    matters: bool

    @property
    def is_same(self) -> bool:
        """True if nothing has changed at all."""
        return self.sigmas == 0.0

    @property
    def sentence(self) -> str:
        """Return the change in one sentence."""
        if self.sigmas is None:
            in_sigmas = "no sigma is known"
        else:
            in_sigmas = f"{self.sigmas:{'.2g' if self.sigmas < 10.0 else '.0f'}} sigma"
        if not self.moved and self.sigmas is not None:
            return f"{self.name} {self.unchanged} ({in_sigmas})"
        hardly = "" if self.matters else ", too little to matter"
        return f"{self.name} {self.change} ({in_sigmas}){hardly}"


def last_calibration(path: Path) -> Path:
    """Return the dated copy of a rig file from before its latest calibration.

    Steps that follow one another within half a day are one calibration; each step leaves a copy.

    Raises `RigError` if the rig has no dated calibration, or no copy of an earlier one is beside
    it.
    """
    dates = {
        name: step.date for name, step in solved_steps(load_rig(path, need_lasers=False)).items()
    }
    if not dates:
        raise RigError(f"{path}: notes no date of a calibration; name an older rig file instead")
    latest = set()
    started = max(dates.values())
    for name, date in sorted(dates.items(), key=lambda one: one[1], reverse=True):
        if started - date <= _PAUSE:
            latest.add((name, date))
            started = date
    copies = dated_copies(path)
    for copy in copies:
        try:
            found = solved_steps(load_rig(copy, need_lasers=False))
        except RigError:
            continue
        steps = {(name, step.date) for name, step in found.items()}
        if steps and not steps & latest:
            return copy
    if not copies:
        raise RigError(
            f"{path}: no dated copy is beside it, such as calibrations keep of the file that they "
            "replace; name an older rig file: --against FILE"
        )
    hours = _PAUSE.total_seconds() / 3600.0
    raise RigError(
        f"{path}: no dated copy beside it is of an earlier calibration (steps less than {hours:g} "
        "hours apart count as one); name the file to compare with, for example --against "
        f"{copies[0]}"
    )


def run_compare(new: Path, old: Path, console: Console | None = None) -> int:
    """Compare two rig files, print what has changed, and return the exit code 0.

    Raises `RigError` if one of the files is not a rig file.
    """
    new_rig, old_rig = (load_rig(path, need_lasers=False) for path in (new, old))
    new_uncertainty, old_uncertainty = rig_uncertainty(new_rig), rig_uncertainty(old_rig)
    new_rig = _with_all_coefficients(new_rig, old_rig)
    old_rig = _with_all_coefficients(old_rig, new_rig)
    # The user or a calibration names the lasers: the same laser may have two names.
    old_names = _old_names(new_rig, old_rig)
    lasers = [replace(one, name=old_names.get(one.name, one.name)) for one in new_rig.lasers]
    new_rig = replace(new_rig, lasers=tuple(lasers))
    new_uncertainty = new_uncertainty.renamed(old_names)
    difference = rig_difference(new_rig, old_rig, new_uncertainty, old_uncertainty)
    console = console or Console()
    console.print(f"{new} against {old}", style="bold", markup=False, highlight=False)
    parts = compared_parts(new_rig, old_rig, difference)
    others = [*_mismatches(new_rig, old_rig), *_settings(new_rig, old_rig)]
    console.print(verdict(parts, differs=bool(others)), style="bold", markup=False, highlight=False)
    if not all(part.is_same for part in parts):
        for line in consequence(new_rig, old_rig):
            console.print(line, markup=False, highlight=False)
    console.print(_table(new_rig, old_rig, difference))
    known = {new: bool(new_uncertainty.names), old: bool(old_uncertainty.names)}
    same = ", ".join(f"'{name}' as '{before}'" for name, before in old_names.items())
    notes = [f"Lasers with new names are matched by their planes: {same}."] if same else []
    for line in (*notes, *_missing_sigmas(known), *others):
        console.print(line, markup=False, highlight=False)
    return 0


def compared_parts(new: Rig, old: Rig, difference: RigDifference) -> list[ComparedPart]:
    """Return the parts that both rigs have, with their changes."""
    parts = [*_pose_parts(difference)]
    if same_lens_model(new, old):
        parts.append(_intrinsics_part(new, old, difference))
    else:
        parts.append(
            ComparedPart("the intrinsics", "cannot be compared", "", None, moved=True, matters=True)
        )
    if old.housing is not None and type(new.housing) is type(old.housing):
        parts += _housing_parts(old.housing, difference)
    for ours, theirs in _shared_lasers(new, old):
        angle, shift, _ = _laser_move(new, ours, theirs, difference)
        turned, moved = f"{math.degrees(angle):.2g} deg", f"{abs(shift) * 1e3:.2g} mm"
        name, names = f"laser '{theirs.name}'", laser_parameter_names(theirs)[:3]
        change = f"moved by {turned}, {moved} at {_WALL_M:g} m"
        matters = angle > _TILT or abs(shift) > _SHIFT_M
        parts.append(_part(difference, name, names, change, matters))
    return parts


def verdict(parts: list[ComparedPart], *, differs: bool = False) -> str:
    """Return what moved and what stayed, in one sentence.

    `differs`: whether the rigs differ in what has no part, such as the shutter.
    """
    moved = [part.sentence for part in parts if part.moved]
    stayed = [part.sentence for part in parts if not part.moved and not part.is_same]
    same = [part.name for part in parts if part.is_same]
    clauses = moved + stayed
    if same:
        none = "not changed at all" if clauses or differs else "nothing has changed"
        clauses.append(f"{none}: {', '.join(same)}")
    if not moved and stayed:
        clauses.insert(0, "nothing has moved that matters")
    return sentence("; ".join(clauses))


def consequence(new: Rig, old: Rig) -> Iterator[str]:
    """Yield what the old rig would measure of a wall if the new one is right, in one sentence."""
    if new.size_px != old.size_px:
        return
    pairs = _shared_lasers(new, old)
    wall = WallView.ahead(replace(new, lasers=tuple(a for a, _ in pairs)), _WALL_M)
    read = wall.measured_by(replace(old, lasers=tuple(b for _, b in pairs)))
    place = f"If the new rig is right, a wall {_WALL_M * 1e3:.0f} mm ahead"
    if not np.isfinite(read).all():
        yield f"{place} cannot be measured with the lasers that both rigs have."
        return
    range_m, pitch, yaw = read.tolist()
    share = range_m / _WALL_M - 1.0
    yield (
        f"{place} and square to the vehicle would read {range_m * 1e3:.1f} mm ({share:+.2%}), "
        f"pitch {_degrees(pitch)} and yaw {_degrees(yaw)} degrees with the old one."
    )


def _pose_parts(difference: RigDifference) -> Iterator[ComparedPart]:
    lens, turn = POSE_PARAMETERS[:3], POSE_PARAMETERS[3:]
    shift, angle = (
        float(np.linalg.norm([difference.of(name) for name in names])) for names in (lens, turn)
    )
    yield _part(difference, "the lens", lens, f"moved by {shift * 1e3:.2g} mm", shift > _LENS_M)
    change = f"turned by {math.degrees(angle):.2g} deg"
    yield _part(difference, "the camera", turn, change, angle > _TURN, "did not turn")


def _intrinsics_part(new: Rig, old: Rig, difference: RigDifference) -> ComparedPart:
    share = max(abs(new.lens.fx / old.lens.fx - 1.0), abs(new.lens.fy / old.lens.fy - 1.0))
    centre = math.hypot(difference.of("cx"), difference.of("cy"))
    moved_px = _distortion_change_px(new, old)
    change = f"changed by {share:.2%} in focal length, {centre:.2g} px in the principal point"
    change += f" and {moved_px:.2g} px (rms) by distortion"
    matters = share > _FOCAL_SHARE or max(centre, moved_px) > _CENTRE_PX
    names = old.lens.parameter_names
    widened = _with_detector_bias(old.lens, old.size_px, difference)
    return _part(widened, "the intrinsics", names, change, matters)


def _with_detector_bias(
    lens: Lens, size_px: tuple[int, int], difference: RigDifference
) -> RigDifference:
    """Return the difference with errors of corners that all views share in its covariance.

    Views that agree do not show them, so the covariance of a calibration lacks them. Without them
    fx / fy may count as known to a millionth, and a thousandth of a pixel as a change.
    """
    # Smooth over the picture, rms; rendered views leave 0.001 to 0.01.
    shared_px = 0.005
    names = lens.parameter_names
    pixels = _picture_grid(size_px)
    directions, seen = lens.directions(pixels)
    rows = [difference.names.index(name) for name in names]
    covariance = difference.covariance.copy()
    # Numbers of one calibration have no error in the difference.
    scale = np.sqrt(np.diag(covariance)[rows])
    known = scale > 0.0
    slopes = []
    for name, step in zip(np.array(names)[known].tolist(), scale[known].tolist(), strict=True):
        shifted, valid = lens.moved_by({name: step}).pixels(directions)
        slopes.append(np.where(valid[:, None], shifted - pixels, 0.0)[seen].reshape(-1))
    if not slopes or not seen.any():
        return difference
    information = np.array(slopes) @ np.array(slopes).T / np.count_nonzero(seen)
    bias = shared_px**2 * np.linalg.pinv(information, hermitian=True)
    at = np.array(rows)[known]
    covariance[np.ix_(at, at)] += bias * np.outer(scale[known], scale[known])
    return replace(difference, covariance=covariance)


def _distortion_change_px(new: Rig, old: Rig) -> float:
    """Return the shift of the old pixels by the new distortion, rms over the picture."""
    pixels = _picture_grid(old.size_px)
    directions, seen = old.lens.directions(pixels)
    moved, valid = replace(old.lens, distortion=new.lens.distortion).pixels(directions)
    squared = np.sum((moved - pixels)[seen & valid] ** 2, axis=-1)
    return float(np.sqrt(squared.mean())) if squared.size else math.inf


def _picture_grid(size_px: tuple[int, int]) -> FloatArray:
    width, height = size_px
    grid = np.meshgrid(np.linspace(0.0, width - 1.0, 17), np.linspace(0.0, height - 1.0, 17))
    return np.stack(grid, axis=-1).reshape(-1, 2)


def _housing_parts(housing: Housing, difference: RigDifference) -> Iterator[ComparedPart]:
    """Yield the changes of the dome or flat port, and of the water."""
    names = tuple(housing.numbers())
    size, thickness, index, *tilts = (difference.of(name) for name in names)
    tilt = math.hypot(*tilts)
    name, what = ("the flat port", "distance") if tilts else ("the dome", "radius")
    change = f"changed by {size * 1e3:+.2g} mm in {what}, {thickness * 1e3:+.2g} mm in thickness"
    if tilts:
        change += f", {index:+.2g} in index and {math.degrees(tilt):.2g} degrees in tilt"
    else:
        change += f" and {index:+.2g} in index"
    matters = max(abs(size), abs(thickness)) > _SHELL_M or abs(index) > _ACRYLIC
    yield _part(difference, name, names, change, matters or tilt > _PORT_TILT)
    step = difference.of("n_water")
    change = f"changed its index by {step:+.4f}"
    yield _part(difference, "the water", ("n_water",), change, abs(step) > _INDEX)


def _part(
    difference: RigDifference,
    name: str,
    names: tuple[str, ...],
    change: str,
    matters: bool,
    unchanged: str = "stayed",
) -> ComparedPart:
    """Return the change of a part, by the covariance or else by whether it `matters`."""
    moved = difference.has_moved(names)
    return ComparedPart(
        name=name,
        change=change,
        unchanged=unchanged,
        sigmas=difference.sigmas(names),
        moved=matters if moved is None else moved,
        matters=matters,
    )


def _laser_move(
    rig: Rig, new: Laser, old: Laser, difference: RigDifference
) -> tuple[float, float, float]:
    """Return the angle between two planes, the shift of the stripe, and the sigma of the shift.

    The shift, in metres, is the distance of the new stripe on a wall `_WALL_M` ahead from the old
    sheet; NaN if the camera does not see it.
    """
    names = laser_parameter_names(old)[:3]
    angle = math.atan(math.hypot(*(difference.of(name) for name in names[:2])))
    points = WallView.ahead(replace(rig, lasers=(new,)), _WALL_M).stripes[0].points_in_dome
    if not len(points):
        return angle, math.nan, math.nan
    sheet = sheet_in(old, rig.n_air, rig.n_water)
    shift = float(sheet.signed_distance(points).mean())
    slope = np.append(points.mean(axis=0) @ tangent_basis(old.plane.normal).T, -1.0)
    rows = [difference.names.index(name) for name in names]
    variance = float(slope @ difference.covariance[np.ix_(rows, rows)] @ slope)
    return angle, shift, math.sqrt(max(variance, 0.0))


def _shared_lasers(new: Rig, old: Rig) -> list[tuple[Laser, Laser]]:
    """Return pairs (new, old) of lasers of the same name, in the order of the old rig."""
    by_name = {laser.name: laser for laser in new.lasers}
    return [(by_name[laser.name], laser) for laser in old.lasers if laser.name in by_name]


def _missing_sigmas(known: dict[Path, bool]) -> Iterator[str]:
    """Yield a sentence if a rig does not state its uncertainty; `known`: by file, if it does."""
    without = [str(path) for path, is_known in known.items() if not is_known]
    if len(without) == len(known):
        yield (
            "Neither rig states its uncertainty, so changes that are too little to matter count as "
            "chance."
        )
    elif without:
        yield f"{without[0]} does not state its uncertainty; sigmas are those of the other rig."


def _mismatches(new: Rig, old: Rig) -> Iterator[str]:
    """Yield sentences on parts that cannot be compared."""
    if new.size_px != old.size_px:
        have, had = ("x".join(map(str, rig.size_px)) for rig in (new, old))
        yield (
            f"The pictures are {have} px and were {had} px: another camera or video mode, so "
            "intrinsics and readings cannot be compared."
        )
    elif not same_lens_model(new, old):
        yield "The lens models differ, so the intrinsics cannot be compared number by number."
    for what, ours, theirs in (
        ("dome", new.dome, old.dome),
        ("flat port", new.flat_port, old.flat_port),
    ):
        if (ours is None) != (theirs is None):
            yield f"Only the {'old' if ours is None else 'new'} rig has a {what}."
    shared = {laser.name for _, laser in _shared_lasers(new, old)}
    for what, rig in (("new", new), ("gone", old)):
        for laser in rig.lasers:
            if laser.name not in shared:
                yield f"Laser '{laser.name}' is {what}."


def _settings(new: Rig, old: Rig) -> Iterator[str]:
    """Yield sentences on changes of what both rigs state without any uncertainty."""
    lasers = [(f"wavelength of laser '{b.name}'", a, b) for a, b in _shared_lasers(new, old)]
    for what, have, had in (
        ("shutter", _shutter_text(new.shutter), _shutter_text(old.shutter)),
        ("working range", *(_range_text(rig) for rig in (new, old))),
        *((what, _light_text(a), _light_text(b)) for what, a, b in lasers),
    ):
        if have != had:
            yield f"The {what} is {have} and was {had}."


def _shutter_text(shutter: Shutter) -> str:
    words = [shutter.kind.value]
    if shutter.readout != 0.0:
        words.append(f"readout {1e3 * shutter.readout:.10g} ms")
    if shutter.exposure > 0.0:
        words.append(f"exposure {1e3 * shutter.exposure:.10g} ms")
    if shutter.is_interlaced:
        words.append(f"{shutter.first_field} field first")
    return ", ".join(words)


def _range_text(rig: Rig) -> str:
    near, far = rig.working_range
    return f"{1e3 * near:.10g} to {1e3 * far:.10g} mm"


def _light_text(laser: Laser) -> str:
    return "not stated" if laser.wavelength_nm is None else f"{laser.wavelength_nm:.10g} nm"


def _old_names(new: Rig, old: Rig) -> dict[str, str]:
    """Return the old name of each new laser whose plane is that of an old one of another name."""
    shared = {laser.name for _, laser in _shared_lasers(new, old)}
    gone = [laser for laser in old.lasers if laser.name not in shared]
    old_names = {}
    for laser in new.lasers:
        # Planes of different lasers are farther apart.
        twin = next((other for other in gone if share_plane(laser, other)), None)
        if laser.name not in shared and twin is not None:
            gone.remove(twin)
            old_names[laser.name] = twin.name
    return old_names


def _table(new: Rig, old: Rig, difference: RigDifference) -> Table:
    """Return the table of all numbers that both rigs have."""
    names = ("number", "old", "new", "change", "sigma", "in sigmas")
    table = number_table(None, *names, texts=["number"])
    values, values_before = rig_numbers(new), rig_numbers(old)
    for name in difference.names:
        if ":" not in name:
            label = file_parameter_name(name)
            scale = _SCALES.get(label.rpartition("_")[2], 1.0)
            pair = [f"{scale * known[name]:.6g}" for known in (values_before, values)]
            # Of rotations, only the change has a meaning.
            cells = ["", ""] if name in POSE_PARAMETERS[3:] else pair
            change, sigma = scale * difference.of(name), scale * difference.sigma(name)
            table.add_row(label, *cells, *_change_cells(change, sigma))
    for ours, theirs in _shared_lasers(new, old):
        for row in _laser_rows(new, ours, theirs, difference):
            table.add_row(*row)
    return table


def _change_cells(change: float, sigma: float) -> list[str]:
    if change == 0.0:
        return ["same", "", ""]
    if sigma == 0.0 or math.isnan(sigma):
        return [f"{change:+.3g}", "", ""]
    return [f"{change:+.3g}", f"{sigma:.2g}", f"{abs(change) / sigma:.1f}"]


def _laser_rows(rig: Rig, new: Laser, old: Laser, difference: RigDifference) -> Iterator[list[str]]:
    angle, shift, sigma = _laser_move(rig, new, old, difference)
    label = escaped(old.name)
    # The sigma of a rotation in the direction in which the laser has turned.
    rows = [difference.names.index(name) for name in laser_parameter_names(old)[:2]]
    tilt = difference.change[rows]
    length, turned_sigma = float(np.linalg.norm(tilt)), 0.0
    if length:
        variance = float(tilt @ difference.covariance[np.ix_(rows, rows)] @ tilt)
        turned_sigma = math.sqrt(variance) / length
    turn = [f"{label} turned by deg", "", ""]
    yield turn + _change_cells(math.degrees(angle), math.degrees(turned_sigma))
    if math.isfinite(shift):
        moved = [f"{label} off at {_WALL_M:g} m by mm", "", ""]
        # Points that have not moved differ by rounding.
        shift = 0.0 if abs(shift) < 1e-12 else shift
        yield moved + _change_cells(shift * 1e3, sigma * 1e3)


def _degrees(angle: float) -> str:
    # Adding zero turns -0.0 into 0.0.
    return f"{round(math.degrees(angle), 2) + 0.0:+.2f}"
