"""Sheets of laser light in the water: planes, or curved behind a flat window.

A laser behind a window that is tilted to its beam does not light a plane: the sheet leaves the
window as another plane would, then deviates from it by millimetres within the working range, and
moves with the water's index. A `Sheet` covers both cases.

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
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import BoolArray, FloatArray, as_vectors
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.geometry.planes import Plane, Rays
from aqualvs.optics.camera import Camera
from aqualvs.optics.refraction import refract
from aqualvs.optics.rig import (
    LASER_PARAMETERS,
    LASER_WINDOW_PARAMETERS,
    Laser,
    Rig,
    Window,
    moved_plane,
    tangent_basis,
)

START = 0
"""A plane near the sheet, normal and offset, at which searches along rays begin. The sheet itself
where there is no window."""
NORMAL, OFFSET, FACE, SOURCE, DEPTH, RATIO, SLANT, WINDOWED = 4, 7, 8, 11, 14, 15, 16, 17
"""n, d, w (from the source to the water), S, s, k, n·w, and 1 where there is a window."""
COLUMNS = 18


@inline_borrowing_kernel
def _steepness(s: float, h: float, k: float, rho: float) -> float:
    """Return m, the ray's tangent to w at the source for one metre of |L|; `rho` is L²."""
    b = 1.0 - k * k
    m = 1.0 / (s + h * k)
    if b < 0.0:
        # No ray in air is flatter than the one that grazes in the water.
        m = min(m, (1.0 - 1e-12) / math.sqrt(-b * rho + 1e-300))
    max_steps = 60
    # Newton's next error is about the square of its step.
    last_step = 1e-9
    for _ in range(max_steps):
        d2 = 1.0 + b * m * m * rho
        d = math.sqrt(d2)
        step = (s * m + h * k * m / d - 1.0) / (s + h * k / (d2 * d))
        m -= step
        if not abs(step) > last_step * m:
            break
    return m


