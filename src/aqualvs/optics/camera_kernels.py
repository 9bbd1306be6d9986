"""Batch kernels that trace pixels into the outer medium, and a camera's numbers as they take them.

Kernels write NaN wherever they write False into `valid`. The block layout of the scratch array is
that of `aqualvs.optics.lens`; kernels are compiled for the class of port that they are called with.
The way back, from points to pixels, is `aqualvs.optics.projection`.
"""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import chosen_by_class, inline_kernel, kernel
from aqualvs.optics.dome import DomeParams, trace_direction
from aqualvs.optics.flat_port import FlatParams, trace_flat
from aqualvs.optics.lens import (
    BLOCK,
    DX,
    DY,
    DZ,
    LENS_OK,
    N_LENS_ROWS,
    directions_block,
    load_pixels,
)
from aqualvs.optics.lens_kernels import LensParams, Vector


class BareParams(NamedTuple):
    """A lens in the outer medium itself, as kernels take it.

    Attributes
    ----------
    centre : tuple of 3 float
        The lens position L in `dome`, metres.
    """

    centre: Vector

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return ()


@inline_kernel
def _trace_bare(
    port: BareParams, dx: float, dy: float, dz: float
) -> tuple[bool, float, float, float, float, float, float]:
    ox, oy, oz = port.centre
    return True, ox, oy, oz, dx, dy, dz


trace_port = chosen_by_class(
    {BareParams: _trace_bare, DomeParams: trace_direction, FlatParams: trace_flat}
)
"""`trace_port(port, dx, dy, dz)`: a unit direction at the lens as the ray in the outer medium, see
`trace_direction`."""


class CameraParams(NamedTuple):
    """A camera as kernels take it; `camera.params` makes it.

    Attributes
    ----------
    lens : LensParams
        Intrinsics.
    rotation : tuple of 9 float
        `dome_from_cam`, row by row.
    port : BareParams, DomeParams or FlatParams
        What stands between the lens and the outer medium, and the lens position.
    """

    lens: LensParams
    rotation: tuple[float, float, float, float, float, float, float, float, float]
    port: BareParams | DomeParams | FlatParams


@inline_kernel
def dome_from_cam(camera: CameraParams, x: float, y: float, z: float) -> Vector:
    """Rotate a direction from `cam` to `dome`."""
    r = camera.rotation
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


# Rows of the scratch array after those of the lens: the origin of the ray.
OX, OY, OZ = ((N_LENS_ROWS + i_row) * BLOCK for i_row in range(3))
N_RAY_ROWS = N_LENS_ROWS + 3


@inline_kernel
def trace_block(camera: CameraParams, w: FloatArray) -> None:
    """Turn unit directions in `dome` into rays in the outer medium, all lanes of a block."""
    for j in range(BLOCK):
        passed, ox, oy, oz, dx, dy, dz = trace_port(camera.port, w[DX + j], w[DY + j], w[DZ + j])
        w[OX + j], w[OY + j], w[OZ + j] = ox, oy, oz
        w[DX + j], w[DY + j], w[DZ + j] = dx, dy, dz
        w[LENS_OK + j] = w[LENS_OK + j] if passed else -1.0


@inline_kernel
def rotate_block(camera: CameraParams, w: FloatArray) -> None:
    """Rotate directions from `cam` to `dome`, all lanes of a block."""
    for j in range(BLOCK):
        x, y, z = dome_from_cam(camera, w[DX + j], w[DY + j], w[DZ + j])
        w[DX + j], w[DY + j], w[DZ + j] = x, y, z


@inline_kernel
def store_rays(
    start: int,
    count: int,
    w: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
) -> None:
    """Write `count` rays from the scratch `w` to the rows from `start`."""
    for j in range(count):
        ok = w[LENS_OK + j] > 0.0
        valid[start + j] = ok
        origins[start + j, 0] = w[OX + j] if ok else np.nan
        origins[start + j, 1] = w[OY + j] if ok else np.nan
        origins[start + j, 2] = w[OZ + j] if ok else np.nan
        directions[start + j, 0] = w[DX + j] if ok else np.nan
        directions[start + j, 1] = w[DY + j] if ok else np.nan
        directions[start + j, 2] = w[DZ + j] if ok else np.nan


@kernel
def rays_all(
    camera: CameraParams,
    pixels: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
) -> None:
    """Write rays of pixels (N, 2): origins (N, 3), directions (N, 3), valid (N)."""
    w = np.zeros(N_RAY_ROWS * BLOCK)
    for start in range(0, pixels.shape[0], BLOCK):
        count = min(BLOCK, pixels.shape[0] - start)
        load_pixels(camera.lens, pixels, start, count, w)
        directions_block(camera.lens, count, w)
        rotate_block(camera, w)
        trace_block(camera, w)
        store_rays(start, count, w, origins, directions, valid)
