"""Fish nets: intersection of rays with twine, on flat, bulging or folded nets.

The axes of the strands lie in the net plane (or in its bulging or folded surface, where the
tangent plane at the crossing stands in for it). A ray that crosses the plane beside an axis at
lateral distance w meets that strand's cylinder where, in the cross-section of the strand,
(w + q tau)² + (z tau)² = r²; only the nearest strand of each family can be met, because the
distance from an axis is w times the same cosine for all of them.

Folds and slack are a height over the net's surface (`folded`); their crossing with a ray is found
by stepping and bisection.
"""

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.compiled import inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import (
    Vec,
    along,
    combine,
    cross,
    dot,
    minus,
    row3,
    scaled,
    unit,
)
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.scene import Fold, Net
from aqualvs.simulation.textures import Tiles, sample, white_at

if TYPE_CHECKING:
    from aqualvs.simulation.surfaces import Surfaces

NET, DIRECTION_U, DIRECTION_V, PLACE, HEIGHT, WIDTH, PERIOD, FOLD_COLUMNS = range(8)


def pack_fold(i_net: int, fold: Fold) -> FloatArray:
    """Return one row of the fold table, shape (N_COLUMNS,).

    Raises `OptionError` if the width is not positive, or the folds of a row run into each other.
    """
    if not fold.width > 0.0:
        raise OptionError(f"fold of a net: width is {1e3 * fold.width:g} mm; it must be positive")
    if fold.overlaps:
        raise OptionError(
            f"fold of a net: period is {1e3 * fold.period:g} mm, less than the "
            f"{2e3 * fold.width:g} mm from foot to foot; make it longer or 0"
        )
    way = (math.cos(fold.direction), math.sin(fold.direction))
    return np.array([i_net, *way, fold.place, fold.height, fold.width, fold.period])


@inline_borrowing_kernel
def folded(u: float, v: float, folds: FloatArray, i: int) -> tuple[float, float, float]:
    """Return height (m) and slopes along u and v of the folds of net i."""
    height, slope_u, slope_v = 0.0, 0.0, 0.0
    for k in range(folds.shape[0]):
        if folds[k, NET] != i:
            continue
        s = folds[k, DIRECTION_U] * u + folds[k, DIRECTION_V] * v - folds[k, PLACE]
        if folds[k, PERIOD] > 0.0:
            s -= folds[k, PERIOD] * np.floor(s / folds[k, PERIOD] + 0.5)
        if abs(s) >= folds[k, WIDTH]:
            continue
        phase = np.pi * s / folds[k, WIDTH]
        height += 0.5 * folds[k, HEIGHT] * (1.0 + np.cos(phase))
        slope = -0.5 * folds[k, HEIGHT] * np.pi / folds[k, WIDTH] * np.sin(phase)
        slope_u += slope * folds[k, DIRECTION_U]
        slope_v += slope * folds[k, DIRECTION_V]
    return height, slope_u, slope_v


@inline_borrowing_kernel
def fold_limits(folds: FloatArray, i: int) -> tuple[float, float, float]:
    """Return the limits of the folds of net i: lowest (0 or less), highest, steepest slope."""
    low, high, steepest = 0.0, 0.0, 0.0
    for k in range(folds.shape[0]):
        if folds[k, NET] == i:
            low += min(folds[k, HEIGHT], 0.0)
            high += max(folds[k, HEIGHT], 0.0)
            steepest += 0.5 * np.pi * abs(folds[k, HEIGHT]) / folds[k, WIDTH]
    return low, high, steepest


ORIGIN, AXIS_U, AXIS_V, NORMAL = 0, 3, 6, 9
KAPPA_U, KAPPA_V, IS_HEXAGON, BAR, RADIUS, FOULING, GROWTH, MISSING = range(12, 20)
SEED, HALF_U, HALF_V, OFFSET_U, OFFSET_V, FAMILIES, DIRECTIONS = range(20, 27)
SPACING, ALBEDO, NET_COLUMNS = 32, 35, 38


class _TwineLook(NamedTuple):
    """Shape and look of twisted twine."""

    # Helix of the twine: spacing of the plies along it, in radii, and depth of the grooves.
    lay: float = 2.2
    groove: float = 0.07
    # Extra thickness of a knot (or a joint of knotless netting), relative to the twine.
    knot: float = 0.45
    growth_albedo: tuple[float, float, float] = (0.42, 0.46, 0.26)


_TWINE = _TwineLook()


class Strand(NamedTuple):
    """Intersection of a ray with a strand."""

    t: float  # Distance along the ray; infinite where it misses.
    normal: Vec  # Outward normal of the cylinder in `dome`.
    along: float  # Position along the strand, in metres.
    across: float  # Lateral position on the strand, -1 to 1 of its radius.
    growth: float  # Thickness of the growth there, as a fraction of the twine's radius.


