"""Batch kernels of the camera, forward: rows of pixels to rows of rays.

Every kernel writes into arrays it is given, and NaN wherever it writes False into `valid`. See
`lens_batch` for how the blocks work.
"""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import inline_kernel, kernel
from aqualvs.optics.dome_forward import (
    CameraParams,
    dome_from_cam,
    trace_direction,
    trace_tangent,
)
from aqualvs.optics.lens_batch import (
    BLOCK,
    DX,
    DY,
    DZ,
    N_LENS_ROWS,
    OK,
    directions_block,
    load_pixels,
)
from aqualvs.optics.lens_kernels import lens_direction_jacobian

# Rows of the scratch array after those of the lens: the origin of the ray.
OX, OY, OZ = ((N_LENS_ROWS + i_row) * BLOCK for i_row in range(3))
N_RAY_ROWS = N_LENS_ROWS + 3


@inline_kernel
def trace_block(camera: CameraParams, w: FloatArray) -> None:
    """Turn unit directions in `dome` into rays in the outer medium, all lanes of a block."""
    for j in range(BLOCK):
        passed, ox, oy, oz, dx, dy, dz = trace_direction(camera, w[DX + j], w[DY + j], w[DZ + j])
        w[OX + j], w[OY + j], w[OZ + j] = ox, oy, oz
        w[DX + j], w[DY + j], w[DZ + j] = dx, dy, dz
        w[OK + j] = w[OK + j] if passed else -1.0


@inline_kernel
def rotate_block(camera: CameraParams, w: FloatArray) -> None:
    """Rotate directions from `cam` to `dome` and start them at the lens, all lanes of a block."""
    cx, cy, cz = camera.centre
    for j in range(BLOCK):
        x, y, z = dome_from_cam(camera, w[DX + j], w[DY + j], w[DZ + j])
        w[DX + j], w[DY + j], w[DZ + j] = x, y, z
        w[OX + j], w[OY + j], w[OZ + j] = cx, cy, cz


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
        ok = w[OK + j] > 0.0
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
        if camera.has_dome:
            trace_block(camera, w)
        store_rays(start, count, w, origins, directions, valid)


@kernel
def trace_all(
    camera: CameraParams,
    directions_at_lens: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
) -> None:
    """Write rays of unit directions (N, 3) at the lens, in `dome`: the dome alone."""
    w = np.zeros(N_RAY_ROWS * BLOCK)
    for start in range(0, directions_at_lens.shape[0], BLOCK):
        count = min(BLOCK, directions_at_lens.shape[0] - start)
        for j in range(count):
            w[DX + j] = directions_at_lens[start + j, 0]
            w[DY + j] = directions_at_lens[start + j, 1]
            w[DZ + j] = directions_at_lens[start + j, 2]
            w[OK + j] = 1.0
        trace_block(camera, w)
        store_rays(start, count, w, origins, directions, valid)


@kernel
def rays_jacobian_all(
    camera: CameraParams,
    pixels: FloatArray,
    valid: BoolArray,
    origin_jacobian: FloatArray,
    direction_jacobian: FloatArray,
) -> None:
    """Write derivatives (N, 3, 2) of origins and directions by the pixel, where `valid` says so."""
    for i in range(pixels.shape[0]):
        if not valid[i]:
            origin_jacobian[i] = np.nan
            direction_jacobian[i] = np.nan
            continue
        _, d, d_u, d_v = lens_direction_jacobian(camera.lens, pixels[i, 0], pixels[i, 1])
        d = dome_from_cam(camera, d[0], d[1], d[2])
        for k in range(2):
            d_dot = d_u if k == 0 else d_v
            d_dot = dome_from_cam(camera, d_dot[0], d_dot[1], d_dot[2])
            o_dot = (0.0, 0.0, 0.0)
            if camera.has_dome:
                o_dot, d_dot = trace_tangent(camera, d, d_dot)
            for j in range(3):
                origin_jacobian[i, j, k] = o_dot[j]
                direction_jacobian[i, j, k] = d_dot[j]
