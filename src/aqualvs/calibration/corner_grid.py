"""The inner corners of a board as a grid: predict from neighbours, grow, find the odd ones out."""

from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.targets import Board
from aqualvs.geometry.arrays import BoolArray, FloatArray

# Neighbours that predict a corner: up to this many squares away.
_REACH = 2
# An affine map needs three neighbours; a fourth guards it.
_MIN_NEIGHBOURS = 4
# Nearer neighbours say more, because the map is affine only nearby.
_FALL = 0.7


@dataclass(frozen=True, slots=True)
class Grid:
    """Corners of a board in one picture.

    Attributes
    ----------
    pixels : array, shape (rows, columns, 2)
        In `image`.
    known : bool array, shape (rows, columns)
        Which were found.
    notes : tuple of str
        What a user should know of how they were found.
    """

    pixels: FloatArray
    known: BoolArray
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Prediction:
    """Where the neighbours of each grid point say that it is.

    Attributes
    ----------
    pixels : array, shape (rows, columns, 2)
        In `image`; NaN where not valid.
    axes : array, shape (rows, columns, 2, 2)
        One square's side along the board's x (`[..., 0]`) and y (`[..., 1]`), in pixels.
    valid : bool array, shape (rows, columns)
        False where too few neighbours are known, or all on one line.
    """

    pixels: FloatArray
    axes: FloatArray
    valid: BoolArray


def nothing_known(board: Board) -> Grid:
    """Return the grid of a board of which no corner was found."""
    shape = board.corner_grid[::-1]
    return Grid(np.zeros((*shape, 2)), np.zeros(shape, dtype=bool))


def predict(pixels: FloatArray, known: BoolArray) -> Prediction:
    """Fit an affine map to the known neighbours of every grid point, without the point itself.

    Parameters
    ----------
    pixels : array, shape (rows, columns, 2)
        Corners in `image`.
    known : bool array, shape (rows, columns)
        Which of them are known; others are ignored, even if NaN.
    """
    rows, columns = known.shape
    weight = np.pad(known.astype(np.float64), _REACH)
    values = np.pad(np.where(known[..., None], pixels, 0.0), ((_REACH,) * 2, (_REACH,) * 2, (0, 0)))
    normal, right = np.zeros((rows, columns, 3, 3)), np.zeros((rows, columns, 3, 2))
    count = np.zeros((rows, columns), dtype=np.int64)
    for dy in range(-_REACH, _REACH + 1):
        for dx in range(-_REACH, _REACH + 1):
            if dx == dy == 0:
                continue
            here = np.s_[_REACH + dy : _REACH + dy + rows, _REACH + dx : _REACH + dx + columns]
            basis = np.array([1.0, dx, dy])
            share = weight[here] * np.exp(-_FALL * (dx * dx + dy * dy))
            normal += share[..., None, None] * np.outer(basis, basis)
            right += share[..., None, None] * (basis[:, None] * values[here][..., None, :])
            count += weight[here] > 0.0
    valid = (count >= _MIN_NEIGHBOURS) & _spread_both_ways(normal)
    safe = np.where(valid[..., None, None], normal, np.eye(3))
    solution = np.linalg.solve(safe, right)
    found = np.where(valid[..., None], solution[..., 0, :], np.nan)
    axes = np.swapaxes(solution[..., 1:, :], -1, -2)
    return Prediction(found, axes, valid)


def _spread_both_ways(normal: FloatArray) -> BoolArray:
    """Whether the neighbours of a point do not all lie on one line."""
    mass = np.maximum(normal[..., 0, 0], 1e-12)
    mean = normal[..., 0, 1:] / mass[..., None]
    spread = normal[..., 1:, 1:] / mass[..., None, None]
    spread = spread - mean[..., :, None] * mean[..., None, :]
    wide: BoolArray = np.linalg.det(spread) > 1e-2
    return wide


def misfits(pixels: FloatArray, known: BoolArray, *, share: float) -> BoolArray:
    """Return which known points their neighbours contradict.

    Parameters
    ----------
    pixels, known
        As in `predict`.
    share : float
        Allowed distance from the prediction, in sides of a square.
    """
    from_neighbours = predict(pixels, known)
    side = np.sqrt(np.min(np.sum(np.square(from_neighbours.axes), axis=-2), axis=-1))
    distance = np.linalg.norm(pixels - from_neighbours.pixels, axis=-1)
    odd: BoolArray = known & from_neighbours.valid & (distance > share * side)
    return odd
