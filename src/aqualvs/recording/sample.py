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
    """Times at which a frame passed the stages, by `time.monotonic_ns`."""

    arrived_ns: int  # Decoded, or in the hands of the source.
    taken_ns: int  # Taken from the mailbox.
    scanned_ns: int  # Measured.


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveSample:
    """One frame's answer on its way to pilot, autopilot and log."""

    rig: Rig  # That it was measured with, in the water as it is known.
    # Raw posture or refusal, and the points. Where the stream is silent there is no frame: the scan
    # then has the refusal `no_frames` and the number and time of the last frame.
    scan: Scan
    # Stripes by search direction, as detected; empty where there is no frame.
    peaks: dict[SearchAxis, StripePeaks]
    # The picture.
    frame: Frame | None
    # System time of arrival, nanoseconds since 1970; may jump, as system clocks do.
    utc_ns: int

    instants: Instants
    filtered: FilteredPosture | None  # From the time filter, where it is switched on and running.
    health: Health  # As of this frame.

    @property
    def posture_ns(self) -> int:
        """Time of the posture by `time.monotonic_ns`: that of the picture's middle.

        As if the picture had come at the end of its last row: delays of camera and network are not
        known here.
        """
        return self.instants.arrived_ns - round(1e9 * self.rig.shutter.middle_to_end)
