"""A whole simulated dive on disk: video, truth, vehicle log and the truth of a net's holes.

For the vehicle log and the holes the net hangs plumb and faces `NET_BEARING`, its middle
`NET_DEPTH` deep; the attitude of the vehicle follows from the trajectory.
"""

import contextlib
import csv
import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aqualvs.errors import OptionError, OutputError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import Scenario
from aqualvs.simulation.scene import SurfaceKind
from aqualvs.simulation.truth import TRUTH_COLUMNS, LitPoints, truth_row
from aqualvs.simulation.video import Compression, VideoWriter, check_size

NET_BEARING = float(np.deg2rad(65.0))
"""Compass bearing of the view to the net, in radians."""
NET_DEPTH = 6.0
"""Depth of the scene's origin, in metres."""
LEAD_S = 20.0
"""Lead of the log before the dive, and its length after it: its clock is not the video's.

Log time = dive time + `LEAD_S`."""
LOG_COLUMNS = ("time_s", "depth_m", "heading_deg", "roll_deg", "pitch_deg")
HOLE_COLUMNS = ("right_m", "up_m", "diameter_mm", "depth_m", "bearing_deg", "time_s")

_SIGMA_DEPTH, _SIGMA_ANGLE = 0.005, float(np.deg2rad(0.2))


def vehicle_attitude(dome_from_scene: SE3) -> tuple[float, float, float]:
    """Return heading, roll and pitch in radians, as in MAVLink's ATTITUDE.

    `dome_from_scene`: pose of the scene, whose net hangs plumb and faces `NET_BEARING`.
    """
    s, c = np.sin(NET_BEARING), np.cos(NET_BEARING)
    # The scene's x, y and z are along the net, away from the vehicle and up.
    ned_from_scene = np.array([[-s, c, 0.0], [c, s, 0.0], [0.0, 0.0, -1.0]])
    right, forward, up = (ned_from_scene @ dome_from_scene.rotation.T).T
    heading = float(np.arctan2(forward[1], forward[0])) % (2.0 * np.pi)
    return heading, float(np.arctan2(right[2], -up[2])), float(-np.arcsin(forward[2]))


def write_vehicle_log(scenario: Scenario, path: Path) -> None:
    """Write depth and attitude of the vehicle, ten times a second, with the noise of sensors.

    The scenario has a net or a wall as its target; the CSV file has `LOG_COLUMNS`, on its own clock
    (`LEAD_S`). Raises `OSError` if it cannot be written.
    """
    rng = np.random.default_rng([scenario.seed, 23])
    with path.open("w", newline="", encoding="ascii") as file:
        table = csv.writer(file)
        table.writerow(LOG_COLUMNS)
        for log_s in _log_times(scenario):
            pose = scenario.trajectory.pose_at(log_s - LEAD_S, scenario.duration)
            depth = NET_DEPTH - pose.inverse().translation[2] + _SIGMA_DEPTH * rng.normal()
            angles = np.array(vehicle_attitude(pose)) + _SIGMA_ANGLE * rng.normal(size=3)
            heading, roll, pitch = np.rad2deg(angles)
            cells = (heading % 360.0, roll, pitch)
            table.writerow([f"{log_s:.2f}", f"{depth:.3f}", *(f"{cell:.2f}" for cell in cells)])


def _log_times(scenario: Scenario) -> FloatArray:
    rate_hz = 10.0
    return np.arange(0.0, scenario.duration + 2.0 * LEAD_S, 1.0 / rate_hz)


def write_hole_truth(scenario: Scenario, path: Path) -> None:
    """Write the places of the holes in a scenario's nets as a CSV file with `HOLE_COLUMNS`.

    These are right and up of the vehicle's foot on the net in the first frame, diameter, depth and
    bearing, and the time at which the vehicle's foot is nearest. Raises `OSError` if the file
    cannot be written.
    """
    times = np.array(list(scenario.times()))
    feet = np.array([_foot(scenario, t) for t in times])
    with path.open("w", newline="", encoding="ascii") as file:
        table = csv.writer(file)
        table.writerow(HOLE_COLUMNS)
        for x, z, radius in (hole for net in scenario.nets for hole in net.holes):
            away = np.hypot(feet[:, 0] - x, feet[:, 1] - z)
            place = (x - feet[0, 0], z - feet[0, 1], 2e3 * radius, NET_DEPTH - z)
            when = (float(np.rad2deg(NET_BEARING)), float(times[int(np.argmin(away))]))
            table.writerow([f"{value:.4f}" for value in (*place, *when)])


