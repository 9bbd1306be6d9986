"""Numbered, timed frames from the packets of a live stream, and the state of its reception."""

import statistics
import threading
import time
from collections import deque
from collections.abc import Iterator

import av
from av.codec.context import Flags
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from aqualvs.scanning.scan import Frame
from aqualvs.sources.base import PartHealth, State, frame_of
from aqualvs.sources.h264 import FrameNumbers
from aqualvs.sources.video import FrameCounter


class Unwrapper:
    """Unwrapped counter: continues a counter of fixed width past its overflow.

    `bits`: width of the counter: 32 for the time in RTP, 33 for that in MPEG-TS.
    """

    def __init__(self, bits: int) -> None:
        self._span = 1 << bits
        self._last: int | None = None

    def __call__(self, value: int) -> int:
        """Return a received value on an endless line, nearest to the one before."""
        if self._last is None:
            self._last = value
        half = self._span // 2
        self._last += (value - self._last + half) % self._span - half
        return self._last


class StreamClock:
    """Time since the first picture, which never falls, also over a sender that starts anew.

    A sender that restarts counts from any number. Where its time disagrees with the time of
    arrival by more than 5 s, or falls, the stream goes on as long after the last picture as the
    new one arrived after it.

    `tick`: length of a tick in seconds; positive.
    """

    def __init__(self, tick: float) -> None:
        self._tick = tick
        self._anchor = 0.0
        self._anchor_ticks: int | None = None
        self._last = 0.0
        self._last_arrival: float | None = None
        self.is_anew = False  # Whether the last picture did not go on with the clock before it.

    def set_tick(self, tick: float) -> None:
        """Go on with ticks of another length in seconds, after a new connection."""
        self._tick = tick
        self._anchor_ticks = None

    def time_of(self, ticks: int | None, arrival: float) -> float:
        """Return the time of a picture, in seconds since the first one asked for.

        `ticks`: by the stream's clock; None where it has none, then the arrival counts. `arrival`:
        seconds on this machine's monotonic clock.
        """
        passed = 0.0 if self._last_arrival is None else max(0.0, arrival - self._last_arrival)
        time = expected = self._last + passed
        if ticks is not None:
            self.is_anew = self._anchor_ticks is None
            if self._anchor_ticks is None:
                self._anchor, self._anchor_ticks = expected, ticks
            time = self._anchor + (ticks - self._anchor_ticks) * self._tick
        # Greatest difference of stream and arrival times for one sender: buffers hold no more.
        disagree_s = 5.0
        if time < self._last or abs(time - expected) > disagree_s:
            self._anchor, self._anchor_ticks = expected, ticks
            time, self.is_anew = expected, True
        self._last, self._last_arrival = time, arrival
        return time


_SILENT_S = 0.5
"""Longer silence is a fault."""

NOTHING_YET = "waiting for the stream"
"""Beginning of the detail of a reception that nothing has come to."""


