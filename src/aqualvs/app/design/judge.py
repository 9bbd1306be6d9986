"""How good a choice of laser angles is: errors over the working range, in goals, and penalties."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.app.design.mount import Mount
from aqualvs.app.design.predict import cross, laser_scatter, net_parts, net_share, wall_parts
from aqualvs.app.design.settings import Design, index_step
from aqualvs.app.design.stripes import Stripes, line_pixels, see_stripes
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import kernel
from aqualvs.geometry.symmetric import invert_symmetric

# A stripe should keep clear of the border by this share of the picture's height, so that targets
# that are not square stay in view, and be at least so long.
_MARGIN_SHARE, _LENGTH_SHARE = 0.05, 0.3
# What a stripe that is out of the picture costs, in goals; and what a crossing may cost.
_OUT_COST, _CROSSING_SHARE = 20.0, 0.3
# What no posture counts as, in goals squared.
_NO_POSTURE = 1e4


@dataclass(frozen=True, slots=True)
class Score:
    """How good a choice of angles is; less is better.

    Attributes
    ----------
    error : float
        Root mean square of the errors of range, pitch and yaw over the working range, from noise
        and the tolerances of lasers and water, on walls and nets alike, in goals.
    total : float
        The same with what missing and crossing stripes cost.
    """

    error: float
    total: float


@dataclass(frozen=True, slots=True)
class Lot:
    """Candidates for one laser, K of them, or the chosen stripes of several.

    Attributes
    ----------
    stripes : Stripes
    parts : tuple of (matrix, scatter, common)
        On a wall and on the net: arrays (K, W, 3, 3), (K, W, 3, 3) and (K, W, G, 3).
    """

    stripes: Stripes
    parts: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]

    def take(self, rows: Sequence[int]) -> "Lot":
        """Return the named rows of K."""
        picked = list(rows)
        parts = tuple((m[picked], s[picked], c[picked]) for m, s, c in self.parts)
        return Lot(self.stripes.take(picked), parts)

    def joined(self, other: "Lot") -> "Lot":
        """Return these rows followed by another's."""
        parts = tuple(
            (np.concatenate([a, x]), np.concatenate([b, y]), np.concatenate([c, z]))
            for (a, b, c), (x, y, z) in zip(self.parts, other.parts, strict=True)
        )
        return Lot(self.stripes.joined(other.stripes), parts)

    def __len__(self) -> int:
        """Return K."""
        return len(self.stripes.lines)


class Judge:
    """Judges choices of stripes for one design."""

    def __init__(self, design: Design) -> None:
        self._design = design
        self._camera = design.rig.camera()
        self._ranges = design.ranges
        self._steps = index_step(self._camera, design.tolerances)
        self._height = min(design.rig.size_px)

    def trace(self, mounts: Sequence[Mount]) -> Lot:
        """Return what the camera sees of mounts, with a margin for turned targets."""
        design, margin = self._design, _MARGIN_SHARE * self._height
        stripes = see_stripes(self._camera, mounts, self._ranges, self._steps, margin)
        scatter = laser_scatter(stripes, design.tolerances)
        share = net_share(stripes, design)[..., None, None]
        wall, net = wall_parts(stripes, design.noise), net_parts(stripes, design)
        on_wall = wall.matrix, wall.scatter + scatter, stripes.common
        on_net = net.matrix, net.scatter + share**2 * scatter, share * stripes.common
        return Lot(stripes, (on_wall, on_net))

    def judge(self, lot: Lot, others: Lot) -> tuple[FloatArray, FloatArray]:
        """Return error and total (see `Score`) of every candidate (K,) beside other lasers."""
        goals = self._design.goals
        wanted = np.array([goals.range_share, goals.angle, goals.angle])
        squares = np.zeros((len(lot), len(self._ranges)))
        for candidates, rest in zip(lot.parts, others.parts, strict=True):
            matrix, scatter, common = (part.sum(axis=0) for part in rest)
            _add_squares(*candidates, matrix, scatter, common, self._ranges, wanted, squares)
        error = np.sqrt(squares.mean(axis=-1) / len(lot.parts))
        short = self._shortfall(lot.stripes) + self._shortfall(others.stripes).sum()
        total = error * (1.0 + _CROSSING_SHARE * self._crossings(lot.stripes, others.stripes))
        return error, total + _OUT_COST * short / (1 + len(others))

    def _shortfall(self, stripes: Stripes) -> FloatArray:
        """How much of each stripe's least length is missing, (K,), mean over the ranges."""
        least = _LENGTH_SHARE * self._height / line_pixels(self._camera)
        missing: FloatArray = np.maximum(1.0 - stripes.lines / least, 0.0).mean(axis=-1)
        return missing

    def _crossings(self, one: Stripes, others: Stripes) -> FloatArray:
        """Share of pairs and ranges (K,) at which stripes cross in the picture."""
        n = len(others.lines)
        if not self._design.avoid_crossings or n == 0:
            return np.zeros(len(one.lines))
        pairs = cross(one, others).mean(axis=-1).sum(axis=-1)
        among = float(np.triu(cross(others, others).mean(axis=-1), 1).sum())
        share: FloatArray = (pairs + among) / (n * (n + 1) / 2)
        return share


def score(design: Design) -> Score:
    """Return how good the angles of a design's mounts are."""
    judge = Judge(design)
    lot = judge.trace(design.mounts)
    errors, totals = judge.judge(lot.take([0]), lot.take(range(1, len(lot))))
    return Score(float(errors[0]), float(totals[0]))


@kernel
def _add_squares(
    matrix: FloatArray,
    scatter: FloatArray,
    common: FloatArray,
    rest_matrix: FloatArray,
    rest_scatter: FloatArray,
    rest_common: FloatArray,
    ranges: FloatArray,
    wanted: FloatArray,
    squares: FloatArray,
) -> None:
    """Add the mean square error in goals of every candidate and range to `squares` (K, W)."""
    whole, inverse, middle = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    scale = np.empty(3)
    for k in range(matrix.shape[0]):
        for w in range(matrix.shape[1]):
            for i in range(3):
                for j in range(3):
                    whole[i, j] = matrix[k, w, i, j] + rest_matrix[w, i, j]
                    middle[i, j] = scatter[k, w, i, j] + rest_scatter[w, i, j]
            for g in range(common.shape[2]):
                for i in range(3):
                    for j in range(3):
                        middle[i, j] += (common[k, w, g, i] + rest_common[w, g, i]) * (
                            common[k, w, g, j] + rest_common[w, g, j]
                        )
            square = _NO_POSTURE
            if invert_symmetric(whole, inverse):
                # Yaw, range and pitch by m, each in its goal.
                scale[0], scale[1] = ranges[w] / wanted[2], ranges[w] / wanted[0]
                scale[2] = ranges[w] / wanted[1]
                square = 0.0
                for axis in range(3):
                    for i in range(3):
                        for j in range(3):
                            variance = inverse[axis, i] * middle[i, j] * inverse[j, axis]
                            square += scale[axis] ** 2 * variance / 3.0
            squares[k, w] += min(square, _NO_POSTURE) if square >= 0.0 else _NO_POSTURE
