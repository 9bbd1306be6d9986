"""Predicted errors of range, pitch and yaw of a design, from noise and tolerances, and its score.

The score of a choice of laser angles is the root mean square error over the working range, in
multiples of the goals, with penalties for missing and crossing stripes (`AngleScore`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.design.settings import Design, Mount, Noise, Tolerances, index_step
from aqualvs.design.stripes import OWN_ERRORS, Stripes, see_stripes
from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import kernel
from aqualvs.geometry.linear_algebra import invert_symmetric
from aqualvs.scanning.laser_bands import pixels_per_line

MIN_LINES = 16
"""Least number of search lines, with one point each, of a stripe that counts as visible."""
_SHIFT, _OFFSET = OWN_ERRORS.index("shift"), OWN_ERRORS.index("laser_offset")


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedErrors:
    """Predicted errors of a design on walls and nets square ahead, at W ranges."""

    ranges: FloatArray  # Shape (W,): metres.
    stripes: Stripes  # Of the design's lasers, L of them.
    # Shape (W, 3): standard deviations of (range, pitch, yaw) of a single frame from noise, on a
    # wall and on the design's net, in m and rad; NaN without a posture.
    wall: FloatArray
    net: FloatArray
    # By cause, shape (W, 3): standard deviations by each tolerance of lasers and water, the same in
    # all frames. `calibrated.camera_errors` gives those by the camera's tolerances.
    systematic: dict[str, FloatArray]
    # Shape (L, W): number of strands of the net that each stripe crosses.
    strands: FloatArray
    # Shape (L, L, W): True if two stripes cross in the picture.
    crossing: BoolArray

    @property
    def visible(self) -> BoolArray:
        """Mask (L, W) of stripes in the picture."""
        return np.asarray(self.stripes.lines >= MIN_LINES)

    @property
    def valid(self) -> BoolArray:
        """Mask (W,) of ranges with a posture."""
        return np.asarray(np.isfinite(self.wall).all(axis=-1))

    @property
    def systematic_total(self) -> FloatArray:
        """Standard deviations of these tolerances together, shape (W, 3)."""
        return together(self.systematic)


def predict(design: Design, ranges: Sequence[float] | FloatArray | None = None) -> PredictedErrors:
    """Predict a design's errors.

    `ranges`: walls square to the forward axis, metres; the design's own if left out.
    """
    walls = design.ranges if ranges is None else np.asarray(ranges, np.float64)
    camera = design.rig.camera()
    stripes = see_stripes(camera, design.mounts, walls, index_step(camera, design.tolerances))
    solid, mesh = wall_parts(stripes, design.noise).total(), net_parts(stripes, design).total()
    twine = outer(twine_pulls(stripes, design).sum(axis=0)[..., None, :])
    mesh = Sums(mesh.matrix, mesh.scatter + twine)
    return PredictedErrors(
        ranges=walls,
        stripes=stripes,
        wall=_sigmas(posture_covariance(solid, walls)),
        net=_sigmas(posture_covariance(mesh, walls)),
        systematic=_systematic(stripes, design.tolerances, walls),
        strands=stripes.length * design.net.strands_per_metre,
        crossing=cross(stripes, stripes),
    )


def together(causes: Mapping[str, FloatArray]) -> FloatArray:
    """Return the joint standard deviation (W, 3) of independent causes."""
    total: FloatArray = np.sqrt(np.sum([sigma**2 for sigma in causes.values()], axis=0))
    return total


@dataclass(frozen=True, slots=True)
class Sums:
    """Normal equations of wall fits, and the scatter added by shared errors."""

    matrix: FloatArray  # Shape (..., W, 3, 3): sum w X X', for errors of 1 px.
    scatter: FloatArray  # Shape (..., W, 3, 3): covariance of sum w X r, where r are the residuals.

    def total(self) -> "Sums":
        """Return the sums over the first axis: over the lasers."""
        return Sums(self.matrix.sum(axis=0), self.scatter.sum(axis=0))


def wall_parts(stripes: Stripes, noise: Noise) -> Sums:
    """Return the contribution of each stripe (K, W) on an unbroken wall."""
    lines = stripes.lines
    return _parts(stripes, np.ones_like(lines), noise.point, np.full_like(lines, noise.shared))


def net_parts(stripes: Stripes, design: Design) -> Sums:
    """Return the contribution of each stripe (K, W) on the design's net: one point a strand."""
    noise = design.noise
    shared = np.hypot(noise.shared, twine_shift(stripes, noise))
    return _parts(stripes, net_share(stripes, design), noise.strand, shared)


