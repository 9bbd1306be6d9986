"""Random pictures of boards with lasers and with light that is no laser's, made without rendering.

Stripes are drawn on true planes in space; what else a detector of stripes finds is added: edges of
the print and of the board, glints, the laser on a wall behind the board.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.lasers.stripes_on_planes import StripePoints, board_surface, place_stripes
from aqualvs.calibration.lasers.views import PlacedView
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Laser, Rig
from aqualvs.simulation.scenarios import example_rig

SQUARE, SQUARES = 0.03, (12, 9)
_FACING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Clutter:
    """What is seen besides lasers; numbers are means for a picture.

    Attributes
    ----------
    edges : float
        Share of the print's grid lines that are taken for stripes.
    glints : float
        Straight or bent chains anywhere.
    behind : float or None
        Distance (metres) of a wall behind the board, on which lasers go on.
    gaps : float
        Share of a stripe that is not seen, in pieces.
    """

    edges: float = 0.0
    glints: float = 0.0
    behind: float | None = None
    gaps: float = 0.0


@dataclass(frozen=True, slots=True)
class Scene:
    """Pictures and their truth."""

    rig: Rig
    views: list[PlacedView]


def scene(
    seed: int,
    n_lasers: int,
    n_views: int,
    *,
    clutter: Clutter,
    noise_px: float,
    margin: float = 0.1,
    rail: bool = False,
    shift: float = 0.0,
    wander: float = 0.0,
) -> Scene:
    """Return pictures of a board, `margin` metres larger than its print on all sides.

    With `rail` the board only comes nearer. Lasers are moved by `shift`, and in every picture by
    `wander` at random (metres).
    """
    rng = np.random.default_rng(seed)
    lasers = tuple(_lasers(rng, n_lasers))
    poses = [_on_rail(rng) if rail else _pose(rng) for _ in range(n_views)]
    rig, views = replace(example_rig(), lasers=lasers), []
    for i, pose in enumerate(poses):
        moved = [_moved(laser, shift + wander * rng.standard_normal()) for laser in lasers]
        seen = replace(rig, lasers=tuple(moved))
        name = f"view_{i}.png"
        views.append(_view(name, rng, seen, rig.camera(), pose, clutter, noise_px, margin))
    return Scene(rig, views)


def _moved(laser: Laser, shift: float) -> Laser:
    return replace(laser, plane=Plane(laser.plane.normal, laser.plane.offset + shift))


def _lasers(rng: np.random.Generator, n: int) -> Iterator[Laser]:
    """Up to five lasers of any direction, or a pencil of near-parallel ones."""
    if n > 5:
        emitter = np.array([0.06, 0.02, rng.uniform(-0.05, 0.05)])
        for i, angle in enumerate(np.deg2rad(np.linspace(-18.0, 9.0, n))):
            normal = np.array([np.cos(angle), -np.sin(angle), 0.1])
            yield Laser(f"laser_{i}", Plane.from_normal(normal, float(normal @ emitter)))
        return
    for i in range(n):
        turn = np.pi * (i + rng.uniform(0.2, 0.8)) / n
        # From 5 to 15 cm beside the lens, leaning towards its axis.
        side = np.array([np.cos(turn), 0.0, np.sin(turn)])
        baseline = rng.choice([-1.0, 1.0]) * rng.uniform(0.05, 0.15)
        lean = -np.sign(baseline) * np.deg2rad(rng.uniform(3.0, 12.0))
        normal = np.cos(lean) * side - np.sin(lean) * np.array([0.0, 1.0, 0.0])
        yield Laser(f"laser_{i}", Plane.from_normal(normal, float(normal @ (baseline * side))))


def _pose(rng: np.random.Generator) -> SE3:
    turn = SE3.from_rotvec(rng.uniform(-0.45, 0.45, 3), np.zeros(3)).rotation @ _FACING
    middle = 0.5 * SQUARE * np.array([SQUARES[0], SQUARES[1], 0.0])
    place = np.array([rng.uniform(-0.06, 0.06), rng.uniform(0.35, 0.8), rng.uniform(-0.05, 0.05)])
    return SE3(turn, place - turn @ middle)


def _on_rail(rng: np.random.Generator) -> SE3:
    middle = 0.5 * SQUARE * np.array([SQUARES[0], SQUARES[1], 0.0])
    return SE3(_FACING, np.array([0.01, rng.uniform(0.35, 0.8), -0.01]) - _FACING @ middle)


def _view(
    name: str,
    rng: np.random.Generator,
    rig: Rig,
    camera: Camera,
    pose: SE3,
    clutter: Clutter,
    noise_px: float,
    margin: float,
) -> PlacedView:
    size = SQUARE * np.array(SQUARES)
    low, high = np.full(2, -margin), size + margin
    surface = board_surface().placed(pose)[0]
    chains: list[FloatArray] = []
    for laser in rig.lasers:
        lit = _cut(laser.plane, surface)
        place = pose.inverse().apply(lit)[:, :2]
        on = np.all((place >= low) & (place <= high), axis=1)
        chains.append(_broken(rng, lit[on], clutter.gaps))
        if clutter.behind is not None:
            wall = Plane(surface.normal, surface.offset + clutter.behind)
            far = _cut(laser.plane, wall)
            hidden = pose.inverse().apply(far * (surface.offset / (far @ surface.normal))[:, None])
            beside = np.any((hidden[:, :2] < low) | (hidden[:, :2] > high), axis=1)
            chains += _sides(far, beside)
    chains += _edges(rng, pose, size, low, high, clutter.edges)
    pixels = [_seen(camera, points) for points in chains]
    pixels += [glint(rng, rig.size_px) for _ in range(rng.poisson(clutter.glints))]
    stripes = _stripes(rng, [p for p in pixels if len(p) >= 12], noise_px)
    x, y = np.meshgrid(np.arange(1, SQUARES[0]), np.arange(1, SQUARES[1]))
    corners = SQUARE * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    # What corners of a tenth of a pixel leave of a pose.
    wobble = SE3.from_rotvec(rng.normal(0.0, 4e-4, 3), rng.normal(0.0, 1e-4, 3))
    found = pose @ wobble
    return PlacedView(
        View(name, np.arange(x.size), corners, camera.project(pose.apply(corners))[0]),
        stripes,
        found,
        found,
        place_stripes(camera, stripes, found, board_surface()),
        0,
        0.1,
    )


def _cut(plane: Plane, surface: Plane) -> FloatArray:
    """Points of the line that a sheet of light draws on a surface, 2 mm apart."""
    direction = np.cross(plane.normal, surface.normal)
    direction /= np.linalg.norm(direction)
    start = np.linalg.solve(
        np.stack([plane.normal, surface.normal, direction]),
        [plane.offset, surface.offset, direction @ np.array([0.0, 0.5, 0.0])],
    )
    points: FloatArray = start + np.arange(-0.6, 0.6, 0.003)[:, None] * direction
    return points[points[:, 1] > 0.15]


def _broken(rng: np.random.Generator, points: FloatArray, gaps: float) -> FloatArray:
    """The points without those of some pieces."""
    piece = np.arange(len(points)) // 12
    return points[rng.random(piece.max(initial=0) + 1)[piece] >= gaps]


def _sides(points: FloatArray, keep: np.ndarray) -> list[FloatArray]:
    """Runs of points that are kept."""
    runs = np.split(np.arange(len(points)), np.flatnonzero(np.diff(keep.astype(int))) + 1)
    return [points[run] for run in runs if len(run) and keep[run[0]]]


def _edges(
    rng: np.random.Generator,
    pose: SE3,
    size: FloatArray,
    low: FloatArray,
    high: FloatArray,
    share: float,
) -> Iterator[FloatArray]:
    """Some of the print's grid lines, in part, and the rim of the board."""
    for axis in (0, 1):
        inside = SQUARE * np.arange(1, SQUARES[axis])
        for place in [*inside.tolist(), low[axis], high[axis]]:
            if rng.random() >= share:
                continue
            first, last = np.sort(rng.uniform(0.0, size[1 - axis], 2))
            along = np.arange(first, last, 0.003)
            points = np.zeros((len(along), 3))
            points[:, axis], points[:, 1 - axis] = place, along
            yield pose.apply(points)


