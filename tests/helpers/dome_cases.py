"""Simulated views of boards, behind a dome or not, that tests of several calibrations share."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest

from aqualvs.calibrate import dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions
from aqualvs.calibration.solver.bundle import rig_difference
from aqualvs.calibration.solver.result import DomeCalibration
from aqualvs.calibration.targets.pose_files import BoardPose
from aqualvs.calibration.targets.targets import View
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig, RigUncertainty, rig_moved_by

AIR, WATER = 1.0003, 1.3333
NOISE_PX = 0.1
LENS = ("lens_x", "lens_y", "lens_z")
INTRINSICS = RigUncertainty.independent(
    {"fx": 0.3, "fy": 0.3, "cx": 0.3, "cy": 0.3, "k1": 5e-4, "k2": 2e-3, "p1": 5e-5, "p2": 5e-5}
)


def leave_bare_lenses_out(patch: pytest.MonkeyPatch) -> None:
    """Have the command compare no dome with a bare lens: most of its time, and a remark of it."""
    patch.setattr(dome, "DomeOptions", partial(DomeOptions, check_cross_validation=False))


@dataclass(frozen=True)
class Given(BoardPose):
    """What was measured of a board's pose."""

    name: str = ""
    distance: float | None = None
    dome_from_board: SE3 | None = None


@dataclass(frozen=True)
class Shoot:
    """Simulated pictures with their truth."""

    views: tuple[View, ...]
    given: tuple[Given | None, ...]
    poses: tuple[SE3, ...]

    def as_set(self, n: float = AIR, sigma: float = 0.0, name: str = "air") -> BoardSet:
        return BoardSet(
            name=name, views=self.views, poses=self.given, n_medium=n, sigma_medium=sigma
        )

    def with_given(self, given: Sequence[Given | None]) -> "Shoot":
        return replace(self, given=tuple(given))


def board_points(columns: int = 26, rows: int = 20, square: float = 0.028) -> FloatArray:
    x, y = np.meshgrid(np.arange(columns) * square, np.arange(rows) * square)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)


def see(
    camera: Camera,
    pose: SE3,
    points: FloatArray,
    rng: np.random.Generator,
    *,
    name: str = "view",
    noise_px: float = NOISE_PX,
    at_most: int = 60,
) -> View:
    """Return what a camera sees of a target at a pose."""
    pixels, valid = camera.project(pose.apply(points))
    ids = np.flatnonzero(valid & camera.inside_image(pixels))
    if len(ids) > at_most:
        ids = np.sort(rng.choice(ids, at_most, replace=False))
    return View(name, ids, points[ids], pixels[ids] + rng.normal(0.0, noise_px, (len(ids), 2)))


def rail(
    rig: Rig,
    n: float,
    kind: str,
    rng: np.random.Generator,
    *,
    n_views: int = 8,
    noise_px: float = NOISE_PX,
    tilt: float | None = None,
    shared_tilt: float = 0.0,
    nearest: float = 0.2,
    farthest: float = 0.9,
    rail_sigma: float = 2e-4,
) -> Shoot:
    """Return views of a board moved along a rail; `kind` is what is given of its poses.

    `tilt` and `shared_tilt`: standard deviations about each axis, of each board and of all.
    """
    camera, points = rig.in_water(n).camera(), board_points()
    if tilt is None:
        tilt = float(np.deg2rad(0.2)) if kind == "distance" else 0.2
    carriage = rotation_from_rotvec(rng.normal(0.0, shared_tilt, 3)) if shared_tilt else np.eye(3)
    zero = rng.normal(0.0, rail_sigma)
    views, given, poses = [], [], []
    for i, distance in enumerate(np.linspace(nearest, farthest, n_views)):
        own_tilt = rotation_from_rotvec(rng.normal(0.0, tilt, 3))
        rotation = own_tilt @ carriage @ DOME_FROM_CAM_NOMINAL
        middle = np.array([rng.normal(0.0, 0.02), distance, rng.normal(0.0, 0.02)])
        pose = SE3(rotation, middle - rotation @ points.mean(axis=0))
        views.append(see(camera, pose, points, rng, name=f"view_{i}", noise_px=noise_px))
        normal = rotation[:, 2]
        on_axis = float(normal @ pose.translation / normal[1])
        measured = on_axis + zero + rng.normal(0.0, rail_sigma)
        given.append(_given(kind, pose, measured))
        poses.append(pose)
    return Shoot(tuple(views), tuple(given), tuple(poses))


def _given(kind: str, pose: SE3, distance: float) -> Given | None:
    if kind == "exact":
        return Given(dome_from_board=pose)
    return Given(distance=distance) if kind == "distance" else None


def drawn_rig(base: Rig, options: DomeOptions, rng: np.random.Generator) -> Rig:
    """Return a rig whose dome and intrinsics are off by what is not known of them."""
    tolerances = RigUncertainty.independent(
        {
            "inner_radius": options.inner_radius_sigma,
            "thickness": options.thickness_sigma,
            "n_acrylic": options.n_acrylic_sigma,
        }
    )
    for known in (tolerances, INTRINSICS):
        sigma = np.sqrt(np.diag(known.covariance))
        base = rig_moved_by(base, known.names, rng.normal(0.0, sigma))
    return base


def guessed(rig: Rig, *, rotation_known: bool) -> Rig:
    """Return a rig as a user has it beforehand: lens at the centre, camera straight ahead."""
    rotation = rig.dome_from_cam.rotation if rotation_known else DOME_FROM_CAM_NOMINAL
    return replace(rig, dome_from_cam=SE3(rotation, np.zeros(3)))


def normalised_errors(
    result: DomeCalibration, true: Rig, poses: Sequence[SE3], media: Sequence[float] = ()
) -> dict[str, float]:
    """Return error over sigma of everything that a calibration reports."""
    sigmas = result.uncertainty.sigmas
    names = [name for name in sigmas if name != "n_water"]
    errors = rig_difference(true, result.rig, names)
    found = {name: float(e) / sigmas[name] for name, e in zip(names, errors, strict=True)}
    for medium, n in zip(result.media, media, strict=False):
        if medium.sigma > 0.0:
            found[f"n of {medium.name}"] = (medium.n - n) / medium.sigma
    for i, (fit, pose) in enumerate(zip(result.views, poses, strict=True)):
        if fit.covariance.any():
            sigma = np.sqrt(np.diag(fit.covariance))
            off = pose_difference(pose, fit.dome_from_target, fit.view.middle) / sigma
            found.update({f"pose {i} {k}": float(off[k]) for k in range(6)})
    return found


def pose_difference(true: SE3, found: SE3, middle: FloatArray) -> FloatArray:
    """Return the step (6,) of `moved_target` from one pose to another."""
    turn = rotvec_from_rotation(found.rotation @ true.rotation.T)
    return np.concatenate([turn, found.apply(middle) - true.apply(middle)])


def lens_error(result: DomeCalibration, true: Rig) -> float:
    return float(
        np.linalg.norm(result.rig.dome_from_cam.translation - true.dome_from_cam.translation)
    )
