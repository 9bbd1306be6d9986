"""From the words of the command line to the outputs of a live run."""

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial

from aqualvs.errors import OptionError
from aqualvs.live.mavlink_link import LinkOptions
from aqualvs.live.outputs.base import Output

FOXGLOVE_PORT, DASHBOARD_PORT = 8765, 8100


@dataclass(frozen=True, slots=True, kw_only=True)
class OutputRequest:
    """Which outputs a live run has; all are off by default.

    Attributes
    ----------
    mavlink, json : tuple of str
        Addresses; one output for each.
    link : LinkOptions
        Of every MAVLink connection.
    ros2, ros1 : bool
    foxglove : str or None
        Address HOST:PORT to listen on.
    """

    mavlink: tuple[str, ...] = ()
    json: tuple[str, ...] = ()
    link: LinkOptions = field(default_factory=LinkOptions)
    ros2: bool = False
    ros1: bool = False
    foxglove: str | None = None


def make_outputs(request: OutputRequest) -> list[Output]:
    """Make the outputs that were asked for.

    Raises
    ------
    OptionError
        If an address cannot be understood, or the extra that an output needs is not installed; the
        outputs made before it are closed.
    """
    makers: list[Callable[[], Output]] = [
        partial(_mavlink, url, request.link) for url in request.mavlink
    ]
    if request.json:
        makers.append(partial(_json, request.json))
    if request.ros2:
        makers.append(_ros2)
    if request.ros1:
        makers.append(_ros1)
    if request.foxglove is not None:
        makers.append(partial(_foxglove, request.foxglove))
    with ExitStack() as made:
        outputs = []
        for make in makers:
            outputs.append(make())
            made.callback(outputs[-1].close)
        made.pop_all()
    return outputs


def host_and_port(text: str, default_port: int, option: str) -> tuple[str, int]:
    """Return host and port of `HOST:PORT`, `HOST`, `:PORT` or "" (127.0.0.1).

    Raises
    ------
    OptionError
        If there is no such port.
    """
    host, _, port = text.rpartition(":") if ":" in text else (text, "", "")
    if port and not (port.isdecimal() and 0 <= int(port) < 2**16):
        raise OptionError(f"{option} {text}: port {port}; give HOST:PORT with a port up to 65535")
    return host.strip("[]") or "127.0.0.1", int(port) if port else default_port


def _mavlink(url: str, options: LinkOptions) -> Output:
    from aqualvs.live.outputs.mavlink import MavlinkOutput

    return MavlinkOutput(url, options)


def _json(receivers: tuple[str, ...]) -> Output:
    from aqualvs.live.outputs.udp_json import UdpJsonOutput

    return UdpJsonOutput(receivers)


def _ros2() -> Output:
    from aqualvs.live.outputs.dds import DdsOutput

    return DdsOutput()


def _ros1() -> Output:
    from aqualvs.live.outputs.ros1 import Ros1Output

    return Ros1Output()


def _foxglove(address: str) -> Output:
    from aqualvs.live.outputs.foxglove import FoxgloveOutput

    host, port = host_and_port(address, FOXGLOVE_PORT, "--foxglove-address")
    return FoxgloveOutput(host, port)
