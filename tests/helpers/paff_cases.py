"""H.264 whose fields are coded each by itself (PAFF), which x264 does not write.

Macroblocks hold their samples as they are (I_PCM), so that decoded pictures equal the given ones.
Sections are those of ITU-T H.264.
"""

from fractions import Fraction

import av
import numpy as np

from aqualvs.sources.base import packet_with

SIDE = 64
"""Width and height of the pictures."""


def pictures(n, seed=0):
    """Random 4:2:0 pictures (96, 64), as PyAV stacks them."""
    rng = np.random.default_rng(seed)
    return [rng.integers(1, 255, (SIDE * 3 // 2, SIDE)).astype(np.uint8) for _ in range(n)]


def field_packets(images, first="top"):
    """Two packets for each picture, the parameter sets before each first one."""
    parities = (0, 1) if first == "top" else (1, 0)
    packets = []
    for n, image in enumerate(images):
        for place, parity in enumerate(parities):
            head = b"" if place else _sequence() + _picture()
            packets.append(head + _field(image, parity, place, n))
    return packets


def write(path, images, *, first="top", singly):
    """Write a video of 25 pictures a second, its fields in packets of their own or by pairs."""
    packets = field_packets(images, first)
    if not singly:
        packets = [one + other for one, other in zip(packets[::2], packets[1::2], strict=True)]
    per_picture = len(packets) // len(images)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("h264", rate=25)
        stream.width = stream.height = SIDE
        stream.codec_context.extradata = _sequence() + _picture()
        for i, data in enumerate(packets):
            packet = packet_with(data)
            packet.stream, packet.time_base = stream, Fraction(1, 25 * per_picture)
            packet.pts, packet.dts, packet.duration = i, i, 1
            packet.is_keyframe = i % per_picture == 0
            container.mux(packet)
    return path


class _Bits:
    def __init__(self):
        self.bits = []

    def put(self, *fields):
        """Append (width, value) each."""
        for width, value in fields:
            self.bits += [value >> (width - 1 - i) & 1 for i in range(width)]
        return self

    def golomb(self, *values):
        for value in values:
            width = (value + 1).bit_length()
            self.put((width - 1, 0), (width, value + 1))
        return self

    def samples(self, *planes):
        self.bits += [0] * (-len(self.bits) % 8)
        for plane in planes:
            self.bits += np.unpackbits(plane.reshape(-1)).tolist()

    def unit(self, head):
        self.put((1, 1))
        payload = np.packbits(np.array(self.bits, np.uint8)).tobytes()
        unit, zeros = bytearray([0, 0, 0, 1, head]), 0
        for byte in payload:
            if zeros >= 2 and byte <= 3:
                unit.append(3)
                zeros = 0
            unit.append(byte)
            zeros = zeros + 1 if byte == 0 else 0
        return bytes(unit)


def _sequence():
    """Sequence parameter set (7.3.2.1.1): main profile, 4 bits of frame_num, fields allowed."""
    bits = _Bits().put((8, 77), (8, 0), (8, 40)).golomb(0, 0, 0, 4, 1).put((1, 0))
    bits.golomb(SIDE // 16 - 1, SIDE // 32 - 1).put((1, 0), (1, 0), (1, 1), (1, 0), (1, 0))
    return bits.unit(0x67)


def _picture():
    """Picture parameter set (7.3.2.2): CAVLC, deblocking is controlled by the slices."""
    bits = _Bits().golomb(0, 0).put((1, 0), (1, 0)).golomb(0, 0, 0).put((1, 0), (2, 0))
    return bits.golomb(0, 0, 0).put((1, 1), (1, 0), (1, 0)).unit(0x68)


def _field(image, parity, place, n):
    """A slice of a field (7.3.3): its number, parity and samples; each picture begins anew."""
    bits = _Bits().golomb(0, 7, 0).put((4, 0), (1, 1), (1, parity))
    if place == 0:
        bits.golomb(n % 2).put((8, 0), (2, 0))
    else:
        bits.put((8, 1), (1, 0))
    bits.golomb(0, 1)
    y = image[:SIDE][parity::2]
    u, v = (plane[parity::2] for plane in image[SIDE:].reshape(2, SIDE // 2, SIDE // 2))
    for row in range(0, SIDE // 2, 16):
        for column in range(0, SIDE, 16):
            bits.golomb(25)  # I_PCM
            halved = (slice(row // 2, row // 2 + 8), slice(column // 2, column // 2 + 8))
            bits.samples(y[row : row + 16, column : column + 16], u[halved], v[halved])
    return bits.unit(0x61 if place else 0x65)