class Reception:
    """Log of what arrived and when; written by the source, read from another thread.

    `name`: of the part. `content`: what arrives, such as "RTP H.264"; may be set later.
    """

    def __init__(self, name: str, content: str = "") -> None:
        self.name = name
        self._lock = threading.Lock()
        self._content = content
        self._fault = ""
        self._size = (0, 0)
        self._began = time.monotonic()  # From the first packet on: when that came.
        self._last_arrival: float | None = None
        self._frames: deque[float] = deque()
        self._losses: deque[tuple[float, int]] = deque()
        self._last_frame: float | None = None
        self._n_lost = 0
        self._n_held = 0
        self._end = ""

    def note_arrival(self, content: str = "") -> None:
        """Note that data came, which ends a fault.

        `content`: kind of the data; empty if it is known.
        """
        with self._lock:
            now = time.monotonic()
            if self._last_arrival is None:
                self._began = now
            self._last_arrival = now
            self._content = content or self._content
            self._fault = ""

    def note_fault(self, words: str) -> None:
        """Note why no usable data come, until some do.

        `words`: empty if the reason is gone.
        """
        with self._lock:
            self._fault = words

    def note_frame(self, size_px: tuple[int, int], n_lost: int) -> None:
        """Note a frame that goes out, its width and height, and how many were lost before it."""
        now = time.monotonic()
        with self._lock:
            self._size = size_px
            self._frames.append(now)
            self._last_frame = now
            self._n_held = 0
            self._losses.append((now, n_lost))
            self._n_lost += n_lost
            self._forget(now)

    def note_held(self, n: int) -> None:
        """Note how many pictures are not delivered, since the last one that was, after a loss."""
        with self._lock:
            self._n_held = n

    def end(self, words: str) -> None:
        """Note that nothing more will come."""
        with self._lock:
            self._end = words

    def health(self) -> PartHealth:
        """Return the state of the reception."""
        now = time.monotonic()
        with self._lock:
            self._forget(now)
            state, words = self._state(now)
            return PartHealth(self.name, state, words, self._n_lost + self._n_held)

    def _forget(self, now: float) -> None:
        # Rates and losses are reported for this time.
        window_s = 5.0
        while self._frames and self._frames[0] < now - window_s:
            self._frames.popleft()
        while self._losses and self._losses[0][0] < now - window_s:
            self._losses.popleft()

    def _state(self, now: float) -> tuple[State, str]:
        if self._end:
            return State.OFF, self._end
        if self._fault:
            return State.FAULT, self._fault
        if self._last_arrival is None:
            return State.FAULT, f"{NOTHING_YET} for {now - self._began:.0f} s"
        silent_s = now - self._last_arrival
        if silent_s > self._timeout():
            return State.FAULT, f"silent for {silent_s:.1f} s; waiting for its return"
        if self._last_frame is None:
            waiting = (
                f"waiting for a whole key frame with SPS and PPS for {now - self._began:.1f} s"
            )
            return State.FAULT, f"{self._content}: {waiting}"
        if now - self._last_frame > self._timeout():
            why = "damaged or lost packets, no sound picture" if self._n_held else "no key frame"
            return State.FAULT, f"{self._content}: {why} for {now - self._last_frame:.1f} s"
        return self._running()

    def _running(self) -> tuple[State, str]:
        span = self._frames[-1] - self._frames[0] if self._frames else 0.0
        words = f"{self._content} {self._size[0]}x{self._size[1]} px"
        if span > 1.0:  # No rate can be told before.
            words += f", {(len(self._frames) - 1) / span:.1f} frames/s"
        n_lost = sum(n for _, n in self._losses)
        if not n_lost:
            return State.OK, words.strip()
        share = 100 * n_lost / (n_lost + len(self._frames))
        return State.WARN, f"{words}, {share:.1f} % lost".strip()

    def _timeout(self) -> float:
        """Return the silence that is no fault: longer for a stream of few frames."""
        if len(self._frames) < 2:
            return max(_SILENT_S, 2.0 if self._last_frame is None else 0.0)
        return max(_SILENT_S, 3 * (self._frames[-1] - self._frames[0]) / (len(self._frames) - 1))


_KNOWS_SOUND = frozenset({"h264", "hevc"})
"""Decoders of FFmpeg that, once emptied, deliver nothing before a picture that needs no other, or
before the end of a gradual refresh."""


class LiveDecoder:
    """Decoder for a stream; after damage it waits for undamaged pictures.

    `codec`: not yet opened; taken over. `reports_losses`: whether the caller learns of every loss
    from the transport. If not, the numbers of H.264's pictures are watched.

    A picture predicted from a lost or damaged one looks sound and is not: stripes stand where they
    stood before. So after each loss, and after each picture that FFmpeg had to patch up, nothing
    is delivered until a key frame, or a completed gradual refresh, which are decoded exactly.

    One thread, because threads that work on several pictures delay each by their number less one;
    threads that share a picture leave patched pictures unmarked. And because packets made from
    Python's bytes deadlock when a decoder with threads is closed (PyAV 18).
    """

    def __init__(self, codec: VideoCodecContext, *, reports_losses: bool) -> None:
        self.is_waiting = False  # No sound picture has come since a loss.
        self._codec = codec
        codec.thread_count = 1
        codec.flags |= int(Flags.low_delay)
        self._numbers = FrameNumbers() if codec.name == "h264" and not reports_losses else None
        if self._numbers is not None and codec.extradata:
            # Parameter sets with lengths instead of start codes are left unread.
            if codec.extradata.startswith(b"\x01"):
                self._numbers = None
            else:
                self._numbers.is_gap_before(codec.extradata)
        self._waits_for_key = codec.name not in _KNOWS_SOUND

    def reset(self) -> None:
        """Wait for a picture that needs no other: something was lost."""
        self.is_waiting = True
        self._codec.flush_buffers()
        self._waits_for_key = self._codec.name not in _KNOWS_SOUND
        if self._numbers is not None:
            self._numbers.restart()

    def decode(self, packet: "Packet[VideoStream]") -> list[VideoFrame]:
        """Return the sound pictures that a packet, a whole picture, completes.

        They are in order of presentation; there are none while waiting.
        """
        if packet.is_corrupt:
            self.reset()
            return []
        if self._numbers is not None and self._numbers.is_gap_before(bytes(packet)):
            self.reset()
        try:
            pictures = self._codec.decode(packet)
        except (av.error.FFmpegError, ValueError):
            self.reset()
            return []
        sound = []
        for picture in pictures:
            if picture.is_corrupt:
                self.reset()
                continue
            self._waits_for_key = self._waits_for_key and not picture.key_frame
            if not self._waits_for_key:
                self.is_waiting = False
                sound.append(picture)
        return sound


