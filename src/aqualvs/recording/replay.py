"""A recorded dive, frame by frame, with the stripes that the scanner detected."""

import functools
import itertools
from collections.abc import Iterator
from dataclasses import replace
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
from aqualvs.recording.messages import RecordedFrame, image_of, rig_texts_of, stripes_of
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.scan import Frame
from aqualvs.sources.mcap_file import McapFile, StoredMessage


class DiveRecording:
    """Recording of a dive.

    Raises `SourceError` if it cannot be read, or contains no stripes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = McapFile(path)
        if STRIPES.name not in self._file.topics:
            raise SourceError(f"{path}: holds no stripes; give a recording of aqualvs, or a video")
        # Rig and options at the beginning of the dive; None if lost or of a later version.
        self.rig: Rig | None = None
        self.options: ScannerOptions | None = None
        self._no_rig = "its rig is in none of its undamaged parts; add --rig"
        # The rig is recorded every minute, so that it survives the loss of the first part.
        stored = next(self._file.messages([RIG.name]), None)
        if stored is not None:
            self._read_rig(stored.data)
        elif next(self._file.messages([STRIPES.name]), None) is None:
            raise SourceError(f"{path}: holds no stripes; give a recording of aqualvs, or a video")
        self.n_frames = self._file.count(STRIPES.name)  # None if unknown, in a torn file.
        self.has_pictures = next(self._file.messages([PICTURE.name]), None) is not None

    @functools.cached_property
    def fps(self) -> float | None:
        """Frames per second over the first frames, which are read on first access; None if unknown.

        Raises `SourceError` if a message cannot be decoded.
        """
        n_frames = 51
        frames = list(itertools.islice(self.frames(with_pictures=False), n_frames))
        if not frames or frames[-1].time_s <= frames[0].time_s:
            return None
        return (frames[-1].index - frames[0].index) / (frames[-1].time_s - frames[0].time_s)

    def need_rig(self) -> Rig:
        """Return the rig.

        Raises `SourceError` if it is lost or cannot be decoded.
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
        """Number of torn chunks, of about half a second each, left out so far."""
        return self._file.n_torn

    def frames(self, *, with_pictures: bool) -> Iterator[RecordedFrame]:
        """Yield the frames in the order of their recording.

        `with_pictures`: whether to decode pictures, if there are any. Raises `SourceError` if a
        message cannot be decoded.
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
        try:
            frame = stripes_of(parts[STRIPES.name].data)
            return replace(frame, picture=_picture(frame.index, frame.time_s, parts))
        except (ValueError, AqualvsError) as fault:
            raise SourceError(
                f"{self.path}: a message cannot be understood ({fault}); "
                "was it written by a later version?"
            ) from fault


def is_recording(path: Path) -> bool:
    """Return whether a file is a recording of stripes."""
    if path.suffix.lower() != ".mcap" or not path.is_file():
        return False
    try:
        return STRIPES.name in McapFile(path).topics
    except SourceError:
        return False


def _picture(index: int, time_s: float, parts: dict[str, StoredMessage]) -> Frame | None:
    """Return the picture of the same frame as the stripes; None if there is none."""
    picture, chroma = parts.get(PICTURE.name), parts.get(CHROMA.name)
    stamp_ns = parts[STRIPES.name].log_ns
    if picture is None or picture.log_ns != stamp_ns:
        return None
    own_chroma = None
    if chroma is not None and chroma.log_ns == stamp_ns:
        own_chroma = image_of(chroma.data)[1]
    return frame_of(index, time_s, *image_of(picture.data), own_chroma)
