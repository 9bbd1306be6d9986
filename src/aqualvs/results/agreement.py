"""Agreement of the lasers over a dive: detection of a laser that has moved, and of zoom.

The stripes of all lasers on a flat target lie in one plane; the stripe of a laser whose sheet is
not where the rig says lies beside it. One frame is weak evidence (three lines, each with a shift
and a turn, have six parameters, of which the target's own plane takes three), but a sheet that has
moved has done so by the same three parameters in all frames, at every range and angle of the
target; a bulge of a net or a fish in front of it does not. So each laser in turn is assumed to have
moved; it is named if that explains all frames and no other laser does. A picture that is larger
than the rig's calibration predicts (zoom, stabilisation) is so by one factor in all frames.

`bin_stripes` summarises each stripe of a frame by its centroid in a few bins, whatever the labels:
the points of a laser that has drifted are labelled as clutter or as another surface. `fit_drift`
fits a plane m·X = 1 to each frame and one step of three parameters (two tilts and a shift) to one
laser's sheet in all frames; the planes are eliminated from the normal equations (Schur complement),
and weights are Tukey's. `fit_zoom` finds the factor instead. `LaserAgreement` collects the frames
and gives the verdict.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Rays
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig, rig_moved_by
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.plane_fit import TUKEY
from aqualvs.scanning.scan import Scan, ScanPoints

N_BINS = 12
"""Bins of a stripe, from one border of the picture to the other."""

# In a bin, points within three standard deviations of the median are the stripe; the limit is at
# least the first of these shares of the range and at most the second. Three standard deviations are
# 4.4 median absolute deviations.
_MIN_NEAR, _MAX_NEAR = 0.003, 0.02
_SCATTER = 4.4
# Least number of these points in a bin, and least share of all points in it.
_MIN_POINTS = 4
_MIN_SHARE = 0.6


def bin_stripes(
    points: ScanPoints, m: FloatArray, along_x: IntArray, size_px: tuple[int, int]
) -> FloatArray:
    """Return the centroid of the light in each bin of each laser's stripe.

    Parameters
    ----------
    points : ScanPoints
        Of one frame.
    m : array, shape (3,)
        Approximate plane m·X = 1 of the target, in `dome`.
    along_x : int array, shape (L,)
        1 for lasers whose search lines run along x, so that the stripe runs along y; else 0.
    size_px : (int, int)
        Image width and height.

    Returns
    -------
    array, shape (L, N_BINS, 2)
        In `image`; NaN if a bin has no stripe, or too many other points.
    """
    laser, n_cells = points.laser.astype(np.int64), len(along_x) * N_BINS
    x, y, place = points.pixels[:, 0], points.pixels[:, 1], points.points_in_dome
    share = np.where(along_x[laser] == 1, y / size_px[1], x / size_px[0])
    i_bin = np.clip((share * N_BINS).astype(np.int64), 0, N_BINS - 1)
    off = m[0] * place[:, 0] + m[1] * place[:, 1] + m[2] * place[:, 2] - 1.0
    # Points farther from the target's plane than this share of the range are on other objects: a
    # laser that is off by two degrees moves them by a quarter of the range at most.
    gate = 0.4
    rows = np.flatnonzero(np.abs(off) < gate)
    cell, off = (laser * N_BINS + i_bin)[rows], off[rows]
    n = np.bincount(cell, minlength=n_cells)
    apart = np.abs(off - _medians(off, cell, n)[cell])
    near = apart < np.clip(_SCATTER * _medians(apart, cell, n), _MIN_NEAR, _MAX_NEAR)[cell]
    rows, cell = rows[near], cell[near]
    n_near = np.bincount(cell, minlength=n_cells)
    brightness = points.intensity[rows] * points.width[rows]
    sums = [np.bincount(cell, brightness * at, n_cells) for at in (1.0, x[rows], y[rows])]
    seen = (n_near >= _MIN_POINTS) & (n_near >= _MIN_SHARE * n)
    middle = np.full((n_cells, 2), np.nan)
    for k in range(2):
        middle[seen, k] = sums[1 + k][seen] / sums[0][seen]
    return middle.reshape(len(along_x), N_BINS, 2)


def _medians(values: FloatArray, group: IntArray, n: IntArray) -> FloatArray:
    """Return the median of each group, NaN without values; `n` are the numbers of its values."""
    found = np.full(len(n), np.nan)
    ordered, filled = values[np.lexsort((values, group))], n > 0
    first, n_filled = (np.cumsum(n) - n)[filled], n[filled]
    found[filled] = (ordered[first + (n_filled - 1) // 2] + ordered[first + n_filled // 2]) / 2.0
    return found


CUT = 4.0
"""Limit of a residual in the cost, in sigmas."""

# Prior standard deviations of a step (rad, rad, m): a laser that was knocked has turned rather than
# shifted, and hardly by more.
_PRIOR = np.array([np.deg2rad(1.5), np.deg2rad(1.5), 0.005])
# Largest step (rad, rad, m): a laser that is farther off would not be visible.
_MAX_STEP = np.array([0.2, 0.2, 0.05])
# Step of the numerical derivative across a stripe, in pixels.
_STEP_PX = 0.25
# Iterations at most, the first ones without weights; the fit has converged if no parameter changes
# by more than the first limit (rad, m), and the weights by less than the second on average.
_ITERATIONS, _UNWEIGHTED = 12, 2
_SMALL_STEP, _SMALL_CHANGE = 1e-5, 1e-3
# Least weight of a point that is seen, and ridge as a share of the trace of the normal matrix.
_MIN_WEIGHT, _RIDGE = 1e-6, 1e-12


@dataclass(frozen=True, slots=True)
class SeenStripes:
    """Stripes of the frames as rays: L lasers, F frames, K bins."""

    # Shape (L, F, K, 3): origins (m) and unit directions of the rays, in `dome`.
    origins: FloatArray
    directions: FloatArray
    # Shape (L, F, K, 3, 2): origins and directions of the rays of pixels that are moved across the
    # stripe by `_STEP_PX`.
    beside: FloatArray
    # Shape (L, F, K): whether the bin has a stripe, and both rays exist.
    seen: BoolArray

    @classmethod
    def of(cls, middles: Sequence[FloatArray], camera: Camera, along_x: IntArray) -> "SeenStripes":
        """Trace the bins (L, K, 2) of several frames from `bin_stripes`, NaN where unseen."""
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
class DriftFit:
    """Fit of the frames under the hypothesis that one laser, or none, has moved."""

    laser: int | None  # Index of the laser that has moved; None for none.
    step: FloatArray  # Shape (3,): its step: two tilts (rad) and a shift (m), as `Sheet.moved_by`.
    cost: float  # Mean square residual in sigmas, none counted beyond `CUT`.
    inliers: float  # Share of residuals below `CUT`.
    # Root mean square distance of that laser's stripe from the targets, as a share of range.
    effect: float
    weight: FloatArray  # Shape (F, L K): robust weights of the bins.
    # Size of the picture over the rig's, less 1, about this pixel; 0 and None if it is as it was.
    zoom: float = 0.0
    centre_px: FloatArray | None = None


def fit_drift(stripes: SeenStripes, sheets: Sequence[Sheet], laser: int | None) -> DriftFit:
    """Fit a plane to every frame, and a step of one laser, or of none, to all of them.

    `sheets`: one for each laser, as the rig has them. `laser`: the one that is assumed to have
    moved.
    """
    step = np.zeros(3)
    on_sheets = _SheetPoints.of(stripes, sheets)
    weight = on_sheets.seen.astype(np.float64)
    for i in range(_ITERATIONS):
        fit, last = _Fit.of(on_sheets, weight), step
        if laser is not None:
            step = np.clip(step - _newton_step(fit, on_sheets, laser, step), -_MAX_STEP, _MAX_STEP)
            on_sheets = on_sheets.with_laser(stripes, laser, _moved(sheets[laser], step))
        if i >= _UNWEIGHTED:
            before, weight = weight, fit.tukey(on_sheets.seen)
            if (
                np.abs(step - last).max() < _SMALL_STEP
                and np.abs(weight - before).mean() < _SMALL_CHANGE
            ):
                break
    fit = _Fit.of(on_sheets, weight)
    z = np.abs(fit.z[on_sheets.seen])
    return DriftFit(
        laser=laser,
        step=step,
        cost=float(np.mean(np.minimum(z, CUT) ** 2)),
        inliers=float(np.mean(z < CUT)),
        effect=0.0 if laser is None else fit.effect(on_sheets, laser, step),
        weight=weight,
    )


def fit_zoom(
    middles: Sequence[FloatArray], rig: Rig, along_x: IntArray, sheets: Sequence[Sheet]
) -> DriftFit:
    """Fit the size of the picture to all frames, and a plane to each.

    A lens zooms about its principal point, software about the middle of the picture; the better one
    counts. `middles`, shape (L, K, 2) each: bins of the frames from `bin_stripes`, in `image`.
    `along_x` is as there, and `sheets` are one for each laser.
    """
    from scipy import optimize  # Takes long to import, and few dives need it.

    camera, lens = rig.camera(), rig.lens
    width, height = rig.size_px

    def fit(zoom: float, centre_px: FloatArray) -> DriftFit:
        stripes = SeenStripes.of(_unzoomed(middles, zoom, centre_px), camera, along_x)
        return replace(fit_drift(stripes, sheets, None), zoom=zoom, centre_px=centre_px)

    def best(centre_px: FloatArray) -> DriftFit:
        def cost(zoom: float) -> float:
            return fit(zoom, centre_px).cost

        # Largest zoom either way, and the step of the zooms that are tried first.
        largest, step = 0.16, 0.04
        near = float(min(np.arange(-largest, largest + 1e-9, step).tolist(), key=cost))
        limits = near - step, near + step
        found = optimize.minimize_scalar(cost, bounds=limits, options={"xatol": 1e-3})
        return fit(float(found.x), centre_px)

    centres_px = np.array([[lens.cx, lens.cy], [0.5 * (width - 1), 0.5 * (height - 1)]])
    return min((best(centre_px) for centre_px in centres_px), key=lambda one: one.cost)


def _unzoomed(
    middles: Sequence[FloatArray], zoom: float, centre_px: FloatArray | None
) -> list[FloatArray]:
    """Return the bins as they would be in a picture of the rig's size."""
    if centre_px is None:
        return list(middles)
    return [centre_px + (middle - centre_px) / (1.0 + zoom) for middle in middles]


