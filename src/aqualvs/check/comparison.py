"""`aqualvs check new.yaml --against old.yaml`: changes between two rigs, and their consequence.

Two rigs are compared number by number, for example before and after maintenance. Each difference
has a sigma from the covariances of both rigs, so that a move can be told from chance. The
consequence is what the old rig would read of a wall where the new one is right.
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
from aqualvs.check.finding import escaped, number_table
from aqualvs.errors import RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.camera import POSE_PARAMETERS
from aqualvs.optics.expected_error import WallView
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
from aqualvs.optics.solved import file_parameter_name, rig_numbers, rig_uncertainty, solved_steps
from aqualvs.text import sentence

SIGNIFICANT = 5.0
"""Sigmas from which on a change is no chance."""

# Rotations (rad) come back from files with this much rounding, and then some.
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True)
class RigDifference:
    """Changes of the numbers that two rigs share."""

    names: tuple[str, ...]  # As `RigUncertainty.names` has them; lasers are those of the old rig.
    change: FloatArray  # Shape (P,): new minus old, SI units and radians.
    # Shape (P, P): of `change`; zero where neither rig says how well it is known.
    covariance: FloatArray

    def of(self, name: str) -> float:
        """Return the change of one number; 0 for those that the rigs do not share."""
        return float(self.change[self.names.index(name)]) if name in self.names else 0.0

    def sigma(self, name: str) -> float:
        """Return the standard deviation of one change; 0 where it is not known."""
        if name not in self.names:
            return 0.0
        i = self.names.index(name)
        return float(np.sqrt(max(self.covariance[i, i], 0.0)))

    def sigmas(self, names: Sequence[str]) -> float | None:
        """Return how many sigmas some numbers have moved together, in the direction that shows it.

        None where it is not known, though something has moved.
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
        # No combination of numbers is believed to be known better than this share of their
        # variances.
        not_better = 1e-4
        return float(np.linalg.norm(scaled @ vectors / np.sqrt(np.maximum(values, not_better))))

    def has_moved(self, names: Sequence[str]) -> bool | None:
        """Return whether some numbers have moved by more than chance, None where unknown.

        The chance is that of `SIGNIFICANT` sigmas of one number, however many there are.
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
        Intrinsics are compared where both have the same lens model and number of coefficients,
        lasers where both have one of that name.
    new_uncertainty, old_uncertainty : RigUncertainty
        Of either. Numbers that are equal to the last bit come from the same calibration, so that
        their errors are common to both and take part in no difference; all others are independent.
    """
    changes = _camera_changes(new, old)
    turns: dict[str, FloatArray] = {}
    for laser in old.lasers:
        twin = next((other for other in new.lasers if other.name == laser.name), None)
        if twin is not None:
            change, turns[laser.name] = _laser_change(twin, laser)
            changes |= dict(zip(laser_parameter_names(laser), change.tolist(), strict=False))
    names = tuple(changes)
    change = np.array([*changes.values()])
    same = change == 0.0
    covariance = _given(old_uncertainty.of(names), same)
    turn = _turned(names, turns)
    covariance += _given(turn @ new_uncertainty.of(names) @ turn.T, same)
    return RigDifference(names, change, covariance)


def _camera_changes(new: Rig, old: Rig) -> dict[str, float]:
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
    """Return whether the intrinsics of two rigs mean the same."""
    return (
        new.lens.model == old.lens.model
        and new.size_px == old.size_px
        and new.lens.parameter_names == old.lens.parameter_names
    )


