"""Posture relative to a plane target: range, pitch and yaw, with their covariance."""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig_covariance import posture_by_plane
from aqualvs.scanning.plane_fit import PlaneFit

# Largest standard deviations of a posture that is accepted: of the range, as a share of it, and of
# the angles.
_MAX_SIGMA_RANGE_SHARE = 0.05
_MAX_SIGMA_ANGLE = np.deg2rad(5.0)
MAX_RMS_SHARE = 0.02
"""Largest scatter of the points of a net or a wall about its plane, as a share of the range."""


class Reason(StrEnum):
    """Reason for a refusal; the value is that of `reason` in `posture.csv`."""

    NO_STRIPES = "no_stripes"
    """No peaks in the lasers' bands."""
    TOO_FEW_POINTS = "too_few_points"
    """Fewer stripe points than a posture needs."""
    ONE_LASER = "one_laser"
    """Stripes of one laser only: a line does not determine a plane."""
    COLLINEAR = "collinear"
    """The points are almost on a line; the plane could turn about it."""
    NOT_A_PLANE = "not_a_plane"
    """Stripes that share no plane."""
    AMBIGUOUS = "ambiguous"
    """Two planes, with different assignments to lasers, explain the stripes about as well."""
    NO_TARGET = "no_target"
    """Surfaces, but none of the kind that was asked for."""
    BLURRED = "blurred"
    """Stripes that share no plane, or too few: the vehicle turned too far during the exposure."""
    OUT_OF_RANGE = "out_of_range"
    """A plane, but outside the working range."""
    CORRUPT_FRAME = "corrupt_frame"
    """The picture could not be decoded."""
    WRONG_SIZE = "wrong_size"
    """The picture has another size than the rig's."""
    NO_FRAMES = "no_frames"
    """A live stream delivers no pictures."""
    FROZEN = "frozen"
    """A live stream repeats its last picture, with new time stamps."""


@dataclass(frozen=True, slots=True)
class Refusal:
    """A refused posture with its reason; falsy.

    Attributes
    ----------
    reason : Reason
    detail : str
        Description with the values that led to it.
    still_s : float
        Upper limit of the time since the last new picture, if the picture is frozen, in seconds.
    """

    reason: Reason
    detail: str = ""
    still_s: float = 0.0

    def __bool__(self) -> Literal[False]:
        """Return False, so that `if posture:` reads well."""
        return False


@dataclass(frozen=True, slots=True, kw_only=True)
class Posture:
    """Posture of the vehicle relative to a plane (paper, Eq. 23-26); truthy.

    Attributes
    ----------
    range, pitch, yaw : float
        Distance of the dome's centre from the plane in metres, angles in radians.
    covariance : array, shape (3, 3)
        Of (range, pitch, yaw) by the noise of this frame alone, in m and rad: the part that differs
        from frame to frame and that averaging reduces. A time filter needs this one.
    rig_covariance : array, shape (3, 3)
        Of the same by the uncertainty of the rig (intrinsics, dome, water, lasers): nearly the same
        error in all frames of a dive. Zero if the rig is exact or its uncertainty is not used.
    normal_in_dome : array, shape (3,)
        Unit normal of the target plane, pointing away from the vehicle.
    slant_range : float
        Distance from the dome's centre to the plane along the camera's axis, in metres.
    nearest : float
        Distance from the dome's centre to the nearest measured point of the target, in metres.
    n_points : int
        Number of inliers of the fit.
    rms : float
        Root mean square distance of their subsegments from the plane, in metres; from the curved
        surface where there is one.
    curvature, sigma_curvature : (float, float) or None
        Of a curved net along the horizontal and along the vertical, in 1/m, and their standard
        deviations; positive if the net recedes from the point nearest to the vehicle. Range, pitch
        and yaw are then those of the tangent plane at that point. None for a plane.
    by_motion : array, shape (3, 6), or None
        Derivative of (range, pitch, yaw) by their rates and accelerations (s, s², m, rad): the rows
        of a rolling shutter show the target at different times. `row_motion` corrects this error.
        None if it has been corrected, or if all rows are exposed at once.
    """

    range: float
    pitch: float
    yaw: float
    covariance: FloatArray
    normal_in_dome: FloatArray
    slant_range: float
    nearest: float
    n_points: int
    rms: float
    curvature: tuple[float, float] | None = None
    sigma_curvature: tuple[float, float] | None = None
    rig_covariance: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))
    by_motion: FloatArray | None = None

    def __bool__(self) -> Literal[True]:
        """Return True: a posture is an answer."""
        return True

    @property
    def numbers(self) -> FloatArray:
        """Range, pitch and yaw as an array (3,), in m and rad."""
        return np.array([self.range, self.pitch, self.yaw])

    @property
    def total_covariance(self) -> FloatArray:
        """Covariance (3, 3) of (range, pitch, yaw) by frame and rig together, in m and rad.

        That of the whole error of the posture, for uses that do not average frames.
        """
        return self.covariance + self.rig_covariance


