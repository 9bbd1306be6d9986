"""What a user may know of a board's pose without its pictures, as residuals of it."""

from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.least_squares import Block
from aqualvs.calibration.losses import Loss
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import SE3

DISTANCES = "distances"
TILTS = "tilts"
ROLLS = "rolls"


@dataclass(frozen=True, slots=True)
class KnownDistance:
    """The board's plane meets the dome's y axis at a measured distance (the paper's rail, 2.2).

    Attributes
    ----------
    distance : float
        From the dome's centre, in metres.
    sigma : float
        How well it is measured, in metres.
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
        return [Block(DISTANCES, columns, residual, jacobian[None, None, :], Loss.HUBER, False)]


@dataclass(frozen=True, slots=True)
class SquareBoard:
    """The board stands square to the dome's axes, or should: some boards may not.

    Attributes
    ----------
    square : array, shape (3, 3)
        `dome_from_target` rotation of a board without tilt.
    lean_sigma, roll_sigma : float
        How square boards are that were set up well, in radians about each axis; boards far beyond
        it count little (Cauchy), so that the square majority decides. How a board leans (about x
        and z) and how it is rolled (about y) are judged apart: a rail keeps the roll of all.
    """

    square: FloatArray
    lean_sigma: float
    roll_sigma: float

    def blocks(self, dome_from_target: SE3, centre: FloatArray, columns: IntArray) -> list[Block]:
        """Return the leaning of the board (about x and z), and its roll (about y)."""
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
                Loss.CAUCHY,
                False,
            )
            for group, axes, sigma in (
                (TILTS, [0, 2], self.lean_sigma),
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
    """Return where a board's plane (its z = 0) meets the dome's y axis, in metres; NaN if not."""
    normal = dome_from_target.rotation[:, 2]
    if normal[1] == 0.0:
        return float("nan")
    return float(normal @ dome_from_target.translation / normal[1])