def _seen(camera: Camera, points: FloatArray) -> FloatArray:
    if not len(points):
        return np.zeros((0, 2))
    pixels, valid = camera.project(points)
    found: FloatArray = pixels[valid & camera.inside_image(pixels)]
    return found


def glint(rng: np.random.Generator, size_px: tuple[int, int]) -> FloatArray:
    """A chain anywhere, half of them bent."""
    angle, length = rng.uniform(0.0, np.pi), rng.uniform(30.0, 250.0)
    t = np.arange(-0.5 * length, 0.5 * length, 3.0)
    bend = rng.choice([0.0, 1.0]) * rng.uniform(0.5, 3.0) * 1e-3
    way, up = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    points = rng.uniform((0.0, 0.0), size_px) + t[:, None] * way + (bend * t**2)[:, None] * up
    inside: FloatArray = points[np.all((points >= 0.0) & (points < np.array(size_px)), axis=1)]
    return inside


def _stripes(rng: np.random.Generator, chains: list[FloatArray], noise_px: float) -> StripePoints:
    across = []
    for pixels in chains:
        along = np.gradient(pixels, axis=0)
        side = np.stack([-along[:, 1], along[:, 0]], axis=-1)
        across.append(side / np.linalg.norm(side, axis=1, keepdims=True))
    sides = np.concatenate([np.zeros((0, 2)), *across])
    pixels = np.concatenate([np.zeros((0, 2)), *chains])
    chain = np.repeat(np.arange(len(chains)), [len(c) for c in chains])
    errors = noise_px * rng.standard_normal((len(pixels), 1))
    return StripePoints(pixels + errors * sides, sides, chain, np.full(len(pixels), 0.1))


def joined(stripes: StripePoints, pixels: FloatArray) -> StripePoints:
    """Return the stripes with one more chain."""
    more = _stripes(np.random.default_rng(0), [pixels], 0.0)
    return StripePoints(
        np.concatenate([stripes.pixels, more.pixels]),
        np.concatenate([stripes.across, more.across]),
        np.concatenate([stripes.chain, more.chain + stripes.chain.max(initial=-1) + 1]),
        np.concatenate([stripes.sigma_px, more.sigma_px]),
    )
