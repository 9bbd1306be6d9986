"""Samples: the result of one frame of a live run, as passed to its outputs."""

from dataclasses import dataclass

from aqualvs.control.time_filter import FilteredPosture
from aqualvs.optics.rig import Rig
from aqualvs.scanning.laser_bands import SearchAxis
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.sources.base import Health


@dataclass(frozen=True, slots=True)
class Instants:
    """Times at which a frame passed the stages of a live run, by `time.monotonic_ns`."""

    arrived_ns: int  # Arrival: decoded, or received from the source.
    taken_ns: int  # Taken from the mailbox.
    scanned_ns: int  # Measured.


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveSample:
    """Result of one frame for the outputs: pilot, autopilot, recording and others."""

    rig: Rig  # Rig of the measurement, in water of the index known then.
    # Raw posture or refusal, and the points. For a silent stream there is no frame: the scan then
    # has the refusal `no_frames` and the number and time of the last frame.
    scan: Scan
    # Detected stripes by search axis; empty without a frame.
    peaks: dict[SearchAxis, StripePeaks]
    # The picture.
    frame: Frame | None
    # System time of arrival, nanoseconds since 1970; may jump, as system clocks do.
    utc_ns: int

    instants: Instants
    filtered: FilteredPosture | None  # Of the time filter; None while it is off or has no state.
    health: Health  # At the time of this frame.

    @property
    def posture_ns(self) -> int:
        """Time of the posture by `time.monotonic_ns`: that of the middle of the picture.

        The picture is assumed to arrive when its last row ends: delays of camera and network are
        not known here.
        """
        return self.instants.arrived_ns - round(1e9 * self.rig.shutter.middle_to_end)
