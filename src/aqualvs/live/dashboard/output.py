"""The pilot's page as an output of a live run, and its record button.

The camera's picture is reduced for the page (`page_picture`), so that it is small and cheap to
make.
"""

import contextlib
import math
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from aqualvs.control.vehicle import VehicleState
from aqualvs.live.dashboard.access import Controls, RecordButton
from aqualvs.live.dashboard.server import DashboardServer, page_state
from aqualvs.recording import RecorderSwitch
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.sources.base import PartHealth, State


def page_picture(frame: Frame) -> bytes:
    """Return the frame as a JPEG of at most 960 px width."""
    max_width, quality = 960, 70
    height, width = frame.luma.shape
    # Rows of a field are two rows apart.
    height = height if frame.field is None else 2 * height
    scale = min(1.0, max_width / width)
    # Even numbers: the colour planes have half the size.
    size = (2 * round(scale * width / 2), 2 * round(scale * height / 2))
    luma = _resized(frame.luma, size)
    if frame.chroma is None:
        image = luma
    else:
        half = (size[0] // 2, size[1] // 2)
        planes = [luma.ravel(), *(_resized(plane, half).ravel() for plane in frame.chroma)]
        stacked = np.concatenate(planes).reshape(size[1] * 3 // 2, size[0])
        image = np.asarray(cv2.cvtColor(stacked, cv2.COLOR_YUV2BGR_I420), np.uint8)
    done, code = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise RuntimeError("the picture could not be encoded")
    return bytes(code)


def _resized(plane: ImagePlane, size: tuple[int, int]) -> ImagePlane:
    if (plane.shape[1], plane.shape[0]) == size:
        return np.ascontiguousarray(plane)
    return np.asarray(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), np.uint8)


class Dashboard:
    """Output to the open pages; costs next to nothing while there is none.

    Parameters
    ----------
    server : DashboardServer
        Owned from here on.
    vehicle : callable or None
        Returns what the autopilot tells of depth and heading.
    """

    name = "dashboard"
    inline = False
    keeps_all = False

    def __init__(
        self,
        server: DashboardServer,
        controls: Controls,
        vehicle: Callable[[], VehicleState | None] = lambda: None,
    ) -> None:
        self._server, self._controls, self._vehicle = server, controls, vehicle
        self._state_s = self._picture_s = 0.0

    def send(self, sample: LiveSample) -> None:
        """Send a sample, and at intervals its picture behind the number of its frame."""
        # More than a pilot perceives; the remaining time of the machine is for the measurement.
        state_every_s, picture_every_s = 0.04, 0.08
        now_s = time.monotonic()
        if not self._server.hub.n_viewers or now_s - self._state_s < 0.5 * state_every_s:
            return
        self._state_s = now_s
        picture = None
        if sample.frame is not None and now_s - self._picture_s > picture_every_s:
            self._picture_s = now_s
            picture = sample.frame.index.to_bytes(4, "big") + page_picture(sample.frame)
        recording = self._controls.recorder.to_dict()
        setpoint = self._controls.setpoint.setpoint
        self._server.publish(page_state(sample, setpoint, recording, self._vehicle()), picture)

    def health(self) -> PartHealth:
        """Return how many pages are open."""
        n = self._server.hub.n_viewers
        return PartHealth(self.name, State.OK, f"{n} page{'' if n == 1 else 's'} open")

    def close(self) -> None:
        """End the server."""
        self._server.close()


class SwitchButton(RecordButton):
    """The page's record button on a recorder's switch."""

    def __init__(self, switch: RecorderSwitch) -> None:
        self._switch = switch
        self._path: Path | None = None
        self._asked_s = -math.inf
        self._found: dict[str, Any] = {}

    def start(self) -> None:
        """Begin a recording."""
        self._switch.start()

    def stop(self) -> None:
        """End it."""
        self._switch.stop()

    def to_dict(self) -> Mapping[str, Any]:
        """Return whether a recording is on, its file or its fault, its time and the disk's room."""
        disk_every_s = 1.0  # Between looks at the size of the recording and at the disk.
        now_s, path = time.monotonic(), self._switch.path
        if path is self._path and now_s - self._asked_s < disk_every_s:
            return self._found
        self._path, self._asked_s = path, now_s
        health = self._switch.health()
        words = health.detail if health.state is State.FAULT else path.name if path else ""
        self._found = {"on": path is not None, "words": words}
        if path is not None:
            # A disk that has been taken away is the recorder's fault to tell.
            with contextlib.suppress(OSError):
                free, seconds = shutil.disk_usage(path.parent).free, self._switch.seconds
                rate = path.stat().st_size / seconds if seconds > disk_every_s else 0.0
                left_s = free / rate if rate else None
                self._found |= {"seconds": seconds, "free_bytes": free, "left_s": left_s}
        return self._found