def _laser_change(new: Laser, old: Laser) -> tuple[FloatArray, FloatArray]:
    """Return the step that leads from the old plane to the new one, and what turns new steps.

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
    turn = np.zeros((3, 3))
    turn[:2, :2] = sign * basis @ tangent_basis(new.plane.normal).T
    turn[2, 2] = sign
    return np.array([*tilt, plane.offset - old.plane.offset]), turn


def _turned(names: tuple[str, ...], turns: dict[str, FloatArray]) -> FloatArray:
    matrix = np.eye(len(names))
    for laser, turn in turns.items():
        rows = [names.index(f"{laser}:{name}") for name in LASER_PARAMETERS]
        matrix[np.ix_(rows, rows)] = turn
    return matrix


def _given(covariance: FloatArray, same: BoolArray) -> FloatArray:
    """Return the covariance where the numbers marked by `same` are known to have no error."""
    if not same.any():
        return covariance
    size = np.sqrt(np.diag(covariance))
    size[size == 0.0] = 1.0
    scaled = covariance / np.outer(size, size)
    across = scaled[np.ix_(~same, same)]
    common = np.linalg.pinv(scaled[np.ix_(same, same)], hermitian=True)
    left: FloatArray = np.zeros_like(covariance)
    left[np.ix_(~same, ~same)] = scaled[np.ix_(~same, ~same)] - across @ common @ across.T
    left *= np.outer(size, size)
    return left


# The steps of one calibration are done in a day's work, two calibrations days or months apart.
_PAUSE = timedelta(hours=12)
_WALL_M = 0.6
# Changes that matter to a dive: about 0.1 % of range or 0.1 degrees.
_LENS_M, _TURN, _FOCAL_SHARE, _CENTRE_PX = 5e-4, math.radians(0.1), 0.002, 2.0
_SHELL_M, _ACRYLIC, _INDEX = 2e-4, 5e-3, 1e-3
# Of a flat port. It bends a ray by about a quarter of it.
_PORT_TILT = math.radians(0.2)
_TILT, _SHIFT_M = math.radians(0.05), 3e-4

_SCALES = {"mm": 1e3, "deg": math.degrees(1.0)}


@dataclass(frozen=True, slots=True)
class ComparedPart:
    """A part of a rig and how it has changed."""

    name: str  # As the verdict calls it.
    # What it did or did not, in words: "moved by 0.4 mm", "stayed".
    did: str
    stayed: str
    # How many sigmas that is; None where no sigma is known.
    sigmas: float | None
    # Whether that is more than chance, or, without sigmas, more than what matters.
    moved: bool
    # Whether it is enough to be seen in a dive.
    matters: bool

    @property
    def is_same(self) -> bool:
        """True if nothing has changed at all."""
        return self.sigmas == 0.0

    @property
    def sentence(self) -> str:
        """Return the change in one sentence."""
        if self.sigmas is None:
            told = "no sigma is known"
        else:
            told = f"{self.sigmas:{'.2g' if self.sigmas < 10.0 else '.0f'}} sigma"
        if not self.moved and self.sigmas is not None:
            return f"{self.name} {self.stayed} ({told})"
        hardly = "" if self.matters else ", too little to matter"
        return f"{self.name} {self.did} ({told}){hardly}"


def last_calibration(path: Path) -> Path:
    """Return the dated copy of a rig file as it was before its latest calibration.

    Steps that follow one another within half a day are one calibration, of which every step leaves
    a copy.

    Raises `RigError` if the rig notes no calibration, or no copy of an earlier one is kept beside
    it.
    """
    dates = {
        name: step.date for name, step in solved_steps(load_rig(path, need_lasers=False)).items()
    }
    if not dates:
        raise RigError(f"{path}: notes no date of a calibration; name an older rig file instead")
    latest = set()
    begun = max(dates.values())
    for name, date in sorted(dates.items(), key=lambda one: one[1], reverse=True):
        if begun - date <= _PAUSE:
            latest.add((name, date))
            begun = date
    for copy in dated_copies(path):
        try:
            found = solved_steps(load_rig(copy, need_lasers=False))
        except RigError:
            continue
        steps = {(name, step.date) for name, step in found.items()}
        if steps and not steps & latest:
            return copy
    raise RigError(
        f"{path}: no dated copy of an earlier calibration is kept beside it; name an older rig file"
    )


def run_compare(new: Path, old: Path, console: Console | None = None) -> int:
    """Compare two rig files, print what has changed, and return the exit code 0.

    Raises `RigError` if one of the files is not a rig file.
    """
    new_rig, new_uncertainty = _loaded(new)
    old_rig, old_uncertainty = _loaded(old)
    new_rig = _with_all_coefficients(new_rig, old_rig)
    old_rig = _with_all_coefficients(old_rig, new_rig)
    # Names are the user's, or made up by a calibration: the same laser may have two.
    called = _names_before(new_rig, old_rig)
    lasers = [replace(one, name=called.get(one.name, one.name)) for one in new_rig.lasers]
    new_rig = replace(new_rig, lasers=tuple(lasers))
    new_uncertainty = new_uncertainty.renamed(called)
    difference = rig_difference(new_rig, old_rig, new_uncertainty, old_uncertainty)
    console = console or Console()
    console.print(f"{new} against {old}", style="bold", markup=False, highlight=False)
    parts = compared_parts(new_rig, old_rig, difference)
    console.print(verdict(parts), style="bold", markup=False, highlight=False)
    if not all(part.is_same for part in parts):
        for line in consequence(new_rig, old_rig):
            console.print(line, markup=False, highlight=False)
    console.print(_table(new_rig, old_rig, difference))
    known = {new: bool(new_uncertainty.names), old: bool(old_uncertainty.names)}
    same = [f"'{name}' as '{before}'" for name, before in called.items()]
    renamed = [f"Lasers with new names are matched by their planes: {', '.join(same)}."]
    for line in (*(renamed if same else []), *_limits(known), *_mismatches(new_rig, old_rig)):
        console.print(line, markup=False, highlight=False)
    return 0


def compared_parts(new: Rig, old: Rig, difference: RigDifference) -> list[ComparedPart]:
    """Return the parts that both rigs have, and how each has changed."""
    parts = [_lens_part(difference), _turn_part(difference)]
    if same_lens_model(new, old):
        parts.append(_intrinsics_part(new, old, difference))
    else:
        parts.append(
            ComparedPart("the intrinsics", "cannot be compared", "", None, moved=True, matters=True)
        )
    if new.dome is not None and old.dome is not None:
        parts += [_shell_part(difference), _water_part(difference)]
    if new.flat_port is not None and old.flat_port is not None:
        parts += [_flat_part(difference), _water_part(difference)]
    return parts + [_laser_part(new, a, b, difference) for a, b in _shared_lasers(new, old)]


def verdict(parts: list[ComparedPart]) -> str:
    """Return what moved and what stayed, in one sentence."""
    moved = [part.sentence for part in parts if part.moved]
    stayed = [part.sentence for part in parts if not part.moved and not part.is_same]
    same = [part.name for part in parts if part.is_same]
    told = moved + stayed
    if same:
        told.append(f"{'not changed at all' if told else 'nothing has changed'}: {', '.join(same)}")
    if not moved and stayed:
        told.insert(0, "nothing has moved that matters")
    return sentence("; ".join(told))


def consequence(new: Rig, old: Rig) -> Iterator[str]:
    """Say what the old rig would read where the new one is right."""
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


def _loaded(path: Path) -> tuple[Rig, RigUncertainty]:
    rig = load_rig(path, need_lasers=False)
    try:
        return rig, rig_uncertainty(rig)
    except RigError as error:
        raise RigError(f"{path}: {error}") from None


def _lens_part(difference: RigDifference) -> ComparedPart:
    names = POSE_PARAMETERS[:3]
    way = float(np.linalg.norm([difference.of(name) for name in names]))
    return _part(difference, "the lens", names, f"moved by {way * 1e3:.2g} mm", way > _LENS_M)


def _turn_part(difference: RigDifference) -> ComparedPart:
    names = POSE_PARAMETERS[3:]
    angle = float(np.linalg.norm([difference.of(name) for name in names]))
    did = f"turned by {math.degrees(angle):.2g} deg"
    return _part(difference, "the camera", names, did, angle > _TURN, "did not turn")


def _intrinsics_part(new: Rig, old: Rig, difference: RigDifference) -> ComparedPart:
    share = max(abs(new.lens.fx / old.lens.fx - 1.0), abs(new.lens.fy / old.lens.fy - 1.0))
    centre = math.hypot(difference.of("cx"), difference.of("cy"))
    bent = _bent_px(new, old)
    did = f"changed by {share:.2%} in focal length, {centre:.2g} px in the principal point"
    did += f" and {bent:.2g} px (rms) by distortion"
    matters = share > _FOCAL_SHARE or max(centre, bent) > _CENTRE_PX
    names = old.lens.parameter_names
    return _part(difference, "the intrinsics", names, did, matters)


def _bent_px(new: Rig, old: Rig) -> float:
    """Return how far the new distortion moves the old pixels, rms over the picture."""
    width, height = old.size_px
    across = np.meshgrid(np.linspace(0.0, width - 1.0, 17), np.linspace(0.0, height - 1.0, 17))
    pixels = np.stack(across, axis=-1).reshape(-1, 2)
    directions, seen = old.lens.directions(pixels)
    moved, valid = replace(old.lens, distortion=new.lens.distortion).pixels(directions)
    way = np.sum((moved - pixels)[seen & valid] ** 2, axis=-1)
    return float(np.sqrt(way.mean())) if way.size else math.inf


def _shell_part(difference: RigDifference) -> ComparedPart:
    names = ("inner_radius", "thickness", "n_acrylic")
    radius, thickness, index = (difference.of(name) for name in names)
    did = f"changed by {radius * 1e3:+.2g} mm in radius, {thickness * 1e3:+.2g} mm in thickness"
    did += f" and {index:+.2g} in index"
    matters = max(abs(radius), abs(thickness)) > _SHELL_M or abs(index) > _ACRYLIC
    return _part(difference, "the dome", names, did, matters)


def _flat_part(difference: RigDifference) -> ComparedPart:
    names = ("port_distance", "thickness", "n_port", "port_tilt_x", "port_tilt_y")
    distance, thickness, index, *tilts = (difference.of(name) for name in names)
    tilt = math.hypot(*tilts)
    did = f"changed by {distance * 1e3:+.2g} mm in distance, {thickness * 1e3:+.2g} mm in thickness"
    did += f", {index:+.2g} in index and {math.degrees(tilt):.2g} degrees in tilt"
    matters = max(abs(distance), abs(thickness)) > _SHELL_M or abs(index) > _ACRYLIC
    return _part(difference, "the flat port", names, did, matters or tilt > _PORT_TILT)


def _water_part(difference: RigDifference) -> ComparedPart:
    change = difference.of("n_water")
    did = f"changed its index by {change:+.4f}"
    return _part(difference, "the water", ("n_water",), did, abs(change) > _INDEX)


def _laser_part(new_rig: Rig, new: Laser, old: Laser, difference: RigDifference) -> ComparedPart:
    names = laser_parameter_names(old)[:3]
    angle, shift, _ = _laser_move(new_rig, new, old, difference)
    did = f"moved by {math.degrees(angle):.2g} deg, {abs(shift) * 1e3:.2g} mm at 0.6 m"
    matters = angle > _TILT or abs(shift) > _SHIFT_M
    return _part(difference, f"laser '{old.name}'", names, did, matters)


def _part(
    difference: RigDifference,
    name: str,
    names: tuple[str, ...],
    did: str,
    matters: bool,
    stayed: str = "stayed",
) -> ComparedPart:
    moved = difference.has_moved(names)
    return ComparedPart(
        name=name,
        did=did,
        stayed=stayed,
        sigmas=difference.sigmas(names),
        moved=matters if moved is None else moved,
        matters=matters,
    )


def _laser_move(
    rig: Rig, new: Laser, old: Laser, difference: RigDifference
) -> tuple[float, float, float]:
    """Return the angle between two planes, the stripe's distance from the old sheet, its sigma.

    The stripe is that on a wall `_WALL_M` ahead; NaN where the camera does not see it.
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


