"""Pictures of a box or a board with laser stripes, made up without rendering."""

from dataclasses import dataclass, replace

import numpy as np

from aqualvs.calibration.lasers.stripes_on_planes import (
    StripePoints,
    TargetSurfaces,
    board_surface,
    box_surfaces,
)
from aqualvs.calibration.lasers.views import LaserView
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import Rig, RigUncertainty
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.simulation.scenarios import example_rig

BOX_PLANES = {
    "left": Plane(np.array([1.0, 0.0, 0.0]), -0.2),
    "right": Plane(np.array([1.0, 0.0, 0.0]), 0.2),
    "forward": Plane(np.array([0.0, 1.0, 0.0]), 0.7),
    "down": Plane(np.array([0.0, 0.0, 1.0]), -0.19),
}
SQUARE = 0.03
# Where the vehicle is in the box: turned to the left, to the right and down, as a rotation vector.
BOX_POSES = [
    ((0.02, 0.0, 0.12), (-0.02, -0.01, 0.03)),
    ((-0.15, 0.02, -0.14), (0.01, 0.0, 0.03)),
    ((-0.13, -0.03, 0.16), (-0.01, 0.02, 0.035)),
]
BOARD_POSES = [
    ((0.0, 0.0, 0.0), 0.42),
    ((0.2, 0.0, -0.1), 0.6),
    ((-0.1, 0.1, 0.3), 0.5),
    ((0.05, -0.1, -0.35), 0.75),
]
# A square board's x runs to the right and its y down, as seen from in front.
_FACING = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def box_corners() -> FloatArray:
    """Return corners of markers on all four planes of the box, (N, 3)."""
    side = np.array([[0.0, 0.0], [0.048, 0.0], [0.048, -0.048], [0.0, -0.048]])
    found = []
    for u, v in np.ndindex(5, 4):
        forward = np.array([-0.19 + 0.083 * u, 0.172 - 0.099 * v]) + side
        found.append(np.insert(forward, 1, 0.7, axis=1))
        wall = np.array([0.206 + 0.1 * u, 0.169 - 0.097 * v]) + side
        found += [np.insert(wall, 0, x, axis=1) for x in (-0.2, 0.2)]
        floor = np.array([-0.188 + 0.082 * u, 0.354 + 0.08 * v]) + side
        found.append(np.insert(floor, 2, -0.19, axis=1))
    return np.concatenate(found)


def box() -> TargetSurfaces:
    return box_surfaces(BOX_PLANES, box_corners())


def board_corners() -> FloatArray:
    x, y = np.meshgrid(np.arange(1, 7), np.arange(1, 10))
    return SQUARE * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


def dome_from_box(i: int) -> SE3:
    rotvec, place = BOX_POSES[i]
    return SE3.from_rotvec(rotvec, place).inverse()


