"""Postures from a stream that loses packets: what is delivered, and what more could be had.

    python -m benchmarks.packet_loss [--frames N] [--seeds N]

encodes the bundled dive as H.264 in several ways, packs it into RTP, loses packets by fixed seeds,
and prints for each stream and pattern of loss

- which frames a live feed delivers (each bit for bit what was encoded),
- postures from all pictures as FFmpeg conceals what is missing,
- postures from the intact pixels of all pictures, and from those alone,
- postures from intact pixels where four fifths of each laser's band are intact,
- postures from returns of the whole picture that lie there: the best that any of this could give.

Intact pixels are told by a second decoder: what is missing is inverted in its pictures, so that
every pixel that depends on it, by prediction, filter or concealment, comes out different from the
first decoder's. What both have alike is what was encoded, but for a grey level or two within 8 px
of damage, which are left out.

A posture is wrong where it differs from that of the whole picture by more than three of its sigmas
and by more than 2 mm or 0.5 degrees.
"""

import argparse
import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, NamedTuple

import av
import cv2
import numpy as np
from av.codec.context import Flags, Flags2
from av.video.frame import VideoFrame

from aqualvs.demo import bundled_dive
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.sources import open_source
from aqualvs.sources.base import bgr_of, packet_with, planes_of
from aqualvs.sources.h264 import START_CODE, NalType
from aqualvs.sources.live_frames import LiveFrames, Reception
from aqualvs.sources.rtp import TICKS_HZ, H264Depacketizer, RtpOrder, parse_rtp
from aqualvs.sources.udp import decoded, decoder_of

FPS = 25
# Of H.264 in a packet; one slice of `slice-max-size` fits into it.
PAYLOAD, SLICE_BYTES = 1188, 1100
STREAMS = {
    "0.8 Mbit/s, key frame every 12, one slice": (12, 800_000, ""),
    "0.8 Mbit/s, key frame every 12, slices of a packet": (
        12,
        800_000,
        f"slice-max-size={SLICE_BYTES}",
    ),
    "2 Mbit/s, key frame every 25, one slice": (25, 2_000_000, ""),
    "2 Mbit/s, key frame every 25, slices of a packet": (
        25,
        2_000_000,
        f"slice-max-size={SLICE_BYTES}",
    ),
    "2 Mbit/s, refresh over 25, slices of a packet": (
        25,
        2_000_000,
        f"slice-max-size={SLICE_BYTES}:intra-refresh=1",
    ),
}
# Share of the packets, and how many in a row.
LOSSES = ((0.01, 1), (0.05, 1), (0.05, 4))
# Pixels around damage that are left out of a picture, and then returns around these.
NEAR_PX = 8
BLACK, NO_COLOUR = 16, 128
# Share of each laser's band that is intact in pictures which are damaged little.
NEARLY_ALL = 0.8
MACROBLOCK = 16


class Part(NamedTuple):
    """One packet: picture, unit within it, and which fragment of how many."""

    picture: int
    unit: int
    fragment: int
    n_fragments: int
    payload: bytes


@dataclass
class RunSummary:
    """Postures compared with those of whole pictures."""

    n: int = 0
    n_wrong: int = 0
    worst: np.ndarray = field(default_factory=lambda: np.zeros(3))

    def add(self, found: Posture | Refusal, true: Posture | Refusal) -> None:
        if not (isinstance(found, Posture) and isinstance(true, Posture)):
            return
        off = np.abs([found.range - true.range, found.pitch - true.pitch, found.yaw - true.yaw])
        sigma = np.sqrt(np.diag(found.covariance))
        least = np.array([2e-3, np.deg2rad(0.5), np.deg2rad(0.5)])
        self.n += 1
        self.n_wrong += bool(np.any(off > np.maximum(3.0 * sigma, least)))
        self.worst = np.maximum(self.worst, off)

    def text(self, n_frames: int) -> str:
        if not self.n:
            return "none"
        worst = f"{1e3 * self.worst[0]:.0f} mm, {np.rad2deg(self.worst[1:].max()):.0f} deg"
        return f"{self.n / n_frames:.0%}, {self.n_wrong / self.n:.0%} of them wrong ({worst})"


