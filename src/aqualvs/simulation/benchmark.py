"""The public benchmark set: dives by difficulty, at fixed seeds, and their truth on disk.

Every difficulty is laid over the same courses and the same nets as the clear dives, so that its
cost can be read off. After any change here the set must get the next number: scores are compared by
name and checksum.

Each dive is a folder with video, truth and rig (`render_benchmark_dive`). Part of the truth is the
stripe points that a picture shows above a fixed contrast, independent of any detector
(`visible_points`).
"""

import csv
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping, save_rig
from aqualvs.optics.solved import with_exact_numbers
from aqualvs.simulation.cameras import expose, spread
from aqualvs.simulation.dive import frames_of_picture
from aqualvs.simulation.lasers import LUMA
from aqualvs.simulation.render import Renderer, SceneAt
from aqualvs.simulation.scenario import Scenario, packaged, parse_scenario
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Scene
from aqualvs.simulation.truth import Cell, LitPoints, target_fit
from aqualvs.simulation.video import VideoWriter

CONTRAST_LIMIT = 10.0
"""Grey levels by which a visible stripe point is brighter than without its stripe."""

VISIBLE_LIMIT = 40
"""Least number of visible stripe points of a frame that should be measured."""

# A stripe is narrower than this share of the picture's width; the glow of the sheets is wider.
_WIDEST_STRIPE = 1 / 36
_LUMA = LUMA.astype(np.float32)
_BEYOND = 1e6


def stripe_contrast(
    renderer: Renderer, scene: Scene, t: float, radiance: NDArray[np.float32], lit: LitPoints
) -> NDArray[np.float32]:
    """Return the contrast of the stripes in grey levels above their surroundings.

    Parameters
    ----------
    scene : Scene
        With its lasers on.
    radiance : float32 array, shape (height, width, 3)
        Of that scene at time `t`, from `Renderer.radiance`.
    lit : LitPoints
        Of that scene at that time.

    Returns
    -------
    contrast : float32 array, shape (height, width)
        Luma (ITU-R BT.601) that the lasers add to the picture without noise, minus that on the
        lighter side of the stripe, left and right or above and below, whichever is more (a
        morphological opening). The glow of the sheets in the water is no stripe, nor is a place
        that daylight saturates. Zero away from lit points.
    """
    height, width = radiance.shape[:2]
    size = 2 * round(0.5 * _WIDEST_STRIPE * width) + 1
    around = _around(lit, (height, width), 2 * size + 1)
    dark = renderer.radiance(replace(scene, lasers_on=False), t, around)
    dark[~around] = radiance[~around]
    images = (
        expose(spread(x, scene.water, scene.sensor), scene.sensor, None) for x in (radiance, dark)
    )
    bright_luma, dark_luma = (image.astype(np.float32) @ _LUMA for image in images)
    lift = bright_luma - dark_luma
    windows = np.ones((1, size), np.uint8), np.ones((size, 1), np.uint8)
    across = [_above_flanks(lift, around, window) for window in windows]
    return np.where(around, np.maximum(*across), 0.0).astype(np.float32)


