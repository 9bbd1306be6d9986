"""Surfaces of a scene as tables in `dome`, and kernels that intersect rays with them."""

from typing import NamedTuple

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import inline_borrowing_kernel
from aqualvs.geometry.linear_algebra import Vec, along, combine, dot, minus, row3, scaled, unit
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.simulation.net import (
    FOLD_COLUMNS,
    NET_COLUMNS,
    NO_STRAND,
    Strand,
    meet_net,
    pack_fold,
    pack_net,
    strand_albedo,
)
from aqualvs.simulation.scene import Box, Fish, Scene, Wall, target_axes
from aqualvs.simulation.textures import Tiles, noise_tiles, sample

# Columns of the tables. A wall: origin on the plane, axes, albedo, contrast, pitch of its tiles.
_ORIGIN, _AXIS_U, _AXIS_V, _NORMAL, _ALBEDO, _CONTRAST, _TILE = 0, 3, 6, 9, 12, 15, 16
# An ellipsoid: centre, rows of unit_sphere_from_dome, albedo, part of the fish.
_CENTRE, _ROWS, _PART = 0, 3, 15
# A box: centre, axes, half sizes, albedo.
_HALF, _BOX_ALBEDO = 12, 15

_BODY, _TAIL, _EYE = 0.0, 1.0, 2.0

NONE, NET, WALL, FISH, BUBBLE, SOLID = range(6)


class Surfaces(NamedTuple):
    """Tables of one scene in `dome`, one row a surface."""

    walls: FloatArray  # Shape (n, columns): see the column constants of this module and of `net`.
    nets: FloatArray  # As `walls`.
    holes: FloatArray  # Shape (n, 4): index of the net, u, v and radius.
    # Shape (n, columns): see `net.pack_fold`; the first column is the index of the net.
    folds: FloatArray
    ellipsoids: FloatArray  # As `walls`.
    all_ellipsoids: IntArray  # Shape (n,): all of their rows.
    boxes: FloatArray  # As `walls`.
    bubbles: FloatArray  # As `walls`.
    tiles: Tiles  # Noise for textures.


class Hit(NamedTuple):
    """Intersection of a ray with the first opaque surface."""

    t: float  # Distance along the ray in metres; infinite if the ray meets nothing.
    # `Label` of the surface and its place in the table.
    kind: int
    row: int
    # Unit normal towards the ray's origin; only set for nets and boxes, whose intersection gives
    # it.
    normal: Vec
    strand: Strand  # Where the surface is a net.


def pack_surfaces(scene: Scene, t: float) -> Surfaces:
    """Return the tables of a scene at time `t`."""
    pose = scene.dome_from_scene
    ellipsoids = [row for fish in scene.fish for row in _pack_fish(fish, pose, t)]
    bubbles = [
        np.append(pose.apply(b.at(t).position), b.radius) for b in scene.bubbles if b.radius > 0.0
    ]
    holes = [(i, *hole) for i, net in enumerate(scene.nets) for hole in net.holes]
    folds = [pack_fold(i, fold) for i, net in enumerate(scene.nets) for fold in net.folds]
    return Surfaces(
        walls=_table([_pack_wall(wall, pose) for wall in scene.walls], 17),
        nets=_table([pack_net(net, pose) for net in scene.nets], NET_COLUMNS),
        holes=_table([np.array(hole) for hole in holes], 4),
        folds=_table(folds, FOLD_COLUMNS),
        ellipsoids=_table(ellipsoids, 16),
        all_ellipsoids=np.arange(len(ellipsoids), dtype=np.int64),
        boxes=_table([_pack_box(box, pose) for box in scene.boxes], 18),
        bubbles=_table(bubbles, 4),
        tiles=noise_tiles(),
    )


def _table(rows: list[FloatArray], columns: int) -> FloatArray:
    return np.ascontiguousarray(np.reshape(rows, (len(rows), columns)), dtype=np.float64)


def _pack_wall(wall: Wall, pose: SE3) -> FloatArray:
    axes = pose.rotation @ target_axes(wall.pitch, wall.yaw)
    origin = pose.apply([0.0, wall.depth, 0.0])
    last = [*wall.albedo, wall.contrast, wall.tile_pitch]
    return np.concatenate([origin, axes[:, 0], axes[:, 2], axes[:, 1], last])


