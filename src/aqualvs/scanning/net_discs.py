"""Round patches of the net in which strands are missing, by likelihood.

Every place where a strand was looked for speaks for a hole there or against it. The evidence adds
up over discs of many sizes around many middles; the discs that explain it, each with its
likelihood, say where a hole is, how large, and how well that is known where its edge was not seen.
"""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import kernel

RIM = 0.8
"""Evidence so far beyond a disc's edge, in bars, belongs to it still."""

# Middles and radii that are tried, in bars: step of the middles, how far beyond missing strands
# they lie, and the radii. With double the step a hole has this score at least.
_STEP, _BESIDE, _COARSE_SCORE = 0.4, 2.4, 6.0
_RADII: FloatArray = np.arange(0.5, 6.01, 0.25)
# Discs up to this radius are single strands that are cut, larger ones holes.
_SINGLE = 0.8
# Large holes are rarer than small ones, by this power of the radius.
_RARER = 2.0
# A hole's log-likelihood over sound net, and over a single strand that is cut.
_LEAST_SCORE, _LEAST_LEAD = 12.0, 5.0
# What the grid and the places of strands leave of a radius, in bars.
_ROUGH = 0.25


@dataclass(frozen=True, slots=True)
class Disc:
    """A round patch where strands are missing.

    Attributes
    ----------
    middle : array, shape (2,)
        In metres.
    radius, sigma : float
        Mean over all discs that explain what was seen, and standard deviation, in metres.
    score : float
        Log-likelihood over sound net.
    """

    middle: FloatArray
    radius: float
    sigma: float
    score: float


def find_discs(place: FloatArray, weight: FloatArray, bar: float) -> list[Disc]:
    """Find discs in which strands are missing, the most certain first.

    Parameters
    ----------
    place : array, shape (N, 2)
        Where strands were looked for, in metres.
    weight : array, shape (N,)
        Log-likelihood of a hole there over sound net.
    bar : float
        Length of the net's bars, in metres.
    """
    weight = weight.copy()
    found: list[Disc] = []
    while weight[weight > 0.0].sum() >= _LEAST_SCORE:
        disc = _best(place, weight, bar)
        if disc is None:
            break
        found.append(disc)
        away = np.hypot(*(place - disc.middle).T)
        weight[away < disc.radius + RIM * bar] = 0.0
    return found


@kernel
def local_sums(place: FloatArray, weight: FloatArray, radius: float) -> FloatArray:
    """Sum of the weights (N,) of places (N, 2) within a radius of each of them, shape (N,)."""
    total = np.zeros(len(place))
    for m in range(len(place)):
        for k in range(len(place)):
            x, y = place[k, 0] - place[m, 0], place[k, 1] - place[m, 1]
            if x * x + y * y < radius * radius:
                total[m] += weight[k]
    return total


def _best(place: FloatArray, weight: FloatArray, bar: float) -> Disc | None:
    radii = _RADII * bar
    rough = _scores(place, weight, _middles(place, weight, 2.0 * _STEP * bar, bar), radii)
    if rough.max() < _COARSE_SCORE:
        return None
    middles = _middles(place, weight, _STEP * bar, bar)
    score = _scores(place, weight, middles, radii)
    total = score - _RARER * np.log(_RADII)
    single = _RADII <= _SINGLE
    total[:, single] = -np.inf
    at, size = np.unravel_index(np.argmax(total), total.shape)
    best = float(score[at, size])
    if best < _LEAST_SCORE or best - max(float(score[:, single].max()), 0.0) < _LEAST_LEAD:
        return None
    # Discs that have the likeliest one's middle in them tell of the same hole.
    away = np.hypot(*(middles - middles[at]).T)
    share = np.exp(total - total[at, size]) * (away[:, None] < np.maximum(radii, radii[size]))
    share /= share.sum()
    radius = float(share.sum(axis=0) @ radii)
    spread = float(share.sum(axis=0) @ (radii - radius) ** 2)
    return Disc(
        middle=share.sum(axis=1) @ middles,
        radius=radius,
        sigma=float(np.sqrt(spread + (_ROUGH * bar) ** 2)),
        score=best,
    )


def _middles(place: FloatArray, weight: FloatArray, step: float, bar: float) -> FloatArray:
    """Grid around the places where strands are missing, shape (C, 2)."""
    missing, beside = place[weight > 0.0], _BESIDE * bar
    low, high = missing.min(axis=0) - beside, missing.max(axis=0) + beside
    sides = [np.arange(a, b, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 2)


@kernel
def _scores(
    place: FloatArray, weight: FloatArray, middles: FloatArray, radii: FloatArray
) -> FloatArray:
    """Sum of the weights within each radius (R,) of each middle (C, 2), shape (C, R)."""
    score = np.zeros((len(middles), len(radii)))
    first, step = radii[0], radii[1] - radii[0]
    for c in range(len(middles)):
        for k in range(len(place)):
            x, y = place[k, 0] - middles[c, 0], place[k, 1] - middles[c, 1]
            away = np.sqrt(x * x + y * y)
            r = max(int(np.ceil((away - first) / step)), 0)
            if r < len(radii):
                score[c, r] += weight[k]
        for r in range(1, len(radii)):
            score[c, r] += score[c, r - 1]
    return score
