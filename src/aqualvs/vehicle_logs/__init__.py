"""Logs of the vehicle's own motion during a dive: depth, heading, attitude."""

from aqualvs.vehicle_logs.reading import read_vehicle_log
from aqualvs.vehicle_logs.time_offset import (
    OffsetRefusal,
    PostureTrack,
    TimeOffset,
    dive_start_utc,
    find_time_offset,
    offset_from_clocks,
)
from aqualvs.vehicle_logs.vehicle_log import (
    Interpolation,
    LoggedStates,
    Places,
    Signal,
    VehicleLog,
    VehiclePlaces,
)

__all__ = [
    "Interpolation",
    "LoggedStates",
    "OffsetRefusal",
    "Places",
    "PostureTrack",
    "Signal",
    "TimeOffset",
    "VehicleLog",
    "VehiclePlaces",
    "dive_start_utc",
    "find_time_offset",
    "offset_from_clocks",
    "read_vehicle_log",
]
