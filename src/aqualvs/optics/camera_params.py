"""The numbers of a camera: their names, small changes to them, and the form that kernels take."""

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray, as_vectors
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.dome import Dome, check_index
from aqualvs.optics.dome_forward import CameraParams
from aqualvs.optics.lens import Lens

POSE_PARAMETERS = ("lens_x", "lens_y", "lens_z", "rotation_x", "rotation_y", "rotation_z")
"""First columns of every parameter Jacobian.

The lens position L in `dome` (metres), and a rotation vector w (radians) in `dome` that is applied
after the camera's rotation: `dome_from_cam.rotation = Rodrigues(w) @ rotation`, taken at w = 0.
"""
DOME_PARAMETERS = ("inner_radius", "thickness", "n_air", "n_acrylic", "n_water")
"""Columns that follow for a camera behind a dome; `inner_radius` moves the outer sphere along."""


class HasParameters(Protocol):
    """What names the parameters of a camera."""

    @property
    def lens(self) -> Lens:
        """Intrinsics."""

    @property
    def params(self) -> CameraParams:
        """What compiled kernels take."""


def parameter_names(camera: HasParameters) -> tuple[str, ...]:
    """Return the names of a camera's parameters, in the order of every parameter Jacobian.

    `POSE_PARAMETERS`, then `DOME_PARAMETERS` if there is a dome, then the intrinsics: fx, fy, cx,
    cy and as many distortion coefficients as the lens has, in OpenCV's order.
    """
    dome = DOME_PARAMETERS if camera.params.has_dome else ()
    return POSE_PARAMETERS + dome + camera.lens.parameter_names


def named_step(camera: HasParameters, step: ArrayLike) -> dict[str, float]:
    """Return `step` (P,) by parameter name."""
    names = parameter_names(camera)
    values: Sequence[float] = as_vectors(step, len(names), "step").tolist()
    return dict(zip(names, values, strict=True))


def moved_pose(pose: SE3, step: dict[str, float]) -> SE3:
    """Return the pose with the lens shifted and the camera turned by `step`."""
    rotvec = [step["rotation_x"], step["rotation_y"], step["rotation_z"]]
    shift = [step["lens_x"], step["lens_y"], step["lens_z"]]
    return SE3(rotation_from_rotvec(rotvec) @ pose.rotation, pose.translation + np.array(shift))


def moved_lens(lens: Lens, step: dict[str, float]) -> Lens:
    """Return the lens with `step` added to its intrinsics."""
    coefficients = zip(lens.parameter_names[4:], lens.distortion, strict=True)
    return Lens(
        model=lens.model,
        fx=lens.fx + step["fx"],
        fy=lens.fy + step["fy"],
        cx=lens.cx + step["cx"],
        cy=lens.cy + step["cy"],
        distortion=tuple(value + step[name] for name, value in coefficients),
    )


def camera_params(
    *,
    size_px: tuple[int, int],
    lens: Lens,
    dome_from_cam: SE3,
    dome: Dome | None,
    n_air: float,
    n_water: float,
) -> CameraParams:
    """Check a camera and return it as kernels take it.

    Raises
    ------
    RigError
        If the lens lies outside the inner sphere, an index or the size cannot be, or the pose is
        not one finite rigid transform.
    """
    _check_size(size_px)
    check_index("camera", "n_air", n_air)
    check_index("camera", "n_water", n_water)
    rotation, centre = _checked_pose(dome_from_cam)
    decentring = float(np.linalg.norm(centre))
    if dome is not None and decentring >= dome.inner_radius:
        raise RigError(
            f"lens at {np.round(centre * 1e3, 3).tolist()} mm is {decentring * 1e3:.3f} mm from "
            f"the dome's centre but the inner radius is {dome.inner_radius * 1e3:.3f} mm; move "
            "the lens inside or correct the radius"
        )
    axis = centre / decentring if decentring > 0.0 else np.array([0.0, 0.0, 1.0])
    shell = dome or Dome(1.0, 0.0, 1.0)
    return CameraParams(
        lens=lens.params,
        has_dome=dome is not None,
        rotation=_nine(rotation),
        centre=_three(centre),
        inner_radius=float(shell.inner_radius),
        outer_radius=float(shell.outer_radius),
        n_air=float(n_air),
        n_acrylic=float(shell.n_acrylic),
        n_water=float(n_water),
        decentring=decentring,
        axis=_three(axis),
    )


def _three(v: FloatArray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])


def _nine(
    m: FloatArray,
) -> tuple[float, float, float, float, float, float, float, float, float]:
    return (*_three(m[0]), *_three(m[1]), *_three(m[2]))


def _check_size(size_px: tuple[int, int]) -> None:
    if len(size_px) != 2 or not all(side > 0 for side in size_px):
        raise RigError(f"camera has size {size_px} px; width and height must be positive")


def _checked_pose(pose: SE3) -> tuple[FloatArray, FloatArray]:
    rotation = np.asarray(pose.rotation, dtype=np.float64)
    centre = np.asarray(pose.translation, dtype=np.float64)
    if rotation.shape != (3, 3) or centre.shape != (3,):
        raise RigError(
            f"camera pose has shapes {rotation.shape} and {centre.shape}; give one rotation "
            "(3, 3) and one position (3,)"
        )
    if not np.all(np.isfinite(centre)):
        raise RigError(f"lens position {centre.tolist()} m is not finite; give three numbers")
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (error < 1e-6 and np.linalg.det(rotation) > 0.0):
        raise RigError(
            f"camera rotation {rotation.tolist()} is no rotation matrix; give an orthogonal "
            "matrix with determinant 1"
        )
    return rotation, centre
