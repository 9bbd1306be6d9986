"""The vehicle file: who the vehicle is on MAVLink, how it is steered, and who must be there."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from aqualvs.control.settings_text import Part, Positive, load_settings
from aqualvs.errors import OptionError
from aqualvs.live.ardusub_link import ArduSubOptions
from aqualvs.live.ardusub_link_commands import Command
from aqualvs.live.mavlink_link import LinkOptions
from aqualvs.live.mavlink_signing import load_key

VERSION = 1
"""Version of the format that is read."""
_KEY = "aqualvs_vehicle"

SystemId = Annotated[int, Field(ge=1, le=255)]


class VehicleFile(Part):
    """A whole vehicle file."""

    aqualvs_vehicle: int
    system: SystemId = 1
    component: SystemId = 191
    ground_station: SystemId = 255
    station_timeout_s: Positive | None = 3.0
    command: Literal["sticks", "guided"] = "sticks"
    modes: list[str] = Field(default_factory=list)
    stick_dead_band: Positive = 0.1
    speed_m_s: Positive = 0.3
    turning_rate_deg_s: Positive = 30.0
    peers: list[str] = Field(default_factory=list)
    key: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleSetup:
    """What a vehicle file says.

    Attributes
    ----------
    link : LinkOptions
        Of the connection.
    steering : ArduSubOptions
    """

    link: LinkOptions = field(default_factory=LinkOptions)
    steering: ArduSubOptions = field(default_factory=ArduSubOptions)


def load_vehicle(path: Path) -> VehicleSetup:
    """Return what a vehicle file says; its key file is looked for beside it.

    Raises
    ------
    OptionError
        One line: file, place, value, remedy.
    """
    content = load_settings(path, VehicleFile, _KEY, VERSION)
    try:
        key = None if content.key is None else load_key(path.parent / content.key)
        link = LinkOptions(
            system=content.system,
            component=content.component,
            peers=tuple(content.peers),
            key=key,
        )
        steering = ArduSubOptions(
            command=Command(content.command),
            modes=tuple(content.modes),
            ground_station=content.ground_station,
            station_timeout_s=content.station_timeout_s,
            stick_dead_band=content.stick_dead_band,
            speed=content.speed_m_s,
            turning_rate=math.radians(content.turning_rate_deg_s),
        )
    except OptionError as fault:
        raise OptionError(f"{path}: {fault}") from None
    return VehicleSetup(link=link, steering=steering)
