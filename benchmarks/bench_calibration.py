"""CPU time of `calibrate dome` from found corners, next to SciPy on the same residuals.

Run `python -m benchmarks calibration` for a table. 14 boards, some 3000 corners, poses free, lens
41 mm from where the solve starts. The reference is what one would first write:
`scipy.optimize.least_squares` (MINPACK) with numeric derivatives, started from the same poses; it
projects through the same compiled camera, and neither estimates noise nor leaves out outliers. It
must end at the same lens position before anything is reported.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from aqualvs.calibration.dome.calibrate import dome
from aqualvs.calibration.dome.problem import BoardSet, DomeOptions, DomeProblem, dome_problem
from aqualvs.calibration.solver.bundle import PRIORS, BundleState
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig, RigUncertainty
from aqualvs.simulation.scenarios import example_rig

_AIR = 1.0003
_NOISE_PX = 0.1
_ROUNDS = 7
_KNOWN = RigUncertainty.independent(
    {"fx": 0.3, "fy": 0.3, "cx": 0.3, "cy": 0.3, "k1": 5e-4, "k2": 2e-3, "p1": 5e-5, "p2": 5e-5}
)


def run(quick: bool = False) -> list[dict[str, Any]]:
    """Return the rows of the table."""
    rig = example_rig()
    views = _views(rig, n_views=7 if quick else 14)
    start = replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, np.zeros(3)))
    sets = [BoardSet(name="air", views=views)]
    options = DomeOptions(check_cross_validation=False)
    ours, seconds = _timed(lambda: dome(start, sets, options, _KNOWN), 3 if quick else _ROUNDS)
    reference, reference_seconds = _timed(lambda: _reference(start, sets, options), 1)
    apart = np.linalg.norm(ours.rig.dome_from_cam.translation - reference)
    # The reference weighs all views alike; the lens is known to 0.3 mm.
    if apart > 2e-4:
        raise RuntimeError(f"the reference ends {1e3 * apart:.2f} mm away")
    n = sum(len(view) for view in views)
    return [
        {
            "name": f"dome, {len(views)} boards at free poses, {n} corners",
            "value": 1e3 * seconds,
            "unit": "ms CPU",
            "reference": 1e3 * reference_seconds,
            "ratio": reference_seconds / seconds,
        }
    ]


def _views(rig: Rig, n_views: int) -> tuple[View, ...]:
    rng, camera = np.random.default_rng(1), rig.in_water(_AIR).camera()
    x, y = np.meshgrid(0.028 * np.arange(1, 38), 0.028 * np.arange(1, 30))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    views = []
    for i, distance in enumerate(np.linspace(0.25, 1.2, n_views)):
        rotation = rotation_from_rotvec(rng.normal(0.0, 0.15, 3)) @ DOME_FROM_CAM_NOMINAL
        pose = SE3(rotation, np.array([0.0, distance, 0.0]) - rotation @ points.mean(axis=0))
        pixels, valid = camera.project(pose.apply(points))
        ids = np.flatnonzero(valid & camera.inside_image(pixels))
        ids = np.sort(rng.permutation(ids)[:300])
        found = pixels[ids] + rng.normal(0.0, _NOISE_PX, (len(ids), 2))
        views.append(View(f"board {i}", ids, points[ids], found))
    return tuple(views)


def _timed(job: Callable[[], Any], rounds: int) -> tuple[Any, float]:
    times, result = [], None
    for _ in range(rounds):
        began = time.process_time()
        result = job()
        times.append(time.process_time() - began)
    return result, min(times)


def _reference(rig: Rig, sets: list[BoardSet], options: DomeOptions) -> FloatArray:
    problem = dome_problem(rig, sets, _KNOWN, options)
    bundle = problem.bundle
    scale = _scales(problem)

    def residuals(x: FloatArray) -> FloatArray:
        try:
            state = bundle.moved(bundle.start, x * scale)
            return _plain_residuals(problem, state)
        except RigError:
            return np.full(n, 1e3)

    n = len(_plain_residuals(problem, bundle.start))
    found = least_squares(residuals, np.zeros(bundle.n_parameters), method="lm")
    state = bundle.moved(bundle.start, found.x * scale)
    position: FloatArray = state.rig.dome_from_cam.translation
    return position


def _plain_residuals(problem: DomeProblem, state: BundleState) -> FloatArray:
    """Return residuals without derivatives, corners first."""
    camera, parts = state.camera(0), []
    for target, pose in zip(problem.bundle.views, state.poses, strict=True):
        pixels, _ = camera.project(pose.apply(target.view.points))
        parts.append(((pixels - target.view.pixels) / _NOISE_PX).ravel())
    empty = replace(problem.bundle, views=())
    priors = empty.blocks(replace(state, poses=()))
    parts += [block.residuals.ravel() for block in priors if block.group == PRIORS]
    return np.nan_to_num(np.concatenate(parts), nan=1e3)


def _scales(problem: DomeProblem) -> FloatArray:
    """Return what numeric derivatives count each parameter in."""
    prior = problem.bundle.priors.sigmas
    shared = [prior.get(name, 1e-3) for name in problem.bundle.free]
    n_poses = problem.bundle.n_parameters - len(shared)
    return np.array([*shared, *[1e-3] * n_poses])
