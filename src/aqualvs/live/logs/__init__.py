"""What the vehicle logged of its own motion, next to a dive: depth, heading, attitude."""

from aqualvs.live.logs.clocks import dive_start_utc, offset_from_clocks
from aqualvs.live.logs.place import Places, VehiclePlaces
from aqualvs.live.logs.reading import read_vehicle_log
from aqualvs.live.logs.signals import Interpolation, Signal
from aqualvs.live.logs.time_offset import (
    OffsetRefusal,
    PostureTrack,
    TimeOffset,
    find_time_offset,
)
from aqualvs.live.logs.vehicle_log import VehicleLog, VehicleState

__all__ = [
    "Interpolation",
    "OffsetRefusal",
    "Places",
    "PostureTrack",
    "Signal",
    "TimeOffset",
    "VehicleLog",
    "VehiclePlaces",
    "VehicleState",
    "dive_start_utc",
    "find_time_offset",
    "offset_from_clocks",
    "read_vehicle_log",
]
