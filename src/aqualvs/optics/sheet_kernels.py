"""The sheet of a line laser behind a flat window: its implicit form, in compiled kernels.

In air the sheet is the plane n·X = d, fanned out from a source S in it. The window's outer face
w·X = c lies s in front of S; a point X in the water lies h in front of the face and, seen along w,
L beside S. Light that reaches X leaves S with the tangent q = m |L| to w, where (Snell)

    s m + h k m / sqrt(1 + (1 - k²) m² L²) = 1,    k = n_air / n_water.

The left side is monotone in m, concave for k < 1 and convex for k > 1; in both cases Newton's steps
from m = 1 / (s + h k) come from one side, and m has a limit where L vanishes: nothing is singular.
Prolonged in air, the ray would pass over X at the height 1/m above S. So X is on the sheet where

    f(X) = (n·L + (n·w)/m) / sqrt(1 + (1 - k²) (n·w)² (1 + q²)) = 0.

The root makes |grad f| = 1 on the sheet far from the window (s << h), so that f is the distance to
it. Without refraction (k = 1) f is n·X - d; behind the face the sheet is that plane.

Every kernel takes a sheet as one row of numbers, `COLUMNS` long; `Sheet.packed` makes it.
"""

import math

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel

START = 0
"""A plane near the sheet, normal and offset: where searches along rays begin. The sheet itself
where there is no window."""
NORMAL, OFFSET, FACE, SOURCE, DEPTH, RATIO, SLANT, WINDOWED = 4, 7, 8, 11, 14, 15, 16, 17
"""n, d, w (from the source to the water), S, s, k, n·w, and 1 where there is a window."""
COLUMNS = 18

_MAX_STEPS = 60
# Newton's next error is about the square of its step.
_LAST_STEP = 1e-9
# Along a ray: sheets bend with radii of metres, so the error after such a step (m) is below 1e-12.
_LAST_STEP_ALONG = 1e-6
_MAX_STEPS_ALONG = 20
# Where the plane near the sheet gives no sensible place on the ray, the search begins here.
_FARTHEST_START = 10.0


@inline_borrowing_kernel
def _steepness(s: float, h: float, k: float, rho: float) -> float:
    """Return m, the ray's tangent to w at the source for one metre of |L|; `rho` is L²."""
    b = 1.0 - k * k
    m = 1.0 / (s + h * k)
    if b < 0.0:
        # No ray in air is flatter than the one that grazes in the water.
        m = min(m, (1.0 - 1e-12) / math.sqrt(-b * rho + 1e-300))
    for _ in range(_MAX_STEPS):
        d2 = 1.0 + b * m * m * rho
        d = math.sqrt(d2)
        step = (s * m + h * k * m / d - 1.0) / (s + h * k / (d2 * d))
        m -= step
        if not abs(step) > _LAST_STEP * m:
            break
    return m


@inline_borrowing_kernel
def crossing(
    row: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float, float, float]:
    """Return f, the way from the source to where light to a point leaves the window, and h.

    The way (three numbers) is meaningless unless h, the point's height above the face, is positive.
    """
    vx, vy, vz = x - row[SOURCE], y - row[SOURCE + 1], z - row[SOURCE + 2]
    height = row[FACE] * vx + row[FACE + 1] * vy + row[FACE + 2] * vz
    s, k = row[DEPTH], row[RATIO]
    h = height - s
    off = row[NORMAL] * vx + row[NORMAL + 1] * vy + row[NORMAL + 2] * vz
    if not h > 0.0:
        return off, 0.0, 0.0, 0.0, h
    lx, ly, lz = (
        vx - height * row[FACE],
        vy - height * row[FACE + 1],
        vz - height * row[FACE + 2],
    )
    rho = lx * lx + ly * ly + lz * lz
    m = _steepness(s, h, k, rho)
    slant = row[SLANT]
    bend = (1.0 - k * k) * slant * slant
    f = (off - slant * (height - 1.0 / m)) / math.sqrt(1.0 + bend * (1.0 + m * m * rho))
    a = s * m
    return (
        f,
        a * lx + s * row[FACE],
        a * ly + s * row[FACE + 1],
        a * lz + s * row[FACE + 2],
        h,
    )


@inline_borrowing_kernel
def sheet_distance(row: FloatArray, x: float, y: float, z: float) -> float:
    """Return the signed distance f of a point from the sheet."""
    if row[WINDOWED] == 0.0:
        return float(row[NORMAL] * x + row[NORMAL + 1] * y + row[NORMAL + 2] * z - row[OFFSET])
    return crossing(row, x, y, z)[0]


