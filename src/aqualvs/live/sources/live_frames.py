"""From the packets of a stream to numbered, timed frames."""

import statistics
import time
from collections import deque
from collections.abc import Iterator

from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from aqualvs.live.sources.clock import StreamClock
from aqualvs.live.sources.ledger import Ledger
from aqualvs.live.sources.live_decoder import LiveDecoder
from aqualvs.live.sources.planes import planes_of
from aqualvs.live.sources.reception import Reception
from aqualvs.scanning.scan import Frame


class LiveFrames:
    """Decodes a stream, over reconnections: numbers rise, time never falls.

    Parameters
    ----------
    reception : Reception
        Told of every frame.
    """

    def __init__(self, reception: Reception) -> None:
        self._reception = reception
        self._ledger = Ledger(counts_packets=True)
        self._clock = StreamClock(1.0)
        self._decoder: LiveDecoder | None = None
        self._spacing = _Spacing()
        self._first: int | None = None
        self._last_index = -1
        self._last_time = 0.0
        self._lossy = False
        self._n_held = 0

    def connect(self, codec: VideoCodecContext, tick: float, *, hears_losses: bool) -> None:
        """Begin with a new decoder; what the old one held is lost.

        Parameters
        ----------
        codec : VideoCodecContext
            Not yet opened.
        tick : float
            Unit of the packets' time, in seconds.
        hears_losses : bool
            As for `LiveDecoder`.
        """
        self._decoder = LiveDecoder(codec, hears_losses=hears_losses)
        self._ledger.restart()
        self._lossy = False
        self._clock.set_tick(tick)

    def restart(self) -> None:
        """Go on with a sender that has begun anew, on the same decoder."""
        self.lose()
        self._ledger.restart()
        self._lossy = False

    def lose(self) -> None:
        """Note that packets were lost: wait for sound pictures."""
        self._lossy = True
        if self._decoder is not None:
            self._decoder.distrust()

    def announce(self, packet: "Packet[VideoStream]") -> None:
        """Count a picture that is too damaged to be decoded.

        Parameters
        ----------
        packet : Packet
        """
        self._ledger.expect(packet)
        self._hold()

    def feed(self, packet: "Packet[VideoStream]") -> Iterator[Frame]:
        """Yield the frames that a packet completes.

        Parameters
        ----------
        packet : Packet
            A whole picture; `pts` in ticks, None where the stream has no clock.

        Yields
        ------
        frame : Frame
        """
        if self._decoder is None or packet.size == 0:
            return
        self._ledger.expect(packet)
        arrival = time.monotonic()
        pictures = self._decoder.decode(packet)
        if self._decoder.is_waiting:
            self._lossy = True
            self._hold()
        for picture in pictures:
            yield self._frame(picture, arrival)

    def _hold(self) -> None:
        self._n_held += 1
        self._reception.hold(self._n_held)

    def _frame(self, picture: VideoFrame, arrival: float) -> Frame:
        at = self._clock.time_of(picture.pts, arrival)
        index = self._number(picture, at)
        n_lost = index - self._last_index - 1
        self._last_index, self._last_time = index, at
        self._lossy, self._n_held = False, 0
        luma, chroma = planes_of(picture)
        self._reception.deliver((picture.width, picture.height), n_lost)
        return Frame(index, at, luma, chroma)

    def _number(self, picture: VideoFrame, at: float) -> int:
        """Return the picture's number; after a loss the time tells how many are missing."""
        number = self._ledger.number(picture.pts)
        if self._first is None:
            self._first = number  # What came before was joined too late, not lost.
        index = number - self._first
        if self._last_index < 0:
            return index
        step, passed = index - self._last_index, at - self._last_time
        if not self._lossy:
            if step == 1:
                self._spacing.learn(passed)
            return index
        missing = max(0, self._spacing.count(passed) - step)
        self._ledger.skip(missing)
        return index + missing


class _Spacing:
    """Learns the time between pictures."""

    def __init__(self) -> None:
        self._seen: deque[float] = deque(maxlen=15)

    def learn(self, passed: float) -> None:
        if passed > 0:
            self._seen.append(passed)

    def count(self, passed: float) -> int:
        """Return how many pictures fit into a time; 0 if the spacing is unknown."""
        if not self._seen:
            return 0
        return round(passed / statistics.median(self._seen))
