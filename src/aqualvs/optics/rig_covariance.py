"""Covariance of a posture from the uncertainty of the rig: the error that all frames share.

A surface is fitted by weighted least squares to points on the lasers' sheets. An error of a rig's
parameter moves the ray of a pixel, or the sheet that it meets, and so the point: by dX, whose
component off the surface is

    s·dX = q·(dp + t dv) - (s·v)/(g·v) df,    q = s - (s·v)/(g·v) g,

where s is the surface's normal, p + t v the ray, f the signed distance from the sheet and g its
gradient. The fit responds with dc = (sum w a a^T)^-1 sum w a (s·dX), a being the terms of its
coefficients c (for the plane m·X = 1: X itself); range, pitch and yaw follow (paper, Eq. 23-26).
Errors of a rig are smooth over the picture: derivatives of rays are taken once per rig on a lattice
of pixels, and a few pixels represent each stripe.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inner_kernel, lazy_kernel
from aqualvs.geometry.linear_algebra import cholesky, cholesky_solve
from aqualvs.optics.camera import Camera, parameter_names
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by
from aqualvs.optics.sheet import packed_sheets, sheet_distance, sheet_tangent, sheets_of

# Segments of stripe that represent all of it: in total, and per laser at least.
_BINS, _MIN_BINS = 24, 3
# Least number of points that are summed, where there are as many.
_ENOUGH = 384
# A pivot below this share of its diagonal is rounding, not information.
_MIN_PIVOT = 1e-12


class FittedSurface(NamedTuple):
    """A surface with K coefficients that was fitted to N points."""

    terms: FloatArray  # Shape (N, K): factors of the coefficients at each point.
    prior: FloatArray  # Shape (K,): prior information on each coefficient.
    normal: FloatArray  # Shape (3,): the gradient at X of the residual is `normal + bend @ X`.
    bend: FloatArray  # Shape (3, 3).
    posture: FloatArray  # Shape (3, K): derivatives of range, pitch and yaw by the coefficients.


def fitted_plane(m: FloatArray, points: FloatArray) -> FittedSurface:
    """Return the plane m·X = 1 as it is fitted to points (N, 3)."""
    # A point that moves along m makes m shorter.
    return FittedSurface(points, np.zeros(3), m, np.zeros((3, 3)), -posture_by_plane(m))


class StripeSums(NamedTuple):
    """Sums over B short segments of the stripes on a surface with K coefficients."""

    # Shape (B, 2), (B, 3): weighted means.
    pixels: FloatArray
    points: FloatArray
    # Shape (B,): index of the laser.
    laser: IntArray
    # Shape (B, K): weighted sum of the terms.
    pulls: FloatArray
    # Shape (K, K): normal matrix of the fit; only its lower half.
    matrix: FloatArray


class _SheetMoves(NamedTuple):
    """Sheets, and their changes by the uncertain parameters; those of laser i are a row range."""

    sheets: FloatArray
    first: IntArray
    column: IntArray
    ahead: FloatArray
    behind: FloatArray
    step: FloatArray


class _Lattice(NamedTuple):
    """Rays and their derivatives on a lattice of pixels.

    `table`, shape (H, W, 1 + C, 6), holds origin and direction of a ray, then their derivatives by
    the camera's uncertain parameters; `scale`, shape (2,), leads from pixels to places on it.
    """

    table: FloatArray
    scale: FloatArray


class _RigErrors(NamedTuple):
    """The uncertain parameters of a rig, P of them, and what their changes move."""

    lattice: _Lattice
    moves: _SheetMoves
    camera_columns: IntArray  # Which of the parameters are the camera's.
    covariance: FloatArray  # Shape (P, P): of the parameters.


class PostureErrors:
    """Propagation of the uncertainty of one rig to range, pitch and yaw.

    Parameters
    ----------
    rig : Rig
        With lasers.
    camera : Camera
        Of the rig, behind its dome or bare.
    uncertainty : RigUncertainty
        Numbers that it does not name are exact.

    Attributes
    ----------
    names : tuple of str
        Numbers of the rig that have an uncertainty, P of them.
    """

    def __init__(self, rig: Rig, camera: Camera, uncertainty: RigUncertainty) -> None:
        # Central differences: this share of a sigma, and no more than this in any unit.
        step_share, largest_step = 0.1, 1e-4
        sigmas = uncertainty.sigmas
        self.names = tuple(name for name in uncertainty.names if sigmas[name] > 0.0)
        steps = {name: min(step_share * sigmas[name], largest_step) for name in self.names}
        self._n_lasers = len(rig.lasers)
        own = parameter_names(camera)
        camera_columns = [i for i, name in enumerate(self.names) if name in own]
        camera_steps = {name: steps[name] for name in self.names if name in own}
        self._rig_errors = _RigErrors(
            _derivatives_on_lattice(replace(rig, housing=camera.housing), camera_steps),
            _sheet_moves(rig, camera, steps),
            np.array(camera_columns, np.int64),
            uncertainty.of(self.names),
        )

    def propagate(
        self,
        surface: FittedSurface,
        pixels: FloatArray,
        laser: IntArray,
        points: FloatArray,
        weights: FloatArray,
        each: int | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Propagate the uncertainty of the rig to (range, pitch, yaw), in m and rad.

        Parameters
        ----------
        surface : FittedSurface
            Surface of the posture.
        pixels, laser, points, weights : array, shape (N, 2), (N,), (N, 3), (N,)
            Points that it was fitted to, ordered along the stripes; weights are 1 over the variance
            of the residual, or 0.
        each : int, optional
            Largest number of short segments that represent the stripes of a laser.

        Returns
        -------
        jacobian : array, shape (3, P)
            Derivatives by the rig's parameters.
        covariance : array, shape (3, 3)
            Both are NaN where the points do not determine the surface.
        """
        n = len(self.names)
        jacobian, covariance = np.empty((3, n)), np.zeros((3, 3))
        if n:
            _propagate(
                surface,
                pixels,
                laser,
                points,
                weights,
                self._n_lasers,
                each or max(_MIN_BINS, -(-_BINS // max(self._n_lasers, 1))),
                self._rig_errors,
                jacobian,
                covariance,
            )
        return jacobian, covariance


def _derivatives_on_lattice(rig: Rig, steps: dict[str, float]) -> _Lattice:
    """Return the rays of a rig's camera, and their derivatives by the numbers that have steps."""
    # Nodes of the lattice: bilinear interpolation of r^6 over it is good to 2 % in the corners.
    lattice = (33, 25)
    width, height = rig.size_px
    n_x, n_y = lattice
    x, y = np.meshgrid(np.linspace(0, width - 1, n_x), np.linspace(0, height - 1, n_y))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    rays = rig.camera().rays(pixels)
    rows = [np.concatenate([rays.origins, rays.directions], axis=-1)]
    for name, h in steps.items():
        moved = (rig_moved_by(rig, [name], np.array([step])) for step in (h, -h))
        ahead, behind = (one.camera().rays(pixels) for one in moved)
        by_origin = (ahead.origins - behind.origins) / (2.0 * h)
        by_direction = (ahead.directions - behind.directions) / (2.0 * h)
        rows.append(np.concatenate([by_origin, by_direction], axis=-1))
    table = np.stack(rows, axis=1)
    seen = np.isfinite(table).all(axis=(1, 2))
    if not seen.any():
        table[:] = 0.0
    else:
        # Nodes without a ray get the values of the nearest one that has a ray.
        for i in np.flatnonzero(~seen):
            nearest = np.argmin(np.sum((pixels[seen] - pixels[i]) ** 2, axis=-1))
            table[i] = table[np.flatnonzero(seen)[nearest]]
    scale = np.array([(n_x - 1) / (width - 1), (n_y - 1) / (height - 1)])
    return _Lattice(np.ascontiguousarray(table.reshape(n_y, n_x, -1, 6)), scale)


def _sheet_moves(rig: Rig, camera: Camera, steps: dict[str, float]) -> _SheetMoves:
    column = {name: i for i, name in enumerate(steps)}
    ahead, behind, columns, sizes, first = [], [], [], [], [0]
    for laser, sheet in zip(rig.lasers, sheets_of(rig), strict=True):
        own = sheet.parameter_names
        full = [name if name == "n_water" else f"{laser.name}:{name}" for name in own]
        for i, name in enumerate(full):
            if name not in column:
                continue
            step = np.zeros(len(own))
            step[i] = steps[name]
            ahead.append(sheet.moved_by(step).packed())
            behind.append(sheet.moved_by(-step).packed())
            columns.append(column[name])
            sizes.append(2.0 * steps[name])
        first.append(len(columns))
    sheets = packed_sheets(rig, camera)
    shape = (-1, sheets.shape[1])
    return _SheetMoves(
        sheets,
        np.array(first, np.int64),
        np.array(columns, np.int64),
        np.array(ahead, np.float64).reshape(shape),
        np.array(behind, np.float64).reshape(shape),
        np.array(sizes, np.float64),
    )


@inner_kernel
def _sum_up(
    pixels: FloatArray,
    laser: IntArray,
    points: FloatArray,
    weights: FloatArray,
    terms: FloatArray,
    prior: FloatArray,
    n_lasers: int,
    each: int,
) -> StripeSums:
    """Return sums over runs of equally many points, at most `each` runs per laser.

    If there are many points, only every second or third is summed, for its neighbours too.
    """
    room, n_terms = each * n_lasers, terms.shape[1]
    mean_pixels, mean_points = np.zeros((room, 2)), np.zeros((room, 3))
    owner, pulls = np.zeros(room, np.int64), np.zeros((room, n_terms))
    matrix = np.zeros((n_terms, n_terms))
    for j in range(n_terms):
        matrix[j, j] = prior[j]
    chosen, n_chosen = np.empty(laser.shape[0], np.int64), 0
    for i in range(laser.shape[0]):
        chosen[n_chosen] = i
        n_chosen += weights[i] > 0.0
    stride = max(1, n_chosen // _ENOUGH)
    share = np.zeros(n_lasers)
    for c in range(0, n_chosen, stride):
        share[laser[chosen[c]]] += 1.0
    for own in range(n_lasers):
        share[own] = each / share[own] if share[own] > 0.0 else 0.0
    done, total = np.zeros(n_lasers), np.zeros(room)
    for c in range(0, n_chosen, stride):
        i = chosen[c]
        own, w = laser[i], weights[i]
        run = own * each + min(int(done[own] * share[own]), each - 1)
        done[own] += 1.0
        total[run] += w
        for j in range(2):
            mean_pixels[run, j] += w * pixels[i, j]
        for j in range(3):
            mean_points[run, j] += w * points[i, j]
        for j in range(n_terms):
            part = w * terms[i, j]
            pulls[run, j] += part
            for k in range(j + 1):
                matrix[j, k] += part * terms[i, k]
    n = 0
    for run in range(room):
        if total[run] > 0.0:
            for j in range(2):
                mean_pixels[n, j] = mean_pixels[run, j] / total[run]
            for j in range(3):
                mean_points[n, j] = mean_points[run, j] / total[run]
            for j in range(n_terms):
                pulls[n, j] = pulls[run, j]
            owner[n] = run // each
            n += 1
    return StripeSums(mean_pixels[:n], mean_points[:n], owner[:n], pulls[:n], matrix)


@lazy_kernel
def _propagate(
    surface: FittedSurface,
    pixels: FloatArray,
    laser: IntArray,
    points: FloatArray,
    weights: FloatArray,
    n_lasers: int,
    each: int,
    rig_errors: _RigErrors,
    jacobian: FloatArray,
    covariance: FloatArray,
) -> None:
    """Write the derivatives J (3, P) of range, pitch and yaw by the rig's parameters, and J C J^T.

    Arguments as of `PostureErrors.propagate`; `covariance` (3, 3) is zero at first.
    """
    sums = _sum_up(pixels, laser, points, weights, surface.terms, surface.prior, n_lasers, each)
    n, n_terms = jacobian.shape[1], surface.terms.shape[1]
    factor, gain, slopes = np.empty((n_terms, n_terms)), surface.posture.copy(), np.empty(n)
    scratch = np.empty(15)
    if not cholesky(sums.matrix, 0.0, _MIN_PIVOT, factor):
        jacobian[:] = np.nan
        covariance[:] = np.nan
        return
    jacobian[:] = 0.0
    for i in range(3):
        cholesky_solve(factor, gain[i], gain[i])
    for b in range(sums.laser.shape[0]):
        _write_slopes(surface, sums, b, rig_errors, scratch, slopes)
        for i in range(3):
            pull = 0.0
            for j in range(n_terms):
                pull += gain[i, j] * sums.pulls[b, j]
            for p in range(n):
                jacobian[i, p] += pull * slopes[p]
    for i in range(3):
        for p in range(n):
            passed = 0.0
            for k in range(n):
                passed += jacobian[i, k] * rig_errors.covariance[k, p]
            for j in range(3):
                covariance[i, j] += passed * jacobian[j, p]


@inner_kernel
def _write_slopes(
    surface: FittedSurface,
    sums: StripeSums,
    b: int,
    rig_errors: _RigErrors,
    scratch: FloatArray,
    slopes: FloatArray,
) -> None:
    """Write by how much each parameter moves one stretch of stripe off the surface, s·dX."""
    normal, bend, lattice = surface.normal, surface.bend, rig_errors.lattice
    moves, camera_columns = rig_errors.moves, rig_errors.camera_columns
    table, own = lattice.table, sums.laser[b]
    place_x = min(max(sums.pixels[b, 0] * lattice.scale[0], 0.0), table.shape[1] - 1.0)
    place_y = min(max(sums.pixels[b, 1] * lattice.scale[1], 0.0), table.shape[0] - 1.0)
    ix, iy = min(int(place_x), table.shape[1] - 2), min(int(place_y), table.shape[0] - 2)
    sx, sy = place_x - ix, place_y - iy
    w00, w01, w10, w11 = (1 - sy) * (1 - sx), (1 - sy) * sx, sy * (1 - sx), sy * sx
    a00, a01, a10, a11 = table[iy, ix], table[iy, ix + 1], table[iy + 1, ix], table[iy + 1, ix + 1]
    ray, s, lever = scratch[:6], scratch[6:9], scratch[9:]
    for j in range(6):
        ray[j] = w00 * a00[0, j] + w01 * a01[0, j] + w10 * a10[0, j] + w11 * a11[0, j]
    x, y, z = sums.points[b, 0], sums.points[b, 1], sums.points[b, 2]
    for j in range(3):
        s[j] = normal[j] + bend[j, 0] * x + bend[j, 1] * y + bend[j, 2] * z
    t = (x - ray[0]) * ray[3] + (y - ray[1]) * ray[4] + (z - ray[2]) * ray[5]
    _, gx, gy, gz = sheet_tangent(moves.sheets[own], x, y, z)
    approach = s[0] * ray[3] + s[1] * ray[4] + s[2] * ray[5]
    ratio = approach / (gx * ray[3] + gy * ray[4] + gz * ray[5])
    lever[0], lever[1], lever[2] = s[0] - ratio * gx, s[1] - ratio * gy, s[2] - ratio * gz
    for j in range(3):
        lever[3 + j] = t * lever[j]
    slopes[:] = 0.0
    for c in range(camera_columns.shape[0]):
        slope = 0.0
        for j in range(6):
            moved = w00 * a00[c + 1, j] + w01 * a01[c + 1, j]
            moved += w10 * a10[c + 1, j] + w11 * a11[c + 1, j]
            slope += lever[j] * moved
        slopes[camera_columns[c]] = slope
    for k in range(moves.first[own], moves.first[own + 1]):
        ahead = sheet_distance(moves.ahead[k], x, y, z)
        behind = sheet_distance(moves.behind[k], x, y, z)
        slopes[moves.column[k]] -= ratio * (ahead - behind) / moves.step[k]


def posture_by_plane(m: FloatArray) -> FloatArray:
    """Return the derivatives (3, 3) of (range, pitch, yaw) by m (paper, Eq. 25-26)."""
    x, y, z = m.tolist()
    yz, xy, square = y * y + z * z, x * x + y * y, x * x + y * y + z * z
    cube = math.sqrt(square) * square
    by_range = [-x / cube, -y / cube, -z / cube]
    return np.array([by_range, [0.0, -z / yz, y / yz], [y / xy, -x / xy, 0.0]])
