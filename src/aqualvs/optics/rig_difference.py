"""What lies between two rigs, such as before and after maintenance: numbers and their sigmas."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2, norm

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.optics.camera_params import DOME_PARAMETERS, POSE_PARAMETERS
from aqualvs.optics.rig import Laser, Rig
from aqualvs.optics.uncertainty import (
    LASER_PARAMETERS,
    RigUncertainty,
    laser_parameter_names,
    tangent_basis,
)

SIGNIFICANT = 5.0
"""Sigmas from which on a change is no chance."""

# No combination of numbers is believed to be known better than this share of their variances.
_NOT_BETTER = 1e-4
# Rotations (rad) come back from files with this much rounding, and then some.
_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True)
class RigDifference:
    """Changes of the numbers that two rigs share.

    Attributes
    ----------
    names : tuple of str
        As `RigUncertainty.names` has them; lasers are those of the old rig.
    change : array, shape (P,)
        New minus old, SI units and radians.
    covariance : array, shape (P, P)
        Of `change`; zero where neither rig says how well it is known.
    """

    names: tuple[str, ...]
    change: FloatArray
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
        return float(np.linalg.norm(scaled @ vectors / np.sqrt(np.maximum(values, _NOT_BETTER))))

    def has_moved(self, names: Sequence[str]) -> bool | None:
        """Return whether some numbers have moved by more than chance, None where unknown.

        The chance is that of `SIGNIFICANT` sigmas of one number, however many there are.
        """
        distance = self.sigmas(names)
        if distance is None:
            return None
        limit = chi2.isf(2.0 * norm.sf(SIGNIFICANT), max(len(names), 1))
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
    shift = new.dome_from_cam.translation - old.dome_from_cam.translation
    turn = new.dome_from_cam.rotation @ old.dome_from_cam.rotation.T
    rotvec = rotvec_from_rotation(turn)
    rotvec[np.abs(rotvec) < _ROUNDING] = 0.0
    values = [*shift, *rotvec]
    changes = dict(zip(POSE_PARAMETERS, map(float, values), strict=True))
    if new.dome is not None and old.dome is not None:
        pairs = (
            new.dome.inner_radius - old.dome.inner_radius,
            new.dome.thickness - old.dome.thickness,
            new.n_air - old.n_air,
            new.dome.n_acrylic - old.dome.n_acrylic,
            new.n_water - old.n_water,
        )
        changes |= dict(zip(DOME_PARAMETERS, pairs, strict=True))
    if same_lens_model(new, old):
        numbers = zip(_intrinsics(new), _intrinsics(old), strict=True)
        differences = (ours - theirs for ours, theirs in numbers)
        changes |= dict(zip(old.lens.parameter_names, differences, strict=True))
    return changes


def same_lens_model(new: Rig, old: Rig) -> bool:
    """Return whether the intrinsics of two rigs mean the same."""
    return (
        new.lens.model == old.lens.model
        and new.size_px == old.size_px
        and new.lens.parameter_names == old.lens.parameter_names
    )


def _intrinsics(rig: Rig) -> tuple[float, ...]:
    lens = rig.lens
    return (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)


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