NO_STRAND = Strand(np.inf, (0.0, 0.0, 0.0), 0.0, 0.0, 0.0)
"""That of a ray that meets none."""


def pack_net(net: Net, dome_from_scene: SE3) -> FloatArray:
    """Return one row of the net table, shape (N_COLUMNS,), everything in `dome`."""
    row = np.zeros(NET_COLUMNS)
    row[ORIGIN : ORIGIN + 3] = dome_from_scene.translation
    axes = dome_from_scene.rotation
    row[AXIS_U : AXIS_U + 3], row[AXIS_V : AXIS_V + 3] = axes[:, 0], axes[:, 2]
    row[NORMAL : NORMAL + 3] = axes[:, 1]
    row[KAPPA_U], row[KAPPA_V] = net.curvature
    row[BAR], row[RADIUS], row[FOULING] = net.bar, net.twine / 2.0, net.fouling
    row[GROWTH], row[MISSING], row[SEED] = 2.0 * net.growth, net.missing, net.seed
    row[HALF_U], row[HALF_V] = net.half_size
    row[OFFSET_U], row[OFFSET_V] = net.offset
    angles, spacing = _families(net)
    row[IS_HEXAGON], row[FAMILIES] = net.mesh == "hexagon", len(angles)
    row[SPACING : SPACING + len(angles)] = spacing
    for i, angle in enumerate(angles):
        row[DIRECTIONS + 2 * i : DIRECTIONS + 2 * i + 2] = np.cos(angle), np.sin(angle)
    row[ALBEDO : ALBEDO + 3] = net.albedo
    return row


def _families(net: Net) -> tuple[list[float], float]:
    """Return the direction of every family of parallel strands, and the distance of its axes."""
    if net.mesh == "square":
        return [net.roll, net.roll + np.pi / 2.0], net.bar
    if net.mesh == "diamond":
        half = float(np.arcsin(net.hanging_ratio))
        upright = net.roll + np.pi / 2.0
        return [upright - half, upright + half], net.bar * np.sin(2.0 * half)
    return [net.roll + i * np.pi / 3.0 for i in range(3)], net.bar * np.sqrt(3.0)


@inline_borrowing_kernel
def _crossing(o: Vec, d: Vec, nets: FloatArray, i: int, lift: float) -> float:
    """Return the distance at which a ray crosses the unfolded net's surface, raised by `lift`."""
    rel = minus(o, row3(nets, i, ORIGIN))
    u0, v0 = dot(rel, row3(nets, i, AXIS_U)), dot(rel, row3(nets, i, AXIS_V))
    w0 = dot(rel, row3(nets, i, NORMAL)) - lift
    du, dv = dot(d, row3(nets, i, AXIS_U)), dot(d, row3(nets, i, AXIS_V))
    dw = dot(d, row3(nets, i, NORMAL))
    ku, kv = nets[i, KAPPA_U], nets[i, KAPPA_V]
    a = 0.5 * (ku * du * du + kv * dv * dv)
    b = ku * u0 * du + kv * v0 * dv - dw
    c = 0.5 * (ku * u0 * u0 + kv * v0 * v0) - w0
    disc = b * b - 4.0 * a * c
    if disc < 0.0 or b == 0.0:
        return np.inf
    # This form of the root stays exact as the curvature tends to zero.
    return float(-2.0 * c / (b + np.copysign(np.sqrt(disc), b)))


@inline_borrowing_kernel
def _behind(o: Vec, d: Vec, t: float, s: "Surfaces", i: int) -> float:
    """Return the distance of a place on a ray behind the folded net, along the net's normal."""
    nets = s.nets
    rel = minus(along(o, d, t), row3(nets, i, ORIGIN))
    u, v = dot(rel, row3(nets, i, AXIS_U)), dot(rel, row3(nets, i, AXIS_V))
    bulge = 0.5 * (nets[i, KAPPA_U] * u * u + nets[i, KAPPA_V] * v * v)
    return float(dot(rel, row3(nets, i, NORMAL)) - bulge - folded(u, v, s.folds, i)[0])


@inline_borrowing_kernel
def _next_crossing(o: Vec, d: Vec, s: "Surfaces", i: int, begin: float) -> float:
    """Return the next crossing of a ray with the net after `begin`; infinite if there is none."""
    low, high, steepest = fold_limits(s.folds, i)
    if low == 0.0 and high == 0.0:
        t = _crossing(o, d, s.nets, i, 0.0)
        return t if t > begin else np.inf
    first, last = _crossing(o, d, s.nets, i, low), _crossing(o, d, s.nets, i, high)
    t = max(min(first, last), begin)
    # Least step along a ray towards a folded net, and number of bisections of the last step.
    least_step, max_steps, halvings = 1e-3, 200, 16
    end = max(first, last) + least_step
    if not end < 1e6:
        return np.inf
    # The height over the net limits the distance to it along the ray from below.
    share = 1.0 / (1.5 + steepest)
    side = _behind(o, d, t, s, i)
    for _ in range(max_steps):
        if t >= end:
            break
        step = max(share * abs(side), least_step)
        now = _behind(o, d, t + step, s, i)
        if side * now <= 0.0:
            # By bisection, where the ray changes sides of the net.
            before, after = t, t + step
            for _ in range(halvings):
                middle = 0.5 * (before + after)
                if side * _behind(o, d, middle, s, i) > 0.0:
                    before = middle
                else:
                    after = middle
            return after
        t, side = t + step, now
    return np.inf


