"""The vehicle's log beside a dive: read it, and lay it on the dive's clock."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aqualvs.app.net_seen import DivePostures
from aqualvs.errors import OptionError
from aqualvs.live.logs import (
    OffsetRefusal,
    TimeOffset,
    VehicleLog,
    VehiclePlaces,
    dive_start_utc,
    find_time_offset,
    offset_from_clocks,
    read_vehicle_log,
)

_DIGITS = 3


@dataclass(frozen=True, slots=True)
class LaidLog:
    """A log and how it lies on the dive's clock.

    Attributes
    ----------
    log : VehicleLog
        As it was read.
    offset : TimeOffset or OffsetRefusal
        Log time minus dive time, or why it is not known.
    overlap : bool
        Whether the log covers any of the dive.
    """

    log: VehicleLog
    offset: TimeOffset | OffsetRefusal
    overlap: bool

    @property
    def places(self) -> VehiclePlaces | None:
        """The log's answers for dive times; None where it cannot be used."""
        if isinstance(self.offset, OffsetRefusal) or not self.overlap:
            return None
        return VehiclePlaces(self.log, self.offset.offset_s)

    def words(self) -> str:
        """Return how the log lies, in one line."""
        if isinstance(self.offset, OffsetRefusal):
            return f"log {self.log.name} is not used: {self.offset.reason} (--log-offset-s)"
        begins, ends = self.log.span_s
        offset = f"{self.offset.offset_s:.2f} s"
        if not self.overlap:
            return (
                f"log {self.log.name} is not used: it covers {begins:.1f} to {ends:.1f} s of its "
                f"own clock, and none of the dive with an offset of {offset}; check --log-offset-s"
            )
        sigma = f" ± {self.offset.sigma_s:.2f} s" if self.offset.sigma_s else ""
        how = self.offset.how
        return f"log {self.log.name}: its clock minus the dive's is {offset}{sigma} ({how})"

    def facts(self) -> dict[str, Any]:
        """Return the same for `net.geojson`."""
        found: dict[str, Any] = {"file": self.log.name, "used": self.places is not None}
        if isinstance(self.offset, OffsetRefusal):
            return found | {"refused": self.offset.reason}
        return found | {
            "offset_s": round(self.offset.offset_s, _DIGITS),
            "sigma_offset_s": round(self.offset.sigma_s, _DIGITS),
            "offset_from": self.offset.how,
        }


def open_log(path: Path | None, offset_s: float | None) -> VehicleLog | None:
    """Read the log that the user names, if any.

    Raises
    ------
    SourceError
        If it cannot be read.
    OptionError
        If there is an offset without a log, or the log's format needs an extra.
    """
    if path is not None:
        return read_vehicle_log(path)
    if offset_s is not None:
        raise OptionError(f"--log-offset-s {offset_s:g}: there is no log; add --log FILE")
    return None


def lay_log(
    log: VehicleLog, postures: DivePostures, offset_s: float | None, video: Path | None
) -> LaidLog:
    """Lay a log on a dive's clock.

    Parameters
    ----------
    log : VehicleLog
        Of the same dive.
    postures : DivePostures
        Of the dive.
    offset_s : float or None
        Log time minus dive time, where the user knows it.
    video : Path or None
        Whose clock may help.

    Notes
    -----
    Without an offset from the user the motion common to both decides; the clocks of video and log
    help where it leaves a choice, and stand in where it says nothing.
    """
    offset = _given(offset_s) or _found(log, postures, video)
    overlap = False
    if not isinstance(offset, OffsetRefusal) and len(postures.time_s):
        state = log.at(postures.time_s + offset.offset_s)
        overlap = bool((state.depth_valid | state.heading_valid).any())
    return LaidLog(log, offset, overlap)


def _given(offset_s: float | None) -> TimeOffset | None:
    return None if offset_s is None else TimeOffset(offset_s, 0.0, None, "given by the user")


def _found(
    log: VehicleLog, postures: DivePostures, video: Path | None
) -> TimeOffset | OffsetRefusal:
    clocks = offset_from_clocks(log, None if video is None else dive_start_utc(video))
    start = clocks if isinstance(clocks, TimeOffset) else None
    motion = find_time_offset(log, postures.track(), start=start)
    return motion if isinstance(motion, TimeOffset) or start is None else start
