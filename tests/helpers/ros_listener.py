"""Subscribers of ROS as processes of their own, heard by lines of JSON."""

import base64
import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from aqualvs.live.outputs.base import Output
from aqualvs.live.outputs.ros_messages import POINT_TYPE
from aqualvs.recording.sample import Instants, LiveSample
from waiting import TIMEOUT_S


def until(true: Callable[[], object], seconds: float = TIMEOUT_S) -> bool:
    """Wait for something to become true."""
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


def n_threads() -> int:
    """Threads of this process, those of libraries too."""
    return len(os.listdir("/proc/self/task"))


class Listener:
    """A subscriber process; ended by `close`, at the latest by itself.

    Parameters
    ----------
    command : sequence of str
    environment : mapping
    """

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self.heard: list[dict[str, Any]] = []
        self._process = subprocess.Popen(
            command, env=dict(environment), stdout=subprocess.PIPE, text=True
        )
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        if not until(lambda: any("ready" in line for line in self.heard)):
            self.close()
            raise AssertionError("the subscriber did not start")

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            # A process that is ended in the middle of a line leaves half of it.
            if line.endswith("\n"):
                self.heard.append(json.loads(line))

    def messages(self, topic: str) -> list[dict[str, Any]]:
        """What came on a topic so far, its name without leading parts such as `rt`."""
        return [h["message"] for h in self.heard if h.get("topic", "").endswith(topic)]

    def has_heard(self, *topics: str) -> bool:
        """Whether something came on every one of these topics.

        A publisher and a subscriber find each other topic by topic, in any order: what came on one
        says nothing of the others.
        """
        return all(self.messages(topic) for topic in topics)

    def latest_ns(self, topic: str) -> int:
        """Stamp of the latest message on a topic; 0 where none has come."""
        messages = self.messages(topic)
        return stamp_ns(messages[-1]) if messages else 0

    def delays_ms(self, topic: str) -> list[float]:
        """From the stamps to the moment of hearing."""
        return [
            1e-6 * (h["at_ns"] - stamp_ns(h["message"]))
            for h in self.heard
            if h.get("topic", "").endswith(topic)
        ]

    def pause(self) -> None:
        self._process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        self._process.kill()
        self._process.wait(TIMEOUT_S)
        self._thread.join(TIMEOUT_S)
        if self._process.stdout is not None:
            self._process.stdout.close()


def stamp_ns(message: Mapping[str, Any]) -> int:
    """Time in a message's header."""
    stamp = message["header"]["stamp"]
    seconds, rest = stamp.values()
    return int(seconds * 10**9 + rest)


def points_of(cloud: Mapping[str, Any]) -> np.ndarray:
    """Rows of a cloud, read as its own fields say."""
    formats = {1: "i1", 2: "u1", 7: "<f4"}
    layout = {
        "names": [field["name"] for field in cloud["fields"]],
        "formats": [formats[field["datatype"]] for field in cloud["fields"]],
        "offsets": [field["offset"] for field in cloud["fields"]],
        "itemsize": cloud["point_step"],
    }
    return np.frombuffer(base64.b64decode(cloud["data"]), np.dtype(layout))


def expected_points(sample: LiveSample) -> np.ndarray:
    """Rows that the cloud of a sample must have, straight from the scan."""
    points = sample.scan.points
    rows = np.zeros(len(points), POINT_TYPE)
    right, forward, up = points.points_in_dome.T
    rows["x"], rows["y"], rows["z"] = forward, -right, up
    for name in ("intensity", "sigma", "laser", "label", "used"):
        rows[name] = getattr(points, name)
    return rows


def send_now(output: Output, sample: LiveSample) -> float:
    """Send a sample as of now; returns how long that took, in seconds.

    Its instants are of now, too: by them diagnostics are repeated, of which a subscriber by best
    effort may lose the first.
    """
    now = time.monotonic_ns()
    of_now = replace(sample, utc_ns=time.time_ns(), instants=Instants(now, now, now))
    began = time.perf_counter()
    output.send(of_now)
    return time.perf_counter() - began


def typical_send(output: Output, sample: LiveSample, n: int) -> float:
    """Send n times; returns the median of how long it took, in seconds.

    A busy machine holds some calls up, but not half of them; an output that waits for others does
    so in all of them.
    """
    return float(np.median([send_now(output, sample) for _ in range(n)]))


def send_until(
    output: Output, sample: LiveSample, true: Callable[[], object], seconds: float = TIMEOUT_S
) -> bool:
    """Send at 50 Hz until something becomes true."""
    end = time.monotonic() + seconds
    while not true():
        if time.monotonic() > end:
            return False
        send_now(output, sample)
        time.sleep(0.02)
    return True