def _pack_fish(fish: Fish, pose: SE3, t: float) -> list[FloatArray]:
    """Return body, tail and eye as ellipsoids; the fish points in its swimming direction."""
    velocity = np.array(fish.velocity)
    if not np.any(velocity[:2]):
        velocity = np.array([1.0, 0.0, 0.0])
    wag = 0.25 * np.sin(2.0 * np.pi * fish.beat * t)
    heading = float(np.arctan2(velocity[1], velocity[0]))
    turn = rotation_from_rotvec([0.0, 0.0, heading])
    bend = turn @ rotation_from_rotvec([0.0, 0.0, wag])
    size = fish.length / 2.0
    centre = np.array(fish.at(t).position)
    parts = [
        (centre, turn, (1.0, 0.16, 0.26), _BODY),
        (centre - bend @ [1.1 * size, 0.0, 0.0], bend, (0.24, 0.02, 0.30), _TAIL),
        (centre + turn @ [0.78 * size, 0.0, 0.05 * size], turn, (0.045, 0.13, 0.045), _EYE),
    ]
    rows = []
    for place, axes, half, part in parts:
        unit_from_dome = (pose.rotation @ axes).T / (size * np.array(half))[:, None]
        albedo_and_part = [*fish.albedo, part]
        rows.append(np.concatenate([pose.apply(place), unit_from_dome.ravel(), albedo_and_part]))
    return rows


def _pack_box(box: Box, pose: SE3) -> FloatArray:
    axes = pose.rotation @ rotation_from_rotvec([0.0, 0.0, box.heading])
    half = np.array(box.size) / 2.0
    return np.concatenate([pose.apply(box.centre), axes.T.ravel(), half, box.albedo])


@inline_borrowing_kernel
def _to_local(v: Vec, table: FloatArray, i: int) -> Vec:
    """Turn a vector by the three rows that start in column 3."""
    return (
        dot(v, row3(table, i, _ROWS)),
        dot(v, row3(table, i, _ROWS + 3)),
        dot(v, row3(table, i, _ROWS + 6)),
    )


@inline_borrowing_kernel
def meet_ellipsoid(o: Vec, d: Vec, ellipsoids: FloatArray, i: int) -> float:
    """Return the distance to an ellipsoid seen from outside, else infinity."""
    p = _to_local(minus(o, row3(ellipsoids, i, _CENTRE)), ellipsoids, i)
    q = _to_local(d, ellipsoids, i)
    a, b, c = dot(q, q), dot(p, q), dot(p, p) - 1.0
    disc = b * b - a * c
    if disc < 0.0:
        return np.inf
    t = (-b - np.sqrt(disc)) / a
    return t if t > 0.0 else np.inf


@inline_borrowing_kernel
def meet_box(o: Vec, d: Vec, boxes: FloatArray, i: int) -> tuple[float, Vec]:
    """Return the distance to a box seen from outside, and its normal there (slab method)."""
    p = _to_local(minus(o, row3(boxes, i, _CENTRE)), boxes, i)
    q = _to_local(d, boxes, i)
    near, far, face, sign = -np.inf, np.inf, 0, 1.0
    for k in range(3):
        half = boxes[i, _HALF + k]
        slope = q[k] if abs(q[k]) > 1e-12 else 1e-12
        enter, leave = (-half - p[k]) / slope, (half - p[k]) / slope
        if enter > leave:
            enter, leave = leave, enter
        if enter > near:
            near, face, sign = enter, k, -np.copysign(1.0, slope)
        far = min(far, leave)
    if near >= far or near <= 0.0:
        return np.inf, (0.0, 0.0, 0.0)
    return near, scaled(row3(boxes, i, _ROWS + 3 * face), sign)


@inline_borrowing_kernel
def first_hit(o: Vec, d: Vec, s: Surfaces, members: IntArray, first: int, last: int) -> Hit:
    """Return the first opaque surface on a ray, with the ellipsoids members[first:last]."""
    far = 1e3
    t, kind, index, normal, met = np.inf, NONE, 0, (0.0, 0.0, 0.0), NO_STRAND
    for i in range(s.walls.shape[0]):
        face_normal = row3(s.walls, i, _NORMAL)
        reach = dot(minus(row3(s.walls, i, _ORIGIN), o), face_normal) / dot(d, face_normal)
        if 0.0 < reach < far and reach < t:
            t, kind, index = reach, WALL, i
    for i in range(s.nets.shape[0]):
        strand = meet_net(o, d, s, i)
        if strand.t < t:
            t, kind, index, normal, met = strand.t, NET, i, strand.normal, strand
    for i in range(s.boxes.shape[0]):
        reach, face = meet_box(o, d, s.boxes, i)
        if reach < t:
            t, kind, index, normal = reach, SOLID, i, face
    for k in range(first, last):
        i = members[k]
        reach = meet_ellipsoid(o, d, s.ellipsoids, i)
        if reach < t:
            t, kind, index = reach, FISH, i
    return Hit(t, kind, index, normal, met)


