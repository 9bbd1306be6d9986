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

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel
from aqualvs.geometry.linear_algebra import (
    cholesky,
    cholesky_inverse,
    cholesky_solve,
    lower_quantile,
)
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
_REWEIGHTS = 3
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
        return candidates._replace(points=_moved_back(candidates.points, times, m, m_rate))

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
        matrix, moved = np.diag(surface.prior), np.zeros((len(surface.prior), 7))
        # An exposure shows the mean of its own times.
        spread = self._shutter.exposure**2 / 12.0
        times, terms = self._times(seen.pixels), np.ascontiguousarray(surface.terms)
        _sum_up(terms, weights, seen.points, still.points, times, spread, m, matrix, moved)
        scale = float(np.linalg.norm(surface.normal) / np.linalg.norm(m))
        by_m = posture_by_plane(m)
        m_moved = -scale * np.linalg.solve(by_m, surface.posture @ np.linalg.solve(matrix, moved))
        m = m + m_moved[:, 6]
        by_m = posture_by_plane(m)
        to_m = np.linalg.inv(by_m)
        by_motion = np.empty((3, 6))
        by_motion[:, :3] = by_m @ m_moved[:, :3] @ to_m
        by_motion[:, 3:] = by_m @ m_moved[:, 3:6] @ to_m
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
        points = scan.points
        moved = _moved_back(points.points_in_dome, self._times(points.pixels), m, m_rate)
        if points.used.any():
            near = moved[points.used]
            nearest = math.sqrt(float(np.einsum("ij,ij->i", near, near).min()))
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
    prior, both = np.zeros((6, 6)), np.concatenate([m, np.zeros(3)])
    scaled = posture_by_plane(m) / _RATES[:, None]
    prior[3:, 3:] = scaled.T @ scaled
    share = min(_INDEPENDENT / max(len(points), 1), 1.0)
    if not _reweight(points, sigma, times, prior, share, both):
        return m, np.zeros(3)
    return both[:3], both[3:]


@kernel
def _reweight(
    points: FloatArray,
    sigma: FloatArray,
    times: FloatArray,
    prior: FloatArray,
    share: float,
    both: FloatArray,
) -> bool:
    """Fit m and its rate, one after the other in `both` (6,), with Tukey's weights times a share.

    Return False where neither points nor prior tell one of them.
    """
    n = len(points)
    z, matrix, right, term = np.empty(n), np.empty((6, 6)), np.empty(6), np.empty(6)
    for _ in range(_REWEIGHTS):
        for i in range(n):
            off = -1.0
            for k in range(3):
                off += points[i, k] * (both[k] + times[i] * both[3 + k])
            z[i] = abs(off / sigma[i])
        scale = max(1.4826 * lower_quantile(z, 0.5), 0.1)
        matrix[:], right[:] = prior, 0.0
        for i in range(n):
            far = z[i] / (TUKEY * scale)
            if not far < 1.0:
                continue
            weight = share * ((1.0 - far * far) / (sigma[i] * scale)) ** 2
            for k in range(3):
                term[k], term[3 + k] = points[i, k], points[i, k] * times[i]
            for a in range(6):
                right[a] += weight * term[a]
                for b in range(a + 1):
                    matrix[a, b] += weight * term[a] * term[b]
        if not cholesky(matrix, 0.0, 0.0, matrix):
            return False
        cholesky_solve(matrix, right, both)
    return True