def posture_of(
    fit: PlaneFit, nearest: float, n_points: int, camera_axis_in_dome: FloatArray
) -> Posture:
    """Convert a plane fit to a posture.

    Parameters
    ----------
    fit : PlaneFit
        To the target's points in `dome`.
    nearest : float
        Distance of the nearest inlier, in metres.
    n_points : int
        Number of inliers.
    camera_axis_in_dome : array, shape (3,)
        Unit vector along which the slant range is measured.
    """
    jacobian = posture_by_plane(fit.m)
    x, y, z = fit.m.tolist()
    along_x, along_y, along_z = camera_axis_in_dome.tolist()
    approach = x * along_x + y * along_y + z * along_z
    distance, pitch, yaw = range_pitch_yaw(fit.m)
    return Posture(
        range=distance,
        pitch=pitch,
        yaw=yaw,
        covariance=np.einsum("ik,kn,jn->ij", jacobian, fit.covariance, jacobian),
        normal_in_dome=fit.m / math.sqrt(x * x + y * y + z * z),
        slant_range=1.0 / approach if approach > 0.0 else float("inf"),
        nearest=nearest,
        n_points=n_points,
        rms=fit.rms,
    )


def validate(
    posture: Posture, working_range: tuple[float, float], max_rms_share: float = MAX_RMS_SHARE
) -> Posture | Refusal:
    """Return the posture if a pilot may rely on it, else a refusal.

    Parameters
    ----------
    posture : Posture
        As measured.
    working_range : (float, float)
        Nearest and farthest range that is accepted, in metres.
    max_rms_share : float
        Largest scatter of the points about the surface, as a share of the range.
    """
    near, far = working_range
    distance = posture.range
    sigma_range, sigma_pitch, sigma_yaw = map(math.sqrt, posture.covariance.diagonal().tolist())
    worst = max(sigma_pitch, sigma_yaw)
    if not (sigma_range <= _MAX_SIGMA_RANGE_SHARE * distance and worst <= _MAX_SIGMA_ANGLE):
        return Refusal(
            Reason.COLLINEAR,
            f"points do not fix the plane: sigma {1e3 * sigma_range:.0f} mm, "
            f"{np.rad2deg(worst):.1f} deg",
        )
    # Tolerance at the limits of the working range for detection noise, as a share.
    range_tolerance = 0.01
    if not (1.0 - range_tolerance) * near <= distance <= (1.0 + range_tolerance) * far:
        return Refusal(
            Reason.OUT_OF_RANGE,
            f"range {distance:.3f} m is outside the working range {near:.2f} to {far:.2f} m",
        )
    if posture.rms > max_rms_share * distance:
        return Refusal(
            Reason.NOT_A_PLANE, f"points are {1e3 * posture.rms:.1f} mm rms off the best plane"
        )
    return posture


def deviations(covariance: FloatArray) -> tuple[float, float, float]:
    """Return the standard deviations of range (m), pitch and yaw (degrees); NaN if unknown."""
    variances = covariance.diagonal()[:3]
    sigma_range, pitch, yaw = np.sqrt(np.where(variances >= 0.0, variances, np.nan)).tolist()
    return sigma_range, math.degrees(pitch), math.degrees(yaw)


def range_pitch_yaw(m: FloatArray) -> tuple[float, float, float]:
    """Return range (m), pitch and yaw (rad) of m·X = 1 (paper, Eq. 25-26 as arctangents)."""
    x, y, z = m.tolist()
    return 1.0 / math.hypot(x, y, z), math.atan2(z, y), math.atan2(x, y)
