"""A whole simulated dive on disk: the video and its truth."""

import csv
import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import numpy as np

from aqualvs.errors import OutputError
from aqualvs.optics.rig import Rig
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.lit_points import LitPoints
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scene import Label
from aqualvs.simulation.truth import TRUTH_COLUMNS, truth_row
from aqualvs.simulation.video import Recording, VideoWriter


@dataclass(frozen=True, slots=True)
class DiveFiles:
    """What `simulate_dive` wrote.

    Attributes
    ----------
    video, truth : Path
        `dive.mp4` and `truth.csv`.
    points : tuple of Path
        `points_FFFF.npz` for the frames that were asked for.
    n_frames : int
        Frames written.
    """

    video: Path
    truth: Path
    points: tuple[Path, ...]
    n_frames: int


def simulate_dive(
    scenario: Scenario,
    rig: Rig,
    out_dir: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    point_frames: Collection[int] = (),
    camera: SimulatedCamera = IDEAL,
    recording: Recording | None = None,
    threads: int | None = None,
) -> DiveFiles:
    """Render a scenario with a rig and write `dive.mp4`, `truth.csv` and, if asked, lit points.

    The same scenario, rig and seed give the same pictures. If it is interrupted, the frames
    written so far and their truth can be read.

    Parameters
    ----------
    scenario : Scenario
        What to render.
    rig : Rig
        With which camera, dome, water and lasers.
    out_dir : Path
        Made if it is missing; files of an earlier dive in it are overwritten.
    progress : callable, optional
        Called after every frame with the number of frames done and of all frames.
    point_frames : collection of int
        Frames whose lit points go to `points_FFFF.npz`: `xyz` in `dome` in mm, `px`, `laser`,
        `label` (index into `labels`) and `labels`.
    camera : SimulatedCamera
        Sensor and processing; see `aqualvs.simulation.cameras`.
    recording : Recording, optional
        How the video is compressed; as the camera does it by default.
    threads : int, optional
        Cores to render with; all of them by default. The pictures do not depend on it.

    Raises
    ------
    OutputError
        If the folder or a file cannot be written.
    RigError, OptionError
        If rig, scenario or options make no sense.
    """
    _make_folder(out_dir)
    video, truth = out_dir / "dive.mp4", out_dir / "truth.csv"
    renderer = Renderer(rig, threads=threads or os.cpu_count() or 1, camera=camera)
    points: list[Path] = []
    with (
        _open_table(truth) as file,
        VideoWriter(video, rig.size_px, scenario.fps, recording or camera.recording) as writer,
    ):
        table = csv.writer(file)
        table.writerow(TRUTH_COLUMNS)
        for i, t in enumerate(scenario.times()):
            scene = scenario.scene_at(t)
            picture = renderer.render(scene, t, np.random.default_rng([scenario.seed, i]))
            writer.write(picture.image)
            table.writerow(truth_row(i, t, scene, rig, picture.lit))
            if i in point_frames:
                points.append(_write_points(out_dir / f"points_{i:04d}.npz", picture.lit))
            if progress is not None:
                progress(i + 1, scenario.n_frames)
    return DiveFiles(video, truth, tuple(points), scenario.n_frames)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: {error.strerror}; choose a folder that can be written"
        ) from None


def _open_table(path: Path) -> TextIO:
    try:
        return path.open("w", newline="", encoding="utf-8")
    except OSError as error:
        raise OutputError(
            f"{path}: {error.strerror}; choose a folder that can be written"
        ) from None


def _write_points(path: Path, lit: LitPoints) -> Path:
    try:
        np.savez_compressed(
            path,
            xyz=1e3 * lit.points_in_dome,
            px=lit.pixels,
            laser=lit.laser,
            label=lit.label,
            labels=np.array([label.name.lower() for label in Label]),
        )
    except OSError as error:
        raise OutputError(
            f"{path}: {error.strerror}; choose a folder that can be written"
        ) from None
    return path