def _limits(known: dict[Path, bool]) -> Iterator[str]:
    """Say what the sigmas do not count."""
    without = [str(path) for path, is_known in known.items() if not is_known]
    if len(without) == len(known):
        yield (
            "Neither rig states its uncertainty, so changes that are too little to matter count as "
            "chance."
        )
    elif without:
        yield f"{without[0]} does not state its uncertainty; sigmas are those of the other rig."


def _mismatches(new: Rig, old: Rig) -> Iterator[str]:
    """Say what cannot be compared."""
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


def _names_before(new: Rig, old: Rig) -> dict[str, str]:
    """Return the old name of every new laser that lies where one of another name lay."""
    shared = {laser.name for _, laser in _shared_lasers(new, old)}
    gone = [laser for laser in old.lasers if laser.name not in shared]
    called = {}
    for laser in new.lasers:
        twin = next((other for other in gone if _alike(laser, other)), None)
        if laser.name not in shared and twin is not None:
            gone.remove(twin)
            called[laser.name] = twin.name
    return called


def _alike(one: Laser, other: Laser) -> bool:
    cosine = float(one.plane.normal @ other.plane.normal)
    shift = one.plane.offset - math.copysign(1.0, cosine) * other.plane.offset
    # A laser whose plane is as near as this to one of another name is likely the same.
    alike_tilt, alike_shift_m = math.radians(1.0), 5e-3
    return abs(cosine) > math.cos(alike_tilt) and abs(shift) < alike_shift_m