@inline_borrowing_kernel
def crossing(
    row: FloatArray, x: float, y: float, z: float
) -> tuple[float, float, float, float, float]:
    """Return f, the vector from the source to the point where light leaves the window, and h.

    The vector (three numbers) is valid only if h, the point's height above the face, is positive.
    """
    vx, vy, vz = x - row[SOURCE], y - row[SOURCE + 1], z - row[SOURCE + 2]
    height = row[FACE] * vx + row[FACE + 1] * vy + row[FACE + 2] * vz
    s, k = row[DEPTH], row[RATIO]
    h = height - s
    off = row[NORMAL] * vx + row[NORMAL + 1] * vy + row[NORMAL + 2] * vz
    if not h > 0.0:
        return off, 0.0, 0.0, 0.0, h
    lx, ly, lz = (vx - height * row[FACE], vy - height * row[FACE + 1], vz - height * row[FACE + 2])
    rho = lx * lx + ly * ly + lz * lz
    m = _steepness(s, h, k, rho)
    slant = row[SLANT]
    bend = (1.0 - k * k) * slant * slant
    f = (off - slant * (height - 1.0 / m)) / math.sqrt(1.0 + bend * (1.0 + m * m * rho))
    a = s * m
    return (f, a * lx + s * row[FACE], a * ly + s * row[FACE + 1], a * lz + s * row[FACE + 2], h)


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

    The derivatives are those by n·(X - S), by n·w, by w·(X - S), h, s, L² and k: a change of the
    point or of any parameter acts through these.
    """
    vx, vy, vz = x - row[SOURCE], y - row[SOURCE + 1], z - row[SOURCE + 2]
    height = row[FACE] * vx + row[FACE + 1] * vy + row[FACE + 2] * vz
    s, k, slant = row[DEPTH], row[RATIO], row[SLANT]
    h = height - s
    lx, ly, lz = (vx - height * row[FACE], vy - height * row[FACE + 1], vz - height * row[FACE + 2])
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
def intersect_ray(
    row: FloatArray, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float, near: float
) -> tuple[float, float, float, float]:
    """Return the distance along a ray to a windowed sheet in the water, and f's gradient there.

    `near` is an initial guess of the distance, which is NaN where Newton's method finds no
    intersection ahead.
    """
    # Start of the search where the plane near the sheet gives no usable place on the ray.
    farthest_start = 10.0
    t = near if 0.0 < near < farthest_start else 1.0
    gx, gy, gz = 0.0, 0.0, 0.0
    # Along a ray: sheets bend with radii of metres, so the error after such a step (m) is below
    # 1e-12.
    last_step_along = 1e-6
    max_steps_along = 20
    for _ in range(max_steps_along):
        f, gx, gy, gz = sheet_tangent(row, ox + t * dx, oy + t * dy, oz + t * dz)
        step = f / (gx * dx + gy * dy + gz * dz)
        t -= step
        if not abs(step) > last_step_along:
            break
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    above = (
        row[FACE] * (x - row[SOURCE])
        + row[FACE + 1] * (y - row[SOURCE + 1])
        + row[FACE + 2] * (z - row[SOURCE + 2])
        - row[DEPTH]
    )
    if not (abs(step) <= last_step_along and t > 0.0 and above > 0.0):
        return math.nan, gx, gy, gz
    return t, gx, gy, gz


@borrowing_kernel
def distances(row: FloatArray, points: FloatArray, out: FloatArray) -> None:
    """Write f of points (N, 3)."""
    for i in range(points.shape[0]):
        out[i] = sheet_distance(row, points[i, 0], points[i, 1], points[i, 2])


@borrowing_kernel
def differentials(row: FloatArray, points: FloatArray, out: FloatArray) -> None:
    """Write what `differential` returns, shape (N, 12), for points (N, 3)."""
    for i in range(points.shape[0]):
        values = differential(row, points[i, 0], points[i, 1], points[i, 2])
        for j in range(12):
            out[i, j] = values[j]


@borrowing_kernel
def intersect_rays(
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
        distance[i] = intersect_ray(row, ox, oy, oz, dx, dy, dz, near)[0]


WINDOW_PARAMETERS = (*LASER_WINDOW_PARAMETERS, "n_water")
"""Columns that follow `LASER_PARAMETERS` where there is a window.

