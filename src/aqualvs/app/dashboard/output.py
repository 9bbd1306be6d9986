"""The pilot's page as an output of a live run."""

import time

from aqualvs.app.dashboard.commands import Controls
from aqualvs.app.dashboard.picture import page_picture
from aqualvs.app.dashboard.server import DashboardServer
from aqualvs.app.dashboard.state import page_state
from aqualvs.live.health import PartHealth, State
from aqualvs.live.sample import LiveSample

# More than a pilot sees; the rest of the machine's time belongs to the measurement.
_STATE_EVERY_S, _PICTURE_EVERY_S = 0.04, 0.08


class Dashboard:
    """Sends samples to the pages that are open; costs next to nothing while there is none.

    Parameters
    ----------
    server : DashboardServer
        Owned from here on.
    controls : Controls
    """

    name = "dashboard"
    inline = False
    keeps_all = False

    def __init__(self, server: DashboardServer, controls: Controls) -> None:
        self._server, self._controls = server, controls
        self._state_s = self._picture_s = 0.0

    def send(self, sample: LiveSample) -> None:
        """Send a sample, and now and then its picture behind the number of its frame."""
        now_s = time.monotonic()
        if not self._server.hub.n_watchers or now_s - self._state_s < 0.5 * _STATE_EVERY_S:
            return
        self._state_s = now_s
        picture = None
        if sample.frame is not None and now_s - self._picture_s > _PICTURE_EVERY_S:
            self._picture_s = now_s
            picture = sample.frame.index.to_bytes(4, "big") + page_picture(sample.frame)
        recording = self._controls.recorder.facts()
        setpoint = self._controls.setpoint.setpoint
        self._server.publish(page_state(sample, setpoint, recording), picture)

    def health(self) -> PartHealth:
        """Return how many pages are open."""
        n = self._server.hub.n_watchers
        return PartHealth(self.name, State.OK, f"{n} page{'' if n == 1 else 's'} open")

    def close(self) -> None:
        """End the server."""
        self._server.close()