def _table(new: Rig, old: Rig, difference: RigDifference) -> Table:
    names = ("number", "old", "new", "change", "sigma", "in sigmas")
    table = number_table(None, *names, texts=["number"])
    values, values_before = rig_numbers(new), rig_numbers(old)
    for name in difference.names:
        if ":" not in name:
            table.add_row(*_row(name, values[name], values_before[name], difference))
    for ours, theirs in _shared_lasers(new, old):
        for row in _laser_rows(new, ours, theirs, difference):
            table.add_row(*row)
    return table


def _row(name: str, new: float, old: float, difference: RigDifference) -> list[str]:
    label = file_parameter_name(name)
    scale = _SCALES.get(label.rpartition("_")[2], 1.0)
    change, sigma = scale * difference.of(name), scale * difference.sigma(name)
    # Rotations are given by their change.
    is_rotation = name in POSE_PARAMETERS[3:]
    values = ["", ""] if is_rotation else [f"{scale * old:.6g}", f"{scale * new:.6g}"]
    return [label, *values, *_change_cells(change, sigma)]


def _change_cells(change: float, sigma: float) -> list[str]:
    if change == 0.0:
        return ["same", "", ""]
    if sigma == 0.0 or math.isnan(sigma):
        return [f"{change:+.3g}", "", ""]
    return [f"{change:+.3g}", f"{sigma:.2g}", f"{abs(change) / sigma:.1f}"]


