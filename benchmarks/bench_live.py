"""Delay of a live run, from the decoded frame to the autopilot's packet, stage by stage.

Run `python -m benchmarks live`. A dive is played in real time at 25 frames a second, decoded on
the same cores, with the time filter on, one MAVLink peer and one open page of the dashboard, each
in a process of its own. A packet's delay is from the decoded frame to its arrival at the peer, by
the system's monotonic clock. The reference is what a live system should need at most.
"""

import json
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.control.time_filter import PostureFilter
from aqualvs.control.vehicle import SetpointHolder
from aqualvs.live.command import SWITCH_S
from aqualvs.live.dashboard.access import Access, Controls, RecordButton
from aqualvs.live.dashboard.server import Dashboard, DashboardServer
from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.mavlink import MavlinkOutput
from aqualvs.live.runner import LiveRunner, ScannerProvider, warm_up
from aqualvs.optics.rig import Rig
from aqualvs.recording.sample import LiveSample
from aqualvs.scanner import Scanner
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig, load_scenario
from aqualvs.simulation.video import VideoWriter
from aqualvs.sources.base import PartHealth, State
from aqualvs.sources.opening import open_feed

_RENDERED, _PLAYED, _FPS = 6, 250, 25.0
# Median and 99th percentile that are asked for, in ms.
_BARS = {"720x576": (5.0, 15.0), "1920x1080": (10.0, 30.0)}

_PEER = """
import json, socket, sys, time
from pymavlink.dialects.v20 import common
wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
wire.bind(("127.0.0.1", 0))
wire.settimeout(20.0)
print(wire.getsockname()[1], flush=True)
parser = common.MAVLink(None)
arrived = []
try:
    while True:
        data = wire.recv(2048)
        now = time.monotonic_ns()
        for message in parser.parse_buffer(data) or []:
            if message.get_type() == "DISTANCE_SENSOR":
                arrived.append(now)
        wire.settimeout(3.0)
except TimeoutError:
    print(json.dumps(arrived), flush=True)
"""

_WATCHER = """
import json, sys
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
with connect(f"ws://127.0.0.1:{sys.argv[1]}/live", max_size=None) as page:
    page.send(json.dumps({"kind": "hello"}))
    print("open", flush=True)
    try:
        while True:
            if isinstance(page.recv(), bytes):
                page.send(json.dumps({"kind": "shown"}))
    except ConnectionClosed:
        pass
"""


@dataclass
class Clock:
    """Notes when each sample's frame was decoded, and its stages."""

    name: str = "clock"
    inline: bool = True
    keeps_all: bool = False
    arrived_ns: list[int] = field(default_factory=list)
    wait_ms: list[float] = field(default_factory=list)
    measure_ms: list[float] = field(default_factory=list)

    def send(self, sample: LiveSample) -> None:
        at = sample.instants
        self.arrived_ns.append(at.arrived_ns)
        self.wait_ms.append(1e-6 * (at.taken_ns - at.arrived_ns))
        self.measure_ms.append(1e-6 * (at.scanned_ns - at.taken_ns))

    def health(self) -> PartHealth:
        return PartHealth(self.name, State.OK)

    def close(self) -> None:
        pass


def make_dive(rig: Rig, path: Path) -> None:
    """Few pictures, shown to and fro for ten seconds."""
    scenario, renderer = load_scenario("net_clutter"), Renderer(rig)
    images = [
        renderer.render(scenario.scene_at(0.04 * i), 0.04 * i, np.random.default_rng(i)).image
        for i in range(_RENDERED)
    ]
    order = [*range(_RENDERED), *range(_RENDERED - 2, 0, -1)]
    with VideoWriter(path, rig.size_px, _FPS) as video:
        for i in range(_PLAYED):
            video.write(images[order[i % len(order)]])


@contextmanager
def script(text: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-c", text, *arguments], stdout=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def line_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def measure(rig: Rig, dive: Path) -> tuple[Clock, list[float]]:
    """Play the dive; returns the clock and the packets' delays in ms."""
    scanner = Scanner(rig)
    warm_up(scanner)
    controls = Controls(SetpointHolder(rig.working_range), RecordButton(None))
    server = DashboardServer("127.0.0.1", 0, Access("127.0.0.1", "unused"), rig, controls)
    clock = Clock()
    with script(_PEER) as peer, script(_WATCHER, str(server.port)) as viewer:
        outputs: list[Output] = [
            MavlinkOutput(f"udpout:127.0.0.1:{line_of(peer)}"),
            clock,
            Dashboard(server, controls, lambda: None),
        ]
        line_of(viewer)
        feed = open_feed(dive, realtime=True)
        LiveRunner(feed, ScannerProvider(scanner), outputs, posture_filter=PostureFilter()).run(
            lambda: False
        )
        arrived = json.loads(line_of(peer))
    if len(arrived) != len(clock.arrived_ns):
        raise RuntimeError(f"{len(clock.arrived_ns)} samples but {len(arrived)} packets")
    return clock, [1e-6 * (b - a) for a, b in zip(clock.arrived_ns, arrived, strict=True)]


def rows(rig: Rig) -> list[dict[str, Any]]:
    size = "x".join(map(str, rig.size_px))
    with tempfile.TemporaryDirectory() as folder:
        dive = Path(folder) / "dive.mp4"
        make_dive(rig, dive)
        clock, total = measure(rig, dive)
    stages = {"wait": clock.wait_ms, "measure": clock.measure_ms, "frame to packet": total}
    found = []
    for name, values in stages.items():
        bars = _BARS[size] if name == "frame to packet" else (None, None)
        figures = (statistics.median(values), float(np.quantile(values, 0.99)))
        for word, value, bar in zip(("median", "99 %"), figures, bars, strict=True):
            found.append(
                {
                    "name": f"{size}, {name}, {word}",
                    "value": value,
                    "unit": "ms",
                    "reference": bar,
                    "ratio": None if bar is None else bar / value,
                }
            )
    return found


def run() -> list[dict[str, Any]]:
    sys.setswitchinterval(SWITCH_S)
    return [row for rig in (example_rig(), bluerov2_rig()) for row in rows(rig)]
