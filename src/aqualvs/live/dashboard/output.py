"""The pilot's page as an output of a live run.

The camera's picture is reduced for the page (`page_picture`), so that it is small and cheap to
make.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np

from aqualvs.control.vehicle import VehicleState
from aqualvs.live.dashboard.access import Controls
from aqualvs.live.dashboard.server import DashboardServer, page_state
from aqualvs.live.outputs.base import Output
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


class Dashboard(Output):
    """Output to the open pages; costs next to nothing while there is none.

    `server`: owned from here on. `vehicle`: returns what the autopilot tells of depth and heading.
    """

    name = "dashboard"

    def __init__(
        self,
        server: DashboardServer,
        controls: Controls,
        vehicle: Callable[[], VehicleState | None],
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