def _laser_rows(rig: Rig, new: Laser, old: Laser, difference: RigDifference) -> Iterator[list[str]]:
    angle, shift, sigma = _laser_move(rig, new, old, difference)
    label = escaped(old.name)
    turn = [f"{label} turned by deg", "", ""]
    yield turn + _change_cells(math.degrees(angle), math.degrees(_tilt_sigma(old, difference)))
    if math.isfinite(shift):
        moved = [f"{label} off at {_WALL_M:g} m by mm", "", ""]
        # Rounding of points that have not moved.
        shift = 0.0 if abs(shift) < 1e-12 else shift
        yield moved + _change_cells(shift * 1e3, sigma * 1e3)


def _tilt_sigma(laser: Laser, difference: RigDifference) -> float:
    """Return the sigma of a laser's rotation in the direction in which it has turned."""
    rows = [difference.names.index(name) for name in laser_parameter_names(laser)[:2]]
    tilt = difference.change[rows]
    length = float(np.linalg.norm(tilt))
    if length == 0.0:
        return 0.0
    return math.sqrt(float(tilt @ difference.covariance[np.ix_(rows, rows)] @ tilt)) / length


def _degrees(angle: float) -> str:
    # Adding zero turns -0.0 into 0.0.
    return f"{round(math.degrees(angle), 2) + 0.0:+.2f}"
