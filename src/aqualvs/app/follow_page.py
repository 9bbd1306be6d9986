"""The pilot's page of `aqualvs follow`: its setpoint is what a mission holds."""

from collections.abc import Callable

from aqualvs.app.live_outputs import DASHBOARD_PORT, host_and_port
from aqualvs.control.setpoint import SetpointHolder
from aqualvs.errors import OptionError
from aqualvs.live.outputs.base import Output
from aqualvs.optics.rig import Rig


def serve_page(
    address: str,
    token: str | None,
    rig: Rig,
    holder: SetpointHolder,
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
    tell : callable
        Takes one line.

    Raises
    ------
    OptionError
        If a part is not installed, the token is too short, or the address cannot be used.
    """
    try:
        from aqualvs.app.dashboard.access import make_access, token_fault
        from aqualvs.app.dashboard.commands import Controls, NoRecorder
        from aqualvs.app.dashboard.output import Dashboard
        from aqualvs.app.dashboard.server import DashboardServer
    except ImportError as fault:
        raise OptionError(
            f"--dashboard: {fault.name} is missing; pip install 'aqualvs[dashboard]'"
        ) from fault
    host, port = host_and_port(address, DASHBOARD_PORT, "--dashboard-address")
    wrong = token_fault(token)
    if wrong:
        raise OptionError(wrong)
    access, controls = make_access(host, token), Controls(holder, NoRecorder())
    server = DashboardServer(host, port, access, rig, controls)
    shown = f"[{host}]" if ":" in host else host
    tell(f"dashboard: http://{shown}:{server.port}/#token={access.token}")
    return Dashboard(server, controls)
