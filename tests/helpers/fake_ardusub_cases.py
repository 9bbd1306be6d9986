"""The fake ArduSub as tests use it, and a dive before its wall."""

import contextlib
import json
import math
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.control.autopilot import NetPilot
from aqualvs.control.gains_file import load_gains
from aqualvs.control.missions import HoldMission
from aqualvs.control.safety import SafetyGate, SafetyLimits
from aqualvs.control.time_filter import FilteredPosture, PostureFilter
from aqualvs.control.vehicle import Effort, Setpoint, SetpointHolder
from aqualvs.live.mavlink.ardusub import ArduSubLink, ArduSubOptions
from aqualvs.live.mavlink.link import MavlinkLink
from aqualvs.live.pilot import Pilot
from aqualvs.recording.sample import Instants, LiveSample
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.sources.base import Health
from fake_ardusub import PARAMETERS
from live_cases import demo_rig
from waiting import TIMEOUT_S, until

FRAME_S = 0.04
HELD = Setpoint(0.6)
MARGIN_S = 0.05
WITHIN_S = 0.2
AT_START = {
    "armed": True,
    "mode": 2,
    "joystick": None,
    "forwards": True,
    "station": True,
    "beats": True,
    "away": False,
    "halves": False,
    "channels_told": True,
    "parameters": PARAMETERS,
    "station_id": 255,
    "obeys": 255,
    "lapsed": True,
    "sticks": [0.0, 0.0, 0.0, 0.0],
    "speeds": [0.0, 0.0, 0.0, 0.0],
    "at": [0.9, 0.0],
}
STEERED = ("MANUAL_CONTROL", "SET_POSITION_TARGET_LOCAL_NED")


