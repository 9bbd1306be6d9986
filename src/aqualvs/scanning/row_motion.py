"""Correction of postures for the motion from row to row of a rolling shutter, and blur named.

Every stripe point is seen at the time of its row, so that a posture is off by its `by_motion` times
the rates and accelerations of range, pitch and yaw. These come from the frames beside it, with the
frames' own errors by them: in frame j, at time t from the frame that is corrected,

    measured_j = posture + t rates + t²/2 acceleration
                 + by_motion_j (rates + t acceleration, acceleration) + e_j.

Frames beside it never smooth a posture: it is moved by its `by_motion` times both, no more.
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
from aqualvs.scanning.posture import Posture, Reason, Refusal, range_pitch_yaw
from aqualvs.scanning.scan import GyroRates, Scan

REACH = 2
"""Frames to each side that tell the rates of a frame."""

# Frames further away tell little of the rates now.
_REACH_S = 0.25
# Standard deviations of a small vehicle's motion near a net, before anything is measured: of the
# rates of range, pitch and yaw (m/s, rad/s), of their changes (m/s², rad/s²), and of the changes of
# these (m/s³, rad/s³): swings of 2 s.
_RATES = np.array([0.3, np.deg2rad(20.0), np.deg2rad(20.0)])
_ACCELERATIONS = np.array([0.5, np.deg2rad(40.0), np.deg2rad(40.0)])
_JERKS = np.array([1.5, np.deg2rad(120.0), np.deg2rad(120.0)])
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

    def stilled(self, candidates: Candidates, on_target: BoolArray, plane: Plane) -> Candidates:
        """Return candidates without the motion that one frame shows.

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
        return replace(candidates, points=still)

    def as_exposed(
        self,
        posture: Posture,
        surface: FittedSurface,
        still: Candidates,
        seen: Candidates,
        weights: FloatArray,
    ) -> Posture:
        """Return the posture to `stilled` candidates as that to the candidates themselves.

        It has `by_motion`, and how `stilled` moved the points is no longer in it.

        Parameters
        ----------
        posture : Posture
        surface : FittedSurface
            Surface of the posture.
        still, seen : Candidates
            N of them, to which it was fitted, and as they were before.
        weights : array, shape (N,)
            1 over the variance of the residual, or 0.
        """
        m = posture.normal_in_dome / posture.range
        terms = surface.terms * weights[:, None]
        matrix = terms.T @ surface.terms + np.diag(surface.prior)
        # At its time t a point lies on the plane m + t rate + t²/2 acceleration, and so off m by
        # the rest times X. An exposure shows the mean of its own times.
        t = self._times(seen.pixels)[:, None]
        half_square = 0.5 * (t**2 + self._shutter.exposure**2 / 12.0)
        back = (seen.points - still.points) @ m
        moved = terms.T @ np.hstack([seen.points * t, seen.points * half_square, -back[:, None]])
        scale = float(np.linalg.norm(surface.normal) / np.linalg.norm(m))
        by_m = _by_m(m)
        m_moved = -scale * np.linalg.solve(by_m, surface.posture @ np.linalg.solve(matrix, moved))
        m = m + m_moved[:, 6]
        by_m = _by_m(m)
        to_m = np.linalg.inv(by_m)
        by_motion = by_m @ np.hstack([m_moved[:, :3] @ to_m, m_moved[:, 3:6] @ to_m])
        return replace(self._on(posture, m), by_motion=by_motion)

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
        by_motion = posture.by_motion
        if by_motion is None:
            return scan
        motion, covariance = motion_beside(scan, beside)
        m, m_rate = _at_middle(posture, by_motion, motion)
        off = self._off_by_light(motion[:3], posture.range)
        corrected = replace(
            self._on(posture, m),
            covariance=posture.covariance
            + by_motion @ covariance @ by_motion.T
            + np.outer(off, off),
        )
        points, seen = scan.points, scan.points.points_in_dome
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
        numbers = posture.numbers + by
        distance, pitch, yaw = numbers.tolist()
        normal = distance * _plane_of(numbers)
        approach = float(normal @ self._axis_in_dome)
        return replace(
            posture,
            range=distance,
            pitch=pitch,
            yaw=yaw,
            normal_in_dome=normal,
            slant_range=distance / approach if approach > 0.0 else float("inf"),
            by_motion=None,
        )

    def _off_by_light(self, rates: FloatArray, distance: float) -> FloatArray:
        """Return the error (3,) of a posture by light that changes during the exposure.

        Stripes are brighter while the target is near, and so their mean is of another time than the
        exposure's middle.
        """
        # Of the distance, by which light falls: a sheet spreads, its stripe is seen smaller, and
        # water dims it to and fro.
        power = 3.0
        late = power * rates[0] / distance * self._shutter.exposure**2 / 12.0
        error: FloatArray = late * rates
        return error

    def _on(self, posture: Posture, m: FloatArray) -> Posture:
        """Return a posture as that to the plane m·X = 1."""
        return self.moved(posture, np.array(range_pitch_yaw(m)) - posture.numbers)

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


