"""Cameras and numeric derivatives that several tests of the optics share."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.camera import Camera, parameter_names
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import Rig, rig_moved_by

SIZE_PX = (720, 576)
NOMINAL = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
PAPER_DOME = Dome(0.04425, 0.00575, 1.49)
PAPER_LENS = Lens(
    fx=817.5, fy=878.0, cx=368.9, cy=281.7, distortion=(-0.126, 0.0827, 6.2e-4, -4.5e-4, 0.01)
)
FISHEYE_LENS = Lens(
    model=LensModel.FISHEYE,
    fx=310.0,
    fy=312.0,
    cx=362.0,
    cy=290.0,
    distortion=(-0.012, 0.004, -0.0021, 0.0003),
)
# Centred, on and off every axis, forwards, sideways and backwards, up to the paper's 41.8 mm.
DECENTRINGS_MM = [
    (0.0, 0.0, 0.0),
    (1e-9, 0.0, 0.0),
    (0.0, 1e-4, 1e-4),
    (0.0, 6.0, 0.0),
    (0.0, -6.0, 0.0),
    (3.1, 41.8, 3.0),
    (0.0, 42.0, 0.0),
    (0.0, -42.0, 0.0),
    (42.0, 0.0, 0.0),
    (0.0, 0.0, -42.0),
    (24.2, -24.2, 24.2),
]


def pose(
    lens_mm: tuple[float, float, float], rotvec: tuple[float, float, float] = (0.04, 0.029, 0.016)
) -> SE3:
    return SE3(rotation_from_rotvec(rotvec) @ NOMINAL, np.array(lens_mm) * 1e-3)


def dome_camera(
    lens_mm: tuple[float, float, float] = (3.1, 41.8, 3.0),
    *,
    lens: Lens = PAPER_LENS,
    dome: Dome = PAPER_DOME,
    n_air: float = 1.0003,
    n_water: float = 1.3333,
    rotvec: tuple[float, float, float] = (0.04, 0.029, 0.016),
) -> Camera:
    return Camera(
        size_px=SIZE_PX,
        lens=lens,
        dome_from_cam=pose(lens_mm, rotvec),
        housing=dome,
        n_air=n_air,
        n_water=n_water,
    )


PORT = FlatPort(0.031, 0.006, 1.49, 0.02, -0.03)


def flat_camera(
    port: FlatPort = PORT,
    *,
    lens_mm: tuple[float, float, float] = (3.1, 41.8, 3.0),
    lens: Lens = PAPER_LENS,
    n_air: float = 1.0003,
    n_water: float = 1.3333,
    rotvec: tuple[float, float, float] = (0.04, 0.029, 0.016),
) -> Camera:
    return Camera(
        size_px=SIZE_PX,
        lens=lens,
        dome_from_cam=pose(lens_mm, rotvec),
        housing=port,
        n_air=n_air,
        n_water=n_water,
    )


def bare_camera(
    lens_mm: tuple[float, float, float] = (3.1, 41.8, 3.0), *, lens: Lens = PAPER_LENS
) -> Camera:
    return Camera(size_px=SIZE_PX, lens=lens, dome_from_cam=pose(lens_mm))


def moved_by(camera: Camera, step: ArrayLike) -> Camera:
    """The camera with `step` added to its parameters, in the order of `parameter_names`."""
    rig = Rig(
        name="moved",
        size_px=camera.size_px,
        lens=camera.lens,
        dome_from_cam=camera.dome_from_cam,
        housing=camera.housing,
        n_air=camera.n_air,
        n_water=camera.n_water,
        lasers=(),
        working_range=(0.3, 1.0),
    )
    return rig_moved_by(rig, parameter_names(camera), np.asarray(step)).camera()


def image_grid(step_px: float = 24.0) -> FloatArray:
    """Pixels over the whole picture, corners included, shape (rows, columns, 2)."""
    x = np.append(np.arange(-0.5, SIZE_PX[0] - 0.5, step_px), SIZE_PX[0] - 0.5)
    y = np.append(np.arange(-0.5, SIZE_PX[1] - 0.5, step_px), SIZE_PX[1] - 0.5)
    return np.stack(np.meshgrid(x, y), axis=-1)


def central_difference(
    function: Callable[[FloatArray], FloatArray], at: FloatArray, step: float | FloatArray
) -> FloatArray:
    """Derivatives of `function` (..., k) by the last axis (n) of `at`, shape (..., k, n)."""
    n = at.shape[-1]
    steps = np.broadcast_to(np.asarray(step, dtype=np.float64), (n,))
    columns = []
    for i in range(n):
        shift = np.zeros(n)
        shift[i] = steps[i]
        columns.append((function(at + shift) - function(at - shift)) / (2.0 * steps[i]))
    return np.stack(columns, axis=-1)


def relative_error(found: FloatArray, expected: FloatArray) -> float:
    """Largest error of a batch of matrices (..., m, n), each relative to its largest entry."""
    scale = np.abs(expected).max(axis=(-2, -1))
    return float((np.abs(found - expected).max(axis=(-2, -1)) / scale).max())
