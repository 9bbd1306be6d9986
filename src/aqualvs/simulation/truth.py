"""Truth of simulated pictures: lit points of the laser sheets, and one row of `truth.csv` a frame.

A lit point is where the middle of a laser sheet meets a surface that the camera sees
(`find_lit_points`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel
from aqualvs.geometry.linear_algebra import row3
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.simulation.lasers import (
    COLOUR_BALANCED,
    ColourFilters,
    FanRays,
    LaserSource,
    Sheets,
    fan_rays,
    pack_sheets,
)
from aqualvs.simulation.scene import Scene, SurfaceKind
from aqualvs.simulation.surfaces import Surfaces, first_hit, meet_bubbles


@dataclass(frozen=True, slots=True)
class LitPoints:
    """N points on the middles of the stripes that the camera sees, ordered by laser."""

    # Shape (N, 3): metres. On twine they lie on its surface, not on the net plane.
    points_in_dome: FloatArray
    pixels: FloatArray  # Shape (N, 2): exact projections in `image`.
    laser: NDArray[np.int32]  # Shape (N,): index into `Rig.lasers`.
    label: NDArray[np.int32]  # Shape (N,): `SurfaceKind` values.

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.laser)


class Beams(NamedTuple):
    """Sheets of lasers as they leave their sources, before anything ends them.

    They depend on the rig alone: who renders many scenes makes them once.
    """

    sheets: Sheets
    fans: tuple[FanRays, ...]  # Rays in the middle of each sheet.

    def ended_by(self, surfaces: Surfaces) -> Sheets:
        """Return the sheets with the distances at which surfaces end them."""
        ends = np.full_like(self.sheets.first, np.inf)
        for i, (origins, directions, way) in enumerate(self.fans):
            ends[i] = way + cast(origins, directions, surfaces).solid
        return self.sheets._replace(first=ends)


def beams_of(
    rig: Rig, sources: Sequence[LaserSource], filters: ColourFilters = COLOUR_BALANCED
) -> Beams:
    """Return the sheets of a rig's lasers; see `pack_sheets`."""
    sheets = pack_sheets(rig, sources, filters)
    return Beams(sheets, tuple(fan_rays(rig, sheets, i) for i in range(len(rig.lasers))))


def find_lit_points(rig: Rig, surfaces: Surfaces, sheets: Sheets) -> LitPoints:
    """Trace every sheet's middle from its source; return the lit points that the camera sees."""
    found = [_lit_by(i, rig, surfaces, sheets) for i in range(len(sheets.table))]
    points = np.concatenate([np.empty((0, 3)), *(p for p, _ in found)])
    label = np.concatenate([np.empty(0, dtype=np.int32), *(kind for _, kind in found)])
    laser = np.repeat(np.arange(len(found), dtype=np.int32), [len(p) for p, _ in found])
    camera = rig.camera()
    pixels, valid = camera.project(points)
    seen = valid & camera.inside_image(pixels)
    rays = camera.rays(pixels[seen])
    reach = cast(rays.origins, rays.directions, surfaces).solid
    distance = np.linalg.norm(points[seen] - rays.origins, axis=-1)
    # A point is seen if the camera's ray to it ends no farther than this before it. The twine's
    # grooves and growth, which depend slightly on the ray's direction, stay within this distance.
    seen_within = 5e-4
    seen[seen] = rays.valid & (reach > distance - seen_within)
    return LitPoints(points[seen], pixels[seen], laser[seen], label[seen].astype(np.int32))


def _lit_by(
    i: int, rig: Rig, surfaces: Surfaces, sheets: Sheets
) -> tuple[FloatArray, NDArray[np.int32]]:
    """Return points and labels lit by sheet i; a bubble and what is behind it may both be lit."""
    origins, directions, way = fan_rays(rig, sheets, i)
    reach, kind, bubble = cast(origins, directions, surfaces)
    # Fraction of the fan's power below which a stripe has faded out.
    fan_floor = 0.5
    strong = (sheets.fan[i] > fan_floor) & np.isfinite(way)
    solid, clear = strong & np.isfinite(reach), strong & (bubble < reach)
    points = np.concatenate(
        [
            origins[solid] + reach[solid, None] * directions[solid],
            origins[clear] + bubble[clear, None] * directions[clear],
        ]
    )
    on_bubbles = np.full(int(clear.sum()), SurfaceKind.BUBBLE, dtype=np.int32)
    return points, np.concatenate([kind[solid].astype(np.int32), on_bubbles])


class Reach(NamedTuple):
    """First intersections of n rays, shape (n,) each."""

    solid: FloatArray  # Distance of the first opaque surface in metres; infinite if there is none.
    kind: IntArray  # Its `SurfaceKind`.
    bubble: FloatArray  # Distance of the first bubble.


def cast(origins: FloatArray, directions: FloatArray, surfaces: Surfaces) -> Reach:
    """Return first intersections of rays, origins and unit directions (n, 3) in `dome`."""
    n = len(origins)
    reach = Reach(np.empty(n), np.empty(n, dtype=np.int64), np.empty(n))
    bubbles = np.arange(len(surfaces.bubbles))
    _cast_all(
        np.ascontiguousarray(origins), np.ascontiguousarray(directions), surfaces, bubbles, reach
    )
    return reach