def _above_flanks(
    lift: FloatArray, around: BoolArray, window: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """Return the difference of a picture and its opening by a window, where it is known."""
    low = cv2.erode(np.where(around, lift, _BEYOND), window)
    opened = cv2.dilate(np.where(around, low, -_BEYOND), window)
    return np.asarray(lift - opened, dtype=np.float64)


def visible_points(lit: LitPoints, label: int, contrast: NDArray[np.float32]) -> IntArray:
    """Return the indices of lit points that are visible stripe points of a target, by laser.

    A stripe has one point in every pixel along it: in every column if it is rather level, in every
    row if it is rather upright. A point is visible if the contrast at its pixel, or at one beside
    it, reaches `CONTRAST_LIMIT`.

    `label`: `SurfaceKind` of the target. `contrast`, shape (height, width): of `stripe_contrast`.
    """
    bright = np.asarray(cv2.dilate(contrast, np.ones((3, 3), np.uint8)))
    x, y = _places(lit.pixels, contrast.shape).T
    seen: BoolArray = (lit.label == label) & (bright[y, x] >= CONTRAST_LIMIT)
    chosen = [
        _one_a_pixel(np.flatnonzero(seen & (lit.laser == k)), lit.pixels)
        for k in np.unique(lit.laser)
    ]
    return np.concatenate([np.empty(0, np.int64), *chosen])


def _around(lit: LitPoints, shape: tuple[int, int], size: int) -> BoolArray:
    """Return the pixels within half of `size` of lit points."""
    marked = np.zeros(shape, np.uint8)
    x, y = _places(lit.pixels, shape).T
    marked[y, x] = 1
    return np.asarray(cv2.dilate(marked, np.ones((size, size), np.uint8)) > 0)


def _places(pixels: FloatArray, shape: tuple[int, ...]) -> IntArray:
    """Return the pixels (x, y) of exact places, clipped to an image of a shape."""
    return np.rint(pixels).astype(np.int64).clip(0, [shape[1] - 1, shape[0] - 1])


def _one_a_pixel(points: IntArray, pixels: FloatArray) -> IntArray:
    """Return the first of the points in every column, or in every row if these are more."""
    places = np.rint(pixels[points]).astype(np.int64)
    firsts = [np.unique(places[:, axis], return_index=True)[1] for axis in (0, 1)]
    return np.asarray(points[np.sort(max(firsts, key=len))], dtype=np.int64)


BENCHMARK_NAME = "aqualvs-bench-1"
"""Name of the set; the number rises with every change of a definition."""

N_FRAMES = 20
"""Frames of every dive."""


LEVELS: Mapping[str, str] = MappingProxyType(
    {
        "clear": "clear water, clean nets and a wall",
        "turbid": "turbid water: glowing sheets, halo, marine snow",
        "sun": "close below the surface: caustics, glare, overexposure",
        "fouled": "nets with growth on 45 and 60 % of their twine",
        "folded": "slack nets that hang in folds",
        "crowded": "holes, fish, bubbles, a box, a wall behind the net",
        "empty": "no target in range, or no lasers: nothing may be measured",
    }
)
"""Levels of difficulty, each with one line about it."""


@dataclass(frozen=True, slots=True)
class BenchmarkDive:
    """A dive of the set."""

    name: str  # `LEVEL_COURSE`; the name of its folder and of its row in scores.
    level: str  # One of `LEVELS`.
    scenario: Scenario  # Scenario to render.

    def shortened(self, n_frames: int) -> "BenchmarkDive":
        """Return the same dive in fewer frames, spread over all of its time."""
        fps = n_frames / self.scenario.duration
        return replace(self, scenario=replace(self.scenario, fps=fps))


def benchmark_rig() -> Rig:
    """Return the rig of all dives: the example rig with a working range of 0.25 to 1.35 m."""
    working_range = (0.25, 1.35)
    return replace(example_rig(), name=BENCHMARK_NAME, working_range=working_range)


def benchmark_dives() -> tuple[BenchmarkDive, ...]:
    """Return all dives of the set, level after level."""
    return tuple(
        BenchmarkDive(name, level, parse_scenario(content, name, name))
        for name, level, content in _definitions()
    )


def benchmark_checksum() -> str:
    """Return the first 12 hex digits of the SHA-256 of everything that defines the set.

    The rig counts to nine digits, so that the last bit of a sine changes nothing.
    """
    parts = [
        BENCHMARK_NAME,
        [VISIBLE_LIMIT, CONTRAST_LIMIT],
        _rounded(rig_to_mapping(benchmark_rig())),
        list(_definitions()),
    ]
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode("ascii")).hexdigest()[:12]


def _definitions() -> list[tuple[str, str, dict[str, Any]]]:
    """Return name, level and scenario mapping of every dive, seeds included."""
    found: list[tuple[str, str, dict[str, Any]]] = []
    duration_s = 5.0
    parts = packaged("benchmark.yaml")
    for level, courses in parts["levels"].items():
        for course, over in courses.items():
            base = parts["targets"].get(course, {})
            content = {**base, **over}
            if "net" in base and "net" in over:
                # The net is laid over key by key.
                content["net"] = {**base["net"], **over["net"]}
            content["motion"] = content.get("motion", parts["courses"].get(course, {}))
            timing = {"duration_s": duration_s, "fps": N_FRAMES / duration_s}
            seed = 1000 + len(found)
            found.append((f"{level}_{course}", level, {**timing, "seed": seed, **content}))
    return found


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(part) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(part) for part in value]
    return float(f"{value:.9g}") if isinstance(value, float) else value


TRUTH_COLUMNS = (
    *("frame", "time_s", "range_m", "pitch_deg", "yaw_deg", "n_visible", "n_visible_lasers"),
    *("residual_mm", "plane_range_m", "plane_pitch_deg", "plane_yaw_deg"),
)
"""Columns of the set's `truth.csv`.

Range, pitch and yaw are those of the plane through the visible stripe points on the target (least
squares), and `residual_mm` is the largest distance of such a point from it. Where the points span
no plane, they are those of the target's own plane, and the residual is empty. The `plane` columns
always hold the latter: the axes of a net's twine, without folds. All are empty without a target.
"""