def twine_shift(stripes: Stripes, noise: Noise) -> FloatArray:
    """Return the shift of the light on twine, (K, W) in pixels."""
    # A sheet that is offset by its width moves its stripe in the picture by the stripe's width.
    per_px, per_m = (np.linalg.norm(stripes.own[..., i, :], axis=-1) for i in (_SHIFT, _OFFSET))
    px_per_m = per_m / np.where(per_px > 0.0, per_px, 1.0)
    shift: FloatArray = noise.twine * noise.stripe * px_per_m
    return shift


def net_share(stripes: Stripes, design: Design) -> FloatArray:
    """Return the number of strands of the design's net per point on a wall, (K, W), at most 1."""
    strands = stripes.length * design.net.strands_per_metre
    return np.minimum(strands / np.maximum(stripes.lines, 1.0), 1.0)


def twine_pulls(stripes: Stripes, design: Design) -> FloatArray:
    """Return the effect (K, W, 3) on each stripe's sums of the shift that all strands share.

    Light on twine appears nearer than the net on every stripe; the direction in the picture depends
    on the side of the lens on which the laser is.
    """
    shift = stripes.own[..., 0, :]
    nearer = np.sign(shift[..., 1:2]) * net_share(stripes, design)[..., None]
    return twine_shift(stripes, design.noise)[..., None] * nearer * shift


def _parts(stripes: Stripes, share: FloatArray, point: float, shared: FloatArray) -> Sums:
    """Return the sums for `share` of the points (K, W), each with a noise of `point` pixels.

    `shared` (K, W) is the shift of the stripe, and its tilt at the image border, in pixels.
    """
    matrix = stripes.matrix * share[..., None, None]
    pulls = stripes.own[..., :2, :] * (share * shared)[..., None, None]
    return Sums(matrix, point**2 * matrix + outer(pulls))


def outer(pulls: FloatArray) -> FloatArray:
    """Return the sum of q q' over vectors (..., M, 3), shape (..., 3, 3)."""
    summed: FloatArray = np.einsum("...mi,...mj->...ij", pulls, pulls)
    return summed


def posture_covariance(sums: Sums, ranges: FloatArray) -> FloatArray:
    """Return the covariance (..., W, 3, 3) of range, pitch and yaw; NaN if undetermined.

    The posture's derivatives by m at a wall square ahead are -range², range and range.
    """
    size = np.trace(sums.matrix, axis1=-2, axis2=-1)
    known = np.isfinite(size) & (size > 0.0)
    safe = np.where(known[..., None, None], sums.matrix, np.eye(3))
    # Below this share of the trace a direction is not determined.
    singular = 1e-9
    known &= np.linalg.eigvalsh(safe)[..., 0] > singular * np.where(known, size, 1.0)
    inverse = np.linalg.inv(np.where(known[..., None, None], safe, np.eye(3)))
    inverse = np.where(known[..., None, None], inverse, np.nan)
    covariance = inverse @ sums.scatter @ inverse
    order = [1, 2, 0]
    scale = np.stack([-(ranges**2), ranges, ranges], axis=-1)
    picked = covariance[..., order, :][..., :, order]
    return picked * scale[..., :, None] * scale[..., None, :]