class LiveFrames:
    """Frames of a stream over reconnections: numbers rise, time never falls.

    `reception`: told of every frame.
    """

    def __init__(self, reception: Reception) -> None:
        self._reception = reception
        self._frame_counter = FrameCounter(counts_packets=True)
        self._clock = StreamClock(1.0)
        self._decoder: LiveDecoder | None = None
        # Times between the latest pictures.
        self._spacings: deque[float] = deque(maxlen=15)
        self._first: int | None = None
        self._last_index = -1
        self._last_time = 0.0
        self._lossy = False
        self._n_held = 0

    def connect(self, codec: VideoCodecContext, tick: float, *, reports_losses: bool) -> None:
        """Begin with a new decoder; pictures in the old one are lost.

        `codec`, `reports_losses`: as for `LiveDecoder`. `tick`: unit of the packets' time, in
        seconds.
        """
        self._decoder = LiveDecoder(codec, reports_losses=reports_losses)
        self._frame_counter.restart()
        self._frame_counter.begin(codec)
        self._lossy = False
        self._clock.set_tick(tick)

    def restart(self) -> None:
        """Continue with a sender that has started anew, on the same decoder."""
        self.lose()
        self._frame_counter.restart()
        self._lossy = False

    def lose(self) -> None:
        """Note that packets were lost: wait for sound pictures."""
        self._lossy = True
        if self._decoder is not None:
            self._decoder.reset()

    def announce(self, packet: "Packet[VideoStream]") -> None:
        """Count a picture that is too damaged to be decoded."""
        self._frame_counter.expect(packet)
        self._hold()

    def feed(self, packet: "Packet[VideoStream]") -> Iterator[Frame]:
        """Yield the frames that a packet, a whole picture, completes.

        Its `pts` is in ticks, None where the stream has no clock.
        """
        if self._decoder is None or packet.size == 0:
            return
        self._frame_counter.expect(packet)
        arrival = time.monotonic()
        pictures = self._decoder.decode(packet)
        if self._decoder.is_waiting:
            self._lossy = True
            self._hold()
        for picture in pictures:
            yield self._frame(picture, arrival)

    def _hold(self) -> None:
        self._n_held += 1
        self._reception.note_held(self._n_held)

    def _frame(self, picture: VideoFrame, arrival: float) -> Frame:
        at = self._clock.time_of(picture.pts, arrival)
        index = self._number(picture, at)
        n_lost = index - self._last_index - 1
        self._last_index, self._last_time = index, at
        self._lossy, self._n_held = False, 0
        self._reception.note_frame((picture.width, picture.height), n_lost)
        return frame_of(index, at, picture)

    def _number(self, picture: VideoFrame, at: float) -> int:
        """Return the picture's number; after a loss, the time gives the number of missing ones."""
        number = self._frame_counter.number(picture.pts)
        if self._first is None:
            self._first = number  # Earlier ones are not lost: reception began later.
        index = number - self._first
        if self._last_index < 0:
            return index
        step, passed = index - self._last_index, at - self._last_time
        if not self._lossy:
            if step == 1 and passed > 0:
                self._spacings.append(passed)
            return index
        # A sender that was off has lost nothing meanwhile.
        if not self._spacings or self._clock.is_anew:
            return index
        missing = max(0, round(passed / statistics.median(self._spacings)) - step)
        self._frame_counter.skip(missing)
        return index + missing
