"""Agreement of the lasers over a dive: detection of a laser whose sheet has moved.

Two lines on a flat target share a plane, and so do three: a laser whose sheet is no longer where
the rig says leaves it. One frame shows little of that (of three lines, each with a shift and a
turn, the target's own plane takes three numbers), but a sheet that has moved has done so by the
same three numbers in all frames, at every range and angle of the target; no bulge of a net or fish
in front of it follows that pattern. So each laser in turn is assumed to have moved, and it is named
if that explains all frames and no other laser does.

`bin_stripes` summarises each stripe of a frame by the middle of its light in a few bins, whatever
its label: the points of a laser that has drifted are labelled as clutter or as another surface.
`explain` fits a plane m·X = 1 to each frame and one step of three numbers (turns and shift) to one
laser's sheet in all frames; the planes are eliminated from the normal equations (Schur complement),
and weights are Tukey's. `LaserAgreement` collects the frames and gives the verdict.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Rays
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import LASER_PARAMETERS, Rig
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.plane_fit import TUKEY
from aqualvs.scanning.scan import Scan, ScanPoints

N_BINS = 12
"""Bins of a stripe, from one border of the picture to the other."""

# In a bin, points within three times the typical scatter of the median are the stripe; the limit is
# at least the first of these shares of the range and at most the second.
_NEAR, _FAR = 0.003, 0.02
_SCATTER = 4.4  # three sigmas in median absolute deviations
_MIN_POINTS = 4
_MIN_SHARE = 0.6


def bin_stripes(
    points: ScanPoints, m: FloatArray, along_x: IntArray, size_px: tuple[int, int]
) -> FloatArray:
    """Return the middle of the light in each bin of each laser's stripe.

    Parameters
    ----------
    points : ScanPoints
        Of one frame.
    m : array, shape (3,)
        The target's plane m·X = 1 in `dome`, roughly.
    along_x : int array, shape (L,)
        1 for lasers whose stripe is searched along x, and so runs along y.
    size_px : (int, int)
        Image width and height.

    Returns
    -------
    array, shape (L, N_BINS, 2)
        In `image`; NaN where a bin shows no stripe, or too much beside it.
    """
    laser, n_cells = points.laser.astype(np.int64), len(along_x) * N_BINS
    x, y, place = points.pixels[:, 0], points.pixels[:, 1], points.points_in_dome
    share = np.where(along_x[laser] == 1, y / size_px[1], x / size_px[0])
    piece = np.clip((share * N_BINS).astype(np.int64), 0, N_BINS - 1)
    off = m[0] * place[:, 0] + m[1] * place[:, 1] + m[2] * place[:, 2] - 1.0
    # Points farther from the target's plane than this share of the range belong to something else:
    # two degrees of a laser are a quarter of the range at worst.
    gate = 0.4
    rows = np.flatnonzero(np.abs(off) < gate)
    cell, off = (laser * N_BINS + piece)[rows], off[rows]
    n = np.bincount(cell, minlength=n_cells)
    apart = np.abs(off - _medians(off, cell, n)[cell])
    near = apart < np.clip(_SCATTER * _medians(apart, cell, n), _NEAR, _FAR)[cell]
    rows, cell = rows[near], cell[near]
    n_near = np.bincount(cell, minlength=n_cells)
    # The middle of the light of the points that lie together.
    brightness = points.intensity[rows] * points.width[rows]
    sums = [np.bincount(cell, brightness * at, n_cells) for at in (1.0, x[rows], y[rows])]
    seen = (n_near >= _MIN_POINTS) & (n_near >= _MIN_SHARE * n)
    middle = np.full((n_cells, 2), np.nan)
    for k in range(2):
        middle[seen, k] = sums[1 + k][seen] / sums[0][seen]
    return middle.reshape(len(along_x), N_BINS, 2)


def _medians(values: FloatArray, group: IntArray, n: IntArray) -> FloatArray:
    """Return the median of each group, NaN for none; `n` are the numbers of its values."""
    found = np.full(len(n), np.nan)
    ordered, filled = values[np.lexsort((values, group))], n > 0
    first, n_filled = (np.cumsum(n) - n)[filled], n[filled]
    found[filled] = (ordered[first + (n_filled - 1) // 2] + ordered[first + n_filled // 2]) / 2.0
    return found


CUT = 4.0
"""Cost limit of residuals, in sigmas: larger residuals count as this."""

# Prior of a step: a laser that was knocked has turned rather than shifted, and hardly by more.
_PRIOR = np.array([np.deg2rad(1.5), np.deg2rad(1.5), 0.005])
# Limit of the steps; a laser so far off would not be seen at all.
_FARTHEST = np.array([0.2, 0.2, 0.05])
_STEP_PX = 0.25
_ITERATIONS, _UNWEIGHTED = 12, 2
_SMALL, _SETTLED = 1e-5, 1e-3
_LEAST, _RIDGE = 1e-6, 1e-12


@dataclass(frozen=True, slots=True)
class SeenStripes:
    """Stripes on flat-looking targets, as rays; F frames, L lasers, K bins."""

    # Shape (L, F, K, 3): of the rays, in `dome`.
    origins: FloatArray
    directions: FloatArray
    # Shape (L, F, K, 3, 2): origins and directions of the rays that pass `_STEP_PX` beside, across
    # the stripe.
    beside: FloatArray
    # Shape (L, F, K).
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
    """Fit of the frames under the hypothesis that one laser, or none, has moved."""

    laser: int | None  # The one that may have moved.
    step: FloatArray  # Shape (3,): its step as `moved_plane` takes it: tilts (rad) and offset (m).
    cost: float  # Mean square residual in sigmas, none counted beyond `CUT`.
    inliers: float  # Share of residuals below `CUT`.
    # Root mean square distance of that laser's stripe from the targets, as a share of range.
    effect: float
    # Shape (3 L, 3 L): of the steps of all lasers, from a typical frame: errors of a stripe are the
    # same in all frames, so more frames add no information.
    information: FloatArray

    def covariance(self) -> FloatArray:
        """Return the covariance (3, 3) of `step`, including its prior."""
        own = self._own()
        total = self.information[own, own] + np.diag(_PRIOR**-2.0)
        return np.asarray(np.linalg.inv(total), dtype=np.float64)

    def spill(self) -> FloatArray:
        """Return the derivative (3, 3 L) of `step` by the steps of all lasers (3 L)."""
        return self.covariance() @ self.information[self._own()]

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
    """Return Newton's correction, to be subtracted, of the step of one laser."""
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
    """Points of stripes on the assumed sheets; frames first, the bins of all lasers in one axis."""

    points: FloatArray  # Shape (F, L K, 3).
    per_px: FloatArray  # Shape (F, L K, 3): derivative of the points by a pixel across the stripe.
    # Shape (F, L K, 3, 3): derivative of the points by a step of their own laser.
    by_step: FloatArray
    # Shape (F, L K).
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
    # The neighbouring ray meets the sheet's tangent plane.
    origin, direction = stripes.beside[laser, ..., 0], stripes.beside[laser, ..., 1]
    reach = np.einsum("fki,fki->fk", normal, points - origin)
    reach /= np.einsum("fki,fki->fk", normal, direction)
    per_px = (origin + reach[..., None] * direction - points) / _STEP_PX
    # Rays of pixels that the lens does not reach, such as the corners of a fisheye's picture, are
    # NaN, which a weight of zero would not take out of a sum.
    unseen = ~seen
    per_px[unseen], by_step[unseen] = 0.0, 0.0
    return _View(points, per_px, by_step, seen)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Planes fitted to all frames, and their residuals."""

    m: FloatArray  # Shape (F, 3).
    # Shape (F, L K): weights by errors and outliers; residuals of m·X = 1, and the same in sigmas.
    weight: FloatArray
    residual: FloatArray
    z: FloatArray
    # Shape (F, 3, 3): of the planes' normal equations.
    inverse: FloatArray

    @classmethod
    def of(cls, view: _View, weight: FloatArray) -> "_Fit":
        """Fit a plane to each frame; `weight` tells outliers from the rest."""
        x = view.points
        # A frame with outliers only keeps some plane, which has no influence.
        least = _LEAST * view.seen
        m, _ = _planes(x, weight + least)
        per_px = np.abs(np.einsum("fbi,fi->fb", view.per_px, m))
        # Error of a bin of stripe that stays from frame to frame: texture, strands, the glow beside
        # the sheet, in pixels; and the unevenness that a target may have, as a share of the range.
        sigma_px, uneven = 0.25, 7e-4
        sigma = np.hypot(sigma_px * per_px, uneven)
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
        """Return Tukey's weights of the residuals."""
        scale = max(1.0, 1.4826 * float(np.median(np.abs(self.z[seen]))))
        return np.maximum(1.0 - (self.z / (TUKEY * scale)) ** 2, 0.0) ** 2 * seen

    def effect(self, view: _View, laser: int, step: FloatArray) -> float:
        """Return the shift of its laser's stripe off the targets by a step, over the range."""
        mine = _pieces(laser)
        off = self.slopes(view)[:, mine] @ step
        return float(np.sqrt(np.mean(off[view.seen[:, mine]] ** 2)))