def _foot(scenario: Scenario, t: float) -> FloatArray:
    """Return the foot of the perpendicular from the dome's centre in the scene's x and z."""
    centre = scenario.trajectory.pose_at(t, scenario.duration).inverse().translation
    return np.asarray(centre[[0, 2]], np.float64)


@contextlib.contextmanager
def writable(path: Path) -> Iterator[None]:
    """Turn a fault of the operating system into an `OutputError` that names the file."""
    try:
        yield
    except OSError as error:
        place = error.filename or path
        raise OutputError(
            f"{place}: {error.strerror}; choose a folder that can be written"
        ) from None


class DiveFiles(NamedTuple):
    """Files written by `simulate_dive`."""

    video: Path  # `dive.mp4`.
    truth: Path  # `truth.csv`.
    n_frames: int  # Frames written.


def simulate_dive(
    scenario: Scenario,
    rig: Rig,
    out_dir: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
    point_frames: Collection[int] = (),
    camera: SimulatedCamera = IDEAL,
    recording: Compression | None = None,
) -> DiveFiles:
    """Render a scenario with a rig and write `dive.mp4`, `truth.csv` and, if asked, lit points.

    The same scenario, rig and seed give the same pictures, taken as the rig's shutter does. The
    truth is that of each picture's middle, at the frame's time; so are lit points. Of an interlaced
    camera each field is a frame, the first at its picture's time, and has a truth of its own. If it
    is interrupted, the frames written so far and their truth can be read.

    Parameters
    ----------
    rig : Rig
        Camera with its shutter, dome, water and lasers.
    out_dir : Path
        Made if it is missing; files of an earlier dive in it are overwritten.
    progress : callable, optional
        Called after every frame with the number of frames done and of all frames.
    point_frames : collection of int
        Frames whose lit points go to `points_FFFF.npz`: `xyz` in `dome` in mm, `px`, `laser`,
        `label` (index into `labels`) and `labels`.
    camera : SimulatedCamera
        Sensor and processing; see `aqualvs.simulation.cameras`.
    recording : Compression, optional
        Compression of the video; by default the camera's.

    Raises
    ------
    OutputError
        If the folder or a file cannot be written.
    RigError, OptionError
        If rig, scenario or options make no sense, a picture takes longer than a frame, or the video
        cannot hold pictures of the rig's size.
    """
    recording = recording or camera.recording
    check_dive(rig, scenario.fps, recording)
    video, truth = out_dir / "dive.mp4", out_dir / "truth.csv"
    renderer = Renderer(rig, threads=os.cpu_count() or 1, camera=camera)
    with writable(out_dir):
        out_dir.mkdir(parents=True, exist_ok=True)
    with writable(truth):
        file = truth.open("w", newline="", encoding="utf-8")
    with (
        file,
        VideoWriter(
            video, rig.size_px, scenario.fps, recording, first_field=rig.shutter.field_of(0)
        ) as writer,
    ):
        table = csv.writer(file)
        is_interlaced = rig.shutter.is_interlaced
        table.writerow((*TRUTH_COLUMNS, "field") if is_interlaced else TRUTH_COLUMNS)
        for i, t in enumerate(scenario.times()):
            rng = np.random.default_rng([scenario.seed, i])
            # The middle between two fields is after the first.
            middle = t + 0.5 * rig.shutter.readout if is_interlaced else t
            picture = renderer.take(scenario.scene_at, middle, rng)
            writer.write(picture.image)
            for frame, at in frames_of_picture(i, t, rig.shutter):
                scene = scenario.scene_at(at)
                lit = renderer.lit_points(scene, at) if is_interlaced else picture.lit
                row = truth_row(frame, at, scene, rig, lit)
                table.writerow([*row, rig.shutter.field_of(frame)] if is_interlaced else row)
                if frame in point_frames:
                    _write_points(out_dir / f"points_{frame:04d}.npz", lit)
            if progress is not None:
                progress(i + 1, scenario.n_frames)
    return DiveFiles(video, truth, scenario.n_frames)


