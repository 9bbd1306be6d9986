"""A decoder that delivers sound pictures only, without delay."""

import av
from av.codec.context import Flags
from av.packet import Packet
from av.video.codeccontext import VideoCodecContext
from av.video.frame import VideoFrame
from av.video.stream import VideoStream

from aqualvs.live.sources.h264 import FrameNumbers

_KNOWS_SOUND = frozenset({"h264", "hevc"})
"""Decoders of FFmpeg that, once emptied, deliver nothing before a picture that needs no other, or
before the end of a gradual refresh."""


class LiveDecoder:
    """Decodes the pictures of a stream; after damage it waits for pictures free of it.

    Parameters
    ----------
    codec : VideoCodecContext
        Not yet opened; taken over.
    hears_losses : bool
        Whether the caller learns of every loss from the transport. If not, the numbers of H.264's
        pictures are watched.

    Attributes
    ----------
    is_waiting : bool
        Since damage no sound picture has come.

    Notes
    -----
    A picture predicted from a lost or damaged one looks sound and is not: stripes stand where they
    stood before. So after each loss, and after each picture that FFmpeg had to patch up, nothing
    is delivered until a key frame, or a completed gradual refresh, which are decoded exactly.

    One thread, because threads that work on several pictures delay each by their number less one;
    threads that share a picture leave patched pictures unmarked. And because packets made from
    Python's bytes deadlock when a decoder with threads is closed (PyAV 18).
    """

    def __init__(self, codec: VideoCodecContext, *, hears_losses: bool) -> None:
        self.is_waiting = False
        self._codec = codec
        codec.thread_count = 1
        codec.flags |= int(Flags.low_delay)
        self._numbers = FrameNumbers() if codec.name == "h264" and not hears_losses else None
        if self._numbers is not None and codec.extradata:
            self._learn(codec.extradata)
        self._waits_for_key = codec.name not in _KNOWS_SOUND

    def _learn(self, extradata: bytes) -> None:
        """Read the parameter sets; units with lengths instead of start codes are left unread."""
        if extradata.startswith(b"\x01") or self._numbers is None:
            self._numbers = None
        else:
            self._numbers.is_gap_before(extradata)

    def distrust(self) -> None:
        """Wait for a picture that needs no other: something was lost."""
        self.is_waiting = True
        self._codec.flush_buffers()
        self._waits_for_key = self._codec.name not in _KNOWS_SOUND
        if self._numbers is not None:
            self._numbers.restart()

    def decode(self, packet: "Packet[VideoStream]") -> list[VideoFrame]:
        """Return the sound pictures that a packet completes.

        Parameters
        ----------
        packet : Packet
            A whole picture.

        Returns
        -------
        pictures : list of VideoFrame
            In order of presentation; empty while waiting.
        """
        if packet.is_corrupt:
            self.distrust()
            return []
        if self._numbers is not None and self._numbers.is_gap_before(bytes(packet)):
            self.distrust()
        try:
            pictures = self._codec.decode(packet)
        except (av.error.FFmpegError, ValueError):
            self.distrust()
            return []
        return self._sound(pictures)

    def _sound(self, pictures: list[VideoFrame]) -> list[VideoFrame]:
        sound = []
        for picture in pictures:
            if picture.is_corrupt:
                self.distrust()
                continue
            self._waits_for_key = self._waits_for_key and not picture.key_frame
            if not self._waits_for_key:
                self.is_waiting = False
                sound.append(picture)
        return sound
