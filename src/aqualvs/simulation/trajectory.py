"""How the vehicle moves before its target: smooth functions of time."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from scipy.interpolate import PchipInterpolator

from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3

_STEEPEST = np.deg2rad(85.0)


def dome_from_target(
    distance: float, pitch: float, yaw: float, slide: tuple[float, float] = (0.0, 0.0)
) -> SE3:
    """Return the pose of a target frame from the posture (docs/conventions.md).

    Parameters
    ----------
    distance : float
        Range: distance of the dome's centre from the target plane, in metres.
    pitch, yaw : float
        tan(pitch) = n_z / n_y and tan(yaw) = n_x / n_y for the far normal n, in radians.
    slide : (float, float)
        Shift of the target in its plane, right and up, in metres.

    Returns
    -------
    SE3
        y of the target frame is n; its z is as near to the dome's z as that allows; without slide
        its origin is the foot of the perpendicular from the dome's centre.

    Raises
    ------
    OptionError
        If the distance is not positive or an angle is 85 degrees or steeper.
    """
    if not distance > 0.0:
        raise OptionError(f"range is {1e3 * distance:g} mm; it must be positive")
    if max(abs(pitch), abs(yaw)) >= _STEEPEST:
        raise OptionError(
            f"pitch {np.rad2deg(pitch):g} and yaw {np.rad2deg(yaw):g} deg: the target would be "
            "seen edge on; keep both below 85 deg"
        )
    normal = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
    normal /= np.linalg.norm(normal)
    up = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    up /= np.linalg.norm(up)
    right = np.cross(normal, up)
    origin = distance * normal + slide[0] * right + slide[1] * up
    return SE3(np.column_stack([right, normal, up]), origin)


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """One quantity over time: through values, with a sway on top.

    Attributes
    ----------
    values : sequence of float
        Passed at equal intervals from the start to the end of the dive; one value holds still.
    mode : {"smooth", "steps"}
        Smooth passes through the values without overshoot; steps holds each of them for its
        share of the dive.
    sway : float
        Amplitude of a sine on top.
    period : float
        Of that sine, in seconds.
    """

    values: Sequence[float] = (0.0,)
    mode: Literal["smooth", "steps"] = "smooth"
    sway: float = 0.0
    period: float = 4.0

    def at(self, t: float, duration: float) -> float:
        """Return the value at time `t` of a dive of `duration` seconds."""
        share = min(max(t / duration, 0.0), 1.0) if duration > 0.0 else 0.0
        value = self._base(share)
        return value + self.sway * float(np.sin(2.0 * np.pi * t / self.period))

    def _base(self, share: float) -> float:
        n = len(self.values)
        if n == 1:
            return float(self.values[0])
        if self.mode == "steps":
            # The small addition keeps frame times such as 0.4 s on the right side of a step.
            return float(self.values[min(int(share * n + 1e-9), n - 1)])
        return float(PchipInterpolator(np.linspace(0.0, 1.0, n), self.values)(share))


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectory:
    """Posture over time.

    Attributes
    ----------
    distance, pitch, yaw : Course
        Metres and radians.
    slide_x, slide_z : Course
        Shift of the target in its plane, in metres.
    """

    distance: Course = field(default_factory=lambda: Course(values=(0.6,)))
    pitch: Course = field(default_factory=Course)
    yaw: Course = field(default_factory=Course)
    slide_x: Course = field(default_factory=Course)
    slide_z: Course = field(default_factory=Course)

    def pose_at(self, t: float, duration: float) -> SE3:
        """Return `dome_from_target` at time `t`."""
        slide = (self.slide_x.at(t, duration), self.slide_z.at(t, duration))
        return dome_from_target(
            self.distance.at(t, duration),
            self.pitch.at(t, duration),
            self.yaw.at(t, duration),
            slide,
        )
