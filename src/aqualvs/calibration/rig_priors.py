"""What is known beforehand of a rig's numbers and of media, as residuals."""

from collections.abc import Sequence

import numpy as np

from aqualvs.calibration.blocks import Block
from aqualvs.calibration.losses import Loss
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import rotvec_from_rotation
from aqualvs.optics.rig import Rig
from aqualvs.optics.uncertainty import RigUncertainty

PRIORS = "priors"
_ROTATION = ("rotation_x", "rotation_y", "rotation_z")


def rig_prior(start: Rig, rig: Rig, free: Sequence[str], priors: RigUncertainty) -> list[Block]:
    """Return how far a rig is from where it was known to be, in sigmas.

    Parameters
    ----------
    start, rig : Rig
        What `priors` is centred on, and the rig now.
    free : sequence of str
        Numbers that have the columns 0, 1, ... of the solve.
    priors : RigUncertainty
        How well `start` is known; numbers it does not name have no prior.
    """
    known = [name for name in free if name in priors.names]
    if not known:
        return []
    columns = np.array([free.index(name) for name in known])
    return [_prior(columns, rig_difference(start, rig, known), _whiten(priors.of(known)))]


def media_prior(
    start: FloatArray, media: FloatArray, sigma: FloatArray, columns: IntArray
) -> list[Block]:
    """Return how far media are from where they were known to be, in sigmas.

    Parameters
    ----------
    start, media : array, shape (M,)
        Of the free media: what was known, and the indices now.
    sigma : array, shape (M,)
        How well; infinite where nothing is known.
    columns : int array, shape (M,)
        Of the media in the solve.
    """
    bounded = np.isfinite(sigma)
    if not bounded.any():
        return []
    moved = (media - start)[bounded]
    return [_prior(columns[bounded], moved, np.diag(1.0 / sigma[bounded]))]


def rig_difference(start: Rig, rig: Rig, names: Sequence[str]) -> FloatArray:
    """Return the step (P,) of `rig_moved_by` that leads from `start` to `rig`, by named numbers."""
    a, b = rig_numbers(start), rig_numbers(rig)
    turn = rotvec_from_rotation(rig.dome_from_cam.rotation @ start.dome_from_cam.rotation.T)
    rotation = dict(zip(_ROTATION, turn, strict=True))
    return np.array([rotation[n] if n in rotation else b[n] - a[n] for n in names])


def rig_numbers(rig: Rig) -> dict[str, float]:
    """Return a rig's numbers by the names of `parameter_names`; those of rotations are zero."""
    lens = rig.lens
    values = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion)
    numbers = dict(zip(lens.parameter_names, values, strict=True))
    position = rig.dome_from_cam.translation.tolist()
    numbers.update(zip(("lens_x", "lens_y", "lens_z"), position, strict=True))
    numbers.update(dict.fromkeys(_ROTATION, 0.0), n_air=rig.n_air, n_water=rig.n_water)
    if rig.dome is not None:
        numbers.update(
            inner_radius=rig.dome.inner_radius,
            thickness=rig.dome.thickness,
            n_acrylic=rig.dome.n_acrylic,
        )
    return numbers


def _whiten(covariance: FloatArray) -> FloatArray:
    """Return W with W.T @ W the inverse of a covariance, whatever its units."""
    sigma = np.sqrt(np.diag(covariance))
    lower = np.linalg.cholesky(covariance / np.outer(sigma, sigma))
    whiten: FloatArray = np.linalg.inv(lower) / sigma
    return whiten


def _prior(columns: IntArray, moved: FloatArray, whiten: FloatArray) -> Block:
    residuals = (whiten @ moved)[:, None]
    return Block(PRIORS, columns, residuals, whiten[:, None, :], Loss.SQUARE, False)
