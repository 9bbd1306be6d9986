"""Nets in random scenes: postures by difficulty, labels against truth, and what labelling costs.

The scenes are rendered anew, about one a second; `AQUALVS_NET_SCENES` sets how many (default 201).
"""

import os
import time
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from benchmarks.random_scenes import Difficulty, random_scene

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanner import Scanner
from aqualvs.scanning.candidates import Candidates, find_candidates
from aqualvs.scanning.detection import FrameDetector
from aqualvs.scanning.labels import label_candidates
from aqualvs.scanning.laser_bands import plan_bands
from aqualvs.scanning.posture_estimator import FitMethod, PostureEstimator
from aqualvs.scanning.scan import Frame, planes_of_image
from aqualvs.scanning.stripe import StripeOptions
from aqualvs.scanning.surfaces import SurfaceFinder
from aqualvs.scanning.target import TargetKind, choose_target
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Scene, SurfaceKind
from aqualvs.simulation.truth import visible_fit

_DIFFICULTIES: tuple[Difficulty, ...] = ("clean", "usual", "hard")
_TARGET_MS = 0.5
# A range that is off by more is another surface's.
_WRONG_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class Outcome:
    """One scene: whether there was a posture, and its errors (share, degrees, degrees)."""

    difficulty: Difficulty
    valid: bool
    errors: FloatArray


def run() -> list[dict[str, Any]]:
    """Rows by difficulty, and the cost of labelling at several numbers of points."""
    n = int(os.environ.get("AQUALVS_NET_SCENES", "201"))
    outcomes = [outcome(index) for index in range(n)]
    rows = []
    for difficulty in (*_DIFFICULTIES, "all"):
        mine = [one for one in outcomes if difficulty in (one.difficulty, "all")]
        rows += _rows(difficulty, mine)
    return rows + _cost()


def outcome(index: int) -> Outcome:
    """Render and scan one scene of a fixed series."""
    difficulty = _DIFFICULTIES[index % len(_DIFFICULTIES)]
    scene = random_scene(np.random.default_rng([2021, index]), difficulty)
    frame, truth = shoot(scene, index)
    posture = Scanner(example_rig()).process(frame).posture
    if not posture:
        return Outcome(difficulty, False, np.full(3, np.nan))
    pitch = posture.pitch - np.arctan2(truth[2], truth[1])
    yaw = posture.yaw - np.arctan2(truth[0], truth[1])
    share = posture.range / truth[3] - 1.0
    return Outcome(difficulty, True, np.abs([share, np.rad2deg(pitch), np.rad2deg(yaw)]))


def shoot(scene: Scene, index: int) -> tuple[Frame, FloatArray]:
    """Return the frame, and normal and offset of the plane through the net's visible light."""
    picture = Renderer(example_rig()).render(scene, 0.0, np.random.default_rng([7, index]))
    luma, chroma = planes_of_image(cv2.cvtColor(picture.image, cv2.COLOR_RGB2BGR))
    seen = visible_fit(picture.lit, SurfaceKind.NET)
    plane = scene.target_plane() if seen is None else seen[0]
    return Frame(index, 0.0, luma, chroma), np.append(plane.normal, plane.offset)


def _rows(difficulty: str, outcomes: list[Outcome]) -> list[dict[str, Any]]:
    errors = np.array([one.errors for one in outcomes if one.valid]).reshape(-1, 3)
    share = np.mean([one.valid for one in outcomes])
    high = np.quantile(errors, 0.95, axis=0)
    name = f"{len(outcomes)} nets, {difficulty}"
    wrong = int(np.count_nonzero(errors[:, 0] > _WRONG_SHARE))
    return [
        _row(f"{name}: posture valid", 100 * float(share), "%", 95.0, float(share) / 0.95),
        _row(f"{name}: range, 95th", 100 * float(high[0]), "%", 0.7, 0.007 / float(high[0])),
        _row(f"{name}: pitch, 95th", float(high[1]), "deg", 1.0, 1.0 / float(high[1])),
        _row(f"{name}: yaw, 95th", float(high[2]), "deg", 1.0, 1.0 / float(high[2])),
        _row(f"{name}: wrong target", wrong, "scenes", 0, None),
    ]


def _cost() -> list[dict[str, Any]]:
    """Time to label one frame whose light is repeated so and so many times."""
    rig = example_rig()
    camera = rig.camera()
    laser_bands = plan_bands(rig, camera)
    frame, _ = shoot(random_scene(np.random.default_rng([2021, 1]), "usual"), 1)
    peaks = FrameDetector(rig.size_px, laser_bands, StripeOptions()).detect(frame)
    candidates = find_candidates(peaks, laser_bands, Triangulator(rig, camera))
    rows = []
    for n in (500, 1000, 2000, 4000):
        some = candidates.where(np.arange(candidates.n) % max(candidates.n / n, 1.0) < 1.0)
        value = _label_ms(some, laser_bands)
        rows.append(_row(f"labels, {some.n} readings", value, "ms", _TARGET_MS, _TARGET_MS / value))
    return rows


def _label_ms(candidates: Candidates, laser_bands: Any) -> float:
    rig = example_rig()
    linked = candidates.linked()
    surfaces = SurfaceFinder(rig).find(linked)
    target = choose_target(surfaces, TargetKind.AUTO, rig.working_range)
    assert target is not None
    found = PostureEstimator(rig, laser_bands, FitMethod.ROBUST).measure(
        candidates, linked.subsegments, target
    )
    times = []
    for _ in range(100):
        start = time.perf_counter()
        label_candidates(linked, surfaces, target, found, rig.working_range)
        times.append(time.perf_counter() - start)
    return float(np.median(times)) * 1e3


def _row(
    name: str, value: float, unit: str, reference: float | None, ratio: float | None
) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "reference": reference, "ratio": ratio}
