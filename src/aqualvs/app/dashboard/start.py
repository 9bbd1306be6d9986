"""From an address to the pilot's page, ready to be opened."""

from collections.abc import Callable, Mapping
from typing import Any

from aqualvs.app.dashboard.access import make_access, token_fault
from aqualvs.app.dashboard.commands import Controls, NoRecorder
from aqualvs.app.dashboard.output import Dashboard
from aqualvs.app.dashboard.server import DashboardServer
from aqualvs.control.setpoint import SetpointHolder
from aqualvs.errors import OptionError
from aqualvs.live.health import State
from aqualvs.live.recorder import RecorderSwitch
from aqualvs.optics.rig import Rig


class SwitchButton:
    """The page's record button on a recorder's switch.

    Parameters
    ----------
    switch : RecorderSwitch
    """

    def __init__(self, switch: RecorderSwitch) -> None:
        self._switch = switch

    def start(self) -> None:
        """Begin a recording."""
        self._switch.start()

    def stop(self) -> None:
        """End it."""
        self._switch.stop()

    def facts(self) -> Mapping[str, Any]:
        """Return whether a recording is on, and its file or what is wrong."""
        path, health = self._switch.path, self._switch.health()
        words = health.detail if health.state is State.FAULT else path.name if path else ""
        return {"on": path is not None, "words": words}


def start_dashboard(
    host: str,
    port: int,
    token: str | None,
    rig: Rig,
    holder: SetpointHolder,
    recorder: RecorderSwitch | None,
    tell: Callable[[str], object],
) -> Dashboard:
    """Serve the page and tell its address; without a recorder, its button refuses.

    Raises
    ------
    OptionError
        If the token is too short, or the address cannot be listened to.
    """
    fault = token_fault(token)
    if fault:
        raise OptionError(fault)
    access = make_access(host, token)
    controls = Controls(holder, NoRecorder() if recorder is None else SwitchButton(recorder))
    server = DashboardServer(host, port, access, rig, controls)
    shown = f"[{host}]" if ":" in host else host
    tell(f"dashboard: http://{shown}:{server.port}/#token={access.token}")
    return Dashboard(server, controls)