def render_benchmark_dive(
    dive: BenchmarkDive, renderer: Renderer, folder: Path, *, tick: Callable[[int], None]
) -> None:
    """Write `dive.mp4`, `truth.csv` and `rig.yaml` into a new or existing folder.

    `renderer`: for `benchmark_rig()`, with any shutter; of an interlaced one each field is a frame.
    `tick`: called with 1 after every frame. Raises `OSError` or `OutputError` if the folder or a
    file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_rig(with_exact_numbers(renderer.rig), folder / "rig.yaml")
    scenario = dive.scenario
    with (
        (folder / "truth.csv").open("w", newline="", encoding="utf-8") as file,
        VideoWriter(
            folder / "dive.mp4",
            renderer.rig.size_px,
            scenario.fps,
            first_field=renderer.rig.shutter.field_of(0),
        ) as video,
    ):
        table = csv.writer(file)
        table.writerow(TRUTH_COLUMNS)
        shutter = renderer.rig.shutter
        for i, t in enumerate(scenario.times()):
            rng = np.random.default_rng([scenario.seed, i])
            if not shutter.is_interlaced:
                image, lit = render_with_visible(renderer, scenario.scene_at, t, rng)
                frames = [(i, t, lit)]
            else:
                image = renderer.take(scenario.scene_at, t + 0.5 * shutter.readout, rng).image
                frames = [
                    (frame, at, visible_lit(renderer, scenario.scene_at(at), at))
                    for frame, at in frames_of_picture(i, t, shutter)
                ]
            video.write(image)
            for frame, at, lit in frames:
                table.writerow([frame, f"{at:.4f}", *truth_cells(scenario.scene_at(at), lit)])
            tick(1)


def render_with_visible(
    renderer: Renderer, scene_at: SceneAt, t: float, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], LitPoints]:
    """Return the picture of a scene and its visible stripe points on the target.

    The rig's shutter takes the picture; the points are those of its middle, visible to a camera
    that exposes all rows at once.
    """
    scene = scene_at(t)
    radiance = renderer.radiance(scene, t)
    if renderer.rig.shutter.instant:
        image = expose(spread(radiance, scene.water, scene.sensor), scene.sensor, rng)
    else:
        image = renderer.take(scene_at, t, rng).image
    return image, visible_lit(renderer, scene, t, radiance)


def visible_lit(
    renderer: Renderer, scene: Scene, t: float, radiance: NDArray[np.float32] | None = None
) -> LitPoints:
    """Return the visible stripe points on the target of a scene at time `t`.

    `radiance` is that of the scene, if it is known.
    """
    lit = renderer.lit_points(scene, t)
    label = scene.target_kind
    if not np.any(lit.label == label):
        return _part(lit, np.empty(0, np.int64))
    seen = renderer.radiance(scene, t) if radiance is None else radiance
    contrast = stripe_contrast(renderer, scene, t, seen, lit)
    return _part(lit, visible_points(lit, label, contrast))


def truth_cells(scene: Scene, visible: LitPoints) -> list[Cell]:
    """Return the cells of one frame after frame and time, in the order of `TRUTH_COLUMNS`."""
    # Least number of points of a visible laser line.
    points_of_a_line = 5
    n_lasers = int(np.sum(np.bincount(visible.laser) >= points_of_a_line)) if len(visible) else 0
    counts: list[Cell] = [len(visible), n_lasers]
    if scene.target == "none":
        return ["", "", "", *counts, "", "", "", ""]
    plane = scene.target_plane()
    fit = target_fit(scene, visible)
    if fit is None:
        return [*_posture(plane), *counts, "", *_posture(plane)]
    return [*_posture(fit[0]), *counts, f"{1e3 * fit[1]:.3f}", *_posture(plane)]


def _part(lit: LitPoints, points: NDArray[np.int64]) -> LitPoints:
    return LitPoints(*(getattr(lit, name)[points] for name in LitPoints.__slots__))


def _posture(plane: Plane) -> list[Cell]:
    """Return range in metres, pitch and yaw in degrees (docs/conventions.md)."""
    nx, ny, nz = plane.normal.tolist()
    angles = np.rad2deg([np.arctan2(nz, ny), np.arctan2(nx, ny)])
    return [f"{plane.offset:.6f}", *(f"{angle:.5f}" for angle in angles)]
