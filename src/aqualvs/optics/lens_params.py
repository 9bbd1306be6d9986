"""A lens as compiled kernels take it."""

from typing import NamedTuple, TypeAlias

Vector: TypeAlias = tuple[float, float, float]
"""A vector as scalar kernels take and return it."""


class LensParams(NamedTuple):
    """Numbers of a lens; `Lens.params` makes it.

    Attributes
    ----------
    fisheye : bool
        Model: equidistant fisheye, else the rational model of OpenCV.
    fx, fy, cx, cy : float
        Pixels.
    k1, k2, p1, p2, k3, k4, k5, k6 : float
        Distortion; the fisheye model uses k1 to k4.
    limit : float
        Where the distortion stops being monotone: squared normalised radius (opencv), angle to
        the axis in radians (fisheye).
    limit_distorted : float
        Squared distorted radius that nothing inside `limit` exceeds.
    """

    fisheye: bool
    fx: float
    fy: float
    cx: float
    cy: float
    k1: float
    k2: float
    p1: float
    p2: float
    k3: float
    k4: float
    k5: float
    k6: float
    limit: float
    limit_distorted: float
