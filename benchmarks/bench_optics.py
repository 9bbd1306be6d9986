"""Rays and projections a second on one core, next to the same mathematics in plain NumPy.

Run `python -m benchmarks optics` for a table, in CPU time. The reference is timed in turns, and the
two must agree before anything is reported. The reference of a flat port is the dome.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.camera import Camera, parameter_names, rays_all
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens
from aqualvs.optics.projection import project_all
from optics_cases import moved_by

SIZE_PX = (720, 576)
LENS = Lens(
    fx=817.5, fy=878.0, cx=368.9, cy=281.7, distortion=(-0.126, 0.0827, 6.2e-4, -4.5e-4, 0.01)
)
NOMINAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
POSE = SE3(rotation_from_rotvec([0.04, 0.029, 0.016]) @ NOMINAL, np.array([3.1, 41.8, 3.0]) * 1e-3)
DOME = Dome(0.04425, 0.00575, 1.49)
N_AIR, N_WATER = 1.0003, 1.3333
CAMERA = Camera(
    size_px=SIZE_PX, lens=LENS, dome_from_cam=POSE, housing=DOME, n_air=N_AIR, n_water=N_WATER
)
FLAT = Camera(
    size_px=SIZE_PX,
    lens=LENS,
    dome_from_cam=POSE,
    housing=FlatPort(0.012, 0.005, 1.49, 0.01, -0.007),
    n_air=N_AIR,
    n_water=N_WATER,
)
BARE = Camera(size_px=SIZE_PX, lens=LENS, dome_from_cam=POSE)
DISTANCE = 0.6
N_JACOBIANS = 40_000


def numpy_distort(x: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    k1, k2, p1, p2, k3 = LENS.distortion
    q = x * x + y * y
    f = 1.0 + q * (k1 + q * (k2 + q * k3))
    return (
        x * f + 2.0 * p1 * x * y + p2 * (q + 2.0 * x * x),
        y * f + p1 * (q + 2.0 * y * y) + 2.0 * p2 * x * y,
    )


def numpy_undistort(xd: FloatArray, yd: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Newton's method, four steps."""
    k1, k2, p1, p2, k3 = LENS.distortion
    x, y = xd, yd
    for _ in range(4):
        q = x * x + y * y
        f = 1.0 + q * (k1 + q * (k2 + q * k3))
        slope = 2.0 * (k1 + q * (2.0 * k2 + q * 3.0 * k3))
        ax, ay = numpy_distort(x, y)
        ex, ey = xd - ax, yd - ay
        j_xx = f + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        j_yy = f + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        j_xy = x * y * slope + 2.0 * (p1 * x + p2 * y)
        det = j_xx * j_yy - j_xy * j_xy
        x, y = x + (j_yy * ex - j_xy * ey) / det, y + (j_xx * ey - j_xy * ex) / det
    return x, y


