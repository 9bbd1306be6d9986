"""The offset that clocks give: the log's UTC against the time that a video's container states."""

import datetime
import math
from pathlib import Path

from aqualvs.live.logs.time_offset import OffsetRefusal, TimeOffset
from aqualvs.live.logs.vehicle_log import VehicleLog

VIDEO_UTC_SIGMA_S = 5.0
"""Containers state whole seconds, some write them when recording ends or the file is copied, and
few cameras' clocks are set to better than this."""


def dive_start_utc(video: str | Path) -> float | None:
    """Return the UTC at which a video says that it was created, in seconds since 1970.

    Only the container's `creation_time` counts; times of the file change when it is copied.

    Parameters
    ----------
    video : str or Path
        A video file.

    Returns
    -------
    start_utc_s : float or None
        None where the container does not state it, or states the zero of its calendar.
    """
    import av

    try:
        with av.open(str(video), metadata_errors="ignore") as container:
            stamps = [container.metadata.get("creation_time")]
            stamps += [stream.metadata.get("creation_time") for stream in container.streams.video]
    except (av.error.FFmpegError, OSError):
        return None
    for stamp in stamps:
        seconds = _seconds(stamp) if stamp else None
        # Cameras without a clock write the zero of their calendar: 1904, 1970 or 1980.
        if seconds is not None and seconds > _FIRST_BELIEVED:
            return seconds
    return None


_FIRST_BELIEVED = datetime.datetime(1990, 1, 1, tzinfo=datetime.UTC).timestamp()


def _seconds(stamp: str) -> float | None:
    try:
        moment = datetime.datetime.fromisoformat(stamp)
    except ValueError:
        return None
    if moment.tzinfo is None:
        moment = moment.replace(tzinfo=datetime.UTC)
    return moment.timestamp()


def offset_from_clocks(
    log: VehicleLog, dive_start_utc_s: float | None, sigma_s: float = VIDEO_UTC_SIGMA_S
) -> TimeOffset | OffsetRefusal:
    """Return the offset that the clocks of dive and log give.

    Parameters
    ----------
    log : VehicleLog
        With `start_utc_s`.
    dive_start_utc_s : float or None
        UTC of dive time 0.
    sigma_s : float
        How far to trust it.
    """
    if log.start_utc_s is None or log.start_utc_sigma_s is None:
        return OffsetRefusal(f"{log.name} does not know the time of day")
    if dive_start_utc_s is None:
        return OffsetRefusal("the dive does not know the time of day")
    return TimeOffset(
        dive_start_utc_s - log.start_utc_s,
        math.hypot(sigma_s, log.start_utc_sigma_s),
        None,
        "clocks of dive and log",
    )
