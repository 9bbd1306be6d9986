"""Priors as residuals: of a rig's numbers, of the indices of media, and of a board's pose."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.solver.least_squares import Block, RobustLoss
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3, rotvec_from_rotation
from aqualvs.optics.rig import Rig, RigUncertainty

DISTANCES = "distances"
TILTS = "tilts"
ROLLS = "rolls"


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """Prior on a pose: measured distance of the board's plane along the dome's y axis (paper, 2.2).

    Attributes
    ----------
    distance : float
        From the dome's centre, in metres.
    sigma : float
        Its standard deviation, in metres.
    """

    distance: float
    sigma: float

    def blocks(self, dome_from_target: SE3, centre: FloatArray, columns: IntArray) -> list[Block]:
        """Return one residual: found minus given distance."""
        normal = dome_from_target.rotation[:, 2]
        found = plane_distance(dome_from_target)
        # normal x (centre - found * y axis), written out.
        nx, ny, nz = normal.tolist()
        x, y, z = float(centre[0]), float(centre[1]) - found, float(centre[2])
        by_turn = np.array([ny * z - nz * y, nz * x - nx * z, nx * y - ny * x])
        jacobian = np.concatenate([by_turn, normal]) / (normal[1] * self.sigma)
        residual = np.array([[(found - self.distance) / self.sigma]])
        return [
            Block(DISTANCES, columns, residual, jacobian[None, None, :], RobustLoss.HUBER, False)
        ]


@dataclass(frozen=True, slots=True)
class SquareBoard:
    """Prior on a pose: the board stands square to the dome's axes, with possible outliers.

    Attributes
    ----------
    square : array, shape (3, 3)
        `dome_from_target` rotation of a board without tilt.
    board_tilt_sigma, roll_sigma : float
        Standard deviations of well set up boards, in radians about each axis; boards far beyond
        count little (Cauchy), so that the square majority decides. Tilt (about x and z) and roll
        (about y) are judged separately: a rail keeps the roll of all.
    """

    square: FloatArray
    board_tilt_sigma: float
    roll_sigma: float

    def blocks(self, dome_from_target: SE3, centre: FloatArray, columns: IntArray) -> list[Block]:
        """Return the tilt of the board (about x and z), and its roll (about y)."""
        del centre
        off_square = dome_from_target.rotation @ self.square.T
        tilt = tilt_of(off_square)
        by_turn = 0.5 * (np.trace(off_square) * np.eye(3) - off_square)
        return [
            Block(
                group,
                columns[:3],
                tilt[None, axes] / sigma,
                by_turn[None, axes, :] / sigma,
                RobustLoss.CAUCHY,
                False,
            )
            for group, axes, sigma in (
                (TILTS, [0, 2], self.board_tilt_sigma),
                (ROLLS, [1], self.roll_sigma),
            )
        ]


def tilt_of(off_square: FloatArray) -> FloatArray:
    """Return the axis of a rotation (..., 3, 3) times the sine of its angle, shape (..., 3)."""
    r = off_square
    return 0.5 * np.stack(
        [
            r[..., 2, 1] - r[..., 1, 2],
            r[..., 0, 2] - r[..., 2, 0],
            r[..., 1, 0] - r[..., 0, 1],
        ],
        axis=-1,
    )


def plane_distance(dome_from_target: SE3) -> float:
    """Return where a board's plane (its z = 0) meets the dome's y axis, in metres, or NaN."""
    normal = dome_from_target.rotation[:, 2]
    if normal[1] == 0.0:
        return float("nan")
    return float(normal @ dome_from_target.translation / normal[1])


PRIORS = "priors"
_ROTATION = ("rotation_x", "rotation_y", "rotation_z")


def rig_prior(start: Rig, rig: Rig, free: Sequence[str], priors: RigUncertainty) -> list[Block]:
    """Return the deviation of a rig from its prior, in sigmas.

    Parameters
    ----------
    start, rig : Rig
        Mean of the prior, and the present rig.
    free : sequence of str
        Numbers of the columns 0, 1, ... of the solve.
    priors : RigUncertainty
        Uncertainty of `start`; numbers that it does not name have no prior.
    """
    known = [name for name in free if name in priors.names]
    if not known:
        return []
    columns = np.array([free.index(name) for name in known])
    return [_prior(columns, rig_difference(start, rig, known), _whiten(priors.of(known)))]


def media_prior(
    start: FloatArray, media: FloatArray, sigma: FloatArray, columns: IntArray
) -> list[Block]:
    """Return the deviation of media from their priors, in sigmas.

    Parameters
    ----------
    start, media : array, shape (M,)
        Indices of the free media: prior means, and present values.
    sigma : array, shape (M,)
        Standard deviations of the prior; infinite where there is none.
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
    if rig.housing is not None:
        numbers.update(rig.housing.numbers())
    return numbers


def _whiten(covariance: FloatArray) -> FloatArray:
    """Return W with W.T @ W the inverse of a covariance, whatever its units."""
    sigma = np.sqrt(np.diag(covariance))
    lower = np.linalg.cholesky(covariance / np.outer(sigma, sigma))
    whiten: FloatArray = np.linalg.inv(lower) / sigma
    return whiten


def _prior(columns: IntArray, moved: FloatArray, whiten: FloatArray) -> Block:
    residuals = (whiten @ moved)[:, None]
    return Block(PRIORS, columns, residuals, whiten[:, None, :], RobustLoss.SQUARE, False)
