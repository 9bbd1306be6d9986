"""Radiance along one ray: daylight, lasers, veil, glow of the sheets, bubbles."""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import Vec, along, dot, minus, row3, scaled, unit
from aqualvs.optics.sheet import START, WINDOWED, sheet_tangent
from aqualvs.simulation.lasers import (
    CUT,
    NORMAL,
    SIGMA,
    SOURCE,
    Sheets,
    add_colour,
    laser_attenuation,
    peak_irradiance,
    sheet_coordinates,
    through_window,
)
from aqualvs.simulation.scene import Scene
from aqualvs.simulation.surfaces import NONE, Surfaces, first_hit, meet_bubbles, normal_and_albedo
from aqualvs.simulation.textures import Tiles, sample

# Daylight comes down steeply, inclined towards the target.
_UP = (0.10, -0.42, 0.90)
_SHADOW_MARGIN = 3e-4
_DARK = (0.0, 0.0, 0.0)
_EVERYWHERE = 1e3


class Light(NamedTuple):
    """Numbers of `WaterOptics` for the kernels of rays."""

    colours: FloatArray  # Shape (3, 3): rows: attenuation per metre, veil, ambient.
    # As in `WaterOptics`.
    sheet_scatter: float
    caustics: float
    glare: float
    time: float  # Moves the caustics, in seconds.


def pack_light(scene: Scene, t: float) -> Light:
    """Return the water of a scene for kernels."""
    water = scene.water
    colours = np.array([water.attenuation, water.veil, water.ambient], dtype=np.float64)
    return Light(
        colours, float(water.sheet_scatter), float(water.caustics), float(water.glare), float(t)
    )


class Members(NamedTuple):
    """Ellipsoids and bubbles that a ray may meet."""

    # Rows of the tables, tile after tile.
    ellipsoids: IntArray
    bubbles: IntArray
    # The part of those arrays that belongs to the ray's tile.
    first: int
    last: int
    first_bubble: int
    last_bubble: int


@inline_borrowing_kernel
def radiance(o: Vec, d: Vec, s: Surfaces, near: Members, sheets: Sheets, light: Light) -> Vec:
    """Return the radiance (red, green, blue) that arrives along a ray."""
    hit = first_hit(o, d, s, near.ellipsoids, near.first, near.last)
    red, green, blue = 0.0, 0.0, 0.0
    if hit.kind != NONE:
        normal, albedo = normal_and_albedo(o, d, hit, s)
        p = along(o, d, hit.t)
        sun = _daylight(p, normal, light, s.tiles)
        laser = _laser_light(p, normal, s, sheets, light)
        red = albedo[0] * (light.colours[2, 0] * sun + laser[0])
        green = albedo[1] * (light.colours[2, 1] * sun + laser[1])
        blue = albedo[2] * (light.colours[2, 2] * sun + laser[2])
    t, row = np.inf, -1
    if near.last_bubble > near.first_bubble:
        t, row = meet_bubbles(o, d, s, near.bubbles, near.first_bubble, near.last_bubble)
    glow = _sheet_glow(o, d, hit.t, sheets, light)
    veil = _veil(d, light)
    path = min(hit.t, _EVERYWHERE)
    seen = (
        _through(red, 0, path, veil, light) + glow[0],
        _through(green, 1, path, veil, light) + glow[1],
        _through(blue, 2, path, veil, light) + glow[2],
    )
    if t < hit.t:
        seen = _over_bubble(seen, o, d, t, row, s, sheets, light)
    return seen


@inline_borrowing_kernel
def _through(source: float, channel: int, path: float, veil: float, light: Light) -> float:
    """Attenuate by the water on the way and add the veil that it scatters in."""
    left = np.exp(-light.colours[0, channel] * path)
    return float(source * left + light.colours[1, channel] * veil * (1.0 - left))


@inline_borrowing_kernel
def _veil(d: Vec, light: Light) -> float:
    """Return the brightness of the veil by direction: lighter above, and the sun's glare."""
    veil = 1.0 + 0.55 * d[2] + 0.12 * d[0]
    if light.glare > 0.0:
        right, up = d[0] / d[1] - 0.22, d[2] / d[1] - 0.30
        shaft = 1.0 + 0.35 * np.sin(9.0 * np.arctan2(right, 0.75 - up) + 1.3 * light.time)
        veil += 6.0 * light.glare * shaft * np.exp(-(right * right + up * up) / 0.05)
    return veil


@inline_borrowing_kernel
def _daylight(p: Vec, normal: Vec, light: Light, tiles: Tiles) -> float:
    """Return diffuse light from above, with the moving network focused by waves."""
    sun = 0.55 + 0.45 * max(dot(normal, _UP), 0.0) * 1.6
    if light.caustics > 0.0:
        u, v = (p[0] + 0.35 * p[2]) / 0.0016, (0.5 * p[1] - 0.7 * p[2]) / 0.0016
        drift = 38.0 * light.time
        a = sample(tiles.ridges, u + drift, v + 0.4 * drift)
        b = sample(tiles.ridges, 0.83 * v - 0.7 * drift, 0.83 * u + 0.5 * drift)
        sun *= 1.0 + light.caustics * (1.9 * min(a, b) - 1.0)
    return sun


