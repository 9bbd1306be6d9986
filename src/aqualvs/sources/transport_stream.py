"""Pictures from MPEG-TS (ITU-T H.222.0)."""

from aqualvs.sources.live_frames import Unwrapper
from aqualvs.sources.rtp import TICKS_HZ, AccessUnit

PACKET_BYTES = 188
SYNC = 0x47

_CODECS = {0x01: "mpeg1video", 0x02: "mpeg2video", 0x10: "mpeg4", 0x1B: "h264", 0x24: "hevc"}
"""FFmpeg's names by stream type (table 2-34)."""

_RESTART_TICKS = 10 * TICKS_HZ
"""A step in time beyond this is a restarted sender."""

_MAX_BYTES = 16 << 20
"""No picture is larger; larger data have lost their end."""


class TransportStream:
    """Demultiplexer of the first video of an MPEG-TS, from packets of 188 bytes.

    Attributes
    ----------
    codec : str or None
        FFmpeg's name; None until the tables have come.

    Notes
    -----
    The stream does not say where a picture ends, only where the next one begins. Muxers fill up
    the last packet of a picture; so a filled packet ends it, and no picture waits for the next.
    Where that proves wrong once, it is given up.
    """

    def __init__(self) -> None:
        self.codec: str | None = None
        self._tables: int | None = None
        self._video: int | None = None
        self._counts: dict[int, int] = {}
        self._unwrap = Unwrapper(33)
        self._ticks: int | None = None
        self._parts: list[bytes] | None = None
        self._n_bytes = 0
        self._last = b""
        self._after_loss = self._is_restart = False
        self._ends_by_filling = True
        self._ended_early = False

    def push(self, content: bytes) -> list[AccessUnit]:
        """Return the pictures that some packets complete.

        Parameters
        ----------
        content : bytes
            Whole packets; what does not begin as one is ignored.

        Returns
        -------
        pictures : list of AccessUnit
            `is_whole` is False for those that miss a packet; their `data` is empty.
        """
        done: list[AccessUnit] = []
        for at in range(0, len(content) - PACKET_BYTES + 1, PACKET_BYTES):
            if content[at] == SYNC:
                done += self._packet(content[at : at + PACKET_BYTES])
        return done

    def _packet(self, packet: bytes) -> list[AccessUnit]:
        pid = (packet[1] & 0x1F) << 8 | packet[2]
        control = packet[3] >> 4 & 3
        if not control & 1 or pid not in (0, self._tables, self._video):
            return []
        start, filled = (4, False) if control == 1 else _adaptation(packet)
        begins = bool(packet[1] & 0x40)
        if pid == self._video:
            if packet == self._last:  # Sent or received twice.
                return []
            self._last = packet
            if packet[1] & 0x80 or not self._follows(pid, packet[3] & 15):
                return self._lose() + self._video_packet(packet[start:], begins, filled)
            return self._video_packet(packet[start:], begins, filled)
        if begins and start < PACKET_BYTES:
            self._table(pid, packet[start + 1 + packet[start] :])
        return []

    def _follows(self, pid: int, count: int) -> bool:
        last = self._counts.get(pid)
        self._counts[pid] = count
        return last is None or count == (last + 1) % 16

    def _table(self, pid: int, section: bytes) -> None:
        """Read a programme association (table 2-30) or map (2-33) that fits into one packet."""
        if len(section) < 12:
            return
        end = min(3 + ((section[1] & 15) << 8 | section[2]) - 4, len(section))
        if pid == 0 and section[0] == 0:
            for at in range(8, end - 3, 4):
                if section[at : at + 2] != b"\x00\x00":  # 0 is the network, not a programme.
                    self._tables = _pid(section, at + 2)
                    return
        elif pid == self._tables and section[0] == 2:
            self._choose(section, end)

    def _choose(self, section: bytes, end: int) -> None:
        """Take the first video of a programme."""
        at = 12 + ((section[10] & 15) << 8 | section[11])
        while at + 5 <= end:
            codec, video = _CODECS.get(section[at]), _pid(section, at + 1)
            if codec is not None:
                if (codec, video) != (self.codec, self._video):
                    self.codec, self._video, self._parts = codec, video, None
                return
            at += 5 + ((section[at + 3] & 15) << 8 | section[at + 4])

    def _lose(self) -> list[AccessUnit]:
        """Give up the picture that misses a packet."""
        self._after_loss = True
        return self._close(is_whole=False)

    def _video_packet(self, payload: bytes, begins: bool, filled: bool) -> list[AccessUnit]:
        done = []
        if begins:
            done = self._close(is_whole=True)
            self._open(payload)
        elif self._parts is not None:
            self._parts.append(payload)
            self._n_bytes += len(payload)
        elif self._ended_early and payload:
            self._ends_by_filling = False
            self._after_loss = True
        self._ended_early = False
        if self._parts is not None and (
            (filled and self._ends_by_filling) or self._n_bytes > _MAX_BYTES
        ):
            done += self._close(is_whole=self._n_bytes <= _MAX_BYTES)
            self._ended_early = True
        return done

    def _open(self, payload: bytes) -> None:
        """Read the head of a picture's packet (2.4.3.6)."""
        self._parts = None
        if len(payload) < 9 or payload[:3] != b"\x00\x00\x01" or payload[3] & 0xF0 != 0xE0:
            return
        start = 9 + payload[8]
        self._stamp(_time(payload) if payload[7] & 0x80 and len(payload) >= 14 else None)
        self._parts, self._n_bytes = [payload[start:]], len(payload) - start

    def _stamp(self, time: int | None) -> None:
        self._is_restart = False
        if time is None:
            return
        before = self._ticks
        self._ticks = self._unwrap(time)
        self._is_restart = before is None or abs(self._ticks - before) > _RESTART_TICKS

    def _close(self, *, is_whole: bool) -> list[AccessUnit]:
        parts, self._parts = self._parts, None
        if parts is None:
            return []
        data = b"".join(parts) if is_whole else b""
        lossy, self._after_loss = self._after_loss, not is_whole
        return [AccessUnit(self._ticks or 0, data, is_whole, lossy, self._is_restart)]


def _adaptation(packet: bytes) -> tuple[int, bool]:
    """Return where the payload begins, and whether the field before it fills the packet up."""
    length = packet[4]
    if length == 0:
        return 5, True
    used = 1 + (6 if packet[5] & 0x10 else 0)
    only_clock = not packet[5] & 0x0F
    return min(5 + length, PACKET_BYTES), only_clock and length > used


def _pid(section: bytes, at: int) -> int:
    return (section[at] & 0x1F) << 8 | section[at + 1]


def _time(payload: bytes) -> int:
    """Return the time of presentation, 33 bits at 90 kHz."""
    a, b, c, d, e = payload[9:14]
    return (a >> 1 & 7) << 30 | b << 22 | (c >> 1) << 15 | d << 7 | e >> 1
