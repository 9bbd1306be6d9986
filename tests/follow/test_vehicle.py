"""`aqualvs follow SOURCE`: the parts together, with a recorded dive and no vehicle that answers."""

import csv
import io
import socket
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from aqualvs.control.autopilot import Decision
from aqualvs.control.missions import Guidance, Stage
from aqualvs.control.safety import LimitReason
from aqualvs.control.vehicle import Effort, Setpoint, VehicleState
from aqualvs.demo import bundled_dive
from aqualvs.errors import OptionError, OutputError
from aqualvs.follow.command import FOLLOW_CSV, Aim
from aqualvs.follow.vehicle import FollowLogOutput, FollowRequest, run_follow
from aqualvs.live.command import LiveRequest
from aqualvs.live.pilot import PilotReport
from aqualvs.results.files import Claim
from aqualvs.sources import open_feed
from aqualvs.sources.base import State
from live_cases import demo_samples

pytest.importorskip("pymavlink")


class Reports:
    """Stands for a pilot: a new report for every sample."""

    def __init__(self) -> None:
        self.latest: PilotReport | None = None

    def step(self, frame: int, forward: float) -> None:
        self.latest = PilotReport(
            at_ns=40_000_000 * frame,
            frame=frame,
            decision=Decision(
                Effort(forward=forward),
                LimitReason.TOO_FAST if frame == 2 else None,
                Guidance(setpoint=Setpoint(0.6), stage=Stage.HOLDING),
                engaged=True,
            ),
            state=VehicleState(armed=True, depth=4.0),
        )


def test_log_has_a_row_for_every_step(tmp_path: Path) -> None:
    pilot = Reports()
    path = tmp_path / "new" / FOLLOW_CSV
    log = FollowLogOutput(path, pilot)
    samples = demo_samples(4)
    log.send(samples[0])
    for frame, sample in enumerate(samples):
        pilot.step(frame, 0.1 * frame)
        log.send(sample)
    log.send(samples[-1])
    assert log.health().state is State.OK
    log.close()
    log.close()
    with path.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["forward"] for row in rows] == ["0.0000", "0.1000", "0.2000", "0.3000"]
    assert [row["reason"] for row in rows] == ["", "", "too_fast", ""]
    for row, sample in zip(rows, samples, strict=True):
        assert (row["posture"] == "valid") is bool(sample.scan.posture)


def demo_request(out: Path, **more: Any) -> FollowRequest:
    """Return a request to follow the net of the bundled dive, with BlueROV2's gains."""
    demo = Path(str(bundled_dive()))
    usual: dict[str, Any] = {"gains": "bluerov2", "aim": Aim(range=0.5)}
    live = LiveRequest(feed=partial(open_feed, demo / "dive.mp4"), rig=demo / "rig.yaml")
    return FollowRequest(live=live, out=out, **(usual | more))


def test_a_dive_without_a_vehicle_is_logged_and_never_steered(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
        nobody.bind(("127.0.0.1", 0))
        port = nobody.getsockname()[1]
        told: list[str] = []
        request = demo_request(tmp_path, mavlink=f"udpout:127.0.0.1:{port}")
        # Two lines: both times there is no vehicle that could be steered.
        keys = io.StringIO("\n\n")
        assert run_follow(request, lambda line: told.append(line), keys) == 0
    assert sum("not engaged" in line and "silent" in line for line in told) == 2
    with (tmp_path / FOLLOW_CSV).open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    # Six seconds at 25 Hz, less what a slow machine drops.
    assert len(rows) >= 10
    assert {row["engaged"] for row in rows} == {"0"}
    assert {row["forward"] for row in rows} == {"0.0000"}
    assert "valid" in {row["posture"] for row in rows}


@pytest.mark.parametrize(
    ("earlier", "overwrite", "words"),
    [
        ("somebody's own", False, "did not write it"),
        ("somebody's own", True, "did not write it"),
        ("a dive's", False, "add --overwrite"),
    ],
)
def test_the_log_of_an_earlier_dive_stays(
    earlier: str, overwrite: bool, words: str, tmp_path: Path
) -> None:
    log = tmp_path / FOLLOW_CSV
    if earlier == "a dive's":
        with Claim("follow", [log], overwrite=False):
            log.write_text(earlier, encoding="utf-8")
    else:
        log.write_text(earlier, encoding="utf-8")
    request = demo_request(tmp_path, mavlink="udpout:127.0.0.1:9", overwrite=overwrite)
    with pytest.raises(OutputError, match=words):
        run_follow(request, lambda _: None, io.StringIO())
    assert log.read_text(encoding="utf-8") == earlier


def test_gains_that_are_not_there_are_told(tmp_path: Path) -> None:
    request = demo_request(tmp_path, mavlink="udpout:127.0.0.1:14550", gains="submarine", aim=Aim())
    with pytest.raises(OptionError, match="submarine"):
        run_follow(request, print, io.StringIO())
