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
    """Times at which a frame passed the stages, by `time.monotonic_ns`.

    Attributes
    ----------
    arrived_ns : int
        Decoded, or in the hands of the source.
    taken_ns : int
        Taken from the mailbox.
    scanned_ns : int
        Measured.
    """

    arrived_ns: int
    taken_ns: int
    scanned_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveSample:
    """One frame's answer on its way to pilot, autopilot and log.

    Attributes
    ----------
    rig : Rig
        That it was measured with, in the water as it is known.
    scan : Scan
        Raw posture or refusal, and the points. Where the stream is silent there is no frame: the
        scan then has the refusal `no_frames` and the number and time of the last frame.
    peaks : dict
        Stripes by search direction, as detected; empty where there is no frame.
    frame : Frame or None
        The picture.
    utc_ns : int
        System time of arrival, nanoseconds since 1970; may jump, as system clocks do.
    instants : Instants
    filtered : FilteredPosture or None
        From the time filter, where it is switched on and running.
    health : Health
        As of this frame.
    """

    rig: Rig
    scan: Scan
    peaks: dict[SearchAxis, StripePeaks]
    frame: Frame | None
    utc_ns: int
    instants: Instants
    filtered: FilteredPosture | None
    health: Health

    @property
    def posture_ns(self) -> int:
        """Time of the posture by `time.monotonic_ns`: that of the picture's middle.

        As if the picture had come at the end of its last row: delays of camera and network are not
        known here.
        """
        return self.instants.arrived_ns - round(1e9 * self.rig.shutter.middle_to_end)
