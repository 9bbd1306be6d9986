"""Options of a live run: outputs, the vehicle file, and the pilot's page.

The vehicle file states the vehicle's MAVLink identity, how it is steered, and which ground station
must be present. `vehicle_setup` combines it with the command line. `Page` is the pilot's page of
`aqualvs live` and `follow`, if its packages are installed.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from aqualvs.control.vehicle import SetpointHolder, VehicleState
from aqualvs.errors import OptionError
from aqualvs.live.mavlink.ardusub import ArduSubOptions
from aqualvs.live.mavlink.ardusub_commands import Command
from aqualvs.live.mavlink.link import LinkOptions
from aqualvs.live.mavlink.peers import load_key
from aqualvs.live.mavlink.ports import parse_address
from aqualvs.live.outputs.base import HearsVehicle, Output
from aqualvs.optics.rig import Rig
from aqualvs.recording import RecorderSwitch
from aqualvs.schema import Positive, StrictPart, load_settings
from aqualvs.terminal import Echo

if TYPE_CHECKING:
    from aqualvs.live.dashboard.access import Access
    from aqualvs.scanner import ScannerOptions

VERSION = 1
"""Version of the format that is read."""
_KEY = "aqualvs_vehicle"

SystemId = Annotated[int, Field(ge=1, le=255)]


class VehicleFile(StrictPart):
    """A whole vehicle file."""

    aqualvs_vehicle: int
    system: SystemId = 1
    component: SystemId = 191
    ground_station: SystemId = 255
    station_timeout_s: Positive | None = 3.0
    command: Literal["sticks", "guided"] = "sticks"
    modes: list[str] | None = None
    stick_dead_band: Positive = 0.1
    speed_m_s: Positive = 0.3
    turning_rate_deg_s: Positive = 30.0
    peers: list[str] = Field(default_factory=list)
    key: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleSetup:
    """Contents of a vehicle file."""

    link: LinkOptions = field(default_factory=LinkOptions)  # Of the connection.
    steering: ArduSubOptions = field(default_factory=ArduSubOptions)


def load_vehicle(path: Path) -> VehicleSetup:
    """Return the contents of a vehicle file; its key file is looked for beside it.

    Raises `OptionError` with one line: file, place, value, remedy.
    """
    content = load_settings(path, VehicleFile, _KEY, VERSION)
    try:
        if content.modes == []:
            raise OptionError("modes is []; name a mode, or leave it out")
        key = None if content.key is None else load_key(path.parent / content.key)
        link = LinkOptions(
            system=content.system, component=content.component, peers=tuple(content.peers), key=key
        )
        steering = ArduSubOptions(
            command=Command(content.command),
            modes=tuple(content.modes or ()),
            ground_station=content.ground_station,
            station_timeout_s=content.station_timeout_s,
            stick_dead_band=content.stick_dead_band,
            speed=content.speed_m_s,
            turning_rate=math.radians(content.turning_rate_deg_s),
        )
    except OptionError as fault:
        raise OptionError(f"{path}: {fault}") from None
    return VehicleSetup(link=link, steering=steering)


def vehicle_setup(file: Path | None, peers: Sequence[str] | None, key: Path | None) -> VehicleSetup:
    """Return who the vehicle is and how it is steered.

    `peers`, `key`: `--mavlink-peer` and `--mavlink-key`, instead of those of the file. Raises
    `OptionError` if a file cannot be used, or a peer is no address.
    """
    setup = VehicleSetup() if file is None else load_vehicle(file)
    link = setup.link
    if peers:
        link = replace(link, peers=tuple(peers))
    if key is not None:
        link = replace(link, key=load_key(key))
    return replace(setup, link=link)


FOXGLOVE_PORT, DASHBOARD_PORT = 8765, 8100


def output_makers(
    *,
    mavlink: Sequence[str],
    link: LinkOptions,
    json: Sequence[str],
    ros2: bool,
    ros1: bool,
    foxglove: str | None,
    rerun: str | None,
    scanner: "ScannerOptions",
) -> Iterator[Callable[[], Output]]:
    """Yield what makes the outputs that were asked for; only these are imported.

    `mavlink`, `json`: addresses; one connection, and one receiver, for each. `link`: of every
    MAVLink connection. `foxglove`: address HOST:PORT to listen on. `rerun`: as `RerunOutput` takes
    it.

    Raises `OptionError` if an address cannot be understood; and from what makes an output, if the
    extra that it needs is not installed.
    """
    for url in mavlink:
        from aqualvs.live.outputs.mavlink import MavlinkOutput

        yield partial(MavlinkOutput, parse_address(url), link)
    if json:
        from aqualvs.live.outputs.udp_json import UdpJsonOutput, receiver_address

        yield partial(UdpJsonOutput, [receiver_address(text) for text in json])
    if ros2:
        from aqualvs.live.outputs.dds import DdsOutput

        yield DdsOutput
    if ros1:
        from aqualvs.live.outputs.ros1 import Ros1Output

        yield Ros1Output
    if foxglove is not None:
        from aqualvs.live.outputs.foxglove import FoxgloveOutput

        where = host_and_port(foxglove, FOXGLOVE_PORT, "--foxglove-address")
        yield partial(FoxgloveOutput, *where, scanner=scanner)
    if rerun is not None:
        from aqualvs.live.outputs.rerun import RerunOutput

        yield partial(RerunOutput, rerun)


def host_and_port(text: str, default_port: int, option: str) -> tuple[str, int]:
    """Return host and port of `HOST:PORT`, `HOST`, `:PORT` or "" (127.0.0.1).

    Raises `OptionError` if there is no such port.
    """
    host, _, port = text.rpartition(":") if ":" in text else (text, "", "")
    if port and not (port.isdecimal() and 0 <= int(port) < 2**16):
        raise OptionError(f"{option} {text}: port {port}; give HOST:PORT with a port up to 65535")
    return host.strip("[]") or "127.0.0.1", int(port) if port else default_port


def vehicle_reader(outputs: Sequence[Output]) -> Callable[[], VehicleState | None]:
    """Return what reads depth and heading from the first output that an autopilot answers."""
    return next(
        (one.vehicle_state for one in outputs if isinstance(one, HearsVehicle)), lambda: None
    )


@dataclass(frozen=True, slots=True)
class Page:
    """The pilot's page, not yet served."""

    host: str
    port: int
    access: "Access"  # Who may use it.

    @classmethod
    def of(cls, address: str, token: str | None, embedders: Sequence[str] = ()) -> "Page":
        """Return the page that the command line asks for.

        `address`: HOST:PORT. `token`: its password; a new one if None. `embedders`: origins, such
        as `http://blueos.local`, whose pages may show this one.

        Raises `OptionError` if a part is not installed, the token is too short, an embedder is no
        origin, or the address makes no sense.
        """
        try:
            # The server needs all of the extra.
            import aqualvs.live.dashboard.server  # noqa: F401
            from aqualvs.live.dashboard.access import make_access
        except ImportError as lack:
            raise OptionError(
                f"--dashboard: {lack.name} is missing; pip install 'aqualvs[dashboard]'"
            ) from lack
        host, port = host_and_port(address, DASHBOARD_PORT, "--dashboard-address")
        return cls(host, port, make_access(host, token, embedders))

    def serve(
        self,
        rig: Rig,
        holder: SetpointHolder,
        recorder: RecorderSwitch | None,
        echo: Echo,
        vehicle: Callable[[], VehicleState | None],
    ) -> Output:
        """Serve the page and print its address.

        `holder`: where the page puts what is to be held. `recorder`: what its record button moves;
        without one the button refuses. `vehicle`: returns what the autopilot tells of depth and
        heading.

        Raises `OptionError` if the address cannot be used.
        """
        from aqualvs.live.dashboard.access import Controls, RecordButton
        from aqualvs.live.dashboard.server import Dashboard, DashboardServer

        controls = Controls(holder, RecordButton(recorder))
        server = DashboardServer(self.host, self.port, self.access, rig, controls)
        # No browser opens the address that stands for all of this machine's.
        is_any = self.host in ("0.0.0.0", "::")
        shown = "127.0.0.1" if is_any else f"[{self.host}]" if ":" in self.host else self.host
        elsewhere = "  (on other machines: this one's address for 127.0.0.1)" if is_any else ""
        echo(f"dashboard: http://{shown}:{server.port}/#token={self.access.token}{elsewhere}")
        return Dashboard(server, controls, vehicle)
