"""What a ray through a pixel brings home from printed panels, in compiled kernels."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel
from aqualvs.simulation.lasers import CUT, SOURCE, Sheets, peak_irradiance, sheet_coordinates
from aqualvs.simulation.vectors import Vec, along, combine, dot, minus, row3, unit

_ZERO = (0.0, 0.0, 0.0)
# Columns of the panel table.
_ORIGIN, _RIGHT, _DOWN, _INTO = 0, 3, 6, 9
COLUMNS = 12
# A laser's light that ends nearer to a panel than this share of its way has met it there.
_AT_END = 1e-6


class PanelTables(NamedTuple):
    """Panels as tables.

    Attributes
    ----------
    frames : array, shape (P, 12)
        Top-left corner, then unit vectors to the right, down and into the panel, in `dome`.
    cells : array, shape (P,)
        Side of a cell, in metres.
    shape : int array, shape (P, 2)
        Rows and columns.
    start : int array, shape (P,)
        Where each panel's part of `sums` begins.
    sums : array
        Sums of albedo, one panel after another.

    `sums[start[i] + r * (columns + 1) + c]` is the sum of the albedo over the first r rows and c
    columns of panel i.
    """

    frames: FloatArray
    cells: FloatArray
    shape: IntArray
    start: IntArray
    sums: FloatArray


class CornerRays(NamedTuple):
    """Rays through the corners of the pixels, shape (height + 1, width + 1, ...)."""

    origins: FloatArray
    directions: FloatArray
    valid: BoolArray


class Lamp(NamedTuple):
    """Place in `dome`, radiance of white that faces it, and how much of that it gives itself."""

    place: Vec
    level: float
    share: float


@borrowing_kernel
def render_panels(
    rays: CornerRays,
    samples: int,
    panels: PanelTables,
    sheets: Sheets,
    lamp: Lamp,
    out: NDArray[np.float32],
) -> None:
    """Average samples x samples rays over every pixel whose four corners see out."""
    weight, step = 1.0 / (samples * samples), 1.0 / samples
    valid = rays.valid
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            if not (
                valid[row, column]
                and valid[row, column + 1]
                and valid[row + 1, column]
                and valid[row + 1, column + 1]
            ):
                continue
            room, laser = 0.0, 0.0
            for k in range(samples * samples):
                x, y = (k % samples + 0.5) * step, (k // samples + 0.5) * step
                seen = _radiance(rays, row, column, x, y, step, panels, sheets, lamp)
                room, laser = room + seen[0], laser + seen[1]
            out[row, column, 0] = room * weight
            out[row, column, 1] = laser * weight


@inline_borrowing_kernel
def _radiance(
    rays: CornerRays,
    row: int,
    column: int,
    x: float,
    y: float,
    step: float,
    panels: PanelTables,
    sheets: Sheets,
    lamp: Lamp,
) -> tuple[float, float]:
    """Return room light and laser light that come along a ray, `step` pixels wide."""
    o, d = _ray(rays, row, column, x, y)
    i, t = _nearest(o, d, panels)
    if i < 0:
        return 0.0, 0.0
    p = along(o, d, t)
    u, v = _cell_of(p, panels, i)
    u_x, v_x = _shift(rays, row, column, x + 0.5 * step, y, panels, i, u, v)
    u_y, v_y = _shift(rays, row, column, x, y + 0.5 * step, panels, i, u, v)
    albedo = _mean(panels, i, u, v, abs(u_x) + abs(u_y), abs(v_x) + abs(v_y))
    normal = row3(panels.frames, i, _INTO)
    to_lamp = unit(minus(lamp.place, p))
    room = lamp.level * (1.0 - lamp.share * (1.0 - abs(dot(normal, to_lamp))))
    return albedo * room, albedo * _laser_light(p, normal, i, panels, sheets)


@inline_borrowing_kernel
def _ray(rays: CornerRays, row: int, column: int, x: float, y: float) -> tuple[Vec, Vec]:
    """Return the ray at (x, y) in 0..1 inside a pixel."""
    return (
        _between(rays.origins, row, column, x, y),
        unit(_between(rays.directions, row, column, x, y)),
    )


@inline_borrowing_kernel
def _between(corners: FloatArray, row: int, column: int, x: float, y: float) -> Vec:
    """Return the bilinear value between the corners of a pixel."""
    a, b = row3(corners[row], column, 0), row3(corners[row], column + 1, 0)
    c, e = row3(corners[row + 1], column, 0), row3(corners[row + 1], column + 1, 0)
    top = combine(a, 1.0 - x, b, x, _ZERO, 0.0)
    return combine(top, 1.0 - y, combine(c, 1.0 - x, e, x, _ZERO, 0.0), y, _ZERO, 0.0)


@inline_borrowing_kernel
def _meet(o: Vec, d: Vec, panels: PanelTables, i: int) -> float:
    """Return how far along a ray a panel's plane is; infinite or NaN where it is parallel."""
    into = row3(panels.frames, i, _INTO)
    return dot(minus(row3(panels.frames, i, _ORIGIN), o), into) / dot(d, into)


