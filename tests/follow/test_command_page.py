"""`aqualvs follow --sim --dashboard`: a simulated loop on the pilot's page."""

import csv
import signal
import subprocess
import sys
import threading
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from aqualvs.control.gains_file import load_gains
from aqualvs.control.missions import HoldMission
from aqualvs.control.vehicle import Setpoint, SetpointHolder
from aqualvs.follow import sensor_model
from aqualvs.follow.case import SimCase, vehicle_model
from aqualvs.follow.command import FOLLOW_CSV, LoopPage
from aqualvs.follow.loop import RangeSensor
from aqualvs.follow.sensor_model import RenderedSensor, SampledSensor
from aqualvs.simulation.cameras import IDEAL, simulated_camera
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import example_rig
from aqualvs.sources.base import State
from browser import open_page
from live_cases import Collector

# A vehicle takes seconds to its setpoint; a busy machine more.
TIMEOUT_S = 120.0
HELD = Setpoint(0.6)


@pytest.fixture(autouse=True)
def one_ray_a_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rendering would be most of the time."""
    monkeypatch.setattr(sensor_model, "Renderer", partial(Renderer, samples=1))


def shown(
    sensor: RangeSensor, case: SimCase, seconds: float
) -> tuple[Collector, LoopPage, SetpointHolder]:
    """Run a loop for a page that keeps what it is sent."""
    rig, collector = example_rig(), Collector()
    holder = SetpointHolder(rig.working_range)
    holder.put(HELD)
    loop = case.loop(sensor, HoldMission(HELD))
    page = LoopPage(collector, rig, loop, holder)
    loop.on_step = page.take

    def every_frame(now_s: float) -> None:
        if now_s > 0.5:
            holder.put(Setpoint(0.7))
        page.keep_pace(now_s)

    loop.run(seconds, every_frame)
    return collector, page, holder


def still_case() -> SimCase:
    return SimCase(model=vehicle_model("bluerov2"), gains=load_gains("bluerov2"))


def test_every_step_is_shown_when_the_clock_has_come_to_it() -> None:
    case = still_case()
    sensor = SampledSensor(case.net, np.random.default_rng(3))
    began = time.monotonic()
    collector, page, _ = shown(sensor, case, 1.5)
    # The last of 38 frames is exposed then.
    assert time.monotonic() - began >= 37 / 25
    samples = collector.samples
    # 38 frames at 25 Hz, the last two still on their way.
    assert len(samples) == 36
    assert [sample.scan.index for sample in samples] == list(range(36))
    assert all(sample.frame is None for sample in samples)
    assert all(sample.filtered is not None for sample in samples[3:])
    pilot, vehicle = samples[-1].health.outputs
    assert pilot.state is State.OK
    assert "0.70 m" in pilot.detail
    assert "0.60 m" in samples[5].health.outputs[0].detail
    assert vehicle.name == "simulated bluerov2"
    assert samples[-1].health.valid_share == 1.0
    # Sent no sooner than simulated: a frame arrives 60 ms after its exposure.
    for sample, at_s in zip(samples, collector.at_s, strict=True):
        assert at_s - began >= sample.scan.time_s
    page.close()
    assert collector.closed


def test_rendered_pictures_come_with_their_own_points() -> None:
    case = still_case()
    sensor = RenderedSensor(case.net, example_rig(), np.random.default_rng(3))
    collector, _, _ = shown(sensor, case, 0.2)
    assert len(collector.samples) >= 3
    for sample in collector.samples:
        assert sample.frame is not None
        assert sample.frame.time_s == sample.scan.time_s
        assert len(sample.scan.points) > 100


def test_rendered_pictures_are_those_of_the_chosen_camera() -> None:
    case = still_case()
    lumas = []
    for camera in (IDEAL, simulated_camera("pal")):
        sensor = RenderedSensor(case.net, example_rig(), np.random.default_rng(3), camera=camera)
        shown(sensor, case, 0.1)
        lumas.append(np.asarray(sensor.shots[0][0].luma))
    assert np.abs(lumas[0].astype(int) - lumas[1]).mean() > 5.0


def test_a_browser_shows_the_loop_and_moves_its_setpoint(tmp_path: Path) -> None:
    code = "import sys; from aqualvs.cli.main import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "follow", "--sim", "--seconds", "300", "--dashboard"]
    command += ["--dashboard-address", "127.0.0.1:0", "-o", str(tmp_path / "out")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        told: list[str] = []
        reader = threading.Thread(target=lambda: told.extend(process.stdout or ()))
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split("dashboard: ")[1].strip()
            reader.start()
            with open_page(tmp_path / "profile") as page:
                page.size(1280, 800)
                page.call("Page.navigate", url=address)
                page.wait_for("document.getElementById('numbers').dataset.valid === '1'")
                near = "Math.abs(document.getElementById('numbers').dataset.range - {}) < 0.04"
                page.wait_for(near.format(0.6), TIMEOUT_S)
                page.wait_for(
                    "document.getElementById('parts').innerHTML.includes('holding: 0.60 m')"
                )
                page.evaluate("document.getElementById('set-range').value = '0.75'")
                page.evaluate("document.getElementById('setpoint').requestSubmit()")
                page.wait_for(near.format(0.75), TIMEOUT_S)
                page.screenshot(tmp_path / "page.png")
                assert page.said == []
            process.send_signal(signal.SIGTERM)
            assert process.wait(TIMEOUT_S) == 0
        finally:
            process.kill()
            reader.join()
    assert any("written:" in line for line in told)
    with (tmp_path / "out" / FOLLOW_CSV).open(encoding="utf-8") as file:
        setpoints = {row["range_setpoint_m"] for row in csv.DictReader(file)}
    assert setpoints == {"0.6000", "0.7500"}
