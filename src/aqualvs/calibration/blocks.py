"""Blocks of residuals: what a least-squares problem is made of."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from aqualvs.calibration.losses import Loss
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Block:
    """Residuals that depend on the same parameters.

    Attributes
    ----------
    group : str
        Measurements of one group are of one kind, with much the same noise.
    columns : int array, shape (C,)
        Parameters these residuals depend on.
    residuals : array, shape (N, K)
        Measured minus predicted, or its negative, over its nominal standard deviation. K values
        belong to one observation, such as x and y of a corner. NaN rows are not seen.
    jacobian : array, shape (N, K, C)
        Derivative of `residuals`.
    loss : Loss
        How the length of an observation's residual counts.
    scaled : bool
        Whether the noise is estimated, as a multiple of the nominal one; priors are meant as they
        are.
    """

    group: str
    columns: IntArray
    residuals: FloatArray
    jacobian: FloatArray
    loss: Loss = Loss.HUBER
    scaled: bool = True
    lengths: FloatArray = field(init=False, repr=False, compare=False)
    """Lengths (N,) of the observations' residuals."""

    def __post_init__(self) -> None:
        squares = np.einsum("nk,nk->n", self.residuals, self.residuals)
        object.__setattr__(self, "lengths", np.sqrt(squares))

    @property
    def seen(self) -> BoolArray:
        """Which observations (N,) have a residual."""
        seen: BoolArray = np.isfinite(self.lengths)
        return seen

    def values(self, inliers: BoolArray) -> int:
        """Return how many numbers the marked observations hold."""
        n_values: int = self.residuals.shape[1]
        return int(np.count_nonzero(inliers)) * n_values


@dataclass(frozen=True, slots=True)
class NormalEquations:
    """Gauss-Newton's view of a cost at one state.

    Attributes
    ----------
    information : array, shape (P, P)
    gradient : array, shape (P,)
    own : tuple of array, shape (C, C)
        Every block's part of `information`, in its own columns.
    """

    information: FloatArray
    gradient: FloatArray
    own: tuple[FloatArray, ...]


def normal_equations(
    n_parameters: int,
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
) -> NormalEquations:
    """Return the normal equations of blocks with their inliers and noise scales."""
    information, gradient = np.zeros((n_parameters, n_parameters)), np.zeros(n_parameters)
    own = []
    for block, inside, scale in zip(blocks, inliers, scales, strict=True):
        matrix, vector = _of_block(block, inside, scale)
        information[block.columns[:, None], block.columns] += matrix
        gradient[block.columns] += vector
        own.append(matrix)
    return NormalEquations(information, gradient, tuple(own))


def _of_block(block: Block, inside: BoolArray, scale: float) -> tuple[FloatArray, FloatArray]:
    n_values, n_columns = block.residuals.shape[1], len(block.columns)
    weights = block.loss.weight(block.lengths / scale)
    # A point that a step made invisible has no slope to offer.
    believed = inside & np.isfinite(weights)
    residuals, jacobian = block.residuals, block.jacobian
    if not believed.all():
        weights, residuals, jacobian = weights[believed], residuals[believed], jacobian[believed]
    root = np.repeat(np.sqrt(weights) / scale, n_values)
    slopes = jacobian.reshape(-1, n_columns) * root[:, None]
    return slopes.T @ slopes, slopes.T @ (residuals.reshape(-1) * root)


def cost(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
    lost_length: float,
) -> float:
    """Return the robust cost; inliers that are no longer seen count as `lost_length`."""
    total = 0.0
    for block, inside, scale in zip(blocks, inliers, scales, strict=True):
        lengths = block.lengths[inside] / scale
        lost = ~np.isfinite(lengths)
        if lost.any():
            lengths[lost] = lost_length
        total += float(np.sum(block.loss.cost(lengths)))
    return total