@inline_borrowing_kernel
def meet_bubbles(
    o: Vec, d: Vec, s: Surfaces, members: IntArray, first: int, last: int
) -> tuple[float, int]:
    """Return distance and row of the nearest bubble among members[first:last]."""
    nearest, row = np.inf, -1
    for k in range(first, last):
        i = members[k]
        rel = minus(o, row3(s.bubbles, i, 0))
        b = dot(rel, d)
        disc = b * b - dot(rel, rel) + s.bubbles[i, 3] * s.bubbles[i, 3]
        if disc >= 0.0 and 0.0 < -b - np.sqrt(disc) < nearest:
            nearest, row = -b - np.sqrt(disc), i
    return nearest, row


@inline_borrowing_kernel
def normal_and_albedo(o: Vec, d: Vec, hit: Hit, s: Surfaces) -> tuple[Vec, Vec]:
    """Return the unit normal towards the camera and the diffuse reflectance at a hit."""
    if hit.kind == WALL:
        normal = row3(s.walls, hit.row, _NORMAL)
        facing = -1.0 if dot(normal, d) > 0.0 else 1.0
        return scaled(normal, facing), _wall_albedo(along(o, d, hit.t), s.walls, hit.row, s.tiles)
    if hit.kind == NET:
        return hit.normal, strand_albedo(hit.strand, s.nets, hit.row, s.tiles)
    if hit.kind == FISH:
        return _fish_skin(along(o, d, hit.t), s.ellipsoids, hit.row, s.tiles)
    p = along(o, d, hit.t)
    grain = sample(s.tiles.smooth, (p[0] + p[1]) / 0.0006, p[2] / 0.0006)
    return hit.normal, scaled(row3(s.boxes, hit.row, _BOX_ALBEDO), 0.85 + 0.3 * grain)


@inline_borrowing_kernel
def _wall_albedo(p: Vec, walls: FloatArray, i: int, tiles: Tiles) -> Vec:
    """Return the albedo of a wall: stains of three sizes, and the joints of tiles."""
    rel = minus(p, row3(walls, i, _ORIGIN))
    u, v = dot(rel, row3(walls, i, _AXIS_U)), dot(rel, row3(walls, i, _AXIS_V))
    broad = sample(tiles.smooth, u / 0.0031 + 97.3, v / 0.0031 + 11.9)
    middle = sample(tiles.smooth, (0.8 * u - 0.6 * v) / 0.0009, (0.6 * u + 0.8 * v) / 0.0009)
    fine = sample(tiles.smooth, (0.6 * u + 0.8 * v) / 0.0002, (0.8 * u - 0.6 * v) / 0.0002)
    stain = 0.30 * broad + 0.40 * middle + 0.30 * fine - 0.5
    shade = 1.0 + 2.0 * walls[i, _CONTRAST] * stain
    pitch = walls[i, _TILE]
    if pitch > 0.0:
        x, y = u / pitch + 0.31, v / pitch + 0.43
        x, y = abs(x - np.floor(x) - 0.5), abs(y - np.floor(y) - 0.5)
        joint = (0.5 - max(x, y)) * pitch
        shade *= 1.0 - 0.35 * np.exp(-((joint / 0.0025) ** 2))
    base = row3(walls, i, _ALBEDO)
    warmth = 0.25 * walls[i, _CONTRAST] * (broad - 0.5)
    return base[0] * shade * (1.0 + warmth), base[1] * shade, base[2] * shade * (1.0 - warmth)


@inline_borrowing_kernel
def _fish_skin(p: Vec, ellipsoids: FloatArray, i: int, tiles: Tiles) -> tuple[Vec, Vec]:
    """Return normal and skin: dark back, pale belly, scales; a dark eye; a striped tail."""
    q = _to_local(minus(p, row3(ellipsoids, i, _CENTRE)), ellipsoids, i)
    a, b = row3(ellipsoids, i, _ROWS), row3(ellipsoids, i, _ROWS + 3)
    normal = unit(combine(a, q[0], b, q[1], row3(ellipsoids, i, _ROWS + 6), q[2]))
    albedo = row3(ellipsoids, i, 12)
    if ellipsoids[i, _PART] == _EYE:
        return normal, scaled(albedo, 0.08)
    scales = sample(tiles.smooth, 150.0 * q[0], 40.0 * q[2])
    back = 1.0 / (1.0 + np.exp(-9.0 * (q[2] - 0.15 + 0.5 * (scales - 0.5))))
    shade = 1.15 - 0.75 * back
    if ellipsoids[i, _PART] == _TAIL:
        shade = 0.55 + 0.10 * np.cos(25.0 * q[2])
    return normal, scaled(albedo, shade * (0.85 + 0.3 * scales))