@kernel
def _sum_up(
    terms: FloatArray,
    weights: FloatArray,
    seen: FloatArray,
    still: FloatArray,
    times: FloatArray,
    spread: float,
    m: FloatArray,
    matrix: FloatArray,
    moved: FloatArray,
) -> None:
    """Add the normal matrix (K, K) of N points, and what motion adds to its right side (K, 7).

    At its time t a point lies on the plane m + t rate + t²/2 acceleration, and so off m by the rest
    times X: columns for the rate, for the acceleration, and for what took points from where they
    were `seen`.

    Parameters
    ----------
    terms, weights : array, shape (N, K), (N,)
    seen, still : array, shape (N, 3)
    times : array, shape (N,)
        Middles of the exposures.
    spread : float
        Variance of the times within an exposure.
    m : array, shape (3,)
    matrix, moved : array, shape (K, K), (K, 7)
    """
    n_terms = terms.shape[1]
    for i in range(len(weights)):
        if weights[i] == 0.0:
            continue
        t = times[i]
        half_square, back = 0.5 * (t * t + spread), 0.0
        for k in range(3):
            back += (seen[i, k] - still[i, k]) * m[k]
        for a in range(n_terms):
            term = weights[i] * terms[i, a]
            for b in range(n_terms):
                matrix[a, b] += term * terms[i, b]
            for k in range(3):
                moved[a, k] += term * seen[i, k] * t
                moved[a, 3 + k] += term * seen[i, k] * half_square
            moved[a, 6] -= term * back


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
    known = [(0.0, posture, posture.by_motion)]
    for one in beside:
        found, after = one.posture, one.time_s - scan.time_s
        is_near = isinstance(found, Posture) and abs(after) <= _REACH_S
        if is_near and isinstance(found, Posture) and found.by_motion is not None:
            known.append((after, found, found.by_motion))
    motion, covariance = np.empty(12), np.empty((12, 12))
    _weigh_motions(
        np.array([after for after, _, _ in known]),
        np.array([found.numbers for _, found, _ in known]),
        np.array([found.covariance for _, found, _ in known]),
        np.array([by for _, _, by in known]),
        np.concatenate([_RATES, _ACCELERATIONS, _JERKS]) ** 2.0,
        motion,
        covariance,
    )
    motion, covariance = motion[3:9], covariance[3:9, 3:9]
    if scan.turning is None:
        return motion, covariance
    return _with_gyros(motion, covariance, posture, scan.turning)


@kernel
def _weigh_motions(
    t: FloatArray,
    numbers: FloatArray,
    covariances: FloatArray,
    by_motion: FloatArray,
    variances: FloatArray,
    motion: FloatArray,
    covariance: FloatArray,
) -> None:
    """Write posture and motion (12,) at the first of some frames, and their covariance (12, 12).

    Unknowns are the posture, relative to what the first frame measured, its rates, its
    accelerations, and how these change, of which the error during a picture is nothing.

    Parameters
    ----------
    t : array, shape (F,)
        Times from the first frame.
    numbers, covariances, by_motion : array, shape (F, 3), (F, 3, 3), (F, 3, 6)
        Range, pitch and yaw, and what belongs to them.
    variances : array, shape (9,)
        Of the motion, before anything is measured.
    motion, covariance : array
    """
    matrix, right = np.zeros((12, 12)), np.zeros(12)
    for k in range(9):
        matrix[3 + k, 3 + k] = 1.0 / variances[k]
    by, off, weighed = np.empty((3, 12)), np.empty(3), np.empty((3, 3))
    for f in range(len(t)):
        off[:] = numbers[f] - numbers[0]
        _fill_terms(t[f], by_motion[f], by)
        both = covariances[f] + covariances[0]
        agrees = f == 0 or _agree(off, by, by_motion[0], variances, both)
        if not agrees or not cholesky(covariances[f], 0.0, 0.0, weighed):
            continue
        weighed[:] = cholesky_inverse(weighed)
        for a in range(12):
            for i in range(3):
                term = 0.0
                for j in range(3):
                    term += by[j, a] * weighed[j, i]
                right[a] += term * off[i]
                for b in range(12):
                    matrix[a, b] += term * by[i, b]
    cholesky(matrix, 0.0, 0.0, matrix)
    covariance[:] = cholesky_inverse(matrix)
    cholesky_solve(matrix, right, motion)


@borrowing_kernel
def _fill_terms(t: float, by_motion: FloatArray, by: FloatArray) -> None:
    """Write the derivatives (3, 12) of what a frame measures at a time, by all unknowns."""
    for i in range(3):
        for k in range(3):
            same = 1.0 if i == k else 0.0
            rate, change = by_motion[i, k] + t * same, by_motion[i, 3 + k]
            by[i, k], by[i, 3 + k] = same, rate
            by[i, 6 + k] = change + t * rate - 0.5 * t**2 * same
            by[i, 9 + k] = t * change + 0.5 * t**2 * rate - t**3 / 3.0 * same