@inline_borrowing_kernel
def _cell_of(p: Vec, panels: PanelTables, i: int) -> tuple[float, float]:
    """Return column and row of a point of a panel's plane, in cells from its top left."""
    rel = minus(p, row3(panels.frames, i, _ORIGIN))
    scale = 1.0 / panels.cells[i]
    return (
        scale * dot(rel, row3(panels.frames, i, _RIGHT)),
        scale * dot(rel, row3(panels.frames, i, _DOWN)),
    )


@inline_borrowing_kernel
def _covers(p: Vec, panels: PanelTables, i: int) -> bool:
    u, v = _cell_of(p, panels, i)
    return bool(0.0 <= u <= panels.shape[i, 1] and 0.0 <= v <= panels.shape[i, 0])


@inline_borrowing_kernel
def _nearest(o: Vec, d: Vec, panels: PanelTables) -> tuple[int, float]:
    """Return the first panel that a ray meets and how far off; -1 where none."""
    best, where = -1, np.inf
    for i in range(panels.frames.shape[0]):
        t = _meet(o, d, panels, i)
        if 0.0 < t < where and _covers(along(o, d, t), panels, i):
            best, where = i, t
    return best, where


@inline_borrowing_kernel
def _shift(
    rays: CornerRays,
    row: int,
    column: int,
    x: float,
    y: float,
    panels: PanelTables,
    i: int,
    u: float,
    v: float,
) -> tuple[float, float]:
    """Return how many cells from (u, v) a neighbouring ray meets the panel's plane."""
    o, d = _ray(rays, row, column, x, y)
    near = _cell_of(along(o, d, _meet(o, d, panels, i)), panels, i)
    return near[0] - u, near[1] - v


@inline_borrowing_kernel
def _mean(panels: PanelTables, i: int, u: float, v: float, half_u: float, half_v: float) -> float:
    """Return the mean albedo over a rectangle around (u, v), as far as it lies on the panel."""
    rows, columns = panels.shape[i]
    # A rectangle of no size would divide nothing by nothing.
    half_u, half_v = max(half_u, 1e-6), max(half_v, 1e-6)
    left, right = max(u - half_u, 0.0), min(u + half_u, float(columns))
    top, low = max(v - half_v, 0.0), min(v + half_v, float(rows))
    total = _sum_to(panels, i, right, low) - _sum_to(panels, i, left, low)
    total -= _sum_to(panels, i, right, top) - _sum_to(panels, i, left, top)
    return total / ((right - left) * (low - top))


@inline_borrowing_kernel
def _sum_to(panels: PanelTables, i: int, u: float, v: float) -> float:
    """Return the sum of the albedo over all that is left of u and above v."""
    rows, columns = panels.shape[i]
    c, r = min(int(u), columns - 1), min(int(v), rows - 1)
    a, b = u - c, v - r
    k = panels.start[i] + r * (columns + 1) + c
    sums, below = panels.sums, k + columns + 1
    upper = sums[k] * (1.0 - a) + sums[k + 1] * a
    lower = sums[below] * (1.0 - a) + sums[below + 1] * a
    return float(upper * (1.0 - b) + lower * b)


@inline_borrowing_kernel
def _laser_light(p: Vec, normal: Vec, own: int, panels: PanelTables, sheets: Sheets) -> float:
    """Return the laser light that reaches a point of a panel, all sheets together."""
    light = 0.0
    for j in range(sheets.table.shape[0]):
        off, distance, place, sigma = sheet_coordinates(p, sheets, j)
        if place < 0.0 or abs(off) > CUT * sigma:
            continue
        way = minus(row3(sheets.table, j, SOURCE), p)
        if _is_shadowed(p, way, own, panels):
            continue
        peak = peak_irradiance(distance, sigma, place, 0.0, sheets, j)
        light += peak * np.exp(-0.5 * (off / sigma) ** 2) * abs(dot(unit(way), normal))
    return light


@inline_borrowing_kernel
def _is_shadowed(p: Vec, way: Vec, own: int, panels: PanelTables) -> bool:
    """Return whether a panel stands on the straight way from a point to a source."""
    for i in range(panels.frames.shape[0]):
        if i != own:
            t = _meet(p, way, panels, i)
            if _AT_END < t < 1.0 - _AT_END and _covers(along(p, way, t), panels, i):
                return True
    return False