def encode(frames: list[Frame], gop: int, bitrate: int, x264: str) -> list[list[bytes]]:
    """Return the units of each picture."""
    codec: Any = av.CodecContext.create("libx264", "w")
    codec.height, codec.width = frames[0].luma.shape
    codec.pix_fmt = "yuv420p"
    codec.time_base, codec.framerate = Fraction(1, FPS), FPS
    codec.bit_rate, codec.gop_size = bitrate, gop
    params = "repeat-headers=1" + (":" + x264 if x264 else "")
    codec.options = {"preset": "ultrafast", "tune": "zerolatency", "threads": "1"}
    codec.options |= {"x264-params": params}
    packets = []
    for i, frame in enumerate(frames):
        picture = VideoFrame.from_ndarray(bgr_of(frame), format="bgr24")
        picture.pts = i
        packets += codec.encode(picture)
    packets += codec.encode(None)
    return [
        [unit for unit in units_of(bytes(packet)) if unit[0] & 31 != NalType.SEI]
        for packet in packets
    ]


def units_of(data: bytes) -> list[bytes]:
    """Return the units of a byte stream whose start codes have three or four bytes."""
    return [part.rstrip(b"\0") for part in data.split(b"\0\0\1") if part.strip(b"\0")]


def parts_of(pictures: list[list[bytes]]) -> list[Part]:
    """Cut units into packets."""
    found = []
    for i, units in enumerate(pictures):
        for k, unit in enumerate(units):
            n = -(-len(unit) // PAYLOAD)
            found += [Part(i, k, j, n, unit[j * PAYLOAD : (j + 1) * PAYLOAD]) for j in range(n)]
    return found


def datagram(sequence: int, part: Part, head: int, *, ends: bool) -> bytes:
    """Pack a part into RTP (RFC 6184): whole units as they are, others as FU-A."""
    payload = part.payload
    if part.n_fragments > 1:
        first, last = part.fragment == 0, part.fragment == part.n_fragments - 1
        flags = 0x80 * first | 0x40 * last | head & 31
        payload = bytes([head & 0xE0 | 28, flags]) + payload[1 if first else 0 :]
    ticks = part.picture * TICKS_HZ // FPS
    return struct.pack("!BBHII", 0x80, 96 | 0x80 * ends, sequence, ticks, 7) + payload


def lost_parts(parts: list[Part], share: float, run: float, seed: int) -> list[bool]:
    """Choose the packets that are lost: `run` of them in a row on average.

    Parameter sets arrive: of these a receiver has those of an SDP file, or of the next key frame.
    """
    chance, lost, found = random.Random(seed), False, []
    begin, go_on = share / run / (1.0 - share), 1.0 - 1.0 / run
    if run == 1:
        begin = go_on = share
    for part in parts:
        lost = chance.random() < (go_on if lost else begin)
        is_set = part.fragment == 0 and part.payload[0] & 31 > NalType.SEI
        found.append(lost and not is_set)
    return found


def delivered(
    pictures: list[list[bytes]], parts: list[Part], lost: list[bool]
) -> list[tuple[int, ImagePlane]]:
    """Return number and luma of what a live feed delivers."""
    frames = LiveFrames(Reception("stream"))
    frames.connect(decoder_of("h264"), 1 / TICKS_HZ, reports_losses=True)
    order, units, found = RtpOrder(), H264Depacketizer(), []
    for sequence, (part, is_lost) in enumerate(zip(parts, lost, strict=True)):
        if is_lost:
            continue
        ends = sequence + 1 == len(parts) or parts[sequence + 1].picture != part.picture
        head = pictures[part.picture][part.unit][0]
        packet = parse_rtp(datagram(sequence, part, head, ends=ends))
        assert packet is not None
        # Packets that are late for a lost one come when its time is over.
        for ordered in [*order.push(packet, sequence), *order.overdue(sequence + 1.0)]:
            for picture in units.push(ordered):
                at = round(picture.ticks * FPS / TICKS_HZ)
                found += [(at, frame.luma.copy()) for frame in decoded(frames, picture)]
    return found


def concealing() -> Any:
    """Return a decoder that delivers whatever it can make."""
    codec: Any = av.CodecContext.create("h264", "r")
    codec.thread_count = 1
    codec.flags |= int(Flags.low_delay) | int(Flags.output_corrupt)
    codec.flags2 |= int(Flags2.show_all)
    return codec


def decode(codec: Any, units: list[bytes], i: int) -> VideoFrame | None:
    packet = packet_with(b"".join(START_CODE + unit for unit in units))
    packet.pts, packet.time_base = i, Fraction(1, FPS)
    try:
        pictures = codec.decode(packet)
    except (av.error.FFmpegError, ValueError):
        return None
    return pictures[0] if len(pictures) == 1 else None


def writable(picture: VideoFrame) -> list[ImagePlane]:
    """Return the planes of a picture, in the memory from which the decoder predicts."""
    return [
        np.asarray(memoryview(plane)).reshape(-1, plane.line_size)[: plane.height, : plane.width]
        for plane in picture.planes
    ]


def first_macroblock(unit: bytes) -> int:
    """Read `first_mb_in_slice` (7.3.3)."""
    bits = "".join(f"{byte:08b}" for byte in unit[1:9])
    zeros = bits.index("1")
    return int(bits[zeros : 2 * zeros + 1], 2) - 1


def missing(units: list[bytes], whole: set[int], shape: tuple[int, int]) -> np.ndarray:
    """Return where a picture's macroblocks may be missing, in pixels.

    Where a slice ends is known by the beginning of the next one only: of a slice before a gap
    nothing is trusted.
    """
    height, width = (-(-n // MACROBLOCK) for n in shape)
    bad = np.ones(height * width, np.bool_)
    slices = [k for k, unit in enumerate(units) if unit[0] & 31 in (NalType.SLICE, NalType.IDR)]
    for k in slices:
        follows = k == slices[-1] or k + 1 in whole
        if k in whole and follows:
            end = bad.size if k == slices[-1] else first_macroblock(units[k + 1])
            bad[first_macroblock(units[k]) : end] = False
    grid = bad.reshape(height, width).repeat(MACROBLOCK, 0).repeat(MACROBLOCK, 1)
    return grid[: shape[0], : shape[1]]


def with_damage(
    pictures: list[list[bytes]], parts: list[Part], lost: list[bool], shape: tuple[int, int]
) -> Iterator[tuple[int, VideoFrame, np.ndarray]]:
    """Yield number, picture as concealed, and the pixels that depend on something missing."""
    torn = {(part.picture, part.unit) for part, bad in zip(parts, lost, strict=True) if bad}
    plain, spoilt = concealing(), concealing()
    last: tuple[list[ImagePlane], list[ImagePlane]] | None = None
    for i, units in enumerate(pictures):
        whole = {k for k in range(len(units)) if (i, k) not in torn}
        got = [unit for k, unit in enumerate(units) if k in whole]
        kinds = {unit[0] & 31 for unit in got}
        if not kinds & {NalType.SLICE, NalType.IDR}:
            if last is not None:
                for one, other in zip(*last, strict=True):
                    np.subtract(255, one, out=other)
            continue
        if last is None and NalType.IDR not in kinds:
            continue
        found, twin = decode(plain, got, i), decode(spoilt, got, i)
        if found is None or twin is None:
            continue
        last = writable(found), writable(twin)
        bad = missing(units, whole, shape)
        for one, other in zip(*last, strict=True):
            here = bad if one.shape == bad.shape else bad[::2, ::2]
            other[here] = 255 - one[here]
        differs = last[0][0] != last[1][0]
        for one, other in zip(last[0][1:], last[1][1:], strict=True):
            differs |= (one != other).repeat(2, 0).repeat(2, 1)[: shape[0], : shape[1]]
        yield i, found, differs


def grown(mask: np.ndarray) -> np.ndarray:
    size = 2 * NEAR_PX + 1
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)))


