"""A recorded dive, frame by frame, with the stripes that the scanner detected."""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from aqualvs.errors import AqualvsError, SourceError
from aqualvs.optics.rig import Rig
from aqualvs.recording.encoding import (
    CHROMA,
    PICTURE,
    RIG,
    STRIPES,
    frame_of,
    options_from_text,
    rig_from_record,
)
from aqualvs.recording.messages import image_of, rig_texts_of, stripes_of
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.laser_bands import SearchAxis
from aqualvs.scanning.posture import Refusal
from aqualvs.scanning.scan import Frame, GyroRates
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.sources.mcap_file import McapFile, StoredMessage


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """Frame as a recording holds it."""

    # As in the `Frame`.
    index: int
    time_s: float
    # Index that it was measured with.
    n_water: float
    # Stripes as detected.
    peaks: dict[SearchAxis, StripePeaks]
    # Why it was not measured at all.
    refusal: Refusal | None
    # By the vehicle's gyros.
    turning: GyroRates | None
    # None where there is none, or it was not asked for.
    picture: Frame | None


class DiveRecording:
    """A recording of a dive.

    Raises `SourceError` if it cannot be read, or holds no stripes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = McapFile(path)
        if STRIPES.name not in self._file.topics:
            raise SourceError(f"{path}: holds no stripes; give a recording of aqualvs, or a video")
        # That the dive was measured with at its beginning; None where it is lost or not understood.
        self.rig: Rig | None = None
        self.options: ScannerOptions | None = None  # As the dive was measured; likewise.
        self._no_rig = "its rig is in none of its undamaged parts; add --rig"
        # The rig is recorded every minute, so it survives the loss of the first part.
        stored = next(self._file.messages([RIG.name]), None)
        if stored is not None:
            self._read_rig(stored.data)
        elif next(self._file.messages([STRIPES.name]), None) is None:
            raise SourceError(f"{path}: holds no stripes; give a recording of aqualvs, or a video")
        self.n_frames = self._file.count(STRIPES.name)  # None where a torn file does not say.
        self.has_pictures = next(self._file.messages([PICTURE.name]), None) is not None

    @functools.cached_property
    def fps(self) -> float | None:
        """Frames per second over the first few of them, which are read when it is asked for.

        Raises `SourceError` if a message cannot be understood.
        """
        first = last = None
        for n, frame in enumerate(self.frames(with_pictures=False)):
            first, last = first or frame, frame
            if n == 50:
                break
        if first is None or last is None or last.time_s <= first.time_s:
            return None
        return (last.index - first.index) / (last.time_s - first.time_s)

    def need_rig(self) -> Rig:
        """Return the rig.

        Raises `SourceError` if it is lost or not understood.
        """
        if self.rig is None:
            raise SourceError(f"{self.path}: {self._no_rig}")
        return self.rig

    def _read_rig(self, message: bytes) -> None:
        try:
            text, exact, options = rig_texts_of(message)
            rig = rig_from_record(text, exact, str(self.path))
            self.options = options_from_text(options)
            self.rig = rig
        except (AqualvsError, ValueError, KeyError, TypeError) as fault:
            self._no_rig = (
                f"its rig cannot be understood ({fault}); was it written by a later version? "
                "Add --rig"
            )

    @property
    def n_torn(self) -> int:
        """Chunks of about half a second that were torn and left out so far."""
        return self._file.n_torn

    def frames(self, *, with_pictures: bool) -> Iterator[RecordedFrame]:
        """Yield the frames in the order of their recording.

        `with_pictures`: whether to decode pictures, where there are any. Raises `SourceError` if a
        message cannot be understood.
        """
        wanted = [STRIPES.name]
        if with_pictures:
            wanted += [PICTURE.name, CHROMA.name]
        parts: dict[str, StoredMessage] = {}
        for message in self._file.messages(wanted):
            parts[message.topic] = message
            if message.topic == STRIPES.name:
                yield self._frame(parts)
                parts = {}

    def _frame(self, parts: dict[str, StoredMessage]) -> RecordedFrame:
        stripes = parts[STRIPES.name]
        try:
            index, time_s, n_water, peaks, refusal, turning = stripes_of(stripes.data)
            picture = _picture(index, time_s, parts)
        except (ValueError, AqualvsError) as fault:
            raise SourceError(
                f"{self.path}: a message cannot be understood ({fault}); "
                "was it written by a later version?"
            ) from fault
        return RecordedFrame(index, time_s, n_water, peaks, refusal, turning, picture)


def is_recording(path: Path) -> bool:
    """Return whether a file is a recording of stripes."""
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    try:
        return STRIPES.name in McapFile(path).topics
    except SourceError:
        return False


def _picture(index: int, time_s: float, parts: dict[str, StoredMessage]) -> Frame | None:
    """Return the picture that came with the stripes."""
    picture, chroma = parts.get(PICTURE.name), parts.get(CHROMA.name)
    stamp_ns = parts[STRIPES.name].log_ns
    if picture is None or picture.log_ns != stamp_ns:
        return None
    kind, data = image_of(picture.data)
    own_chroma = None
    if chroma is not None and chroma.log_ns == stamp_ns:
        own_chroma = image_of(chroma.data)[1]
    return frame_of(index, time_s, kind, data, own_chroma)
