"""The pilot's page of `aqualvs live` and `follow`, where its packages are installed."""

from collections.abc import Callable

from aqualvs.app.live_outputs import DASHBOARD_PORT, host_and_port
from aqualvs.control.setpoint import SetpointHolder
from aqualvs.errors import OptionError
from aqualvs.live.outputs.base import Output
from aqualvs.live.recorder import RecorderSwitch
from aqualvs.optics.rig import Rig


def serve_page(
    address: str,
    token: str | None,
    rig: Rig,
    holder: SetpointHolder,
    recorder: RecorderSwitch | None,
    tell: Callable[[str], object],
) -> Output:
    """Serve the page and tell its address.

    Parameters
    ----------
    address : str
        HOST:PORT.
    token : str or None
        Its password; a new one if left out.
    rig : Rig
    holder : SetpointHolder
        Where the page puts what is to be held.
    recorder : RecorderSwitch or None
        What its record button moves; None where nothing can be recorded.
    tell : callable
        Takes one line.

    Raises
    ------
    OptionError
        If a part is not installed, the token is too short, or the address cannot be used.
    """
    try:
        from aqualvs.app.dashboard.start import start_dashboard
    except ImportError as fault:
        raise OptionError(
            f"--dashboard: {fault.name} is missing; pip install 'aqualvs[dashboard]'"
        ) from fault
    host, port = host_and_port(address, DASHBOARD_PORT, "--dashboard-address")
    return start_dashboard(host, port, token, rig, holder, recorder, tell)
