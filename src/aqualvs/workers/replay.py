"""A recording as the source of a run: its stripes are measured again, bit for bit.

Modules that read recordings are imported where they are used, because every run imports this module
and few replay a recording.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from aqualvs.closing import Closing
from aqualvs.errors import OptionError, SourceError
from aqualvs.optics.rig import Rig
from aqualvs.results.run_request import RunRequest, Water, in_water, prepared_rig
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.laser_bands import SearchAxis
from aqualvs.scanning.scan import Frame, ImagePlane, Scan, ScanPoints
from aqualvs.scanning.stripe import Returns

if TYPE_CHECKING:
    from aqualvs.recording import DiveRecording, RecordedFrame


@dataclass(frozen=True, slots=True)
class ReplayedFrame(Frame):
    """A frame from a recording; black where the recording has no picture.

    Attributes
    ----------
    recorded : RecordedFrame or None
        Never None; only a base class with defaults asks for one.
    """

    recorded: "RecordedFrame | None" = None


class Replay(Closing):
    """A recording that is measured again; both `FrameSource` and scanner of a run.

    Parameters
    ----------
    path : Path
    request : RunRequest
        Rig, water and the `chosen` options stand for the recorded ones; an overlay needs pictures
        even if stripes are not looked for again.

    Attributes
    ----------
    rig : Rig
        To measure with.
    options : ScannerOptions
        To measure with.
    name, size_px, fps, n_frames
        As in `FrameSource`.

    Raises
    ------
    SourceError, RigError, OptionError
        If the recording or the rig cannot be used, or the recording lacks the pictures that the
        request needs.
    """

    def __init__(self, path: Path, request: RunRequest) -> None:
        from aqualvs.recording import DiveRecording

        self._recording = recording = DiveRecording(path)
        self.name = str(path)
        self.options = _options(recording, request)
        self.rig = _rig(recording, request)
        self.size_px, self.fps = (recording.rig or self.rig).size_px, recording.fps
        self.n_frames = recording.n_frames
        self._follows = request.rig is None and request.water == Water()
        self._detects = _detects(recording, request, self.options)
        self._pictures = self._detects or request.overlay
        self._scanner = Scanner(self.rig, self.options)
        width, height = self.size_px
        self._black: ImagePlane = np.zeros((height, width), np.uint8)

    def __iter__(self) -> Iterator[ReplayedFrame]:
        """Yield the recorded frames.

        Raises
        ------
        SourceError
            At the end, if parts of the recording were torn.
        """
        for recorded in self._recording.frames(with_pictures=self._pictures):
            picture = recorded.picture
            luma, chroma = (
                (self._black, None) if picture is None else (picture.luma, picture.chroma)
            )
            yield ReplayedFrame(recorded.index, recorded.time_s, luma, chroma, recorded)
        if self._recording.n_torn:
            raise SourceError(
                f"{self.name}: {self._recording.n_torn} of its parts are damaged, as by a loss of "
                "power, and were left out; the others were measured"
            )

    def process(self, frame: Frame) -> Scan:
        """Return the scan of a frame of this source."""
        return self.measured(frame)[1]

    def measured(self, frame: Frame) -> tuple[Rig, Scan, dict[SearchAxis, Returns]]:
        """Return the scan of a frame of this source, with its rig and stripes."""
        recorded = frame.recorded if isinstance(frame, ReplayedFrame) else None
        if recorded is None:
            raise ValueError("a replay measures its own frames only")
        if recorded.refusal is not None:
            nothing = ScanPoints.none()
            scan = Scan(frame.index, frame.time_s, recorded.refusal, nothing, recorded.n_water)
            return self.rig, scan, {}
        scanner = self._scanner_in(recorded.n_water)
        returns = scanner.detect(frame) if self._detects else recorded.returns
        return scanner.rig, scanner.measure(frame.index, frame.time_s, returns), returns

    def _scanner_in(self, n_water: float) -> Scanner:
        """Return the scanner for the water of a frame, as the dive's run knew it."""
        if self._follows and n_water != self._scanner.rig.n_water:
            self._scanner = Scanner(self.rig.in_water(n_water), self.options)
        return self._scanner


def replay_of(request: RunRequest) -> Replay | None:
    """Return the replay of a request's source, None where it is no recording.

    Raises
    ------
    AqualvsError
        As `Replay`.
    """
    path = Path(request.source)
    if path.suffix.lower() != ".mcap":
        return None
    from aqualvs.recording import is_recording

    return Replay(path, request) if is_recording(path) else None


def _options(recording: "DiveRecording", request: RunRequest) -> ScannerOptions:
    if request.chosen is None or recording.options is None:
        return request.scanner
    own = {name: getattr(request.scanner, name) for name in request.chosen}
    return replace(recording.options, **own)


def _rig(recording: "DiveRecording", request: RunRequest) -> Rig:
    if request.rig is not None:
        return prepared_rig(request.rig, request.water, no_dome=request.no_dome)
    return in_water(recording.need_rig(), request.water, no_dome=request.no_dome)


def _detects(recording: "DiveRecording", request: RunRequest, options: ScannerOptions) -> bool:
    """Return whether stripes must be looked for again, in the recorded pictures."""
    if recording.options is not None and options.detector != recording.options.detector:
        wanted = "--detector: this detector needs the pictures, which"
    elif request.index_target is not None:
        wanted = "--index-target: the target is looked for in the pictures, which"
    else:
        return False
    if not recording.has_pictures:
        raise OptionError(
            f"{wanted} {recording.path} does not hold; leave it out, or run the video"
        )
    return True