def frames_of_picture(picture: int, t: float, shutter: Shutter) -> list[tuple[int, float]]:
    """Return number and time of the frames that a picture makes."""
    if not shutter.is_interlaced:
        return [(picture, t)]
    return [(2 * picture, t), (2 * picture + 1, t + shutter.readout)]


def shutter_from_words(words: str, fps: float, place: str = "--shutter") -> Shutter:
    """Return the shutter that words name, of the option `--shutter` or of a scenario.

    `words`: `global`, `rolling:READOUT_MS` or `interlaced`, each with `:EXPOSURE_MS` at its end
    where that is not 0. `fps`: pictures a second; the fields of an interlaced one are half a
    picture apart. Raises `OptionError`, which names `place`, if they name no shutter.
    """
    kind, *numbers = words.split(":")
    try:
        milliseconds = [float(number) for number in numbers]
        readout = 0.0
        if kind == ShutterKind.ROLLING:
            readout = 1e-3 * milliseconds.pop(0)
        elif kind == ShutterKind.INTERLACED:
            readout = 0.5 / fps
        exposure = 1e-3 * milliseconds.pop(0) if milliseconds else 0.0
        if milliseconds:
            raise ValueError
        return Shutter(kind=ShutterKind(kind), readout=readout, exposure=exposure)
    except (ValueError, IndexError):
        raise OptionError(
            f"{place}: {words!r} is none; write rolling:READOUT_MS:EXPOSURE_MS, "
            "interlaced:EXPOSURE_MS or global:EXPOSURE_MS, such as rolling:20:8"
        ) from None
    except RigError as fault:
        raise OptionError(f"{place}: {words}: {fault}") from None


def check_shutter(shutter: Shutter, fps: float) -> None:
    """Raise `OptionError` if a shutter takes longer for a picture than pictures are apart."""
    # Two fields make a frame, and the second is as far from the next frame's first.
    needed = abs(shutter.readout) * (2.0 if shutter.is_interlaced else 1.0)
    needed = max(needed, shutter.exposure)
    # NTSC's fields are stated to a few digits.
    if needed > (1.0 + 1e-3) / fps:
        raise OptionError(
            f"the {shutter.kind.value} shutter takes {1e3 * needed:g} ms for a picture, but at "
            f"{fps:g} frames a second there are {1e3 / fps:g} ms; lower "
            "fps, or give a faster shutter"
        )


def check_dive(rig: Rig, fps: float, recording: Compression, rig_file: Path | None = None) -> None:
    """Raise `OptionError` if a rig's shutter or the size of its pictures does not suit a video.

    `rig_file`: that of the rig, which the message names.
    """
    check_shutter(rig.shutter, fps)
    place = f"{rig_file or f'rig {rig.name}'}: image"
    check_size(rig.size_px, recording, rig.shutter.field_of(0), place)


def check_motion(scenario: Scenario, shutter: Shutter, place: str) -> None:
    """Raise `OptionError`, which names `place`, if the motion comes to a posture that cannot be.

    Asked are the times of the pictures that `shutter` takes and, of a net, of the vehicle's log.
    """
    middle = 0.5 * shutter.readout if shutter.is_interlaced else 0.0
    reach = 0.5 * (abs(shutter.readout) + shutter.exposure)
    # A set: most shutters take all at once.
    offsets = {0.0, middle - reach, middle, middle + reach}
    log = (_log_times(scenario) - LEAD_S).tolist() if scenario.nets else []
    try:
        for t in (*(t + offset for t in scenario.times() for offset in offsets), *log):
            scenario.trajectory.pose_at(t, scenario.duration)
    except OptionError as fault:
        raise OptionError(f"{place}: {fault}") from None


def _write_points(path: Path, lit: LitPoints) -> None:
    with writable(path):
        np.savez_compressed(
            path,
            xyz=1e3 * lit.points_in_dome,
            px=lit.pixels,
            laser=lit.laser,
            label=lit.label,
            labels=np.array([label.name.lower() for label in SurfaceKind]),
        )