def intact_posture(scanner: Scanner, frame: Frame, damage: np.ndarray) -> Posture | Refusal:
    """Measure from intact pixels and from returns that are not beside others."""
    assert frame.chroma is not None
    bad = grown(damage)
    luma = np.where(bad > 0, np.uint8(BLACK), frame.luma)
    half = cv2.dilate(bad, np.ones((3, 3), np.uint8))[::2, ::2] > 0
    u, v = (np.where(half, np.uint8(NO_COLOUR), plane) for plane in frame.chroma)
    return posture_outside(scanner, Frame(frame.index, frame.time_s, luma, (u, v)), damage)


def posture_outside(scanner: Scanner, frame: Frame, damage: np.ndarray) -> Posture | Refusal:
    """Measure from the returns that are not beside damage."""
    bad, kept = grown(grown(damage)), {}
    for axis, one in scanner.detect(frame).items():
        lines = bad if axis is SearchAxis.ALONG_X else bad.T
        at = np.clip(np.rint(one.position).astype(int), 0, lines.shape[1] - 1)
        good = lines[one.line, at] == 0
        columns = (one.line, one.position, one.height, one.width, one.likelihood)
        kept[axis] = type(one)(*(column[good] for column in columns))
    return scanner.measure(frame.index, frame.time_s, kept).posture


