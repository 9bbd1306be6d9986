"""One dive of the benchmark set on disk: video, truth, rig."""

import csv
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.planes import Plane
from aqualvs.optics.rigfile import save_rig
from aqualvs.optics.solved import with_exact_numbers
from aqualvs.simulation.benchmark_scenarios import BenchmarkDive
from aqualvs.simulation.lit_points import LitPoints
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scene import Label, Scene
from aqualvs.simulation.sensor import expose, spread
from aqualvs.simulation.truth import visible_fit
from aqualvs.simulation.video import VideoWriter
from aqualvs.simulation.visible import stripe_contrast, visible_points

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

_LABELS = {"net": Label.NET, "wall": Label.WALL, "none": Label.NONE}
# A laser with fewer points shows no line.
_POINTS_OF_A_LINE = 5

Cell: TypeAlias = int | float | str


def render_benchmark_dive(
    dive: BenchmarkDive, renderer: Renderer, folder: Path, *, tick: Callable[[int], None]
) -> None:
    """Write `dive.mp4`, `truth.csv` and `rig.yaml` into a folder, which is made.

    Parameters
    ----------
    dive : BenchmarkDive
        What to render.
    renderer : Renderer
        For `benchmark_rig()`.
    folder : Path
        Files of the same names in it are replaced.
    tick : callable
        Called with 1 after every frame.

    Raises
    ------
    OSError, OutputError
        If the folder or a file cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    save_rig(with_exact_numbers(renderer.rig), folder / "rig.yaml")
    scenario = dive.scenario
    with (
        (folder / "truth.csv").open("w", newline="", encoding="utf-8") as file,
        VideoWriter(folder / "dive.mp4", renderer.rig.size_px, scenario.fps) as video,
    ):
        table = csv.writer(file)
        table.writerow(TRUTH_COLUMNS)
        for i, t in enumerate(scenario.times()):
            scene = scenario.scene_at(t)
            rng = np.random.default_rng([scenario.seed, i])
            image, lit = render_with_visible(renderer, scene, t, rng)
            video.write(image)
            table.writerow([i, f"{t:.4f}", *truth_cells(scene, lit)])
            tick(1)


def render_with_visible(
    renderer: Renderer, scene: Scene, t: float, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], LitPoints]:
    """Return the picture of a scene and the stripe points on its target that it truly shows."""
    radiance = renderer.radiance(scene, t)
    image = expose(spread(radiance, scene.water, scene.sensor), scene.sensor, rng)
    lit = renderer.lit_points(scene, t)
    label = _LABELS[scene.target]
    if not np.any(lit.label == label):
        return image, _part(lit, np.empty(0, np.int64))
    contrast = stripe_contrast(renderer, scene, t, radiance, lit)
    return image, _part(lit, visible_points(lit, label, contrast))


def truth_cells(scene: Scene, visible: LitPoints) -> list[Cell]:
    """Return the cells of one frame after frame and time, in the order of `TRUTH_COLUMNS`."""
    n_lasers = int(np.sum(np.bincount(visible.laser) >= _POINTS_OF_A_LINE)) if len(visible) else 0
    counts: list[Cell] = [len(visible), n_lasers]
    if scene.target == "none":
        return ["", "", "", *counts, "", "", "", ""]
    plane = scene.target_plane()
    fit = visible_fit(visible, _LABELS[scene.target])
    if fit is None:
        return [*_posture(plane), *counts, "", *_posture(plane)]
    return [*_posture(fit[0]), *counts, f"{1e3 * fit[1]:.3f}", *_posture(plane)]


def _part(lit: LitPoints, points: NDArray[np.int64]) -> LitPoints:
    return replace(
        lit,
        points_in_dome=lit.points_in_dome[points],
        pixels=lit.pixels[points],
        laser=lit.laser[points],
        label=lit.label[points],
    )


def _posture(plane: Plane) -> list[Cell]:
    """Range in metres, pitch and yaw in degrees (docs/conventions.md)."""
    nx, ny, nz = plane.normal.tolist()
    angles = np.rad2deg([np.arctan2(nz, ny), np.arctan2(nx, ny)])
    return [f"{plane.offset:.6f}", *(f"{angle:.5f}" for angle in angles)]