@borrowing_kernel
def _cast_all(
    origins: FloatArray, directions: FloatArray, s: Surfaces, bubbles: IntArray, out: Reach
) -> None:
    ellipsoids = s.all_ellipsoids
    for k in range(origins.shape[0]):
        o, d = row3(origins, k, 0), row3(directions, k, 0)
        hit = first_hit(o, d, s, ellipsoids, 0, ellipsoids.shape[0])
        out.solid[k], out.kind[k] = hit.t, hit.kind
        out.bubble[k] = meet_bubbles(o, d, s, bubbles, 0, bubbles.shape[0])[0]


Cell: TypeAlias = int | float | str

TRUTH_COLUMNS = (
    *("frame", "time_s", "range_mm", "pitch_deg", "yaw_deg", "medium", "n_outside", "target"),
    *("lasers_on", "nx", "ny", "nz", "d_mm"),
    *("visible_fit_range_mm", "visible_fit_pitch_deg", "visible_fit_yaw_deg"),
    *("visible_fit_max_resid_mm", "pts_net", "pts_wall", "pts_fish", "pts_bubble", "pts_solid"),
)
"""Columns of `truth.csv`.

Range, pitch, yaw, normal and d are those of the target plane; empty without a target. The
`visible_fit` columns hold the plane through all visible lit points of the target (for a net they
lie on the front of the twine, up to a twine radius before the net plane), or of a net that bulges
the plane that touches it where it is nearest to the dome; empty where the points do not span a
plane. The `pts` columns count visible lit points by what they lie on.
"""

# Ratio of the second to the first spread of lit points below which they lie on one line.
_FLAT = 0.02
_AIR = 1.1
# Largest distance of a lit point from the wall that it lies on, in metres.
_ON_WALL = 1e-6
# Each step divides what is left by the radius over the range; nets bend less than 1 / m.
_STEPS_TO_NEAREST = 40


def truth_row(frame: int, t: float, scene: Scene, rig: Rig, lit: LitPoints) -> list[Cell]:
    """Return the cells of one frame, in the order of `TRUTH_COLUMNS`."""
    medium = "water" if rig.n_water > _AIR else "air"
    counts: list[Cell] = [int(np.sum(lit.label == label)) for label in list(SurfaceKind)[1:]]
    head: list[Cell] = [frame, f"{t:.4f}"]
    middle: list[Cell] = [medium, rig.n_water, scene.target, int(scene.lasers_on)]
    if scene.target == "none":
        return [*head, "", "", "", *middle, *([""] * 8), *counts]
    plane = scene.target_plane()
    fit = target_fit(scene, lit)
    seen: list[Cell] = [""] * 4
    if fit is not None:
        seen = [*_posture(fit[0]), 1e3 * fit[1]]
    row = [*head, *_posture(plane), *middle, *plane.normal.tolist(), 1e3 * plane.offset]
    return [*row, *seen, *counts]


def _posture(plane: Plane) -> list[Cell]:
    """Return range in mm, pitch and yaw in degrees (docs/conventions.md)."""
    nx, ny, nz = plane.normal.tolist()
    pitch, yaw = np.arctan2(nz, ny), np.arctan2(nx, ny)
    return [1e3 * plane.offset, float(np.rad2deg(pitch)), float(np.rad2deg(yaw))]


def visible_fit(lit: LitPoints, label: SurfaceKind) -> tuple[Plane, float] | None:
    """Return the least-squares plane through the lit points of a label and its largest residual.

    None if there are fewer than three points or all are on one line. The residual is in metres.
    """
    return _plane_through(lit.points_in_dome[lit.label == label])


def _plane_through(points: FloatArray) -> tuple[Plane, float] | None:
    """Return the least-squares plane and its largest residual; None if undetermined."""
    if len(points) < 3:
        return None
    centre = points.mean(axis=0)
    _, spread, axes = np.linalg.svd(points - centre, full_matrices=False)
    if spread[1] < _FLAT * spread[0]:
        return None
    plane = Plane(axes[2], float(axes[2] @ centre)).facing_origin()
    return plane, float(np.abs(plane.signed_distance(points)).max())


def target_fit(scene: Scene, lit: LitPoints) -> tuple[Plane, float] | None:
    """Return the target's plane by its lit points, and their largest residual in metres.

    It is what a posture states: of a net that bulges, the plane that touches it at the point
    nearest to the dome's centre, moved to where the lit points are; else the plane through the lit
    points, without those on other walls.
    """
    lit_points: FloatArray = lit.points_in_dome[lit.label == scene.target_kind]
    if scene.target == "wall":
        off = scene.target_plane().signed_distance(lit_points)
        lit_points = lit_points[np.abs(off) < _ON_WALL]
    fit = _plane_through(lit_points)
    net = scene.nets[0] if scene.nets else None
    if fit is None or net is None or not any(net.curvature) or net.folds:
        return fit
    scene_from_dome = scene.dome_from_scene.inverse()
    points = scene_from_dome.apply(lit_points)
    bend = np.array(net.curvature)
    off = points[:, 1] - 0.5 * points[:, [0, 2]] ** 2 @ bend
    dome = scene_from_dome.translation
    place, height = dome[[0, 2]], 0.0
    for _ in range(_STEPS_TO_NEAREST):
        place = dome[[0, 2]] / (1.0 + (height - dome[1]) * bend)
        height = float(0.5 * place**2 @ bend)
    slope = bend * place
    normal = np.array([-slope[0], 1.0, -slope[1]]) / np.sqrt(1.0 + slope @ slope)
    offset = normal @ (np.array([place[0], height, place[1]]) - dome) + off.mean()
    plane = Plane(scene.dome_from_scene.rotation @ normal, float(offset))
    return plane, float(np.abs(off).max())