def cross(one: Stripes, other: Stripes) -> BoolArray:
    """Return the mask (K, L, W) of stripes of two sets that cross within their visible parts.

    No stripe crosses itself.
    """
    e, f = one.along[:, None, None], other.along[None, :, None]
    apart = other.centre[None] - one.centre[:, None]
    sine = _cross_xz(e, f)
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = _cross_xz(apart, f) / sine, _cross_xz(apart, e) / sine
        here = (s >= one.ends[:, None, :, 0]) & (s <= one.ends[:, None, :, 1])
        there = (t >= other.ends[None, ..., 0]) & (t <= other.ends[None, ..., 1])
    return here & there & (np.abs(sine) > 1e-9)


def _cross_xz(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the cross product of vectors (..., 3) in the x-z plane, the plane of the wall."""
    return a[..., 0] * b[..., 2] - a[..., 2] * b[..., 0]


def _systematic(
    stripes: Stripes, tolerances: Tolerances, ranges: FloatArray
) -> dict[str, FloatArray]:
    """Return standard deviations (W, 3) by cause."""
    angles = stripes.own[..., 2:4, :] * tolerances.laser_angle
    offsets = stripes.own[..., 4:, :] * tolerances.laser_offset
    scatters = {
        "water index": outer(stripes.common.sum(axis=0)),
        "laser angles": outer(angles).sum(axis=0),
        "laser offsets": outer(offsets).sum(axis=0),
    }
    matrix = stripes.matrix.sum(axis=0)
    return {
        cause: _sigmas(posture_covariance(Sums(matrix, scatter), ranges))
        for cause, scatter in scatters.items()
    }


def _sigmas(covariance: FloatArray) -> FloatArray:
    # Rounding may leave negative variances.
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    return np.sqrt(np.maximum(variance, 0.0))


# Margin of a stripe to the border, as a share of the picture's height, so that it stays in view on
# oblique targets; and its least length.
_MARGIN_SHARE, _LENGTH_SHARE = 0.05, 0.3


@dataclass(frozen=True, slots=True)
class AngleScore:
    """Score of a choice of angles; less is better."""

    # Root mean square of the errors of range, pitch and yaw over the working range, in multiples of
    # the goals, from noise and the tolerances of lasers and water, on walls and nets.
    error: float
    # The same with the penalties of missing and crossing stripes.
    total: float


@dataclass(frozen=True, slots=True)
class StripeSet:
    """K stripes with their sums: candidates for one laser, or the chosen ones of several."""

    stripes: Stripes
    # (matrix, scatter, common) on a wall, and the same on the net: arrays (K, W, 3, 3),
    # (K, W, 3, 3) and (K, W, G, 3).
    parts: tuple[tuple[FloatArray, FloatArray, FloatArray], ...]

    def take(self, rows: Sequence[int]) -> "StripeSet":
        """Return the stripes of these indices."""
        picked = list(rows)
        parts = tuple((m[picked], s[picked], c[picked]) for m, s, c in self.parts)
        return StripeSet(self.stripes.take(picked), parts)

    def joined(self, other: "StripeSet") -> "StripeSet":
        """Return these stripes followed by others."""
        parts = tuple(
            (np.concatenate([a, x]), np.concatenate([b, y]), np.concatenate([c, z]))
            for (a, b, c), (x, y, z) in zip(self.parts, other.parts, strict=True)
        )
        return StripeSet(self.stripes.joined(other.stripes), parts)

    def __len__(self) -> int:
        """Return K."""
        return len(self.stripes.lines)


class Judge:
    """Evaluator of choices of stripes for one design."""

    def __init__(self, design: Design) -> None:
        self._design = design
        self._camera = design.rig.camera()
        self._ranges = design.ranges
        self._steps = index_step(self._camera, design.tolerances)
        self._height = min(design.rig.size_px)

    def trace(self, mounts: Sequence[Mount]) -> StripeSet:
        """Return the stripes of mounts in the picture, with a margin for oblique targets."""
        design, margin = self._design, _MARGIN_SHARE * self._height
        stripes = see_stripes(self._camera, mounts, self._ranges, self._steps, margin)
        # By errors of each laser's plane, shape (K, W, 3, 3).
        angle, offset = design.tolerances.laser_angle, design.tolerances.laser_offset
        scatter = outer(stripes.own[..., 2:, :] * np.array([angle, angle, offset])[:, None])
        share = net_share(stripes, design)[..., None, None]
        wall, net = wall_parts(stripes, design.noise), net_parts(stripes, design)
        on_wall = wall.matrix, wall.scatter + scatter, stripes.common
        # What all strands share adds up over the stripes, as the water's index does.
        pulls = np.concatenate(
            [share * stripes.common, twine_pulls(stripes, design)[..., None, :]], axis=-2
        )
        on_net = net.matrix, net.scatter + share**2 * scatter, pulls
        return StripeSet(stripes, (on_wall, on_net))

    def judge(self, candidates: StripeSet, others: StripeSet) -> tuple[FloatArray, FloatArray]:
        """Return error and total (see `AngleScore`) of every candidate (K,) beside other lasers."""
        goals = self._design.goals
        wanted = np.array([goals.range_share, goals.angle, goals.angle])
        squares = np.zeros((len(candidates), len(self._ranges)))
        for own, rest in zip(candidates.parts, others.parts, strict=True):
            matrix, scatter, common = (part.sum(axis=0) for part in rest)
            _add_squares(*own, matrix, scatter, common, self._ranges, wanted, squares)
        error = np.sqrt(squares.mean(axis=-1) / len(candidates.parts))
        short = self._shortfall(candidates.stripes) + self._shortfall(others.stripes).sum()
        # Penalty of a stripe out of the picture, in goals; largest penalty of crossings, as a share
        # of the error.
        out_cost, crossing_share = 20.0, 0.3
        total = error * (1.0 + crossing_share * self._crossings(candidates.stripes, others.stripes))
        return error, total + out_cost * short / (1 + len(others))

    def _shortfall(self, stripes: Stripes) -> FloatArray:
        """Return the share (K,) by which each stripe is too short, mean over the ranges."""
        least = _LENGTH_SHARE * self._height / pixels_per_line(self._camera.size_px)
        missing: FloatArray = np.maximum(1.0 - stripes.lines / least, 0.0).mean(axis=-1)
        return missing

    def _crossings(self, one: Stripes, others: Stripes) -> FloatArray:
        """Return the share (K,) of pairs and ranges at which stripes cross in the picture."""
        n = len(others.lines)
        if not self._design.avoid_crossings or n == 0:
            return np.zeros(len(one.lines))
        pairs = cross(one, others).mean(axis=-1).sum(axis=-1)
        among = float(np.triu(cross(others, others).mean(axis=-1), 1).sum())
        share: FloatArray = (pairs + among) / (n * (n + 1) / 2)
        return share


def score(design: Design) -> AngleScore:
    """Return the score of the angles of a design's mounts."""
    judge = Judge(design)
    candidates = judge.trace(design.mounts)
    errors, totals = judge.judge(candidates.take([0]), candidates.take(range(1, len(candidates))))
    return AngleScore(float(errors[0]), float(totals[0]))


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
    """Add the mean square error, in goals squared, of each candidate and range to `squares` (K, W).

    Arrays as in `StripeSet.parts`; those of the other lasers are summed over these.
    """
    whole, inverse, middle = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    scale = np.empty(3)
    # Square error without a posture, in goals squared.
    no_posture = 1e4
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
            square = no_posture
            if invert_symmetric(whole, inverse):
                # Derivatives of yaw, range and pitch by m, each in units of its goal.
                scale[0], scale[1] = ranges[w] / wanted[2], ranges[w] / wanted[0]
                scale[2] = ranges[w] / wanted[1]
                square = 0.0
                for axis in range(3):
                    for i in range(3):
                        for j in range(3):
                            variance = inverse[axis, i] * middle[i, j] * inverse[j, axis]
                            square += scale[axis] ** 2 * variance / 3.0
            squares[k, w] += min(square, no_posture) if square >= 0.0 else no_posture
