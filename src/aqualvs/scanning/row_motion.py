"""Correction of postures for the motion from row to row of a rolling shutter, and blur named.

Every stripe point is seen at the time of its row, so that a posture is off by its `by_rates` times
the rates of range, pitch and yaw. The rates come from the frames beside it, with the frames' own
errors by them: in frame j, at time t from the frame that is corrected,

    measured_j = posture + t rates + t²/2 acceleration + by_rates_j (rates + t acceleration) + e_j.

Frames beside it never smooth a posture: it is moved by its `by_rates` times the rates, no more.
Gyros, where they are known, tell the rates of pitch and yaw too: most of all of a lone frame.

The points of one frame alone tell the rates too, but worse: they bend and twist a plane. That is
enough to take the motion out of the scatter, before surfaces are fitted and sigmas are found.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.rig_covariance import FittedSurface, posture_by_plane
from aqualvs.scanning.candidates import Candidates
from aqualvs.scanning.plane_fit import TUKEY
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Scan, Turning

REACH = 2
"""Frames to each side that tell the rates of a frame."""

# Frames further away tell little of the rates now.
_REACH_S = 0.25
# Standard deviations of a small vehicle's motion near a net, before anything is measured: of the
# rates of range, pitch and yaw (m/s, rad/s), and of their changes (m/s², rad/s²).
_RATES = np.array([0.3, np.deg2rad(20.0), np.deg2rad(20.0)])
_ACCELERATIONS = np.array([0.5, np.deg2rad(40.0), np.deg2rad(40.0)])
# Some of the points are enough for it. They share the errors of their stripe: all together they
# count as fewer still, so that a rate of which one frame tells little, such as that of the range,
# stays near zero.
_ENOUGH, _INDEPENDENT = 200, 30.0
# Blur explains these reasons where the vehicle turns by more during an exposure: rendered nets at
# 480 mm, meshes of 25 mm, were refused from 2.7 degrees on, and none up to 1.9.
_BLURRED = np.deg2rad(2.5)
_BY_BLUR = (Reason.NO_STRIPES, Reason.TOO_FEW_POINTS, Reason.ONE_LASER, Reason.NOT_A_PLANE)


class RowMotion:
    """Motion during the pictures of one rig, from row to row and during the exposure.

    Parameters
    ----------
    rig : Rig
        With a shutter that `needs_neighbours`.
    """

    def __init__(self, rig: Rig) -> None:
        self._shutter, self._height = rig.shutter, rig.size_px[1]
        self._axis_in_dome = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])

    def stilled(
        self, candidates: Candidates, on_target: BoolArray, plane: Plane
    ) -> tuple[Candidates, FloatArray]:
        """Return candidates without the motion that one frame shows, and its rates (3,).

        Parameters
        ----------
        candidates : Candidates
            N of them.
        on_target : bool array, shape (N,)
            Candidates on the target.
        plane : Plane
            Of the target, roughly.
        """
        seen = np.flatnonzero(on_target)
        seen = seen[:: -(-len(seen) // _ENOUGH)]
        times, m = self._times(candidates.pixels), plane.normal / plane.offset
        sigma = np.abs(candidates.sensitivity[seen] @ m) * candidates.sigma_px[seen] + 1e-12
        m, m_rate = _fit_rates(candidates.points[seen], sigma, times[seen], m)
        still = candidates.points - times[:, None] * _velocity(m, m_rate, candidates.points)
        return replace(candidates, points=still), _by_m(m) @ m_rate

    def as_exposed(
        self,
        posture: Posture,
        surface: FittedSurface,
        candidates: Candidates,
        weights: FloatArray,
        rates: FloatArray,
    ) -> Posture:
        """Return the posture to `stilled` candidates as that to the candidates themselves.

        It has `by_rates`, and the noise of `rates` is no longer in it.

        Parameters
        ----------
        posture : Posture
        surface : FittedSurface
            Surface of the posture.
        candidates : Candidates
            N of them, to which it was fitted.
        weights : array, shape (N,)
            1 over the variance of the residual, or 0.
        rates : array, shape (3,)
            From `stilled`.
        """
        m = posture.normal_in_dome / posture.range
        terms = surface.terms * weights[:, None]
        matrix = terms.T @ surface.terms + np.diag(surface.prior)
        # At its time t a point lies on the plane m + t rate, and so off m by -t rate·X.
        moved = terms.T @ (candidates.points * self._times(candidates.pixels)[:, None])
        scale = float(np.linalg.norm(surface.normal) / np.linalg.norm(m))
        by_m_rate = -scale * surface.posture @ np.linalg.solve(matrix, moved)
        by_rates: FloatArray = by_m_rate @ np.linalg.inv(_by_m(m))
        return replace(self.moved(posture, by_rates @ rates), by_rates=by_rates)

    def correct(self, scan: Scan, beside: Sequence[Scan]) -> Scan:
        """Return a scan with posture and points as they are at the picture's middle.

        Points move as the target does if it turns about the dome's centre: how it slides along
        itself, or rolls, no posture tells. Their pixels stay as seen.

        Parameters
        ----------
        scan : Scan
            As the scanner measured it; without a posture, its reason is `BLURRED` where the frames
            beside it say so.
        beside : sequence of Scan
            Scans just before and after, as measured; in a live run, those before alone.
        """
        posture = scan.posture
        if isinstance(posture, Refusal):
            return replace(scan, posture=self._with_blur_named(scan, posture, beside))
        if posture.by_rates is None:
            return scan
        rates, covariance = rates_beside(scan, beside)
        corrected = replace(
            self.moved(posture, -posture.by_rates @ rates),
            covariance=posture.covariance + posture.by_rates @ covariance @ posture.by_rates.T,
        )
        points, seen = scan.points, scan.points.points_in_dome
        m = posture.normal_in_dome / posture.range
        m_rate: FloatArray = np.linalg.inv(_by_m(m)) @ rates
        velocity = _velocity(m, m_rate, seen)
        moved = seen - self._times(points.pixels)[:, None] * velocity
        if points.used.any():
            nearest = float(np.linalg.norm(moved[points.used], axis=1).min())
            corrected = replace(corrected, nearest=nearest)
        return replace(scan, posture=corrected, points=replace(points, points_in_dome=moved))

    def _with_blur_named(self, scan: Scan, refusal: Refusal, beside: Sequence[Scan]) -> Refusal:
        """Return a refusal with the reason `BLURRED` if the vehicle turned too fast."""
        near = [one for one in beside if one.posture and abs(one.time_s - scan.time_s) < _REACH_S]
        near.sort(key=lambda one: abs(one.time_s - scan.time_s))
        if refusal.reason not in _BY_BLUR or len(near) < 2:
            return refusal
        (one, t), (other, u) = ((scan.posture, scan.time_s) for scan in near[:2])
        if not (isinstance(one, Posture) and isinstance(other, Posture) and t != u):
            return refusal
        exposure = self._shutter.exposure
        turned = float(np.hypot(*(other.numbers - one.numbers)[1:])) / abs(u - t) * exposure
        if turned < _BLURRED:
            return refusal
        return Refusal(
            Reason.BLURRED,
            f"turned by {np.rad2deg(turned):.1f} deg in {1e3 * exposure:.0f} ms of exposure: "
            f"{refusal.detail}",
        )

    def moved(self, posture: Posture, by: FloatArray) -> Posture:
        """Return a posture with a change (3,) of range, pitch and yaw, in m and rad."""
        distance, pitch, yaw = (posture.numbers + by).tolist()
        normal = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
        normal /= np.linalg.norm(normal)
        approach = float(normal @ self._axis_in_dome)
        return replace(
            posture,
            range=distance,
            pitch=pitch,
            yaw=yaw,
            normal_in_dome=normal,
            slant_range=distance / approach if approach > 0.0 else float("inf"),
            by_rates=None,
        )

    def _times(self, pixels: FloatArray) -> FloatArray:
        return self._shutter.row_times(pixels[:, 1], self._height)


def _fit_rates(
    points: FloatArray, sigma: FloatArray, times: FloatArray, m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the plane m·X = 1 at time 0 and the rate of m, from points (N, 3) at their times.

    Parameters
    ----------
    points, sigma, times : array, shape (N, 3), (N,), (N,)
        In `dome` (m); standard deviations of m·X; seconds.
    m : array, shape (3,)
        A first m.
    """
    terms = np.hstack([points, points * times[:, None]])
    prior, both = np.zeros((6, 6)), np.concatenate([m, np.zeros(3)])
    scaled = _by_m(m) / _RATES[:, None]
    prior[3:, 3:] = scaled.T @ scaled
    reweights = 3
    for _ in range(reweights):
        z = (terms @ both - 1.0) / sigma
        # NumPy's median takes several times as long.
        middle = float(np.partition(np.abs(z), len(z) // 2)[len(z) // 2])
        scale = max(1.4826 * middle, 0.1)
        weights = (np.maximum(1.0 - (z / (TUKEY * scale)) ** 2, 0.0) / (sigma * scale)) ** 2
        weighted = terms.T * (weights * min(_INDEPENDENT / len(points), 1.0))
        both = np.linalg.solve(weighted @ terms + prior, weighted.sum(axis=1))
    return both[:3], both[3:]


def rates_beside(scan: Scan, beside: Sequence[Scan]) -> tuple[FloatArray, FloatArray]:
    """Return the rates (3,) of range, pitch and yaw at a scan, and their covariance (3, 3).

    Parameters
    ----------
    scan : Scan
        As the scanner measured it, with a posture.
    beside : sequence of Scan
        As in `RowMotion.correct`.
    """
    posture = scan.posture
    if not isinstance(posture, Posture) or posture.by_rates is None:
        raise ValueError(f"frame {scan.index}: no posture as its rows were exposed")
    # Unknowns: posture, rates, accelerations, relative to the scan's own measurement.
    matrix, right = np.zeros((9, 9)), np.zeros(9)
    prior = np.concatenate([_RATES, _ACCELERATIONS]) ** -2.0
    matrix[range(3, 9), range(3, 9)] = prior
    # A frame whose squared Mahalanobis distance is larger (once in 1000 times by chance, 3 values)
    # shows another surface, or is wrong.
    gate = 16.27
    for one in (scan, *beside):
        found, t = one.posture, one.time_s - scan.time_s
        if not isinstance(found, Posture) or found.by_rates is None or abs(t) > _REACH_S:
            continue
        off = found.numbers - posture.numbers
        by = np.hstack([np.eye(3), t * np.eye(3) + found.by_rates])
        by = np.hstack([by, 0.5 * t**2 * np.eye(3) + t * found.by_rates])
        # Of the difference between the two, in which their common error is not.
        by_motion = by[:, 3:].copy()
        by_motion[:, :3] -= posture.by_rates
        expected = found.covariance + posture.covariance + (by_motion / prior) @ by_motion.T
        if one is not scan and off @ np.linalg.solve(expected, off) > gate:
            continue
        weighed = by.T @ np.linalg.inv(found.covariance)
        matrix += weighed @ by
        right += weighed @ off
    covariance = np.asarray(np.linalg.inv(matrix), np.float64)
    rates, covariance = (covariance @ right)[3:6], covariance[3:6, 3:6]
    if scan.turning is None:
        return rates, covariance
    return _with_gyros(rates, covariance, posture, scan.turning)


def _with_gyros(
    rates: FloatArray, covariance: FloatArray, posture: Posture, turning: Turning
) -> tuple[FloatArray, FloatArray]:
    """Return rates of range, pitch and yaw and their covariance, as gyros change them."""
    m = posture.normal_in_dome / posture.range
    # A target that stands still turns against the vehicle; its distance does not change by that.
    by_turning = (_by_m(m) @ np.cross(m, np.eye(3)).T)[1:]
    off = by_turning @ turning.rates - rates[1:]
    expected = covariance[1:, 1:] + turning.sigma**2 * by_turning @ by_turning.T
    # A squared Mahalanobis distance that is larger once in 1000 times by chance, of 2 values: the
    # target moves by itself, or the gyros are not the vehicle's.
    gate = 13.82
    if not off @ np.linalg.solve(expected, off) <= gate:
        return rates, covariance
    gain = np.linalg.solve(expected, covariance[1:]).T
    return rates + gain @ off, covariance - gain @ covariance[1:]


def _velocity(m: FloatArray, m_rate: FloatArray, points: FloatArray) -> FloatArray:
    """Return the velocities (N, 3) of points (N, 3) that turn and move with the plane m·X = 1."""
    distance = float(1.0 / np.linalg.norm(m))
    normal = m * distance
    along = float(normal @ m_rate)
    turned = distance * (m_rate - along * normal)
    turn = np.outer(normal, turned)
    velocity: FloatArray = points @ (turn - turn.T) - along * distance**2 * normal
    return velocity


def _by_m(m: FloatArray) -> FloatArray:
    """Return the derivatives (3, 3) of range, pitch and yaw by m."""
    by_m = np.empty((3, 3))
    posture_by_plane(m, by_m)
    return by_m
