"""How noisy measurements are, from their residuals: of every block, tempered by its group's."""

import functools
from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from aqualvs.calibration.blocks import Block, NormalEquations
from aqualvs.geometry.arrays import BoolArray, FloatArray

# Residuals longer than this, in scales, are outliers: 4e-6 of good corners.
_REJECT = 5.0
# How many times the median's scale may be too small by chance.
_DOUBT = 1.5
# Data without any noise still need a scale to divide by.
_TINY = 1e-6
# A block's noise is that of its group until its own residuals, by so many values, say otherwise.
_GROUP_FREEDOM = 10.0
# Fewer values than this left over by the fit say nothing about noise.
_LEAST_FREEDOM = 0.5


def start_scales(blocks: Sequence[Block]) -> list[float]:
    """Return a first noise scale for every block: its group's median, which outliers hardly move.

    Blocks that are not scaled have 1.
    """
    groups = {b.group for b in blocks if b.scaled}
    scale = {g: _median_scale([b for b in blocks if b.scaled and b.group == g]) for g in groups}
    return [scale[b.group] if b.scaled else 1.0 for b in blocks]


def freedoms(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    equations: NormalEquations,
    covariance: FloatArray,
) -> list[float]:
    """Return for every block how many of its values are left over by the fit."""
    triples = zip(blocks, inliers, equations.own, strict=True)
    return [
        block.values(inside)
        - float(np.sum(own * covariance[block.columns[:, None], block.columns]))
        for block, inside, own in triples
    ]


def believed(
    blocks: Sequence[Block], scales: Sequence[float], freedom: Sequence[float]
) -> list[BoolArray]:
    """Return the inliers of every block."""
    return [
        # NaN compares false.
        block.lengths < _REJECT * min(scale, _largest_scale(block, free))
        if block.scaled
        else block.seen
        for block, scale, free in zip(blocks, scales, freedom, strict=True)
    ]


def group_scales(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
    freedom: Sequence[float],
) -> dict[str, float]:
    """Return the typical scale of every group: the median over what its blocks say by themselves.

    A block counts by its freedom, so that one block alone is its group; a few bad ones do not
    count.
    """
    typical = {}
    for group in {b.group for b in blocks if b.scaled}:
        mine = [i for i, b in enumerate(blocks) if b.scaled and b.group == group]
        useful = [i for i in mine if freedom[i] > _LEAST_FREEDOM]
        if not useful:
            typical[group] = scales[mine[0]]
            continue
        by_itself = [_squares(blocks[i], inliers[i], scales[i]) / freedom[i] for i in useful]
        weights = np.array([freedom[i] for i in useful])
        scale = float(np.sqrt(_weighted_median(np.array(by_itself), weights)))
        largest = _weighted_median(
            np.array([_largest_scale(blocks[i], freedom[i]) for i in useful]), weights
        )
        typical[group] = max(min(scale, largest), _TINY)
    return typical


def block_scales(
    blocks: Sequence[Block],
    inliers: Sequence[BoolArray],
    scales: Sequence[float],
    freedom: Sequence[float],
    typical: dict[str, float],
) -> list[float]:
    """Return the scale of every block: from its own residuals, tempered by its group's."""
    found = []
    for block, inside, scale, free in zip(blocks, inliers, scales, freedom, strict=True):
        if not block.scaled:
            found.append(1.0)
            continue
        prior = typical[block.group]
        squares = _squares(block, inside, scale) + _GROUP_FREEDOM * prior**2
        tempered = float(np.sqrt(squares / (max(free, 0.0) + _GROUP_FREEDOM)))
        found.append(min(tempered, max(_largest_scale(block, free), prior)))
    return found


def _largest_scale(block: Block, freedom: float) -> float:
    """Return the scale that a block's median allows at most.

    Where many observations are outliers, they hold up the scale that lets them in; this breaks it.
    """
    values = block.values(block.seen)
    if freedom <= _LEAST_FREEDOM or not values:
        return float("inf")
    return _DOUBT * _median_scale([block]) * float(np.sqrt(values / freedom))


def _squares(block: Block, inliers: BoolArray, scale: float) -> float:
    lengths = block.lengths[inliers]
    return float(np.sum(block.loss.weight(lengths / scale) * lengths**2))


def _median_scale(blocks: Sequence[Block]) -> float:
    lengths = np.concatenate([b.lengths for b in blocks])
    lengths = lengths[np.isfinite(lengths)]
    if not len(lengths):
        return 1.0
    return max(float(np.median(lengths)) / _median_length(blocks[0].residuals.shape[1]), _TINY)


@functools.cache
def _median_length(n_values: int) -> float:
    """Return the median length of so many values with unit noise."""
    return float(np.sqrt(chi2.ppf(0.5, n_values)))


def _weighted_median(values: FloatArray, weights: FloatArray) -> float:
    order = np.argsort(values)
    heaped = np.cumsum(weights[order])
    return float(np.interp(0.5 * heaped[-1], heaped - 0.5 * weights[order], values[order]))
