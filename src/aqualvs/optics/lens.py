"""The lens: pixels to directions in `cam` and back, with OpenCV's two distortion models.

The batch kernels behind `Lens` write into arrays that they are given, and NaN wherever they write
False into `valid`; those of the way back are in `aqualvs.optics.projection`. The hot kernels
work in blocks: rows of coordinates are copied into one flat scratch array, each quantity in a row
of its own, and loops of constant length without branches run over it. One array and constant
offsets let LLVM prove that nothing overlaps and use vector instructions; operations that need a
branch are done lane by lane in between.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import BoolArray, FloatArray, as_vectors
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.lens_kernels import (
    ROUNDS,
    LensParams,
    fisheye_direction,
    fisheye_limits,
    opencv_limits,
    opencv_undistort_guarded,
    opencv_undistort_round,
    opencv_undistort_start,
)

# Lanes a block holds: enough to drown the loop's overhead, few enough to stay in the first cache.
BLOCK = 128
# Rows of the scratch array of `directions_block`: distorted coordinates in, unit direction and a
# sign (positive where valid) out.
XD, YD, DX, DY, DZ, LENS_OK = (i_row * BLOCK for i_row in range(6))
N_LENS_ROWS = 6


@inline_kernel
def load_pixels(
    lens: LensParams, pixels: FloatArray, start: int, count: int, w: FloatArray
) -> None:
    """Write the distorted coordinates of `count` pixels from row `start` into the scratch `w`."""
    inverse_x, inverse_y = 1.0 / lens.fx, 1.0 / lens.fy
    for j in range(count):
        w[XD + j] = (pixels[start + j, 0] - lens.cx) * inverse_x
        w[YD + j] = (pixels[start + j, 1] - lens.cy) * inverse_y


@inline_kernel
def directions_block(lens: LensParams, count: int, w: FloatArray) -> None:
    """Turn distorted coordinates into unit directions, all lanes of a block at once.

    Lanes from `count` on hold leftovers: computed, because a fixed length vectorises, and ignored.
    """
    if lens.fisheye:
        for j in range(count):
            ok, w[DX + j], w[DY + j], w[DZ + j] = fisheye_direction(lens, w[XD + j], w[YD + j])
            w[LENS_OK + j] = 1.0 if ok else -1.0
        return
    for j in range(BLOCK):
        xd, yd = w[XD + j], w[YD + j]
        w[DX + j], w[DY + j] = opencv_undistort_start(lens, xd, yd)
        w[LENS_OK + j] = 0.0 if xd * xd + yd * yd <= lens.limit_distorted else -1.0
    n_open = count
    for _ in range(ROUNDS):
        if n_open == 0:
            break
        for j in range(BLOCK):
            x, y, solved = opencv_undistort_round(lens, w[XD + j], w[YD + j], w[DX + j], w[DY + j])
            w[DX + j], w[DY + j] = x, y
            w[LENS_OK + j] = 1.0 if solved & (w[LENS_OK + j] >= 0.0) else w[LENS_OK + j]
        n_open = 0
        for j in range(count):
            n_open += w[LENS_OK + j] == 0.0
    for j in range(count):
        if w[LENS_OK + j] == 0.0:
            ok, w[DX + j], w[DY + j] = opencv_undistort_guarded(lens, w[XD + j], w[YD + j])
            w[LENS_OK + j] = 1.0 if ok else -1.0
    for j in range(BLOCK):
        x, y = w[DX + j], w[DY + j]
        z = 1.0 / math.sqrt(1.0 + x * x + y * y)
        w[DX + j], w[DY + j], w[DZ + j] = x * z, y * z, z


@kernel
def directions_all(
    lens: LensParams, pixels: FloatArray, directions: FloatArray, valid: BoolArray
) -> None:
    """Write directions (N, 3) of pixels (N, 2)."""
    w = np.zeros(N_LENS_ROWS * BLOCK)
    for start in range(0, pixels.shape[0], BLOCK):
        count = min(BLOCK, pixels.shape[0] - start)
        load_pixels(lens, pixels, start, count, w)
        directions_block(lens, count, w)
        for j in range(count):
            ok = w[LENS_OK + j] > 0.0
            valid[start + j] = ok
            for k in range(3):
                directions[start + j, k] = w[DX + k * BLOCK + j] if ok else np.nan


_OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_FISHEYE_NAMES = ("k1", "k2", "k3", "k4")


class LensModel(StrEnum):
    """Distortion model of a lens."""

    OPENCV = "opencv"
    """Brown-Conrady and its rational extension, as `cv2.projectPoints`."""
    FISHEYE = "fisheye"
    """Equidistant with an odd polynomial in the angle, as `cv2.fisheye` (Kannala-Brandt)."""


COEFFICIENT_COUNTS = {LensModel.OPENCV: (0, 4, 5, 8), LensModel.FISHEYE: (0, 4)}
"""Numbers of distortion coefficients that a model takes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lens:
    """Intrinsics of a camera, calibrated in air without the dome.

    Raises
    ------
    RigError
        If a value is not finite, a focal length is not positive, or the number of coefficients
        does not fit the model.

    Notes
    -----
    The distortion is valid only where it is monotone: for directions inside the largest disc round
    the image centre in which the Jacobian determinant of the distortion is positive, and for the
    pixels they map to. Outside, two directions share a pixel.
    """

    model: LensModel = LensModel.OPENCV  # Distortion model.
    # Focal lengths in pixels.
    fx: float
    fy: float
    # Image centre in pixels; the centre of the top-left pixel is (0, 0).
    cx: float
    cy: float
    # `opencv`: none, or k1 k2 p1 p2 [k3 [k4 k5 k6]]; `fisheye`: none, or k1 k2 k3 k4.
    distortion: tuple[float, ...] = ()

    params: LensParams = field(init=False, repr=False, compare=False)
    """Packed numbers for compiled kernels."""

    def __post_init__(self) -> None:
        intrinsics = (self.fx, self.fy, self.cx, self.cy)
        if not np.all(np.isfinite((*intrinsics, *self.distortion))):
            raise RigError(
                f"lens has intrinsics {(*intrinsics, *self.distortion)}; every one must be a "
                "finite number"
            )
        if not (self.fx > 0.0 and self.fy > 0.0):
            raise RigError(
                f"lens has focal lengths fx = {self.fx}, fy = {self.fy} px; both must be positive"
            )
        allowed = COEFFICIENT_COUNTS[LensModel(self.model)]
        if len(self.distortion) not in allowed:
            raise RigError(
                f"lens has {len(self.distortion)} distortion coefficients; the {self.model} model "
                f"takes {' or '.join(map(str, allowed))}"
            )
        fisheye = self.model is LensModel.FISHEYE
        names = _FISHEYE_NAMES if fisheye else _OPENCV_NAMES
        values = dict.fromkeys(_OPENCV_NAMES, 0.0)
        values.update(zip(names, map(float, self.distortion), strict=False))
        numbers = [*map(float, intrinsics), *values.values(), 0.0, 0.0]
        params = LensParams._make([fisheye, *numbers])
        limit, limit_distorted = fisheye_limits(params) if fisheye else opencv_limits(params)
        params = params._replace(limit=limit, limit_distorted=limit_distorted)
        object.__setattr__(self, "params", params)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the intrinsics, in the order of every intrinsics Jacobian."""
        names = _FISHEYE_NAMES if self.model is LensModel.FISHEYE else _OPENCV_NAMES
        return ("fx", "fy", "cx", "cy", *names[: len(self.distortion)])

    def numbers(self) -> dict[str, float]:
        """Return the intrinsics by their names."""
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        return dict(zip(self.parameter_names, values, strict=True))

    def moved_by(self, step: Mapping[str, float]) -> "Lens":
        """Return the lens with steps added to the intrinsics that are named."""
        numbers = [value + step.get(name, 0.0) for name, value in self.numbers().items()]
        fx, fy, cx, cy, *distortion = numbers
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, distortion=tuple(distortion))

    def directions(self, pixels: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Return the directions that pixels see.

        Parameters
        ----------
        pixels : array, shape (..., 2)
            In `image`, in pixels.

        Returns
        -------
        directions_in_cam : array, shape (..., 3)
            Unit directions away from the camera; NaN where not valid.
        valid : bool array, shape (...)
            False where no direction inside the monotone region maps to the pixel.

        Notes
        -----
        Newton's method on the exact Jacobian, to machine precision.
        """
        p = as_vectors(pixels, 2, "pixels")
        directions, valid = np.empty((*p.shape[:-1], 3)), np.empty(p.shape[:-1], dtype=np.bool_)
        directions_all(self.params, p.reshape(-1, 2), directions.reshape(-1, 3), valid.reshape(-1))
        return directions, valid

    def pixels(self, directions_in_cam: ArrayLike) -> tuple[FloatArray, BoolArray]:
        """Return the pixels that directions are seen at.

        Parameters
        ----------
        directions_in_cam : array, shape (..., 3)
            Directions away from the camera, of any length: points in `cam` will do.

        Returns
        -------
        pixels : array, shape (..., 2)
            In `image`, in pixels, possibly outside the picture; NaN where not valid.
        valid : bool array, shape (...)
            False outside the monotone region, and behind the camera for `opencv`.
        """
        d = as_vectors(directions_in_cam, 3, "directions_in_cam")
        pixels, valid = np.empty((*d.shape[:-1], 2)), np.empty(d.shape[:-1], dtype=np.bool_)
        from aqualvs.optics.projection import pixels_all

        pixels_all(self.params, d.reshape(-1, 3), pixels.reshape(-1, 2), valid.reshape(-1))
        return pixels, valid