def dome_from_board(i: int) -> SE3:
    """Board on the left of the view, so that stripes fall beside it, on its plane."""
    rotvec, distance = BOARD_POSES[i]
    turn = SE3.from_rotvec(rotvec, (0.0, 0.0, 0.0)).rotation @ _FACING
    return SE3(turn, np.array([0.0, distance, 0.0]) + turn @ np.array([-0.17, -0.15, 0.0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """What is added to true pixels; `bias_px` (L, K) shifts a laser's stripe on a surface."""

    corner_px: float = 0.0
    stripe_px: float = 0.0
    bias_px: FloatArray | None = None
    correlation: float = 0.0


def simulated(
    rig: Rig,
    poses: list[SE3],
    corners: FloatArray,
    surfaces: TargetSurfaces,
    *,
    noise: Noise | None = None,
    seed: int = 0,
    spacing: float = 0.002,
) -> list[LaserView]:
    """Return pictures of the target in the rig's own water, one for each `dome_from_target`."""
    rng, noise = np.random.default_rng(seed), noise or Noise()
    camera, found = rig.camera(), []
    for i, pose in enumerate(poses):
        name = f"view_{i}.png"
        pixels, valid = camera.project(pose.apply(corners))
        seen = valid & camera.inside_image(pixels)
        pixels = pixels[seen] + noise.corner_px * rng.standard_normal((int(seen.sum()), 2))
        view = View(name, np.flatnonzero(seen), corners[seen], pixels)
        stripes = [
            _stripe(camera, pose, surfaces, k, sheet, spacing, noise, i_laser, rng)
            for i_laser, sheet in enumerate(sheets_of(rig))
            for k in range(len(surfaces.planes))
        ]
        found.append(LaserView(view, _joined(stripes)))
    return found


def _stripe(
    camera: Camera,
    pose: SE3,
    surfaces: TargetSurfaces,
    i_surface: int,
    sheet: Sheet,
    spacing: float,
    noise: Noise,
    i_laser: int,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Pixels and directions across of one laser's stripe on one surface."""
    points, up = _lit(pose, surfaces.placed(pose)[i_surface], sheet, spacing)
    in_target = pose.inverse().apply(points)
    on = np.all((in_target >= surfaces.lowest) & (in_target <= surfaces.highest), axis=1)
    for i, plane in enumerate(surfaces.planes):
        if i != i_surface:
            on &= plane.signed_distance(in_target) < 0.0
    pixels, valid = camera.project(points[on])
    beyond, _ = camera.project(points[on] + 1e-5 * up[on])
    inside = valid & camera.inside_image(pixels)
    pixels, beyond = pixels[inside], beyond[inside]
    if len(pixels) < 3:
        return np.zeros((0, 2)), np.zeros((0, 2))
    along = np.gradient(pixels, axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    # Towards the sheet's positive side.
    across *= np.sign(np.sum(across * (beyond - pixels), axis=1, keepdims=True))
    errors = noise.stripe_px * _correlated(rng, len(pixels), noise.correlation)
    if noise.bias_px is not None:
        errors = errors + noise.bias_px[i_laser, i_surface]
    return pixels + errors[:, None] * across, across


def _correlated(rng: np.random.Generator, n: int, correlation: float) -> FloatArray:
    values = rng.standard_normal(n)
    for i in range(1, n):
        values[i] = correlation * values[i - 1] + np.sqrt(1.0 - correlation**2) * values[i]
    return values


def _lit(pose: SE3, surface: Plane, sheet: Sheet, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Points where a sheet cuts a surface, and the way to its positive side within the surface."""
    normal = sheet.plane.normal
    direction = np.cross(normal, surface.normal)
    direction /= np.linalg.norm(direction)
    start = np.linalg.solve(
        np.stack([normal, surface.normal, direction]), [sheet.plane.offset, surface.offset, 0.0]
    )
    steps = np.arange(-1.2, 1.2, spacing)
    points = start + steps[:, None] * direction
    up = np.zeros_like(points)
    # A bent sheet lies millimetres away from its plane: Newton's method within the surface.
    for _ in range(2 if sheet.is_plane else 20):
        gradient = sheet.gradient(points)
        up = gradient - (gradient @ surface.normal)[:, None] * surface.normal
        up /= np.sum(up * gradient, axis=1, keepdims=True)
        points = points - sheet.signed_distance(points)[:, None] * up
    ahead = points[:, 1] > 0.08
    return points[ahead], up[ahead]


def _joined(stripes: list[tuple[FloatArray, FloatArray]]) -> StripePoints:
    pixels = np.concatenate([s[0] for s in stripes])
    chain = np.concatenate([np.full(len(s[0]), i) for i, s in enumerate(stripes)])
    across = np.concatenate([s[1] for s in stripes])
    return StripePoints(pixels, across, chain, np.full(len(pixels), 0.1))


def box_views(
    rig: Rig | None = None, *, noise: Noise | None = None, seed: int = 0, spacing: float = 0.002
) -> list[LaserView]:
    poses = [dome_from_box(i) for i in range(len(BOX_POSES))]
    rig = rig or example_rig()
    return simulated(rig, poses, box_corners(), box(), noise=noise, seed=seed, spacing=spacing)


def board_views(
    rig: Rig | None = None, *, noise: Noise | None = None, seed: int = 0, spacing: float = 0.002
) -> list[LaserView]:
    poses = [dome_from_board(i) for i in range(len(BOARD_POSES))]
    rig = rig or example_rig()
    surfaces = board_surface()
    return simulated(rig, poses, board_corners(), surfaces, noise=noise, seed=seed, spacing=spacing)


def camera_uncertainty(scale: float = 1.0) -> RigUncertainty:
    """Return what a calibration of camera and dome leaves open, with correlations."""
    sigmas = {
        "lens_x": 5e-5,
        "lens_y": 2e-4,
        "lens_z": 5e-5,
        "rotation_x": 3e-4,
        "rotation_y": 3e-4,
        "rotation_z": 3e-4,
        "fx": 0.4,
        "fy": 0.4,
        "cx": 0.5,
        "cy": 0.5,
    }
    sigma = scale * np.array(list(sigmas.values()))
    correlation = np.eye(len(sigma))
    correlation[6, 7] = correlation[7, 6] = 0.9
    correlation[1, 6] = correlation[6, 1] = -0.5
    correlation[1, 7] = correlation[7, 1] = -0.5
    return RigUncertainty(tuple(sigmas), correlation * np.outer(sigma, sigma))


def without_lasers(rig: Rig) -> Rig:
    return replace(rig, lasers=())


def laser_error(found: Plane, true: Plane) -> tuple[float, float]:
    """Return the angle (radians) between normals and the offset's error (metres)."""
    sign = np.sign(found.normal @ true.normal)
    angle = float(np.linalg.norm(np.cross(found.normal, true.normal)))
    return angle, float(sign * found.offset - true.offset)
