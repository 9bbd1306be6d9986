"""From samples to the messages of a recording."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from aqualvs.errors import OptionError
from aqualvs.live.recorder import messages, pictures, schemas
from aqualvs.live.recorder.pictures import PictureFormat
from aqualvs.live.recorder.rig_record import rig_exact
from aqualvs.live.recorder.schemas import Topic
from aqualvs.live.sample import LiveSample
from aqualvs.optics.rig import Rig
from aqualvs.scanning.pipeline import ScannerOptions
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Frame

_HEALTH_EVERY_NS = 1_000_000_000
# The rig is told again after a second, then at intervals that double up to a minute, and at the
# end: a part that is damaged, the first one too, takes no rig with it.
_RIG_AGAIN_NS, _RIG_EVERY_NS = 1_000_000_000, 60_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderOptions:
    """What is recorded, and how safely.

    Attributes
    ----------
    pictures : PictureFormat or None
        Every frame's picture, or none of them.
    jpeg_quality : int
        1 to 100.
    points_hz : float or None
        Point clouds per second, for the eye: stripes, from which every point can be had again bit
        for bit, are always kept. 0 for none, None for those of every frame.
    scanner : ScannerOptions
        That the run measures with; a replay uses them.
    chunk_s : float
        Time after which what was gathered is written: what the death of the process costs.
    sync_s : float or None
        Time after which it is also on the disk: what a loss of power costs. None leaves it to the
        system.
    max_waiting_bytes : int
        Memory for what the disk has not taken yet.
    """

    pictures: PictureFormat | None = None
    jpeg_quality: int = 90
    points_hz: float | None = 5.0
    scanner: ScannerOptions = field(default_factory=ScannerOptions)
    chunk_s: float = 0.5
    sync_s: float | None = 5.0
    max_waiting_bytes: int = 64 << 20

    def __post_init__(self) -> None:
        """Refuse values that cannot work."""
        if not 1 <= self.jpeg_quality <= 100:
            raise OptionError(f"jpeg quality {self.jpeg_quality}: use 1 to 100")
        if self.points_hz is not None and not self.points_hz >= 0.0:
            raise OptionError(f"points_hz {self.points_hz:g}: use 0 or more")


class SampleEncoder:
    """Makes the messages of each sample.

    Parameters
    ----------
    options : RecorderOptions
    """

    def __init__(self, options: RecorderOptions) -> None:
        self._options = options
        self._rig: Rig | None = None
        self._exact = ""
        self._rig_texts: tuple[str, str, str] | None = None
        self._rig_wait_ns = self._rig_from_ns = 0
        self._health_from_ns = self._points_from_ns = 0

    def messages(self, sample: LiveSample, stamp_ns: int) -> Iterator[tuple[Topic, bytes]]:
        """Yield topic and content; pictures come before the stripes that belong to them."""
        yield from self.rig_messages(sample.rig, stamp_ns)
        if sample.frame is not None:
            yield from self._pictures(sample.frame, stamp_ns)
        if not _is_silence(sample):
            yield schemas.STRIPES, messages.stripes_message(sample, stamp_ns)
        yield schemas.POSTURE, messages.posture_message(sample, stamp_ns)
        if self._points_due(sample, stamp_ns):
            yield schemas.POINTS, messages.points_message(sample.scan.points, stamp_ns)
        if stamp_ns >= self._health_from_ns:
            self._health_from_ns = stamp_ns + _HEALTH_EVERY_NS
            yield schemas.HEALTH, messages.health_message(sample.health, stamp_ns)

    def rig_messages(self, rig: Rig, stamp_ns: int) -> Iterator[tuple[Topic, bytes]]:
        """Yield the rig if it is not the one before, or due again; its water is in every frame."""
        if self._is_new(rig):
            self._rig, self._exact = rig, rig_exact(rig)
            self._rig_texts = messages.rig_texts(rig, self._options.scanner)
            self._rig_wait_ns = _RIG_AGAIN_NS
        elif stamp_ns >= self._rig_from_ns:
            self._rig_wait_ns = min(2 * self._rig_wait_ns, _RIG_EVERY_NS)
        else:
            return
        self._rig_from_ns = stamp_ns + self._rig_wait_ns
        yield from self.rig_again(stamp_ns)

    def rig_again(self, stamp_ns: int) -> Iterator[tuple[Topic, bytes]]:
        """Yield the rig that was told last, to the same bit."""
        if self._rig_texts is not None:
            yield schemas.RIG, messages.rig_message(self._rig_texts, stamp_ns)

    def _is_new(self, rig: Rig) -> bool:
        if rig is self._rig:
            return False
        return self._exact != rig_exact(
            rig if self._rig is None else rig.in_water(self._rig.n_water)
        )

    def _pictures(self, frame: Frame, stamp_ns: int) -> Iterator[tuple[Topic, bytes]]:
        kind = self._options.pictures
        if kind is PictureFormat.JPEG:
            data = pictures.jpeg_of(frame, self._options.jpeg_quality)
            yield schemas.PICTURE, messages.image_message(kind, data, stamp_ns)
        elif kind is PictureFormat.PNG:
            luma, chroma = pictures.png_of(frame)
            yield schemas.PICTURE, messages.image_message(kind, luma, stamp_ns)
            if chroma is not None:
                yield schemas.CHROMA, messages.image_message(kind, chroma, stamp_ns)

    def _points_due(self, sample: LiveSample, stamp_ns: int) -> bool:
        hz = self._options.points_hz
        if not len(sample.scan.points) or hz == 0.0 or stamp_ns < self._points_from_ns:
            return False
        if hz is not None:
            # A tenth of a period early rather than a whole frame late.
            self._points_from_ns = stamp_ns + round(0.9e9 / hz)
        return True


class RecordClock:
    """Gives every sample a time that rises, whatever the system's clock does.

    That of the first sample is the system's; from there on the monotonic clock counts.

    Attributes
    ----------
    last_ns : int
        Time of the last sample.
    """

    def __init__(self) -> None:
        self._offset_ns: int | None = None
        self.last_ns = 0

    def stamp_ns(self, sample: LiveSample) -> int:
        """Return the time of a sample's arrival, nanoseconds since 1970."""
        arrived_ns = sample.instants.arrived_ns
        if self._offset_ns is None:
            self._offset_ns = sample.utc_ns - arrived_ns
        self.last_ns = max(self._offset_ns + arrived_ns, self.last_ns + 1)
        return self.last_ns


def _is_silence(sample: LiveSample) -> bool:
    """Return whether a sample stands for no frame at all."""
    posture = sample.scan.posture
    return isinstance(posture, Refusal) and posture.reason is Reason.NO_FRAMES
