"""Correction of postures for motion during the readout of a rolling shutter; detection of blur.

Every stripe point is exposed at the time of its row, so that the error of a posture is its
`by_motion` times the rates and accelerations of range, pitch and yaw. These are estimated from the
neighbouring frames, including their own errors by motion: in frame j, at time t from the frame that
is corrected,

    measured_j = posture + t rates + t²/2 acceleration
                 + by_motion_j (rates + t acceleration, acceleration) + e_j.

Neighbouring frames do not smooth a posture: it is only corrected by its `by_motion` times both.
Gyros, if there are any, measure the rates of pitch and yaw, too, which matters most for a single
frame.

The points of a single frame also show the rates, but less accurately: motion bends and twists a
plane. That is enough to remove the motion from the scatter of the points, before surfaces are
fitted and sigmas are estimated.
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
"""Frames on each side from which the rates of a frame are estimated."""

# Largest time to such a frame, in seconds: over longer times the rates change too much.
_REACH_S = 0.25
# Prior standard deviations of a small vehicle's motion near a net, swinging with a period of 2 s:
# rates of range, pitch and yaw (m/s, rad/s), accelerations (m/s², rad/s²), jerks (m/s³, rad/s³).
_RATES = np.array([0.3, np.deg2rad(20.0), np.deg2rad(20.0)])
_ACCELERATIONS = np.array([0.5, np.deg2rad(40.0), np.deg2rad(40.0)])
_JERKS = np.array([1.5, np.deg2rad(120.0), np.deg2rad(120.0)])
# Points of one frame that are used for its rates, at most; and their weight in independent points,
# because they share the errors of their stripe: a rate that one frame hardly determines, such as
# that of the range, stays near zero.
_MAX_POINTS, _N_INDEPENDENT = 200, 30.0
_REWEIGHTS = 3
# Least turn of the vehicle during an exposure by which blur explains one of these reasons. Postures
# to rendered nets with meshes of 25 mm at 480 mm were refused from 2.7 degrees on, none up to 1.9.
_BLUR_ANGLE = np.deg2rad(2.5)
_BY_BLUR = (Reason.NO_STRIPES, Reason.TOO_FEW_POINTS, Reason.ONE_LASER, Reason.NOT_A_PLANE)


class RowMotion:
    """Correction of motion during the pictures of one rig, from row to row and in the exposure.

    Parameters
    ----------
    rig : Rig
        With a shutter that `needs_neighbours`.
    """

    def __init__(self, rig: Rig) -> None:
        self._shutter, self._height = rig.shutter, rig.size_px[1]
        self._axis_in_dome = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])

    def stilled(self, candidates: Candidates, on_target: BoolArray, plane: Plane) -> Candidates:
        """Return candidates with their points at the picture's middle, by the frame's own rates.

        Parameters
        ----------
        candidates : Candidates
            N of them.
        on_target : bool array, shape (N,)
            Candidates on the target.
        plane : Plane
            Approximate plane of the target.
        """
        seen = np.flatnonzero(on_target)
        seen = seen[:: -(-len(seen) // _MAX_POINTS)]
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
        """Convert a posture to `stilled` candidates to that to the candidates themselves.

        The shift of the points by `stilled` is undone to first order, and `by_motion` is added.

        Parameters
        ----------
        posture : Posture
        surface : FittedSurface
            Surface of the posture.
        still, seen : Candidates
            N of them: after `stilled`, to which the surface was fitted, and before.
        weights : array, shape (N,)
            1 over the variance of the residual; 0 for candidates that were not used.
        """
        m = posture.normal_in_dome / posture.range
        matrix, moved = np.diag(surface.prior), np.zeros((len(surface.prior), 7))
        # Variance of the times within an exposure.
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
        return replace(self._with_plane(posture, m), by_motion=by_motion)

    def correct(self, scan: Scan, beside: Sequence[Scan]) -> Scan:
        """Return a scan with posture and points at the middle of the picture's readout.

        Points move as if the target turned about the dome's centre: postures do not show a motion
        along the target, nor roll. Their pixels stay as measured.

        Parameters
        ----------
        scan : Scan
            As the scanner measured it. A refusal gets the reason `BLURRED` if the neighbouring
            frames show that the vehicle turned too fast.
        beside : sequence of Scan
            Neighbouring scans before and after, as measured; in a live run, only those before.
        """
        posture = scan.posture
        if isinstance(posture, Refusal):
            return replace(scan, posture=self._named_blurred(scan, posture, beside))
        by_motion = posture.by_motion
        if by_motion is None:
            return scan
        motion, covariance = motion_beside(scan, beside)
        m, m_rate = _at_middle(posture, by_motion, motion)
        off = self._error_of_brightness(motion[:3], posture.range)
        corrected = replace(
            self._with_plane(posture, m),
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

    def _named_blurred(self, scan: Scan, refusal: Refusal, beside: Sequence[Scan]) -> Refusal:
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
        if turned < _BLUR_ANGLE:
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

    def _error_of_brightness(self, rates: FloatArray, distance: float) -> FloatArray:
        """Return the error (3,) of a posture by stripes whose brightness changes in the exposure.

        Stripes are brighter while the target is near, so that their mean position is that at
        another time than the exposure's middle.
        """
        # Brightness falls with this power of the distance: the sheet spreads, the stripe appears
        # smaller, and water absorbs light on both ways.
        power = 3.0
        late = power * rates[0] / distance * self._shutter.exposure**2 / 12.0
        error: FloatArray = late * rates
        return error

    def _with_plane(self, posture: Posture, m: FloatArray) -> Posture:
        """Return a posture as that to the plane m·X = 1."""
        return self.moved(posture, np.array(range_pitch_yaw(m)) - posture.numbers)

    def _times(self, pixels: FloatArray) -> FloatArray:
        """Return the time (N,) of each pixel's row from the picture's middle, in seconds."""
        return self._shutter.row_times(pixels[:, 1], self._height)


def _fit_rates(
    points: FloatArray, sigma: FloatArray, times: FloatArray, m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the plane m·X = 1 at time 0, and the rate of m, fitted to points at different times.

    `points` (N, 3) are in `dome`, in metres; `sigma` (N,) is that of m·X; `times` (N,) are in
    seconds. Returns m (3,) in 1/m and its rate (3,) in 1/(m s): the initial `m` and zero if the
    points do not determine them.
    """
    prior, both = np.zeros((6, 6)), np.concatenate([m, np.zeros(3)])
    scaled = posture_by_plane(m) / _RATES[:, None]
    prior[3:, 3:] = scaled.T @ scaled
    share = min(_N_INDEPENDENT / max(len(points), 1), 1.0)
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
    """Fit m and its rate, concatenated in `both` (6,), with Tukey's weights times `share`.

    `prior` (6, 6) is the prior information. Return False if the fit is singular.
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
    """Add the normal matrix (K, K) of N points, and the change of its right side by motion (K, 7).

    At time t a point lies on the plane m + t rate + t²/2 acceleration, and so off the plane m by
    the difference times X. The columns are for the rates, the accelerations, and the shift from
    `seen` to `still`, both (N, 3). `times` (N,) are the middles of the exposures, `spread` is the
    variance of the times within one.
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
    """Estimate the motion (6,) at a scan, and its covariance (6, 6).

    The motion is the rates of range, pitch and yaw, then their accelerations.

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
        if isinstance(found, Posture) and abs(after) <= _REACH_S and found.by_motion is not None:
            known.append((after, found, found.by_motion))
    motion, covariance = np.empty(12), np.empty((12, 12))
    _estimate_motion(
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
def _estimate_motion(
    t: FloatArray,
    numbers: FloatArray,
    covariances: FloatArray,
    by_motion: FloatArray,
    variances: FloatArray,
    motion: FloatArray,
    covariance: FloatArray,
) -> None:
    """Estimate posture and motion (12,) at the first of F frames, with their covariance (12, 12).

    Unknowns are the posture, relative to that measured in the first frame, its rates,
    accelerations and jerks. Jerks during a picture are neglected. `t` (F,) are the times from the
    first frame, in seconds; `numbers` (F, 3), `covariances` (F, 3, 3) and `by_motion` (F, 3, 6) are
    as in `Posture`; `variances` (9,) are the prior ones of rates, accelerations and jerks.
    """
    matrix, right = np.zeros((12, 12)), np.zeros(12)
    for k in range(9):
        matrix[3 + k, 3 + k] = 1.0 / variances[k]
    by, off, information = np.empty((3, 12)), np.empty(3), np.empty((3, 3))
    for f in range(len(t)):
        off[:] = numbers[f] - numbers[0]
        _fill_terms(t[f], by_motion[f], by)
        both = covariances[f] + covariances[0]
        agrees = f == 0 or _is_consistent(off, by, by_motion[0], variances, both)
        if not agrees or not cholesky(covariances[f], 0.0, 0.0, information):
            continue
        information[:] = cholesky_inverse(information)
        for a in range(12):
            for i in range(3):
                term = 0.0
                for j in range(3):
                    term += by[j, a] * information[j, i]
                right[a] += term * off[i]
                for b in range(12):
                    matrix[a, b] += term * by[i, b]
    cholesky(matrix, 0.0, 0.0, matrix)
    covariance[:] = cholesky_inverse(matrix)
    cholesky_solve(matrix, right, motion)


@borrowing_kernel
def _fill_terms(t: float, by_motion: FloatArray, by: FloatArray) -> None:
    """Write the derivatives (3, 12) of the posture measured at time t by all unknowns."""
    for i in range(3):
        for k in range(3):
            same = 1.0 if i == k else 0.0
            rate, change = by_motion[i, k] + t * same, by_motion[i, 3 + k]
            by[i, k], by[i, 3 + k] = same, rate
            by[i, 6 + k] = change + t * rate - 0.5 * t**2 * same
            by[i, 9 + k] = t * change + 0.5 * t**2 * rate - t**3 / 3.0 * same


@kernel
def _is_consistent(
    off: FloatArray,
    by: FloatArray,
    by_motion_of_first: FloatArray,
    variances: FloatArray,
    expected: FloatArray,
) -> bool:
    """Return whether two frames may show the same surface, given their difference (3,).

    `expected` (3, 3), the sum of their covariances, is overwritten.
    """
    # Quantile 0.999 of the squared Mahalanobis distance (chi-squared, 3 degrees of freedom).
    gate = 16.27
    # Derivative of the difference by the motion; the posture itself cancels.
    of_both, solved = by[:, 3:].copy(), np.empty(3)
    of_both[:, :6] -= by_motion_of_first
    for i in range(3):
        for j in range(3):
            for k in range(9):
                expected[i, j] += of_both[i, k] * variances[k] * of_both[j, k]
    if not cholesky(expected, 0.0, 0.0, expected):
        return False
    cholesky_solve(expected, off, solved)
    return bool(off[0] * solved[0] + off[1] * solved[1] + off[2] * solved[2] <= gate)


def _with_gyros(
    motion: FloatArray, covariance: FloatArray, posture: Posture, turning: GyroRates
) -> tuple[FloatArray, FloatArray]:
    """Update a motion (6,) and its covariance (6, 6) by gyros, as a Kalman filter does."""
    m = posture.normal_in_dome / posture.range
    # Pitch and yaw rates of a target at rest, by the vehicle's rotation; its range does not change.
    by_turning = (posture_by_plane(m) @ np.cross(m, np.eye(3)).T)[1:]
    angles = slice(1, 3)
    off = by_turning @ turning.rates - motion[angles]
    expected = covariance[angles, angles] + turning.sigma**2 * by_turning @ by_turning.T
    # Quantile 0.999 of the squared Mahalanobis distance (chi-squared, 2 degrees of freedom). Beyond
    # it the target moves itself, or the gyros are not the vehicle's.
    gate = 13.82
    if not off @ np.linalg.solve(expected, off) <= gate:
        return motion, covariance
    gain = np.linalg.solve(expected, covariance[angles]).T
    return motion + gain @ off, covariance - gain @ covariance[angles]


def _at_middle(
    posture: Posture, by_motion: FloatArray, motion: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return m (3,) of the plane m·X = 1 at the picture's middle, and its rate (3,).

    The error of m by motion is linear in its rate and acceleration. That of range, pitch and yaw is
    not: a plane that is tilted by 1.3 degrees, as at 0.3 m/s, is nearer by 0.03 %.
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
    """Replace an initial m by that at the picture's middle; write its rate.

    Rate and acceleration of m are central differences over 0.01 s.
    """
    step, before, after = 0.01, np.empty(3), np.empty(3)
    # The motion of m depends on m itself; each round reduces the error to 2 %.
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
    """Return m (3,) of the plane m·X = 1 with a range (m), pitch and yaw (rad)."""
    distance, pitch, yaw = numbers.tolist()
    x, z = math.tan(yaw), math.tan(pitch)
    scale = 1.0 / (distance * math.sqrt(x * x + 1.0 + z * z))
    return np.array([x * scale, scale, z * scale])


def _moved_back(
    points: FloatArray, times: FloatArray, m: FloatArray, m_rate: FloatArray
) -> FloatArray:
    """Return the positions at time 0 of points (N, 3) that were seen at different times (N,).

    They turn and move with the plane m·X = 1.
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
    """Write points (N, 3) minus their times (N,) times their velocities.

    The velocity at X is (n·X) turned - (turned·X + approach) n, with the unit normal n.
    """
    for i in range(len(points)):
        ahead, across = 0.0, approach
        for k in range(3):
            ahead += points[i, k] * normal[k]
            across += points[i, k] * turned[k]
        for k in range(3):
            moved[i, k] = points[i, k] - times[i] * (ahead * turned[k] - across * normal[k])