@inline_borrowing_kernel
def _laser_light(p: Vec, normal: Vec, s: Surfaces, sheets: Sheets, light: Light) -> Vec:
    """Return the laser light that a surface receives, all sheets together."""
    total = _DARK
    for i in range(sheets.table.shape[0]):
        off, distance, place, sigma = sheet_coordinates(p, sheets, i)
        if place < 0.0 or abs(off) > CUT * sigma:
            continue
        from_source, slant = _from_source(p, off, sigma, sheets, i)
        facing = -dot(from_source, normal)
        if facing <= 0.0 or _shadowed(p, from_source, slant, s):
            continue
        dimmed = laser_attenuation(row3(light.colours, 0, 0), sheets, i)
        peak = peak_irradiance(distance, sigma, place, dimmed, sheets, i)
        total = add_colour(total, peak * facing * np.exp(-0.5 * (off / sigma) ** 2), sheets, i)
    return total


@inline_borrowing_kernel
def _from_source(p: Vec, off: float, sigma: float, sheets: Sheets, i: int) -> tuple[Vec, float]:
    """Return direction and length of the light's way from its place in the source's thickness.

    Behind a window it is the way through the water, from the window on.
    """
    source = row3(sheets.table, i, SOURCE)
    if sheets.optics[i, WINDOWED] != 0.0:
        source = along(source, through_window(p, sheets, i)[1], 1.0)
    start = along(source, row3(sheets.table, i, NORMAL), off * sheets.table[i, SIGMA] / sigma)
    way = minus(p, start)
    length = np.sqrt(dot(way, way))
    return scaled(way, 1.0 / length), length


@inline_borrowing_kernel
def _shadowed(p: Vec, from_source: Vec, length: float, s: Surfaces) -> bool:
    start = along(p, from_source, -length)
    blocker = first_hit(start, from_source, s, s.all_ellipsoids, 0, s.all_ellipsoids.shape[0])
    return blocker.t < length - _SHADOW_MARGIN


@inline_borrowing_kernel
def _sheet_glow(o: Vec, d: Vec, reach: float, sheets: Sheets, light: Light) -> Vec:
    """Return the light that the water in the sheets scatters into the ray before `reach`."""
    glow = _DARK
    for i in range(sheets.table.shape[0]):
        t, slope = crossing_sheet(o, d, sheets, i)
        if not 0.0 < t < reach:
            continue
        _, distance, place, sigma = sheet_coordinates(along(o, d, t), sheets, i)
        if place < 0.0 or distance > sheets.first[i, int(place + 0.5)]:
            continue
        dimmed = laser_attenuation(row3(light.colours, 0, 0), sheets, i)
        peak = peak_irradiance(distance, sigma, place, dimmed, sheets, i)
        thickness = np.sqrt(2.0 * np.pi) * sigma / max(abs(slope), 0.02)
        seen = peak * thickness * light.sheet_scatter * np.exp(-dimmed * t)
        glow = add_colour(glow, seen, sheets, i)
    return glow


@inline_borrowing_kernel
def crossing_sheet(o: Vec, d: Vec, sheets: Sheets, i: int) -> tuple[float, float]:
    """Return where a ray crosses a sheet, and its cosine to the sheet's normal there.

    For a bent sheet, by one Newton step from the plane that fits it: the error is 0.2 mm at most.
    """
    optics = sheets.optics
    normal = row3(optics, i, START)
    slope = dot(d, normal)
    t = (optics[i, START + 3] - dot(o, normal)) / slope
    if optics[i, WINDOWED] != 0.0 and 0.0 < t < _EVERYWHERE:
        p = along(o, d, t)
        off, x, y, z = sheet_tangent(optics[i], p[0], p[1], p[2])
        slope = dot(d, (x, y, z))
        t -= off / slope
    return t, slope


@inline_borrowing_kernel
def _over_bubble(
    behind: Vec, o: Vec, d: Vec, t: float, row: int, s: Surfaces, sheets: Sheets, light: Light
) -> Vec:
    """Return the light with a bubble in front: totally reflecting rim, glints of sun and lasers."""
    p = along(o, d, t)
    normal = scaled(minus(p, row3(s.bubbles, row, 0)), 1.0 / s.bubbles[row, 3])
    facing = max(-dot(d, normal), 0.0)
    rim = (1.0 - facing) ** 2
    cover = min(0.18 + 1.1 * rim, 0.95)
    mirrored = unit(along(d, normal, 2.0 * facing))
    sky = 0.35 + 0.55 * max(mirrored[2], 0.0) + 2.2 * max(dot(mirrored, _UP), 0.0) ** 60
    laser = scaled(_laser_light(p, normal, s, sheets, light), 0.35 + 0.5 * rim)
    veil, rest = _veil(d, light), 1.0 - cover
    red, green, blue = row3(light.colours, 2, 0)
    return (
        rest * behind[0] + cover * _through(red * sky + laser[0], 0, t, veil, light),
        rest * behind[1] + cover * _through(green * sky + laser[1], 1, t, veil, light),
        rest * behind[2] + cover * _through(blue * sky + laser[2], 2, t, veil, light),
    )