Only the ratio of the indices matters: the derivative by `n_air` is that by `n_water` times
-n_water / n_air.
"""

# Distance beyond the window at which the tangent plane represents the sheet, in metres.
_USUAL_REACH = 0.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Sheet:
    """The light of one laser in the water, in `dome`."""

    plane: Plane  # As `Laser.plane`: in air, where there is a window.
    window: Window | None = None  # As `Laser.window`.
    # Refractive indices behind the window and in front of it.
    n_air: float = 1.0
    n_water: float = 1.0

    _row: FloatArray = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_row", self._pack())
        if self.window is not None:
            start = self._plane_beyond()
            self._row[START : START + 3], self._row[START + 3] = start.normal, start.offset

    @property
    def is_plane(self) -> bool:
        """Whether the sheet in the water is `plane` itself, because there is no window."""
        return self.window is None

    @property
    def source(self) -> FloatArray:
        """Point that the light fans out from, exactly in the plane, shape (3,).

        Raises `ValueError` if there is no window: the source is then not known, and not needed.
        """
        if self.window is None:
            raise ValueError("a sheet without a window has no source")
        at = self.window.source
        return at - float(self.plane.signed_distance(at)) * self.plane.normal

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Parameters of `signed_distance_with_parameter_jacobian` and `moved_by`, in order."""
        return LASER_PARAMETERS + (() if self.window is None else WINDOW_PARAMETERS)

    def laser(self, like: Laser) -> Laser:
        """Return a laser with this sheet, and the other attributes of `like`."""
        return replace(like, plane=self.plane, window=self.window)

    def signed_distance(self, points: ArrayLike) -> FloatArray:
        """Return the signed distance (...) of points (..., 3) from the sheet, in metres.

        Exact for planes. Behind a window it is exactly zero on the sheet and grows by a metre a
        metre to 1 %, half a metre from a source that is 20 mm behind a window tilted by 25 degrees
        to the sheet (5 % if it is tilted along the sheet by as much again); less tilt, a nearer
        source or more distance reduce the error. The distance of points behind the window's face is
        that from the plane in air. The sign is that of `plane`.
        """
        p = as_vectors(points, 3, "points")
        if self.window is None:
            return self.plane.signed_distance(p)
        found = np.empty(p.shape[:-1])
        distances(self._row, p.reshape(-1, 3), found.reshape(-1))
        return found

    def gradient(self, points: ArrayLike) -> FloatArray:
        """Return the gradient (..., 3) of `signed_distance` at points (..., 3)."""
        p = as_vectors(points, 3, "points")
        return self._by_point(self._differentials(p.reshape(-1, 3))).reshape(p.shape)

    def tangent_plane(self, point: ArrayLike) -> Plane:
        """Return the plane that touches the sheet beside a point (3,) near it."""
        p = as_vectors(point, 3, "point")
        if self.window is None:
            return self.plane
        parts = self._differentials(p[None])
        gradient = self._by_point(parts)[0]
        return Plane.from_normal(gradient, float(gradient @ p - parts[0, 0]))

    def intersect(self, rays: Rays) -> tuple[FloatArray, BoolArray]:
        """Intersect rays with the sheet, as `Plane.intersect` does with a plane.

        Returns
        -------
        points : array, shape (..., 3)
            NaN where there is none ahead, or none in front of the window's face.
        valid : bool array, shape (...)

        Notes
        -----
        Newton's method from the sheet's tangent plane, to 1e-12 m. A ray that grazes the sheet can
        meet it twice; one of the two is found.
        """
        if self.window is None:
            return self.plane.intersect(rays)
        distance = np.empty(rays.valid.shape)
        intersect_rays(
            self._row,
            np.ascontiguousarray(rays.origins).reshape(-1, 3),
            np.ascontiguousarray(rays.directions).reshape(-1, 3),
            np.ascontiguousarray(rays.valid).reshape(-1),
            distance.reshape(-1),
        )
        return rays.points_at(distance), np.isfinite(distance)

    def best_plane(self, camera: Camera, working_range: tuple[float, float]) -> Plane:
        """Return the plane that fits the sheet best where the camera sees it.

        For uses that need only an approximate plane: frames of drawings, the mesh filter, initial
        guesses. Without a window it is `plane`.

        `working_range`: points at these distances from the dome's centre count, in metres.
        """
        if self.window is None:
            return self.plane
        width, height = camera.size_px
        # Rays to each side on which a plane is fitted to a sheet.
        grid = (33, 25)
        x, y = np.meshgrid(np.linspace(0, width - 1, grid[0]), np.linspace(0, height - 1, grid[1]))
        points, valid = self.intersect(camera.rays(np.stack([x, y], axis=-1)))
        points = points[valid]
        distance = np.linalg.norm(points, axis=-1)
        near, far = working_range
        points = points[(distance >= near) & (distance <= far)]
        start = Plane(self._row[START : START + 3].copy(), float(self._row[START + 3]))
        if len(points) < 3:
            return start
        found = Plane.fitted(points)
        sign = 1.0 if found.normal @ start.normal > 0.0 else -1.0
        return Plane.from_normal(sign * found.normal, sign * found.offset)

    def shine(self, directions: ArrayLike) -> tuple[Rays, FloatArray]:
        """Trace light from the source through the window.

        Parameters
        ----------
        directions : array, shape (..., 3)
            Unit directions in air; those in the laser's plane are the sheet.

        Returns
        -------
        rays : Rays
            In the water, from the window's face on; not valid where the light misses the window or
            is reflected back.
        way : array, shape (...)
            Length of the light's way to the face, in metres.

        Raises
        ------
        ValueError
            If there is no window.
        """
        source = self.source
        d, face = as_vectors(directions, 3, "directions"), self._row[FACE : FACE + 3]
        ahead = d @ face
        with np.errstate(divide="ignore", invalid="ignore"):
            way = np.where(ahead > 0.0, self._row[DEPTH] / ahead, np.nan)
        bent, through = refract(d, -face, n_in=self.n_air, n_out=self.n_water)
        valid = through & np.isfinite(way)
        bent = np.where(valid[..., None], bent, np.nan)
        return Rays(source + way[..., None] * d, bent, valid), way

    def signed_distance_with_parameter_jacobian(
        self, points: ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the signed distances of points (N, 3) and their derivatives.

        Returns
        -------
        distance : array, shape (N,)
        by_point : array, shape (N, 3)
        by_parameter : array, shape (N, P)
            By `parameter_names`, at the step zero of `moved_by`.
        """
        p = as_vectors(points, 3, "points").reshape(-1, 3)
        parts = self._differentials(p)
        f, (by_v, by_slant, by_height, by_h, by_s, by_rho, by_k) = parts[:, 0], parts[:, 1:8].T
        height, beside = parts[:, 8], parts[:, 9:]
        normal, face, slant = self._row[NORMAL:OFFSET], self._row[FACE:SOURCE], self._row[SLANT]
        by_point = self._by_point(parts)
        # The source stays in the plane: as the plane moves along its normal, so does the source.
        by_source_along_normal = -slant * (by_height + by_s) - 2.0 * by_rho * (beside @ normal)
        columns = []
        for tangent in tangent_basis(normal):
            lag = float(tangent @ self._row[SOURCE:DEPTH])
            turned = by_v * (p @ tangent) + by_slant * (tangent @ face)
            columns.append(turned - lag * by_source_along_normal)
        columns.append(by_source_along_normal - by_v)
        if self.window is not None:
            toward_water = self._toward_water(self.window)
            for tangent in toward_water * tangent_basis(self.window.face.normal):
                before = (p - self._row[SOURCE:DEPTH]) @ tangent
                columns.append(
                    by_slant * (tangent @ normal)
                    + (by_height - 2.0 * height * by_rho) * before
                    + by_h * (p @ tangent)
                    - by_s * (tangent @ self._row[SOURCE:DEPTH])
                )
            columns.append(toward_water * (by_s - by_h))
            for tangent in tangent_basis(normal):
                columns.append(
                    -(by_height + by_s) * (tangent @ face) - 2.0 * by_rho * (beside @ tangent)
                )
            columns.append(-by_k * self._row[RATIO] / self.n_water)
        return f, by_point, np.stack(columns, axis=-1)

    def _differentials(self, points: FloatArray) -> FloatArray:
        """Return what `differential` returns, shape (N, 12), for points (N, 3)."""
        parts = np.zeros((len(points), 12))
        if self.window is not None:
            differentials(self._row, points, parts)
            return parts
        # A plane: no refraction.
        normal, face = self._row[NORMAL:OFFSET], self._row[FACE:SOURCE]
        from_source = points - self._row[SOURCE:DEPTH]
        parts[:, 0], parts[:, 1], parts[:, 8] = from_source @ normal, 1.0, from_source @ face
        parts[:, 9:] = from_source - parts[:, 8, None] * face
        return parts

    def moved_by(self, step: ArrayLike) -> "Sheet":
        """Return the sheet with `step` (P,) added to the parameters `parameter_names`.

        The source keeps to the plane. SI units and radians.
        """
        values = as_vectors(step, len(self.parameter_names), "step").tolist()
        plane = moved_plane(self.plane, *values[:3])
        if self.window is None:
            return replace(self, plane=plane)
        shift = np.array(values[6:8]) @ tangent_basis(self.plane.normal)
        window = Window(moved_plane(self.window.face, *values[3:6]), self.source + shift)
        moved = replace(self, plane=plane, window=window, n_water=self.n_water + values[8])
        return replace(moved, window=replace(window, source=moved.source))

    def packed(self, start: Plane | None = None) -> FloatArray:
        """Return the sheet as kernels take it, shape (COLUMNS,).

        `start`: where searches along rays begin, such as `best_plane`; a tangent plane if left out.
        """
        row = self._row.copy()
        if start is not None and self.window is not None:
            row[START : START + 3], row[START + 3] = start.normal, start.offset
        return row

    def _by_point(self, parts: FloatArray) -> FloatArray:
        """Return the gradients (N, 3) of f, from `_differentials`."""
        by_v, _, by_height, by_h, _, by_rho = parts[:, 1:7].T
        normal, face = self._row[NORMAL:OFFSET], self._row[FACE:SOURCE]
        by_point: FloatArray = by_v[:, None] * normal + (by_height + by_h)[:, None] * face
        by_point += 2.0 * by_rho[:, None] * parts[:, 9:]
        return by_point

    def _toward_water(self, window: Window) -> float:
        """1 if the face's normal points away from the source, else -1."""
        return 1.0 if window.face.signed_distance(self.source) <= 0.0 else -1.0

    def _pack(self) -> FloatArray:
        row = np.zeros(COLUMNS)
        for first in (START, NORMAL):
            row[first : first + 3], row[first + 3] = self.plane.normal, self.plane.offset
        # Without a window any point of the plane serves as the source.
        row[SOURCE:DEPTH], row[RATIO] = self.plane.normal * self.plane.offset, 1.0
        if self.window is None:
            return row
        source = self.source
        face = self._toward_water(self.window) * self.window.face.normal
        row[FACE:SOURCE], row[SOURCE:DEPTH] = face, source
        row[DEPTH] = abs(float(self.window.face.signed_distance(source)))
        row[RATIO], row[SLANT] = self.n_air / self.n_water, float(self.plane.normal @ face)
        row[WINDOWED] = 1.0
        return row

    def _plane_beyond(self) -> Plane:
        """Return the tangent plane `_USUAL_REACH` along the light squarest to the window."""
        face, depth = self._row[FACE:SOURCE], self._row[DEPTH]
        inward = face - self._row[SLANT] * self.plane.normal
        length = float(np.linalg.norm(inward))
        if length < 1e-6:
            return self.plane
        inward /= length
        bent, _ = refract(inward, -face, n_in=self.n_air, n_out=self.n_water)
        source = self._row[SOURCE:DEPTH]
        return self.tangent_plane(
            source + depth / float(inward @ face) * inward + _USUAL_REACH * bent
        )


def sheet_in(laser: Laser, n_air: float, n_water: float) -> Sheet:
    """Return the sheet of a laser with air behind its window and water in front of it."""
    return Sheet(plane=laser.plane, window=laser.window, n_air=n_air, n_water=n_water)


def sheets_of(rig: Rig) -> tuple[Sheet, ...]:
    """Return the sheets of a rig's lasers in its water, in the order of `rig.lasers`."""
    return tuple(sheet_in(laser, rig.n_air, rig.n_water) for laser in rig.lasers)


def packed_sheets(rig: Rig, camera: Camera) -> FloatArray:
    """Return a rig's sheets as kernels take them, shape (n, COLUMNS).

    Parameters
    ----------
    rig : Rig
        Lasers, indices and working range.
    camera : Camera
        Searches along its rays begin at the planes that best fit the sheets in its view.
    """
    rows = [s.packed(s.best_plane(camera, rig.working_range)) for s in sheets_of(rig)]
    return np.array(rows).reshape(-1, COLUMNS)


def planes_and_bent(sheets: FloatArray) -> tuple[FloatArray, FloatArray | None]:
    """Return the planes of packed sheets, and the sheets if windows bend any of them.

    A kernel that is given None is compiled without the code for bent sheets.
    """
    planes = np.ascontiguousarray(sheets[:, START : START + 4])
    return planes, sheets if sheets[:, WINDOWED].any() else None