def numpy_trace(directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Snell's law in vector form at both spheres."""
    p, d = POSE.translation, directions
    for radius, ratio in (
        (DOME.inner_radius, N_AIR / DOME.n_acrylic),
        (DOME.outer_radius, DOME.n_acrylic / N_WATER),
    ):
        along = np.sum(p * d, axis=-1, keepdims=True)
        reach = np.sqrt(along**2 + radius**2 - np.sum(p * p, axis=-1, keepdims=True))
        p = p + (reach - along) * d
        cos_in = reach / radius
        cos_out = np.sqrt(1.0 - ratio**2 * (1.0 - cos_in**2))
        d = ratio * d - (ratio * cos_in - cos_out) / radius * p
    return p, d


def numpy_rays(pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y = numpy_undistort((pixels[:, 0] - LENS.cx) / LENS.fx, (pixels[:, 1] - LENS.cy) / LENS.fy)
    d = np.stack([x, y, np.ones_like(x)], axis=-1) / np.sqrt(1.0 + x * x + y * y)[:, None]
    return numpy_trace(d @ POSE.rotation.T)


def numpy_project(points: FloatArray) -> FloatArray:
    """Bouguer's invariant with arc sines, five Newton steps from the straight line."""
    length = np.linalg.norm(POSE.translation)
    axis = POSE.translation / length
    rho = np.linalg.norm(points, axis=-1)
    cosine = points @ axis / rho
    across = points / rho[:, None] - cosine[:, None] * axis
    sine = np.linalg.norm(across, axis=-1)
    target = np.arctan2(sine, cosine)
    alpha = np.arctan2(rho * sine, rho * cosine - length)
    surfaces = (
        (-1.0, N_AIR * DOME.inner_radius),
        (1.0, DOME.n_acrylic * DOME.inner_radius),
        (-1.0, DOME.n_acrylic * DOME.outer_radius),
        (1.0, N_WATER * DOME.outer_radius),
        (-1.0, N_WATER * rho),
    )
    for _ in range(5):
        b = N_AIR * length * np.sin(alpha)
        theta, slope = alpha, 1.0
        for sign, n_rho in surfaces:
            s = b / n_rho
            theta = theta + sign * np.arcsin(s)
            slope = slope + sign * N_AIR * length * np.cos(alpha) / (n_rho * np.sqrt(1.0 - s * s))
        alpha = alpha + (target - theta) / slope
    d = np.cos(alpha)[:, None] * axis + (np.sin(alpha) / sine)[:, None] * across
    d = d @ POSE.rotation
    x, y = numpy_distort(d[:, 0] / d[:, 2], d[:, 1] / d[:, 2])
    return np.stack([LENS.fx * x + LENS.cx, LENS.fy * y + LENS.cy], axis=-1)


def numeric_jacobian(points: FloatArray) -> FloatArray:
    """Central differences of the compiled projection: what a solver without derivatives pays."""
    columns = []
    for axis in np.eye(3) * 1e-6:
        columns.append((CAMERA.project(points + axis)[0] - CAMERA.project(points - axis)[0]) / 2e-6)
    return np.stack(columns, axis=-1)


def numpy_project_bare(points: FloatArray) -> FloatArray:
    d = (points - POSE.translation) @ POSE.rotation
    x, y = numpy_distort(d[:, 0] / d[:, 2], d[:, 1] / d[:, 2])
    return np.stack([LENS.fx * x + LENS.cx, LENS.fy * y + LENS.cy], axis=-1)


def numeric_parameter_jacobian(points: FloatArray) -> FloatArray:
    """Central differences by the point and by every parameter, as `numeric_jacobian` has them."""
    columns = []
    for step in np.eye(len(parameter_names(CAMERA))) * 1e-6:
        ahead, behind = moved_by(CAMERA, step), moved_by(CAMERA, -step)
        columns.append((ahead.project(points)[0] - behind.project(points)[0]) / 2e-6)
    return np.concatenate([numeric_jacobian(points), np.stack(columns, axis=-1)], axis=-1)


def best_rates(count: int, *calls: Callable[[], object], rounds: int) -> list[float]:
    """Items a second of CPU in the fastest of `rounds` in turns, after one that compiles."""
    best = [np.inf] * len(calls)
    for i in range(rounds + 1):
        for k, call in enumerate(calls):
            start = time.process_time()
            call()
            if i:
                best[k] = min(best[k], time.process_time() - start)
    return [count / seconds for seconds in best]


def row(
    name: str, count: int, call: Callable[[], object], reference: Callable[[], object]
) -> dict[str, Any]:
    value, slow = (rate / 1e6 for rate in best_rates(count, call, reference, rounds=5))
    return {"name": name, "value": value, "unit": "M/s", "reference": slow, "ratio": value / slow}


def flat_port_rows(pixels: FloatArray) -> list[dict[str, Any]]:
    """Time the same directions through a flat port, next to the dome."""
    n = len(pixels)
    out = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, dtype=np.bool_)
    back, valid = np.empty((n, 2)), np.empty(n, dtype=np.bool_)
    points = []
    for camera in (FLAT, CAMERA):
        rays = camera.rays(pixels)
        assert rays.valid.all()
        points.append(rays.points_at(np.full(n, DISTANCE)))
        assert np.abs(camera.project(points[-1])[0] - pixels).max() < 1e-9
    flat, domed = points
    every = n // N_JACOBIANS
    return [
        row(
            "pixel to ray, flat port",
            n,
            lambda: rays_all(FLAT.params, pixels, *out),
            lambda: rays_all(CAMERA.params, pixels, *out),
        ),
        row(
            "point to pixel, flat port",
            n,
            lambda: project_all(FLAT.params, flat, back, valid),
            lambda: project_all(CAMERA.params, domed, back, valid),
        ),
        row(
            "point to pixel with Jacobian, flat port",
            len(flat[::every]),
            lambda: FLAT.project_with_jacobian(flat[::every]),
            lambda: CAMERA.project_with_jacobian(domed[::every]),
        ),
        row(
            "point to pixel with all parameters, flat port",
            len(flat[::every]),
            lambda: FLAT.project_with_parameter_jacobian(flat[::every]),
            lambda: CAMERA.project_with_parameter_jacobian(domed[::every]),
        ),
    ]


def run(quick: bool = False) -> list[dict[str, Any]]:
    """Time every direction through the camera on one full picture (720 x 576).

    Parameters
    ----------
    quick : bool
        Every other row of the picture only.

    Returns
    -------
    list of dict
        name, value and reference in millions a second, unit, and their ratio.
    """
    rows = np.arange(0.0, float(SIZE_PX[1]), 2.0 if quick else 1.0)
    x, y = np.meshgrid(np.arange(float(SIZE_PX[0])), rows)
    pixels = np.stack([x, y], axis=-1).reshape(-1, 2)
    n = len(pixels)
    origins, directions = np.empty((n, 3)), np.empty((n, 3))
    valid = np.empty(n, dtype=np.bool_)
    back = np.empty((n, 2))
    rays_all(CAMERA.params, pixels, origins, directions, valid)
    points = origins + DISTANCE * directions
    few = points[:: n // N_JACOBIANS]
    bare_valid = np.empty(n, dtype=np.bool_)

    assert valid.all()
    expected_origins, expected_directions = numpy_rays(pixels)
    assert np.abs(expected_origins - origins).max() < 1e-15
    assert np.abs(expected_directions - directions).max() < 1e-13
    assert np.abs(numpy_project(points) - pixels).max() < 1e-9
    assert np.abs(CAMERA.project(points)[0] - pixels).max() < 1e-9
    assert np.abs(numpy_project_bare(points) - BARE.project(points)[0]).max() < 1e-9
    _, _, by_point, by_parameter = CAMERA.project_with_parameter_jacobian(few[:100])
    exact = np.concatenate([by_point, by_parameter], axis=-1)
    # Central differences of 1e-6 leave some 1e-4 of a derivative to roundings.
    assert np.allclose(numeric_parameter_jacobian(few[:100]), exact, rtol=1e-3, atol=1e-3)
    ray_out = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, dtype=np.bool_)

    return [
        row(
            "pixel to ray, 5 coefficients",
            n,
            lambda: rays_all(CAMERA.params, pixels, *ray_out),
            lambda: numpy_rays(pixels),
        ),
        row(
            "pixel to direction, 5 coefficients",
            n,
            lambda: LENS.directions(pixels),
            lambda: numpy_undistort(pixels[:, 0] / 800.0 - 0.45, pixels[:, 1] / 800.0 - 0.36),
        ),
        row(
            "point to pixel, 5 coefficients",
            n,
            lambda: project_all(CAMERA.params, points, back, valid),
            lambda: numpy_project(points),
        ),
        row(
            "point to pixel, bare lens",
            n,
            lambda: project_all(BARE.params, points, back, bare_valid),
            lambda: numpy_project_bare(points),
        ),
        row(
            "point to pixel with Jacobian",
            len(few),
            lambda: CAMERA.project_with_jacobian(few),
            lambda: numeric_jacobian(few),
        ),
        row(
            "point to pixel with all 20 parameters",
            len(few),
            lambda: CAMERA.project_with_parameter_jacobian(few),
            lambda: numeric_parameter_jacobian(few),
        ),
        *flat_port_rows(pixels),
    ]