def _planes(x: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit m·X = 1, shape (F, 3), to weighted points; return the inverse normal matrices too."""
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


# Frames in the fit; when there are twice as many, every other one is dropped.
_MAX_FRAMES = 24
_MIN_FRAMES = 5
# Least share of the stripes that must be explained: by a flat target, or by the laser that moved.
_EXPLAINED = 0.6
# Another laser is excluded if its mean square is worse by this value and by the first share; a
# laser has moved at all if the hypothesis of none is worse by this value and by the second share.
_WORSE, _WORSE_SHARE, _WORSE_SHARE_OF_NONE = 0.1, 0.1, 0.3


class AgreementState(StrEnum):
    """Agreement of the lasers; the value is written to `run.yaml`."""

    AGREE = "agree"
    DRIFTED = "drifted"
    """One laser has moved, and it is known which."""
    DISAGREE = "disagree"
    """One laser has moved, but it could be one of several."""
    NOT_FLAT = "not_flat"
    """The targets are not flat enough to say."""
    NOT_CHECKED = "not_checked"
    """Too few frames show a stripe of every laser."""


@dataclass(frozen=True, slots=True)
class AgreementVerdict:
    """The verdict on the lasers: their agreement, and the suspects if they disagree."""

    state: AgreementState
    n_frames: int  # Frames that the verdict is based on.
    # Lasers of which one has moved, numbered from 0, the likeliest first.
    suspects: tuple[int, ...] = ()
    # Of the suspects.
    names: tuple[str, ...] = ()
    # By how much the first of them has turned (rad) if it is the one; NaN without suspects.
    angle: float = math.nan
    sigma_angle: float = math.nan
    # How far its stripe lies off the plane of the others, as a share of the range; NaN likewise.
    effect: float = math.nan

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as written to `run.yaml`."""
        found: dict[str, Any] = {"state": self.state.value, "n_frames": self.n_frames}
        if self.suspects:
            found["suspects"] = list(self.names)
            found["angle_deg"] = round(math.degrees(self.angle), 3)
            found["sigma_angle_deg"] = round(math.degrees(self.sigma_angle), 3)
            found["off_range_share"] = round(self.effect, 5)
            found["words"] = self.sentence()
        return found

    def sentence(self) -> str:
        """Return the fault and its remedy as text; empty if there is none."""
        if not self.suspects:
            return ""
        named = [
            f"laser {i + 1} ({name})" for i, name in zip(self.suspects, self.names, strict=True)
        ]
        off = f"off by {math.degrees(self.angle):.2g} deg"
        remedy = "recalibrate with 'aqualvs calibrate lasers'"
        if self.state is AgreementState.DRIFTED:
            share = f"{self.effect:.1%} of the range"
            return f"{named[0]} is {off} (its stripe lies {share} off the others' plane): {remedy}"
        return f"the lasers disagree: {' or '.join(named)} is {off} or so: {remedy}"


class LaserAgreement:
    """Monitor of the agreement of a rig's lasers over a dive.

    Parameters
    ----------
    rig : Rig
        The rig of the scans. Its uncertainty counts: a disagreement within the uncertainty of the
        calibration is no fault.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._camera = rig.camera()
        self._known = rig_uncertainty(rig)
        axes = [band.axis for band in plan_bands(rig, self._camera)]
        self._along_x = np.array([axis is SearchAxis.ALONG_X for axis in axes], np.int64)
        self._middles: dict[int, FloatArray] = {}
        # At first one frame in this many is used: neighbouring frames show the same.
        every = 3
        self._every = every
        self._verdict: AgreementVerdict | None = None

    def add(self, scan: Scan) -> None:
        """Add a frame; frames without a posture, and all but a sample of the others, are skipped.

        A frame is sampled by its number, so that parts of a dive, added by themselves, take the
        same frames as the whole dive.
        """
        if not scan.posture or scan.index % self._every or len(self._along_x) < 2:
            return
        m = scan.posture.normal_in_dome / scan.posture.range
        middles = bin_stripes(scan.points, m, self._along_x, self._rig.size_px)
        # Bins of stripe that every laser must show for a frame to count.
        min_pieces = 4
        if np.isfinite(middles[..., 0]).sum(axis=1).min() >= min_pieces:
            self._sample({scan.index: middles})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the sampled frames, to be stored and given to `extend`."""
        shape = (len(self._middles), len(self._along_x), N_BINS, 2)
        return {
            "every": np.array(self._every),
            "frames": np.array(list(self._middles), np.int64),
            "middles": np.array(list(self._middles.values())).reshape(shape),
        }

    def extend(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Add frames that another monitor of the same rig has sampled, as from `arrays`."""
        self._every = max(self._every, int(arrays["every"]))
        frames = arrays["frames"].tolist()
        self._sample(dict(zip(frames, arrays["middles"], strict=True)))

    def _sample(self, middles: Mapping[int, FloatArray]) -> None:
        """Take frames into the sample; where it grows too large, every other one is dropped."""
        self._verdict = None
        self._middles |= middles
        while True:
            kept = {i: one for i, one in self._middles.items() if i % self._every == 0}
            self._middles = kept
            if len(kept) < 2 * _MAX_FRAMES:
                return
            self._every *= 2

    def verdict(self) -> AgreementVerdict:
        """Return the verdict on the frames so far."""
        if self._verdict is None:
            self._verdict = self._judged()
        return self._verdict

    def _judged(self) -> AgreementVerdict:
        thinning = max(1, math.ceil(len(self._middles) / _MAX_FRAMES))
        middles = list(self._middles.values())[::thinning]
        n_frames = len(middles)
        if n_frames < _MIN_FRAMES:
            return AgreementVerdict(AgreementState.NOT_CHECKED, n_frames)
        stripes = SeenStripes.of(middles, self._camera, self._along_x)
        sheets = sheets_of(self._rig)
        none = explain(stripes, sheets, None)
        found = sorted(
            (explain(stripes, sheets, laser) for laser in range(len(sheets))),
            key=lambda one: one.cost,
        )
        best = found[0]
        if not self._is_off(best):
            return _no_alarm(best, n_frames)
        if not _is_worse(none, best, _WORSE_SHARE_OF_NONE):
            return _no_alarm(none, n_frames)
        # Beyond this the target is bent: a laser so far off shows next to nothing.
        unlikely = math.radians(5.0)
        if best.inliers < _EXPLAINED or float(np.linalg.norm(best.step[:2])) > unlikely:
            return AgreementVerdict(AgreementState.NOT_FLAT, n_frames)
        suspects = [one for one in found if one is best or not _is_worse(one, best)]
        if len(suspects) == len(found) > 2:
            # If any of three lasers could explain it, none has moved: the target is no plane.
            return AgreementVerdict(AgreementState.NOT_FLAT, n_frames)
        return self._told(suspects, n_frames)

    def _told(self, suspects: list[Explanation], n_frames: int) -> AgreementVerdict:
        best = suspects[0]
        numbers = tuple(one.laser for one in suspects if one.laser is not None)
        tilt = best.step[:2]
        angle = float(np.linalg.norm(tilt))
        covariance = self._covariance(best)[:2, :2]
        state = AgreementState.DRIFTED if len(suspects) == 1 else AgreementState.DISAGREE
        return AgreementVerdict(
            state=state,
            n_frames=n_frames,
            suspects=numbers,
            names=tuple(self._rig.lasers[i].name for i in numbers),
            angle=angle,
            sigma_angle=math.sqrt(float(tilt @ covariance @ tilt)) / angle,
            effect=best.effect,
        )

    def _is_off(self, found: Explanation) -> bool:
        """Return whether the step of a laser is significant, and large enough to matter."""
        step = found.step
        sigmas = math.sqrt(float(step @ np.linalg.solve(self._covariance(found), step)))
        # An alarm needs a step of this significance, and of this size in angle or range.
        significant = 5.0
        angle, effect = math.radians(0.15), 0.005
        matters = found.effect > effect or float(np.linalg.norm(step[:2])) > angle
        return sigmas > significant and matters

    def _covariance(self, found: Explanation) -> FloatArray:
        """Return the covariance of a step, by errors of the stripes and of the calibration."""
        names = [f"{laser.name}:{name}" for laser in self._rig.lasers for name in LASER_PARAMETERS]
        spill = found.spill()
        return found.covariance() + spill @ self._known.of(names) @ spill.T


def _no_alarm(found: Explanation, n_frames: int) -> AgreementVerdict:
    """Return that the lasers agree, if flat targets without a relevant step explain the frames."""
    flat = found.inliers >= _EXPLAINED
    return AgreementVerdict(AgreementState.AGREE if flat else AgreementState.NOT_FLAT, n_frames)


def _is_worse(one: Explanation, best: Explanation, share: float = _WORSE_SHARE) -> bool:
    return one.cost - best.cost > _WORSE + share * best.cost
