"""The fit behind `LaserAgreement`: flat targets of many frames, and one laser that may have moved.

Every frame has a target plane m·X = 1 of its own. One laser's sheet, the same in all frames, may
have turned and shifted by a small step of three numbers; the planes are eliminated from the normal
equations (Schur complement), and weights are Tukey's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.rays import Rays
from aqualvs.optics.camera import Camera
from aqualvs.optics.sheet import Sheet
from aqualvs.scanning.stripe_bins import N_BINS

CUT = 4.0
"""Residuals beyond so many sigmas cost as much as this and no more."""

# Error of a piece of stripe that stays from frame to frame: texture, strands, the glow beside the
# sheet, in pixels; and what a target may be uneven, as a share of the range.
_SIGMA_PX, _UNEVEN = 0.25, 7e-4
# A laser that was knocked has turned rather than shifted; and hardly by more.
_PRIOR = np.array([np.deg2rad(1.5), np.deg2rad(1.5), 0.005])
# Steps are not followed beyond this; no laser of which anything is seen is so far off.
_FARTHEST = np.array([0.2, 0.2, 0.05])
_STEP_PX = 0.25
_TUKEY = 4.685  # 95 % efficiency for normal errors
_ITERATIONS, _UNWEIGHTED = 12, 2
_SMALL, _SETTLED = 1e-5, 1e-3
_LEAST, _RIDGE = 1e-6, 1e-12


@dataclass(frozen=True, slots=True)
class SeenStripes:
    """What was seen of flat-looking targets, as rays; F frames, L lasers, K pieces.

    Attributes
    ----------
    origins, directions : array, shape (L, F, K, 3)
        Of the rays, in `dome`.
    beside : array, shape (L, F, K, 3, 2)
        Origins and directions of the rays that pass `_STEP_PX` beside, across the stripe.
    seen : bool array, shape (L, F, K)
    """

    origins: FloatArray
    directions: FloatArray
    beside: FloatArray
    seen: BoolArray

    @classmethod
    def of(cls, middles: Sequence[FloatArray], camera: Camera, along_x: IntArray) -> "SeenStripes":
        """Trace the pieces of stripes (L, K, 2) of several frames, NaN where unseen."""
        pixels = np.stack(middles, axis=1)
        step = np.where(along_x[:, None] == 1, [_STEP_PX, 0.0], [0.0, _STEP_PX])
        rays = camera.rays(np.nan_to_num(pixels))
        beside = camera.rays(np.nan_to_num(pixels) + step[:, None, None])
        return cls(
            rays.origins,
            rays.directions,
            np.stack([beside.origins, beside.directions], axis=-1),
            np.isfinite(pixels[..., 0]) & rays.valid & beside.valid,
        )


@dataclass(frozen=True, slots=True)
class Explanation:
    """How well the frames are explained, by one laser that has moved or by none.

    Attributes
    ----------
    laser : int or None
        The one that may have moved.
    step : array, shape (3,)
        Its step as `moved_plane` takes it: tilts (rad) and offset (m).
    cost : float
        Mean square residual in sigmas, none counted beyond `CUT`.
    inliers : float
        Share of residuals below `CUT`.
    effect : float
        Root mean square distance of that laser's stripe from the targets, as a share of range.
    information : array, shape (3 L, 3 L)
        Of the steps of all lasers, from a typical frame: what is wrong with a stripe is so in all
        frames, so more of them do not tell more.
    """

    laser: int | None
    step: FloatArray
    cost: float
    inliers: float
    effect: float
    information: FloatArray

    def covariance(self) -> FloatArray:
        """Return the covariance (3, 3) of `step`, with what is known of it beforehand."""
        own = self._own()
        total = self.information[own, own] + np.diag(_PRIOR**-2.0)
        return np.asarray(np.linalg.inv(total), dtype=np.float64)

    def spill(self) -> FloatArray:
        """Return what a step of any laser (3 L) does to `step`, shape (3, 3 L)."""
        spill: FloatArray = self.covariance() @ self.information[self._own()]
        return spill

    def _own(self) -> slice:
        if self.laser is None:
            raise ValueError("no laser has moved, so there is no step")
        return slice(3 * self.laser, 3 * self.laser + 3)


def explain(stripes: SeenStripes, sheets: Sequence[Sheet], laser: int | None) -> Explanation:
    """Fit a plane to every frame, and a step of one laser, or of none, to all of them.

    Parameters
    ----------
    stripes : SeenStripes
    sheets : sequence of Sheet
        One for each laser, as the rig has them.
    laser : int or None
        The one that may have moved.
    """
    step = np.zeros(3)
    view = _View.of(stripes, sheets)
    weight = view.seen.astype(np.float64)
    for i in range(_ITERATIONS):
        fit, last = _Fit.of(view, weight), step
        if laser is not None:
            step = np.clip(step - _toward(fit, view, laser, step), -_FARTHEST, _FARTHEST)
            view = view.with_laser(stripes, laser, _moved(sheets[laser], step))
        if i >= _UNWEIGHTED:
            before, weight = weight, fit.tukey(view.seen)
            if np.abs(step - last).max() < _SMALL and np.abs(weight - before).mean() < _SETTLED:
                break
    fit = _Fit.of(view, weight)
    z = np.abs(fit.z[view.seen])
    return Explanation(
        laser=laser,
        step=step,
        cost=float(np.mean(np.minimum(z, CUT) ** 2)),
        inliers=float(np.mean(z < CUT)),
        effect=0.0 if laser is None else fit.effect(view, laser, step),
        information=fit.normal_equations(view, _spread(fit.slopes(view)))[0],
    )


def _toward(fit: "_Fit", view: "_View", laser: int, step: FloatArray) -> FloatArray:
    """Newton's step, to be subtracted, for the step of one laser."""
    slope = np.zeros((*view.seen.shape, 3))
    mine = _pieces(laser)
    slope[:, mine] = fit.slopes(view)[:, mine]
    information, right = fit.normal_equations(view, slope)
    prior = _PRIOR**-2.0
    toward = np.linalg.solve(information + np.diag(prior), right + prior * step)
    return np.asarray(toward, dtype=np.float64)