def motion_beside(scan: Scan, beside: Sequence[Scan]) -> tuple[FloatArray, FloatArray]:
    """Return the motion (6,) at a scan, and its covariance (6, 6).

    It is the rates of range, pitch and yaw, then their accelerations.

    Parameters
    ----------
    scan : Scan
        As the scanner measured it, with a posture.
    beside : sequence of Scan
        As in `RowMotion.correct`.
    """
    posture = scan.posture
    if not isinstance(posture, Posture) or posture.by_motion is None:
        raise ValueError(f"frame {scan.index}: no posture as its rows were exposed")
    # Unknowns: posture and motion, relative to the scan's own measurement, and how accelerations
    # change, of which the error during a picture is nothing.
    matrix, right, one_each = np.zeros((12, 12)), np.zeros(12), np.eye(3)
    prior = np.concatenate([_RATES, _ACCELERATIONS, _JERKS]) ** -2.0
    matrix[range(3, 12), range(3, 12)] = prior
    # A frame whose squared Mahalanobis distance is larger (once in 1000 times by chance, 3 values)
    # shows another surface, or is wrong.
    gate = 16.27
    for one in (scan, *beside):
        found, t = one.posture, one.time_s - scan.time_s
        if not isinstance(found, Posture) or found.by_motion is None or abs(t) > _REACH_S:
            continue
        off = found.numbers - posture.numbers
        by_rates = found.by_motion[:, :3] + t * one_each
        by_accelerations = found.by_motion[:, 3:]
        by_jerks = t * by_accelerations + 0.5 * t**2 * by_rates - t**3 / 3.0 * one_each
        by_accelerations = by_accelerations + t * by_rates - 0.5 * t**2 * one_each
        by = np.hstack([one_each, by_rates, by_accelerations, by_jerks])
        # Of the difference between the two, in which their common error is not.
        of_both = by[:, 3:].copy()
        of_both[:, :6] -= posture.by_motion
        expected = found.covariance + posture.covariance + (of_both / prior) @ of_both.T
        if one is not scan and off @ np.linalg.solve(expected, off) > gate:
            continue
        weighed = by.T @ np.linalg.inv(found.covariance)
        matrix += weighed @ by
        right += weighed @ off
    covariance = np.asarray(np.linalg.inv(matrix), np.float64)
    motion, covariance = (covariance @ right)[3:9], covariance[3:9, 3:9]
    if scan.turning is None:
        return motion, covariance
    return _with_gyros(motion, covariance, posture, scan.turning)


def _with_gyros(
    motion: FloatArray, covariance: FloatArray, posture: Posture, turning: GyroRates
) -> tuple[FloatArray, FloatArray]:
    """Return a motion and its covariance as gyros change them."""
    m = posture.normal_in_dome / posture.range
    # A target that stands still turns against the vehicle; its distance does not change by that.
    by_turning = (_by_m(m) @ np.cross(m, np.eye(3)).T)[1:]
    angles = slice(1, 3)
    off = by_turning @ turning.rates - motion[angles]
    expected = covariance[angles, angles] + turning.sigma**2 * by_turning @ by_turning.T
    # A squared Mahalanobis distance that is larger once in 1000 times by chance, of 2 values: the
    # target moves by itself, or the gyros are not the vehicle's.
    gate = 13.82
    if not off @ np.linalg.solve(expected, off) <= gate:
        return motion, covariance
    gain = np.linalg.solve(expected, covariance[angles]).T
    return motion + gain @ off, covariance - gain @ covariance[angles]


def _at_middle(
    posture: Posture, by_motion: FloatArray, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the plane m·X = 1 at the picture's middle, and the rate of m.

    Rows that show it moving give a plane that is off by constants times rate and acceleration of m.
    Range, pitch and yaw are not so simple: a plane that leans by 1.3 degrees, as by 0.3 m/s, is
    nearer by 0.03 %.
    """
    exposed = posture.normal_in_dome / posture.range
    by_m = _by_m(exposed)
    m_by_rate, m_by_acceleration = (
        np.linalg.solve(by_m, one @ by_m) for one in np.hsplit(by_motion, 2)
    )
    rates, accelerations = np.split(motion, 2)
    m, step = exposed, 0.01
    # The motion of m depends on m itself; each round leaves 2 % of the error.
    rounds = 2
    for _ in range(rounds):
        now = np.array(range_pitch_yaw(m))
        before, after = (
            _plane_of(now + t * rates + 0.5 * t**2 * accelerations) for t in (-step, step)
        )
        m_rate = (after - before) / (2.0 * step)
        m_acceleration = (after - 2.0 * m + before) / step**2
        m = exposed - m_by_rate @ m_rate - m_by_acceleration @ m_acceleration
    return m, m_rate


def _plane_of(numbers: FloatArray) -> FloatArray:
    """Return m of range, pitch and yaw, in m and rad."""
    distance, pitch, yaw = numbers.tolist()
    toward = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
    m: FloatArray = toward / (distance * np.linalg.norm(toward))
    return m


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