@inline_borrowing_kernel
def differential(
    row: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float, float, float, float, float, float, float]:
    """Return f, and f's derivatives by the seven numbers that it depends on, then height, L.

    The derivatives are those by n·(X - S), by n·w, by w·(X - S), h, s, L² and k: whatever moves,
    point or parameter, moves these.
    """
    vx, vy, vz = x - row[SOURCE], y - row[SOURCE + 1], z - row[SOURCE + 2]
    height = row[FACE] * vx + row[FACE + 1] * vy + row[FACE + 2] * vz
    s, k, slant = row[DEPTH], row[RATIO], row[SLANT]
    h = height - s
    lx, ly, lz = (
        vx - height * row[FACE],
        vy - height * row[FACE + 1],
        vz - height * row[FACE + 2],
    )
    off = row[NORMAL] * vx + row[NORMAL + 1] * vy + row[NORMAL + 2] * vz
    if not (row[WINDOWED] != 0.0 and h > 0.0):
        return off, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height, lx, ly, lz
    rho = lx * lx + ly * ly + lz * lz
    m = _steepness(s, h, k, rho)
    b, q2 = 1.0 - k * k, m * m * rho
    d2 = 1.0 + b * q2
    d = math.sqrt(d2)
    d3 = d2 * d
    zeta = 1.0 / m
    a = s + h * k / d3
    # Derivatives of zeta by h, s, L² and k, from those of Snell's law.
    by_h, by_s = k / (d * m * a), 1.0 / (m * a)
    by_rho, by_k = -h * k * b * m / (2.0 * d3 * a), h * (1.0 + q2) / (d3 * m * a)
    e = 1.0 + b * slant * slant * (1.0 + q2)
    scale = 1.0 / math.sqrt(e)
    f = (off - slant * (height - zeta)) * scale
    by_zeta = slant * scale + f * b * slant * slant * m * q2 / e
    return (
        f,
        scale,
        -(height - zeta) * scale - f * b * slant * (1.0 + q2) / e,
        -slant * scale,
        by_zeta * by_h,
        by_zeta * by_s,
        by_zeta * by_rho - f * b * slant * slant * m * m / (2.0 * e),
        by_zeta * by_k + f * k * slant * slant * (1.0 + q2) / e,
        height,
        lx,
        ly,
        lz,
    )


@inline_borrowing_kernel
def sheet_tangent(
    row: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float, float]:
    """Return the signed distance f of a point from the sheet, and its gradient."""
    f, c_v, _, c_height, c_h, _, c_rho, _, _, lx, ly, lz = differential(row, x, y, z)
    c_w, c_l = c_height + c_h, 2.0 * c_rho
    return (
        f,
        c_v * row[NORMAL] + c_w * row[FACE] + c_l * lx,
        c_v * row[NORMAL + 1] + c_w * row[FACE + 1] + c_l * ly,
        c_v * row[NORMAL + 2] + c_w * row[FACE + 2] + c_l * lz,
    )


@inline_borrowing_kernel
def meet_sheet(
    row: FloatArray,
    ox: float,
    oy: float,
    oz: float,
    dx: float,
    dy: float,
    dz: float,
    near: float,
) -> tuple[float, float, float, float]:
    """Return where a ray meets a windowed sheet's part in the water, and f's gradient there.

    `near` is a guess of the distance along the ray. The distance found is NaN where Newton's
    method finds none ahead.
    """
    t = near if 0.0 < near < _FARTHEST_START else 1.0
    gx, gy, gz = 0.0, 0.0, 0.0
    for _ in range(_MAX_STEPS_ALONG):
        f, gx, gy, gz = sheet_tangent(row, ox + t * dx, oy + t * dy, oz + t * dz)
        step = f / (gx * dx + gy * dy + gz * dz)
        t -= step
        if not abs(step) > _LAST_STEP_ALONG:
            break
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    above = (
        row[FACE] * (x - row[SOURCE])
        + row[FACE + 1] * (y - row[SOURCE + 1])
        + row[FACE + 2] * (z - row[SOURCE + 2])
        - row[DEPTH]
    )
    if not (abs(step) <= _LAST_STEP_ALONG and t > 0.0 and above > 0.0):
        return math.nan, gx, gy, gz
    return t, gx, gy, gz


@borrowing_kernel
def distances(row: FloatArray, points: FloatArray, out: FloatArray) -> None:
    """Write f of points (N, 3)."""
    for i in range(points.shape[0]):
        out[i] = sheet_distance(row, points[i, 0], points[i, 1], points[i, 2])


@borrowing_kernel
def tangents(row: FloatArray, points: FloatArray, out: FloatArray) -> None:
    """Write f and its gradient, shape (N, 4), of points (N, 3)."""
    for i in range(points.shape[0]):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = sheet_tangent(
            row, points[i, 0], points[i, 1], points[i, 2]
        )


@borrowing_kernel
def differentials(row: FloatArray, points: FloatArray, out: FloatArray) -> None:
    """Write what `differential` returns, shape (N, 12), for points (N, 3)."""
    for i in range(points.shape[0]):
        values = differential(row, points[i, 0], points[i, 1], points[i, 2])
        for j in range(12):
            out[i, j] = values[j]


@borrowing_kernel
def meet_rays(
    row: FloatArray,
    origins: FloatArray,
    directions: FloatArray,
    valid: BoolArray,
    distance: FloatArray,
) -> None:
    """Write the distances (N,) along rays (N, 3) to a windowed sheet; NaN where there is none."""
    for i in range(origins.shape[0]):
        distance[i] = math.nan
        if not valid[i]:
            continue
        ox, oy, oz = origins[i, 0], origins[i, 1], origins[i, 2]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        approach = row[0] * dx + row[1] * dy + row[2] * dz
        near = (row[3] - row[0] * ox - row[1] * oy - row[2] * oz) / approach
        distance[i] = meet_sheet(row, ox, oy, oz, dx, dy, dz, near)[0]