def frame_of(i: int, picture: VideoFrame) -> Frame:
    return Frame(i, i / FPS, *planes_of(picture))


def main() -> None:
    """Print a line for each stream and pattern of loss."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    folder = bundled_dive()
    scanner = Scanner(load_rig(str(folder / "rig.yaml")))
    bands = bands_of(scanner.rig)
    # Damage outside of all of them would not matter.
    shares = ", ".join(f"{band.mean():.0%}" for band in bands)
    print(f"of the picture the lasers' bands take {shares}, together {np.any(bands, 0).mean():.0%}")
    with open_source(str(folder / "dive.mp4")) as source:
        frames = [frame for _, frame in zip(range(options.frames), source, strict=False)]
    for (gop, bitrate, x264), name in zip(STREAMS.values(), STREAMS, strict=True):
        pictures = encode(frames, gop, bitrate, x264)
        parts, plain, true, sound = parts_of(pictures), concealing(), [], []
        for i, units in enumerate(pictures):
            picture = decode(plain, units, i)
            assert picture is not None
            sound.append(picture)
            true.append(scanner.process(frame_of(i, picture)).posture)
        print(f"{name}: {len(parts) / len(pictures):.1f} packets a picture")
        for share, run in LOSSES:
            report(scanner, bands, pictures, parts, sound, true, (share, run, options.seeds))


def bands_of(rig: Rig) -> list[np.ndarray]:
    """Return the pixels in which each laser is looked for, shape (height, width)."""
    width, height = rig.size_px
    found = []
    for search in plan_bands(rig, rig.camera()):
        along_x = search.axis is SearchAxis.ALONG_X
        at = np.arange(width if along_x else height)
        inside = (at >= search.lowest[:, None]) & (at <= search.highest[:, None])
        inside = inside.repeat(search.line_px, 0)
        found.append(inside if along_x else inside.T)
    return found


def report(
    scanner: Scanner,
    bands: list[np.ndarray],
    pictures: list[list[bytes]],
    parts: list[Part],
    sound: list[VideoFrame],
    true: list[Posture | Refusal],
    loss: tuple[float, int, int],
) -> None:
    """Measure one pattern of loss."""
    share, run, n_seeds = loss
    shape = bands[0].shape
    n_exact, area, worst_leak = 0, 0.0, 0
    concealed, intact, nearly, best = RunSummary(), RunSummary(), RunSummary(), RunSummary()
    for seed in range(n_seeds):
        lost = lost_parts(parts, share, run, seed)
        for at, luma in delivered(pictures, parts, lost):
            assert np.array_equal(luma, planes_of(sound[at])[0]), f"picture {at} is not exact"
            n_exact += 1
        for i, picture, damage in with_damage(pictures, parts, lost, shape):
            frame = frame_of(i, picture)
            concealed.add(scanner.process(frame).posture, true[i])
            leak = np.abs(frame.luma.astype(int) - planes_of(sound[i])[0])[grown(damage) == 0]
            area, worst_leak = area + leak.size, max(worst_leak, int(leak.max(initial=0)))
            found = intact_posture(scanner, frame, damage)
            intact.add(found, true[i])
            if damage.any() and all(damage[band].mean() <= 1.0 - NEARLY_ALL for band in bands):
                nearly.add(found, true[i])
            best.add(posture_outside(scanner, frame_of(i, sound[i]), damage), true[i])
    n = n_seeds * len(pictures)
    print(
        f"  {share:.0%} lost, {run} in a row: {n_exact / n:.0%} delivered; "
        f"concealed: {concealed.text(n)}; intact pixels ({area / n / np.prod(shape):.0%} of all, "
        f"off by {worst_leak} at most): {intact.text(n)}; "
        f"damaged little: {nearly.text(n)}; at best {best.text(n)}",
        flush=True,
    )


if __name__ == "__main__":
    main()