def _pieces(laser: int) -> slice:
    return slice(N_BINS * laser, N_BINS * (laser + 1))


def _moved(sheet: Sheet, step: FloatArray) -> Sheet:
    rest = np.zeros(len(sheet.parameter_names) - len(step))
    return sheet.moved_by(np.concatenate([step, rest]))


@dataclass(frozen=True, slots=True)
class _View:
    """Points of stripes on the sheets as they are assumed; frames first, lasers' pieces in one.

    Attributes
    ----------
    points : array, shape (F, L K, 3)
    per_px : array, shape (F, L K, 3)
        Derivative of the points by a pixel across the stripe.
    by_step : array, shape (F, L K, 3, 3)
        Derivative of the points by a step of their own laser.
    seen : bool array, shape (F, L K)
    """

    points: FloatArray
    per_px: FloatArray
    by_step: FloatArray
    seen: BoolArray

    @classmethod
    def of(cls, stripes: SeenStripes, sheets: Sequence[Sheet]) -> "_View":
        """Return the points on all sheets."""
        parts = [_on_sheet(stripes, i, sheet) for i, sheet in enumerate(sheets)]
        return cls(
            np.concatenate([part.points for part in parts], axis=1),
            np.concatenate([part.per_px for part in parts], axis=1),
            np.concatenate([part.by_step for part in parts], axis=1),
            np.concatenate([part.seen for part in parts], axis=1),
        )

    def with_laser(self, stripes: SeenStripes, laser: int, sheet: Sheet) -> "_View":
        """Return the same view with another sheet of one laser."""
        changed = _View(
            self.points.copy(), self.per_px.copy(), self.by_step.copy(), self.seen.copy()
        )
        mine, part = _pieces(laser), _on_sheet(stripes, laser, sheet)
        changed.points[:, mine], changed.per_px[:, mine] = part.points, part.per_px
        changed.by_step[:, mine], changed.seen[:, mine] = part.by_step, part.seen
        return changed