def _newton_step(
    fit: "_Fit", on_sheets: "_SheetPoints", laser: int, step: FloatArray
) -> FloatArray:
    """Return the Gauss-Newton correction (3,) of the step of one laser, to be subtracted."""
    information, right = fit.normal_equations(on_sheets, fit.own_slopes(on_sheets, laser))
    prior = _PRIOR**-2.0
    toward = np.linalg.solve(information + np.diag(prior), right + prior * step)
    return np.asarray(toward, dtype=np.float64)


def _bins_of(laser: int) -> slice:
    """Return the columns of one laser on the axis of the bins of all lasers."""
    return slice(N_BINS * laser, N_BINS * (laser + 1))


def _moved(sheet: Sheet, step: FloatArray) -> Sheet:
    """Return a sheet moved by two tilts and a shift; its other parameters stay."""
    rest = np.zeros(len(sheet.parameter_names) - len(step))
    return sheet.moved_by(np.concatenate([step, rest]))


class _SheetPoints(NamedTuple):
    """Points of the bins on the assumed sheets, in `dome`; the bins of all lasers on one axis."""

    points: FloatArray  # Shape (F, L K, 3): metres; 0 where unseen.
    per_px: FloatArray  # Shape (F, L K, 3): derivative of the points by a pixel across the stripe.
    # Shape (F, L K, 3, 3): derivative of the points by a step of their own laser.
    by_step: FloatArray
    # Shape (F, L K): whether the ray meets the sheet.
    seen: BoolArray

    @classmethod
    def of(cls, stripes: SeenStripes, sheets: Sequence[Sheet]) -> "_SheetPoints":
        """Return the points on all sheets."""
        parts = (_on_sheet(stripes, i, sheet) for i, sheet in enumerate(sheets))
        return cls._make(np.concatenate(arrays, axis=1) for arrays in zip(*parts, strict=True))

    def with_laser(self, stripes: SeenStripes, laser: int, sheet: Sheet) -> "_SheetPoints":
        """Return a copy with the points of one laser on another sheet."""
        changed = _SheetPoints._make(array.copy() for array in self)
        for array, own in zip(changed, _on_sheet(stripes, laser, sheet), strict=True):
            array[:, _bins_of(laser)] = own
        return changed