class Fake:
    """The other process, and all that it tells."""

    def __init__(self, *options: str) -> None:
        script = Path(__file__).with_name("fake_ardusub.py")
        self.process = subprocess.Popen(
            [sys.executable, str(script), *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.wire: list[dict[str, Any]] = []
        self.truths: list[dict[str, Any]] = []
        self.events: list[dict[str, Any]] = []
        self.port = 0
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        until(lambda: self.port and self.truths, "a fake vehicle")

    @property
    def url(self) -> str:
        return f"udpout:127.0.0.1:{self.port}"

    @property
    def truth(self) -> dict[str, float]:
        """Where it is now: range, yaw, aside, depth."""
        found: dict[str, float] = self.truths[-1]["truth"]
        return found

    def play(self, **event: object) -> float:
        """Play an event; return when it came into force."""
        assert self.process.stdin is not None
        n = len(self.events)
        self.process.stdin.write(json.dumps(event) + "\n")
        self.process.stdin.flush()
        until(lambda: any(e["event"] == "played" for e in self.events[n:]), f"{event}")
        at = float(next(e["at"] for e in self.events[n:] if e["event"] == "played"))
        until(lambda: self.truths and self.truths[-1]["at"] > at, "a place after it")
        return at

    def steered(self, since: float = 0.0, before: float = math.inf) -> list[dict[str, Any]]:
        """What it was told to do, in a stretch of time."""
        return [m for m in list(self.wire) if m["kind"] in STEERED and since <= m["at"] < before]

    def lateness(self, since: float) -> float:
        """By how much the busy machine held it up at worst."""
        at = [t["at"] for t in list(self.truths) if t["at"] >= since - 0.1]
        return max(np.diff(at), default=0.0)

    def stop(self) -> None:
        self.process.kill()
        self.process.wait(TIMEOUT_S)
        self._reader.join(TIMEOUT_S)
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            told = json.loads(line)
            if "kind" in told:
                self.wire.append(told)
            elif "truth" in told:
                self.truths.append(told)
            elif "event" in told:
                self.events.append(told)
            else:
                self.port = told["port"]


def is_neutral(message: dict[str, Any]) -> bool:
    """Whether a message on the wire asks for nothing."""
    fields = message["fields"]
    if message["kind"] == "MANUAL_CONTROL":
        return (fields["x"], fields["y"], fields["z"], fields["r"]) == (0, 0, 500, 0)
    return not any(fields[name] for name in ("vx", "vy", "vz", "yaw_rate"))


def posture(distance: float, yaw: float = 0.0) -> Posture:
    """A posture as the scanner gives it."""
    return Posture(
        range=distance,
        pitch=0.0,
        yaw=yaw,
        covariance=np.diag((1e-6, 1e-5, 1e-5)),
        normal_in_dome=np.array((math.sin(yaw), math.cos(yaw), 0.0)),
        slant_range=distance / math.cos(yaw),
        nearest=distance,
        n_points=900,
        rms=0.001,
    )


def sample(
    i: int,
    seen: Posture | Refusal,
    filtered: FilteredPosture | None = None,
    arrived_s: float | None = None,
) -> LiveSample:
    """A sample of a live run; it arrives now unless told otherwise."""
    rig = demo_rig()
    arrived_ns = time.monotonic_ns() if arrived_s is None else round(1e9 * arrived_s)
    return LiveSample(
        rig=rig,
        scan=Scan(i, FRAME_S * i, seen, ScanPoints.none(), rig.n_water),
        peaks={},
        frame=None,
        utc_ns=0,
        instants=Instants(arrived_ns, arrived_ns, arrived_ns),
        filtered=filtered,
        health=Health(),
    )


class PlainController:
    """Proportional, so that these tests rest on the rules and not on tuning."""

    gains = load_gains("bluerov2")

    def update(
        self, _time_s: float, distance: float, yaw: float, *rest: Any, down: float = 0.0
    ) -> Effort:
        setpoint = next(part for part in rest if isinstance(part, Setpoint))
        return Effort(
            forward=min(max(1.2 * (distance - setpoint.range), -0.4), 0.4),
            yaw=2.0 * (yaw - setpoint.yaw),
            down=down,
        )

    def reset(self) -> None:
        """Keep nothing."""

    def pause(self) -> None:
        """Keep nothing."""

    def applied(self, effort: Effort) -> None:
        """Keep nothing."""


def steering(limits: SafetyLimits | None = None) -> NetPilot:
    """Mission, controller and gate as in a dive."""
    controller: Any = PlainController()
    return NetPilot(HoldMission(None), controller, SafetyGate(limits))


@dataclass
class Frames:
    """What the camera sees; tests change it as a dive goes on."""

    seen: Callable[[], Posture | Refusal]
    flows: bool = True
    """Whether frames come; without them the loop tells of silence, as a live run does."""
    hangs: bool = False
    """Whether the loop itself stands still."""


class Dive:
    """A live loop at 25 frames a second that steers the fake vehicle by what it sees."""

    def __init__(
        self,
        fake: Fake,
        options: ArduSubOptions | None = None,
        limits: SafetyLimits | None = None,
        setpoint: Setpoint | None = HELD,
        link: MavlinkLink | None = None,
    ) -> None:
        self.fake = fake
        self.began = time.monotonic()
        self.link = link or MavlinkLink(fake.url)
        self.vehicle = ArduSubLink(self.link, options)
        self.holder = SetpointHolder((0.3, 2.0))
        self.holder.put(setpoint)
        self.pilot = Pilot(steering(limits), self.vehicle, self.holder)
        rng = np.random.default_rng(5)
        self.frames = Frames(
            lambda: posture(
                fake.truth["range"] + 0.001 * rng.standard_normal(),
                fake.truth["yaw"] + 0.003 * rng.standard_normal(),
            )
        )
        self._filter = PostureFilter()
        self.last_seen_s = 0.0
        self._late: list[tuple[float, float]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def engage(self) -> float:
        """Engage as soon as the vehicle can be; return when."""
        until(lambda: self.vehicle.state().mode == "ours", "a vehicle to steer")
        until(lambda: not self.vehicle.state().pilot_moves, "sticks at their centre")
        self.pilot.engage()
        at = time.monotonic()
        until(lambda: self.fake.steered(at), "a first effort")
        return at

    def lateness(self, since: float) -> float:
        """By how much the busy machine held loop and fake up, at worst, since then."""
        own = max((late for at, late in self._late if at >= since - 0.2), default=0.0)
        return own + self.fake.lateness(since)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(TIMEOUT_S)
        self.pilot.close()
        self.link.close()

    def _run(self) -> None:
        i, due, heard_s, told_s = 0, time.monotonic(), time.monotonic(), 0.0
        while not self._stop.wait(max(0.0, due - time.monotonic())):
            now = time.monotonic()
            self._late.append((now, now - due))
            due = max(due + FRAME_S, now)
            if self.frames.hangs:
                continue
            if self.frames.flows:
                seen, heard_s = self.frames.seen(), now
            elif now - heard_s > 0.15 and now - told_s > 0.1:
                seen, told_s = Refusal(Reason.NO_FRAMES), now
            else:
                continue
            self.last_seen_s = now if seen else self.last_seen_s
            i += 1
            filtered = self._filter.update(FRAME_S * i, seen)
            self.pilot.send(sample(i, seen, filtered, arrived_s=now))


def quiet_since(messages: Sequence[dict[str, Any]], at: float) -> float:
    """How long after a moment the last effort that is not neutral came on the wire; 0 if none."""
    late = [m["at"] - at for m in messages if m["at"] > at and not is_neutral(m)]
    return max(late, default=0.0)


def pushing(fake: Fake) -> bool:
    """Whether the vehicle was just told to move."""
    told = fake.steered(time.monotonic() - 0.3)
    return bool(told) and not is_neutral(told[-1])


def pushed(one: Dive) -> None:
    """Engage and wait until the vehicle is told to move."""
    one.engage()
    until(lambda: pushing(one.fake), "an effort")


def within(one: Dive, at: float, limit_s: float = WITHIN_S) -> float:
    """A time limit with what the busy machine adds."""
    return limit_s + MARGIN_S + one.lateness(at)


def assert_stopped(one: Dive, at: float, limit_s: float = WITHIN_S) -> None:
    """Assert that efforts stop in time, and that the vehicle is told so."""
    time.sleep(max(0.0, at + limit_s + 0.15 - time.monotonic()))
    assert_quiet(one, at, limit_s)


def assert_released(one: Dive, at: float, limit_s: float = WITHIN_S) -> None:
    """Assert that efforts stop in time, and that nothing at all is sent after a few neutrals."""
    until(lambda: not one.pilot.engaged, "a stop")
    # Three neutrals go out frame by frame.
    time.sleep(4 * FRAME_S + one.lateness(at))
    assert_quiet(one, at, limit_s)
    until(lambda: not one.fake.steered(time.monotonic() - 0.2), "silence", 1.0 + one.lateness(at))
    silent = time.monotonic()
    time.sleep(0.2)
    assert not one.fake.steered(silent)


def assert_quiet(one: Dive, at: float, limit_s: float) -> None:
    told = one.fake.steered(at)
    assert quiet_since(told, at) <= within(one, at, limit_s)
    assert told
    assert is_neutral(told[-1])
