"""Dives of any length for benchmarks, made of a few pictures without coding them again."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np

from aqualvs.demo import bundled_dive
from aqualvs.optics.rigfile import save_rig
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import bluerov2_rig, load_scenario
from aqualvs.simulation.video import VideoWriter

_RENDERED, _FPS = 4, 25.0


@dataclass(frozen=True, slots=True)
class Dive:
    """A file, its rig's, and how many frames it has."""

    name: str
    path: Path
    rig: Path
    n_frames: int

    def times(self, n: int) -> "Dive":
        """Return the dive so many times over, written beside it."""
        path = self.path.with_name(f"{self.path.stem}_{n}.mp4")
        repeat(self.path, path, n)
        return replace(self, path=path, n_frames=n * self.n_frames)


def small_dive(folder: Path) -> Dive:
    """Copy the bundled dive, 150 frames of 720x576 pixels."""
    path, rig = (Path(str(bundled_dive() / name)) for name in ("dive.mp4", "rig.yaml"))
    return Dive("720x576", Path(shutil.copy(path, folder)), rig, 150)


def wide_dive(folder: Path, n_frames: int) -> Dive:
    """Write frames of 1920x1080 pixels: a few pictures of a net, noisy, shown to and fro."""
    rig, scenario = bluerov2_rig(), load_scenario("net_diamond")
    renderer, n = Renderer(rig, threads=2), min(_RENDERED, n_frames // 8)
    images = [
        renderer.render(scenario.scene_at(0.04 * i), 0.04 * i, np.random.default_rng(i)).image
        for i in range(n)
    ]
    order = [*range(n), *range(n - 2, 0, -1)]
    path, rig_file = folder / "wide.mp4", folder / "wide.yaml"
    with VideoWriter(path, rig.size_px, _FPS) as video:
        for i in range(n_frames):
            video.write(images[order[i % len(order)]])
    save_rig(rig, rig_file)
    return Dive("1920x1080", path, rig_file, n_frames)


def repeat(source: Path, path: Path, n_times: int) -> None:
    """Copy the packets of a video so many times, one after the other.

    The video must begin with a key frame and have frames of equal duration.
    """
    with av.open(str(path), "w") as new:
        stream, shift = None, 0
        for _ in range(n_times):
            with av.open(str(source)) as old:
                video = old.streams.video[0]
                stream = stream or new.add_stream_from_template(video)
                length = 0
                for packet in old.demux(video):
                    if packet.dts is None or packet.pts is None:
                        continue
                    packet.pts, packet.dts = packet.pts + shift, packet.dts + shift
                    length += packet.duration or 0
                    packet.stream = stream
                    new.mux(packet)
            shift += length