def _on_sheet(stripes: SeenStripes, laser: int, sheet: Sheet) -> _SheetPoints:
    """Return the points of one laser's K bins on a sheet."""
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
    # Rays of pixels outside the lens model, such as the corners of a fisheye's picture, are NaN,
    # which a weight of zero would not remove from a sum.
    unseen = ~seen
    per_px[unseen], by_step[unseen] = 0.0, 0.0
    return _SheetPoints(points, per_px, by_step, seen)


@dataclass(frozen=True, slots=True)
class _Fit:
    """Planes fitted to all frames, and their residuals."""

    m: FloatArray  # Shape (F, 3): planes m·X = 1 in `dome`, in 1/m.
    # Shape (F, L K): weights, 1 over the variance and less for outliers; residuals of m·X = 1, and
    # the same in sigmas.
    weight: FloatArray
    residual: FloatArray
    z: FloatArray
    # Shape (F, 3, 3): inverse of the planes' normal matrices.
    inverse: FloatArray

    @classmethod
    def of(cls, on_sheets: _SheetPoints, weight: FloatArray) -> "_Fit":
        """Fit a plane to each frame; `weight` (F, L K) is the robust weight, 0 for outliers."""
        x = on_sheets.points
        # So that a frame with outliers only still has a plane, which has no influence.
        least = _MIN_WEIGHT * on_sheets.seen
        m, _ = _planes(x, weight + least)
        per_px = np.abs(np.einsum("fbi,fi->fb", on_sheets.per_px, m))
        # Standard deviation of a bin in pixels: texture, strands, and the glow beside the sheet do
        # not average out; and unevenness of the target, as a share of the range.
        sigma_px, uneven = 0.25, 7e-4
        sigma = np.hypot(sigma_px * per_px, uneven)
        w = (weight + least) / sigma**2
        m, inverse = _planes(x, w)
        residual = np.where(on_sheets.seen, np.einsum("fbi,fi->fb", x, m) - 1.0, 0.0)
        return cls(m, w, residual, residual / sigma, inverse)

    def slopes(self, on_sheets: _SheetPoints) -> FloatArray:
        """Return the derivative (F, L K, 3) of the residuals by their own laser's step."""
        slopes: FloatArray = np.einsum("fbij,fi->fbj", on_sheets.by_step, self.m)
        return slopes

    def own_slopes(self, on_sheets: _SheetPoints, laser: int) -> FloatArray:
        """Return the derivative (F, L K, 3) of the residuals by the step of one laser."""
        slope, mine = np.zeros((*on_sheets.seen.shape, 3)), _bins_of(laser)
        slope[:, mine] = self.slopes(on_sheets)[:, mine]
        return slope

    def normal_equations(
        self, on_sheets: _SheetPoints, slope: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return normal matrix (C, C) and right side (C,) of C parameters besides the planes.

        `slope`, shape (F, L K, C), are the derivatives of the residuals by the parameters. Means
        over the frames, with the planes eliminated.
        """
        weighed = self.weight[..., None] * slope
        across = np.swapaxes(on_sheets.points, 1, 2) @ weighed
        eliminated = self.inverse @ across
        matrix = np.swapaxes(slope, 1, 2) @ weighed - np.swapaxes(across, 1, 2) @ eliminated
        right = np.einsum("fbc,fb->fc", weighed, self.residual)
        # The planes are at their minimum: their part of the right side is zero.
        return matrix.mean(axis=0), right.mean(axis=0)

    def tukey(self, seen: BoolArray) -> FloatArray:
        """Return Tukey's weights of the residuals (F, L K); 0 where unseen."""
        scale = max(1.0, 1.4826 * float(np.median(np.abs(self.z[seen]))))
        return np.maximum(1.0 - (self.z / (TUKEY * scale)) ** 2, 0.0) ** 2 * seen

    def effect(self, on_sheets: _SheetPoints, laser: int, step: FloatArray) -> float:
        """Return the rms shift of a laser's stripe off the targets by a step, over the range."""
        mine = _bins_of(laser)
        off = self.slopes(on_sheets)[:, mine] @ step
        return float(np.sqrt(np.mean(off[on_sheets.seen[:, mine]] ** 2)))


def _planes(x: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit m (F, 3) of m·X = 1 to points (F, N, 3) with weights (F, N).

    Return also the inverse of the normal matrices (F, 3, 3).
    """
    weighed = w[..., None] * x
    normal = np.swapaxes(x, 1, 2) @ weighed
    # Points of one laser alone leave the rotation of the plane about their line undetermined.
    ridge = _RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = np.asarray(np.linalg.inv(normal + ridge), dtype=np.float64)
    return (inverse @ weighed.sum(axis=1)[..., None])[..., 0], inverse


# Frames in the fit; when there are twice as many, every other one is dropped.
_MAX_FRAMES = 24
_MIN_FRAMES = 5
# Least share of inliers of a hypothesis: flat targets, or a laser that has moved.
_EXPLAINED = 0.6
# Least significance of a fault, in sigmas.
_SIGNIFICANT = 5.0
# Another laser is excluded if its cost (mean square in sigmas) is higher by this value plus the
# first share; no laser has moved unless the cost without a move is higher by this value plus the
# second share.
_WORSE_COST, _WORSE_SHARE, _WORSE_SHARE_OF_NONE = 0.1, 0.1, 0.3


class AgreementState(StrEnum):
    """Agreement of the lasers; the value is written to `run.yaml`."""

    AGREE = "agree"
    DRIFTED = "drifted"
    """One laser has moved, and it is known which."""
    DISAGREE = "disagree"
    """One laser has moved, but it could be one of several, or the picture is zoomed."""
    ZOOMED = "zoomed"
    """The picture is larger or smaller than the rig's calibration predicts."""
    NOT_FLAT = "not_flat"
    """The targets are not flat enough to say."""
    NOT_CHECKED = "not_checked"
    """Too few frames show a stripe of every laser."""


@dataclass(frozen=True, slots=True)
class AgreementVerdict:
    """The verdict on the lasers: their agreement, and the suspects if they disagree."""

    state: AgreementState
    n_frames: int  # Frames that the verdict is based on.
    # Indices of the lasers one of which has moved, the likeliest first.
    suspects: tuple[int, ...] = ()
    # Names of the suspects.
    names: tuple[str, ...] = ()
    # Turn of the first suspect and its standard deviation, in radians; NaN without suspects.
    angle: float = math.nan
    sigma_angle: float = math.nan
    # Its shift along the normal of its plane, in metres; NaN without suspects.
    shift: float = math.nan
    # Rms distance of its stripe from the targets, as a share of the range; NaN without suspects.
    effect: float = math.nan
    # Size of the picture over that of the rig's camera, less 1; 0 where it is not in doubt.
    zoom: float = 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as written to `run.yaml`."""
        found: dict[str, Any] = {"state": self.state.value, "n_frames": self.n_frames}
        if self.suspects:
            found["suspects"] = list(self.names)
            found["angle_deg"] = round(math.degrees(self.angle), 3)
            found["sigma_angle_deg"] = round(math.degrees(self.sigma_angle), 3)
            found["off_range_share"] = round(self.effect, 5)
        if self.zoom:
            found["zoom_percent"] = round(100.0 * self.zoom, 1)
        words = self.sentence()
        return found | {"words": words} if words else found

    def sentence(self) -> str:
        """Return the fault and its remedy as text; empty if there is none."""
        if not self.suspects and not self.zoom:
            return ""
        size = f"{abs(self.zoom):.1%} {'larger' if self.zoom > 0.0 else 'smaller'}"
        zoomed = f"the picture is {size} than the rig's calibration predicts"
        settings = "set zoom, stabilisation and field of view as they were for its calibration"
        if self.state is AgreementState.ZOOMED:
            return f"{zoomed}: {settings}, or recalibrate with 'aqualvs calibrate camera'"
        pairs = zip(self.suspects, self.names, strict=True)
        named = " or ".join(f"laser {i + 1} ({name})" for i, name in pairs)
        # A laser may be pushed aside without a turn.
        turned = self.angle > 2.0 * self.sigma_angle
        far = f"{math.degrees(self.angle):.2g} deg" if turned else f"{1e3 * abs(self.shift):.2g} mm"
        off = f"{named} is off by {far}"
        remedy = "recalibrate with 'aqualvs calibrate lasers'"
        if self.state is AgreementState.DRIFTED:
            share = f"{self.effect:.1%} of the range"
            return f"{off} (its stripe lies {share} off the others' plane): {remedy}"
        if self.zoom:
            return f"the lasers disagree: {off} or so ({remedy}), or {zoomed} ({settings})"
        return f"the lasers disagree: {off} or so: {remedy}"


class LaserAgreement:
    """Monitor of the agreement of a rig's lasers over a dive.

    The rig's uncertainty counts: a disagreement within that of its calibration is no fault.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._camera = rig.camera()
        self._known = rig_uncertainty(rig)
        axes = [band.axis for band in plan_bands(rig, self._camera)]
        self._along_x = np.array([axis is SearchAxis.ALONG_X for axis in axes], np.int64)
        self._middles: dict[int, FloatArray] = {}
        # One frame in this many is sampled; at first in 3: neighbouring frames are about the same.
        self._every = 3
        self._verdict: AgreementVerdict | None = None

    @property
    def n_lasers(self) -> int:
        """Number of lasers of the rig."""
        return len(self._along_x)

    def add(self, scan: Scan) -> None:
        """Add a frame; frames without a posture, and all but a sample of the others, are skipped.

        Frames are sampled by their index, so that the parts of a dive, added separately, sample the
        same frames as the whole dive.
        """
        if not scan.posture or scan.index % self._every or len(self._along_x) < 2:
            return
        m = scan.posture.normal_in_dome / scan.posture.range
        middles = bin_stripes(scan.points, m, self._along_x, self._rig.size_px)
        # Least number of bins with a stripe that every laser must have for a frame to count.
        min_bins = 4
        if np.isfinite(middles[..., 0]).sum(axis=1).min() >= min_bins:
            self._sample({scan.index: middles})

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the sampled frames as arrays, for `extend`."""
        shape = (len(self._middles), len(self._along_x), N_BINS, 2)
        return {
            "every": np.array(self._every),
            "frames": np.array(list(self._middles), np.int64),
            "middles": np.array(list(self._middles.values())).reshape(shape),
        }

    def extend(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Add the frames that another monitor of the same rig has sampled, from `arrays`."""
        self._every = max(self._every, int(arrays["every"]))
        frames = arrays["frames"].tolist()
        self._sample(dict(zip(frames, arrays["middles"], strict=True)))

    def _sample(self, middles: Mapping[int, FloatArray]) -> None:
        """Add frames to the sample; while it is too large, drop every other one."""
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
            self._verdict = self._compute_verdict()
        return self._verdict

    def _compute_verdict(self) -> AgreementVerdict:
        """Compare the fits without a move and with a move of each laser."""
        thinning = max(1, math.ceil(len(self._middles) / _MAX_FRAMES))
        middles = list(self._middles.values())[::thinning]
        n_frames = len(middles)
        if n_frames < _MIN_FRAMES:
            return AgreementVerdict(AgreementState.NOT_CHECKED, n_frames)
        stripes = SeenStripes.of(middles, self._camera, self._along_x)
        sheets = sheets_of(self._rig)
        none = fit_drift(stripes, sheets, None)
        found = sorted(
            (fit_drift(stripes, sheets, laser) for laser in range(len(sheets))),
            key=lambda one: one.cost,
        )
        best = found[0]
        if not _is_worse(none, best, _WORSE_SHARE_OF_NONE):
            return _no_alarm(none, n_frames)
        covariance = self.covariance(best, middles)
        is_significant = _is_significant(best, covariance)
        # A zoom moves the stripes of one laser more than the others', so that one seems to be off.
        zoomed = fit_zoom(middles, self._rig, self._along_x, sheets)
        zoom = zoomed.zoom if _explains(zoomed, best) else 0.0
        if zoom and abs(zoom) < _SIGNIFICANT * math.sqrt(self.covariance(zoomed, middles)[0, 0]):
            return AgreementVerdict(AgreementState.AGREE, n_frames)
        if zoom and (zoomed.cost < best.cost or not is_significant):
            return AgreementVerdict(AgreementState.ZOOMED, n_frames, zoom=zoom)
        if not is_significant:
            return _no_alarm(best, n_frames)
        # A larger turn means a bent target: a laser so far off would show next to nothing.
        unlikely = math.radians(5.0)
        if best.inliers < _EXPLAINED or float(np.linalg.norm(best.step[:2])) > unlikely:
            return AgreementVerdict(AgreementState.NOT_FLAT, n_frames)
        suspects = [one for one in found if one is best or not _is_worse(one, best)]
        if len(suspects) == len(found) > 2:
            # If each of three lasers or more could have moved, none has: the target is no plane.
            return AgreementVerdict(AgreementState.NOT_FLAT, n_frames)
        return self._drift_verdict(suspects, covariance, n_frames, zoom)

    def _drift_verdict(
        self, suspects: list[DriftFit], covariance: FloatArray, n_frames: int, zoom: float
    ) -> AgreementVerdict:
        """Return the verdict that one of the suspects has moved, the likeliest first, or a zoom."""
        best = suspects[0]
        numbers = tuple(one.laser for one in suspects if one.laser is not None)
        tilt = best.step[:2]
        angle = float(np.linalg.norm(tilt))
        is_sure = len(suspects) == 1 and not zoom
        state = AgreementState.DRIFTED if is_sure else AgreementState.DISAGREE
        return AgreementVerdict(
            state=state,
            n_frames=n_frames,
            suspects=numbers,
            names=tuple(self._rig.lasers[i].name for i in numbers),
            angle=angle,
            sigma_angle=math.sqrt(float(tilt @ covariance[:2, :2] @ tilt)) / angle,
            shift=float(best.step[2]),
            effect=best.effect,
            zoom=zoom,
        )

    def covariance(self, found: DriftFit, middles: Sequence[FloatArray]) -> FloatArray:
        """Return the covariance of a laser's step (3, 3), or of a zoom (1, 1).

        By errors of the stripes, which are the same in all frames, and of the rig's numbers.
        """

        def trace(rig: Rig, zoom: float) -> _SheetPoints:
            places = _unzoomed(middles, zoom, found.centre_px)
            sheets = list(sheets_of(rig))
            if found.laser is not None:
                sheets[found.laser] = _moved(sheets[found.laser], found.step)
            return _SheetPoints.of(SeenStripes.of(places, rig.camera(), self._along_x), sheets)

        def change(rig: Rig, zoom: float) -> FloatArray:
            other = trace(rig, zoom)
            moved = np.einsum("fbi,fi->fb", other.points - points.points, fit.m)
            return np.asarray((moved * (points.seen & other.seen))[..., None], np.float64)

        points = trace(self._rig, found.zoom)
        fit, step = _Fit.of(points, found.weight), 1e-3
        if found.laser is None:
            own, prior = change(self._rig, found.zoom + step) / step, np.zeros(1)
        else:
            own, prior = fit.own_slopes(points, found.laser), _PRIOR**-2.0
        sigmas = {name: sigma for name, sigma in self._known.sigmas.items() if sigma > 0.0}
        moved = (rig_moved_by(self._rig, (name,), np.array([s])) for name, s in sigmas.items())
        by_rig = [change(rig, found.zoom) for rig in moved]
        information, _ = fit.normal_equations(points, np.concatenate([own, *by_rig], axis=-1))
        n, scale = len(prior), np.array(list(sigmas.values()))
        covariance = np.linalg.inv(information[:n, :n] + np.diag(prior))
        by_errors = covariance @ information[:n, n:] / scale
        known = self._known.of(list(sigmas))
        return np.asarray(covariance + by_errors @ known @ by_errors.T, np.float64)


def _is_significant(found: DriftFit, covariance: FloatArray) -> bool:
    """Return whether the step of a laser is significant, and large enough to matter."""
    step = found.step
    sigmas = math.sqrt(float(step @ np.linalg.solve(covariance, step)))
    # Least turn in radians, or least effect.
    angle, effect = math.radians(0.15), 0.005
    matters = found.effect > effect or float(np.linalg.norm(step[:2])) > angle
    return sigmas > _SIGNIFICANT and matters


def _no_alarm(found: DriftFit, n_frames: int) -> AgreementVerdict:
    """Return the verdict without suspects: the lasers agree, or the targets are not flat."""
    flat = found.inliers >= _EXPLAINED
    return AgreementVerdict(AgreementState.AGREE if flat else AgreementState.NOT_FLAT, n_frames)


def _explains(zoomed: DriftFit, best: DriftFit) -> bool:
    """Return whether a zoom explains the frames about as well as the best of the lasers."""
    # Least zoom: one of 3 % moves the range by 0.3 % with lasers like those of the example rig.
    matters = abs(zoomed.zoom) > 0.01
    # It is one number, a laser's step three.
    as_good = not _is_worse(zoomed, best, _WORSE_SHARE_OF_NONE)
    return matters and as_good and zoomed.inliers >= _EXPLAINED


def _is_worse(one: DriftFit, best: DriftFit, share: float = _WORSE_SHARE) -> bool:
    """Return whether a hypothesis costs clearly more than the best one."""
    return one.cost - best.cost > _WORSE_COST + share * best.cost