@kernel
def _agree(
    off: FloatArray,
    by: FloatArray,
    by_motion_of_first: FloatArray,
    variances: FloatArray,
    expected: FloatArray,
) -> bool:
    """Return whether two frames show one surface, from their difference (3,).

    `expected` (3, 3), the sum of their covariances, is used up.
    """
    # A squared Mahalanobis distance that is larger once in 1000 times by chance, of 3 values.
    gate = 16.27
    # Of the difference, in which what both have in common is not.
    of_both, told = by[:, 3:].copy(), np.empty(3)
    of_both[:, :6] -= by_motion_of_first
    for i in range(3):
        for j in range(3):
            for k in range(9):
                expected[i, j] += of_both[i, k] * variances[k] * of_both[j, k]
    if not cholesky(expected, 0.0, 0.0, expected):
        return False
    cholesky_solve(expected, off, told)
    return bool(off[0] * told[0] + off[1] * told[1] + off[2] * told[2] <= gate)


def _with_gyros(
    motion: FloatArray, covariance: FloatArray, posture: Posture, turning: GyroRates
) -> tuple[FloatArray, FloatArray]:
    """Return a motion and its covariance as gyros change them."""
    m = posture.normal_in_dome / posture.range
    # A target that stands still turns against the vehicle; its distance does not change by that.
    by_turning = (posture_by_plane(m) @ np.cross(m, np.eye(3)).T)[1:]
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
    by_m = posture_by_plane(exposed)
    to_m = np.linalg.inv(by_m)
    m_by_rate, m_by_acceleration = (
        to_m @ one @ by_m for one in (by_motion[:, :3], by_motion[:, 3:])
    )
    m, m_rate = exposed.copy(), np.empty(3)
    _go_to_middle(exposed, m_by_rate, m_by_acceleration, motion, m, m_rate)
    return m, m_rate


@kernel
def _go_to_middle(
    exposed: FloatArray,
    m_by_rate: FloatArray,
    m_by_acceleration: FloatArray,
    motion: FloatArray,
    m: FloatArray,
    m_rate: FloatArray,
) -> None:
    """Write m at the picture's middle over a first guess, and its rate."""
    step, before, after = 0.01, np.empty(3), np.empty(3)
    # The motion of m depends on m itself; each round leaves 2 % of the error.
    rounds = 2
    for _ in range(rounds):
        distance = 1.0 / math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
        pitch, yaw = math.atan2(m[2], m[1]), math.atan2(m[0], m[1])
        for t, plane in ((-step, before), (step, after)):
            half = 0.5 * t * t
            x = math.tan(yaw + t * motion[2] + half * motion[5])
            z = math.tan(pitch + t * motion[1] + half * motion[4])
            far = distance + t * motion[0] + half * motion[3]
            plane[1] = 1.0 / (far * math.sqrt(x * x + 1.0 + z * z))
            plane[0], plane[2] = x * plane[1], z * plane[1]
        for k in range(3):
            m_rate[k] = (after[k] - before[k]) / (2.0 * step)
            after[k] = (after[k] - 2.0 * m[k] + before[k]) / step**2
        for i in range(3):
            m[i] = exposed[i]
            for k in range(3):
                m[i] -= m_by_rate[i, k] * m_rate[k] + m_by_acceleration[i, k] * after[k]


def _plane_of(numbers: FloatArray) -> FloatArray:
    """Return m of range, pitch and yaw, in m and rad."""
    distance, pitch, yaw = numbers.tolist()
    x, z = math.tan(yaw), math.tan(pitch)
    scale = 1.0 / (distance * math.sqrt(x * x + 1.0 + z * z))
    return np.array([x * scale, scale, z * scale])


def _moved_back(
    points: FloatArray, times: FloatArray, m: FloatArray, m_rate: FloatArray
) -> FloatArray:
    """Return points (N, 3) where they are at time 0.

    Each was seen at its time (N,), and turns and moves with the plane m·X = 1.
    """
    distance = float(1.0 / np.linalg.norm(m))
    normal = m * distance
    along = float(normal @ m_rate)
    moved = np.empty(points.shape)
    turned = distance * (m_rate - along * normal)
    _move_back(points, times, normal, turned, along * distance**2, moved)
    return moved


@borrowing_kernel
def _move_back(
    points: FloatArray,
    times: FloatArray,
    normal: FloatArray,
    turned: FloatArray,
    approach: float,
    moved: FloatArray,
) -> None:
    """Write points (N, 3) less their times times their velocities.

    The velocity at X is (n·X) turned - (turned·X + approach) n, with the unit normal n.
    """
    for i in range(len(points)):
        ahead, across = 0.0, approach
        for k in range(3):
            ahead += points[i, k] * normal[k]
            across += points[i, k] * turned[k]
        for k in range(3):
            moved[i, k] = points[i, k] - times[i] * (ahead * turned[k] - across * normal[k])