@inline_borrowing_kernel
def _in_a_hole(u: float, v: float, holes: FloatArray, i: int) -> bool:
    for k in range(holes.shape[0]):
        if holes[k, 0] == i:
            x, y = u - holes[k, 1], v - holes[k, 2]
            if x * x + y * y < holes[k, 3] * holes[k, 3]:
                return True
    return False


@inline_borrowing_kernel
def _hexagon_centre(u: float, v: float, nets: FloatArray, i: int) -> tuple[float, float]:
    """Return the centre of the honeycomb cell around (u, v): the nearest lattice point."""
    p = nets[i, SPACING]
    c, s = nets[i, DIRECTIONS], nets[i, DIRECTIONS + 1]
    # One lattice direction is perpendicular to the first family of bars.
    x, y = (-s * u + c * v) / p, (c * u + s * v) / (p * np.sqrt(0.75))
    best, best_x, best_y = np.inf, 0.0, 0.0
    row0 = np.floor(y)
    for k in range(2):
        row = row0 + k
        shift = 0.5 * (row - 2.0 * np.floor(0.5 * row))
        column = np.floor(x - shift + 0.5) + shift
        distance = (x - column) ** 2 + 0.75 * (y - row) ** 2
        if distance < best:
            best, best_x, best_y = distance, column, row
    return (
        p * (-s * best_x + np.sqrt(0.75) * c * best_y),
        p * (c * best_x + np.sqrt(0.75) * s * best_y),
    )


@inline_borrowing_kernel
def _nearest_axis(
    u: float, v: float, nets: FloatArray, i: int, k: int, cell: tuple[float, float]
) -> tuple[float, float, float, int, int]:
    """Return w beside the nearest axis of family k, place along it, distance to its next knot.

    The last two numbers identify the bar.
    """
    c, s = nets[i, DIRECTIONS + 2 * k], nets[i, DIRECTIONS + 2 * k + 1]
    if nets[i, IS_HEXAGON] != 0.0:
        x, y = u - cell[0], v - cell[1]
        w, place = -s * x + c * y, c * x + s * y
        apothem = 0.5 * nets[i, SPACING]
        side = 1.0 if w >= 0.0 else -1.0
        ends = max(0.5 * nets[i, BAR] - abs(place), 0.0)
        # The two cells beside a bar must agree on its identity.
        line = (-s * cell[0] + c * cell[1]) / apothem + side
        centre = c * cell[0] + s * cell[1]
        bar = int(np.floor(centre / (0.5 * nets[i, BAR]) + 0.5))
        return w - side * apothem, place + centre, ends, int(np.floor(line + 0.5)), bar
    spacing = nets[i, SPACING + k]
    w, place = -s * u + c * v, c * u + s * v
    line = np.floor(w / spacing + 0.5)
    other = DIRECTIONS + 2 * (1 - k)
    across = (-nets[i, other + 1] * u + nets[i, other] * v) / nets[i, SPACING + 1 - k]
    knot = abs(across - np.floor(across + 0.5)) * nets[i, BAR]
    return w - line * spacing, place, knot, int(line), int(np.floor(across))


@inline_borrowing_kernel
def _profile(
    place: float, knot: float, u: float, v: float, nets: FloatArray, i: int, tiles: Tiles
) -> tuple[float, float]:
    """Return the strand's local radius and the growth's part of it, in clean radii."""
    r = nets[i, RADIUS]
    phase = 2.0 * np.pi * place / (_TWINE.lay * r)
    swell = _TWINE.knot * np.exp(-((knot / (1.6 * r)) ** 2))
    radius = r * (1.0 - _TWINE.groove + _TWINE.groove * np.cos(phase) + swell)
    fouling = nets[i, FOULING]
    if fouling <= 0.0:
        return radius, 0.0
    shift = 61.7 * nets[i, SEED]
    cover = sample(tiles.smooth, u / 0.0011 + shift, v / 0.0011 + 0.37 * shift)
    if cover >= fouling:
        return radius, 0.0
    tuft = sample(tiles.smooth, u / 0.00021 - shift, v / 0.00021)
    growth = nets[i, GROWTH] * min(1.0, 4.0 * (fouling - cover)) * (0.15 + 0.85 * tuft)
    return radius + r * growth, growth