def _on_sheet(stripes: SeenStripes, laser: int, sheet: Sheet) -> _View:
    """Return the points of one laser, K pieces of it."""
    shape = stripes.seen.shape[1:]
    origins, directions = stripes.origins[laser], stripes.directions[laser]
    rays = Rays(origins, directions, stripes.seen[laser])
    points, seen = sheet.intersect(rays)
    points = np.where(seen[..., None], points, 0.0)
    _, normal, by_parameter = sheet.signed_distance_with_parameter_jacobian(points)
    normal, by_parameter = normal.reshape(*shape, 3), by_parameter[:, :3].reshape(*shape, 3)
    approach = np.einsum("fki,fki->fk", normal, directions)
    by_step = -directions[..., None] * (by_parameter / approach[..., None])[..., None, :]
    # The ray beside meets the sheet's tangent plane.
    origin, direction = stripes.beside[laser, ..., 0], stripes.beside[laser, ..., 1]
    reach = np.einsum("fki,fki->fk", normal, points - origin)
    reach /= np.einsum("fki,fki->fk", normal, direction)
    per_px = (origin + reach[..., None] * direction - points) / _STEP_PX
    return _View(points, per_px, by_step, seen)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Planes of all frames, and residuals.

    Attributes
    ----------
    m : array, shape (F, 3)
    weight, residual, z : array, shape (F, L K)
        Weights by errors and outliers; residuals of m·X = 1, and the same in sigmas.
    inverse : array, shape (F, 3, 3)
        Of the planes' normal equations.
    """

    m: FloatArray
    weight: FloatArray
    residual: FloatArray
    z: FloatArray
    inverse: FloatArray

    @classmethod
    def of(cls, view: _View, weight: FloatArray) -> "_Fit":
        """Fit a plane to each frame; `weight` tells outliers from the rest."""
        x = view.points
        # A frame all of whose pieces are outliers keeps some plane, which says nothing.
        least = _LEAST * view.seen
        m, _ = _planes(x, weight + least)
        per_px = np.abs(np.einsum("fbi,fi->fb", view.per_px, m))
        sigma = np.hypot(_SIGMA_PX * per_px, _UNEVEN)
        w = (weight + least) / sigma**2
        m, inverse = _planes(x, w)
        residual = np.where(view.seen, np.einsum("fbi,fi->fb", x, m) - 1.0, 0.0)
        return cls(m, w, residual, residual / sigma, inverse)

    def slopes(self, view: _View) -> FloatArray:
        """Return the derivative (F, L K, 3) of the residuals by their own laser's step."""
        slopes: FloatArray = np.einsum("fbij,fi->fbj", view.by_step, self.m)
        return slopes

    def normal_equations(self, view: _View, slope: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return matrix (C, C) and right side (C,) of parameters with derivatives (F, L K, C).

        Means over the frames, with the planes eliminated.
        """
        weighed = self.weight[..., None] * slope
        across = np.swapaxes(view.points, 1, 2) @ weighed
        eliminated = self.inverse @ across
        matrix = np.swapaxes(slope, 1, 2) @ weighed - np.swapaxes(across, 1, 2) @ eliminated
        right = np.einsum("fbc,fb->fc", weighed, self.residual)
        # The planes are at their minimum, so that the residuals' pull on them is zero.
        return matrix.mean(axis=0), right.mean(axis=0)

    def tukey(self, seen: BoolArray) -> FloatArray:
        """Return the weights that the residuals deserve."""
        scale = max(1.0, 1.4826 * float(np.median(np.abs(self.z[seen]))))
        weight: FloatArray = np.maximum(1.0 - (self.z / (_TUKEY * scale)) ** 2, 0.0) ** 2 * seen
        return weight

    def effect(self, view: _View, laser: int, step: FloatArray) -> float:
        """Share of the range by which a step takes its laser's stripe off the targets."""
        mine = _pieces(laser)
        off = self.slopes(view)[:, mine] @ step
        return float(np.sqrt(np.mean(off[view.seen[:, mine]] ** 2)))


def _planes(x: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit m·X = 1, shape (F, 3), to weighted points; the inverse normal matrices come along."""
    weighed = w[..., None] * x
    normal = np.swapaxes(x, 1, 2) @ weighed
    # Points of one laser alone would leave the plane to turn about their line.
    ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = np.asarray(np.linalg.inv(normal + ridge), dtype=np.float64)
    return (inverse @ weighed.sum(axis=1)[..., None])[..., 0], inverse


def _spread(slope: FloatArray) -> FloatArray:
    """Give every laser columns of its own: (F, L K, 3) to (F, L K, 3 L)."""
    n_frames, n, _ = slope.shape
    n_lasers = n // N_BINS
    spread = np.zeros((n_frames, n_lasers, N_BINS, n_lasers, 3))
    own = np.arange(n_lasers)
    spread[:, own, :, own] = np.moveaxis(slope.reshape(n_frames, n_lasers, N_BINS, 3), 1, 0)
    return spread.reshape(n_frames, n, 3 * n_lasers)