@inline_borrowing_kernel
def _cylinder(w: float, q: float, z: float, r: float) -> float:
    """Return the first root of (w + q tau)² + (z tau)² = r²; infinite if there is none."""
    a = q * q + z * z
    half_b = w * q
    disc = half_b * half_b - a * (w * w - r * r)
    if disc < 0.0 or a == 0.0:
        return np.inf
    return float((-half_b - np.sqrt(disc)) / a)


@inline_borrowing_kernel
def meet_net(o: Vec, d: Vec, s: "Surfaces", i: int) -> Strand:
    """Return the first strand of net i that a ray meets."""
    found = NO_STRAND
    t = 0.0
    # Greatest number of layers of a folded net along a ray.
    max_layers = 5
    for _ in range(max_layers):
        t = _next_crossing(o, d, s, i, t)
        if not t < 1e6:
            break
        found = _meet_layer(o, d, t, s, i)
        if found.t < np.inf:
            break
    return found


@inline_borrowing_kernel
def _meet_layer(o: Vec, d: Vec, t: float, surfaces: "Surfaces", i: int) -> Strand:
    """Return the first strand that a ray meets where it crosses the net at `t`."""
    best, nets, tiles = NO_STRAND, surfaces.nets, surfaces.tiles
    eu, ev, out = row3(nets, i, AXIS_U), row3(nets, i, AXIS_V), row3(nets, i, NORMAL)
    rel = minus(along(o, d, t), row3(nets, i, ORIGIN))
    u, v = dot(rel, eu), dot(rel, ev)
    if abs(u) > nets[i, HALF_U] or abs(v) > nets[i, HALF_V]:
        return best
    if surfaces.holes.shape[0] > 0 and _in_a_hole(u, v, surfaces.holes, i):
        return best
    _, slope_u, slope_v = folded(u, v, surfaces.folds, i)
    flank = unit(combine(eu, -slope_u, ev, -slope_v, out, 1.0))
    tilt_u, tilt_v = slope_u + nets[i, KAPPA_U] * u, slope_v + nets[i, KAPPA_V] * v
    normal = unit(combine(eu, -tilt_u, ev, -tilt_v, out, 1.0))
    u, v = u - nets[i, OFFSET_U], v - nets[i, OFFSET_V]
    cell = (0.0, 0.0)
    if nets[i, IS_HEXAGON] != 0.0:
        cell = _hexagon_centre(u, v, nets, i)
    dz = dot(d, normal)
    widest = nets[i, RADIUS] * (1.0 + _TWINE.knot + nets[i, GROWTH] * (nets[i, FOULING] > 0.0))
    for k in range(int(nets[i, FAMILIES])):
        w, place, knot, line, bar = _nearest_axis(u, v, nets, i, k, cell)
        c, s = nets[i, DIRECTIONS + 2 * k], nets[i, DIRECTIONS + 2 * k + 1]
        # The strand and its neighbourhood follow the fold's flank; bulges are gentle.
        strand = unit(combine(eu, c, ev, s, out, c * slope_u + s * slope_v))
        side = cross(strand, flank)
        w *= dot(combine(eu, -s, ev, c, out, c * slope_v - s * slope_u), side)
        q = dot(d, side)
        if w * w * dz * dz > widest * widest * (q * q + dz * dz):
            continue
        key = line * 131 + k * 17 + int(nets[i, SEED])
        if white_at(tiles.white, key, bar) < nets[i, MISSING]:
            continue
        r, growth = _profile(place, knot, u, v, nets, i, tiles)
        tau = _cylinder(w, q, dz, r)
        if t + tau < best.t and t + tau > 0.0:
            outward = combine(side, (w + q * tau) / r, normal, dz * tau / r, side, 0.0)
            best = Strand(t + tau, outward, place, (w + q * tau) / r, growth)
    return best


@inline_borrowing_kernel
def strand_albedo(strand: Strand, nets: FloatArray, i: int, tiles: Tiles) -> Vec:
    """Return the diffuse reflectance of the twine: a helix of plies, or growth over it."""
    r = nets[i, RADIUS]
    phase = 2.0 * np.pi * strand.along / (_TWINE.lay * r) + 2.0 * strand.across
    dirt = sample(tiles.smooth, strand.along / 0.002, 40.0 * strand.across)
    shade = (0.80 + 0.20 * np.cos(phase)) * (0.85 + 0.30 * dirt)
    clean = scaled(row3(nets, i, ALBEDO), shade)
    cover = min(1.0, 2.0 * strand.growth)
    grown = scaled(_TWINE.growth_albedo, 0.6 + 0.8 * dirt)
    return combine(clean, 1.0 - cover, grown, cover, grown, 0.0)
