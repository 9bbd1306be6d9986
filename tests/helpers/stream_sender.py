"""Sends a clip of H.264 as vehicles do, from the process of a test or as a program of its own.

RTP and MPEG-TS are made by FFmpeg's muxers, and pass through a relay that loses, damages or
renumbers datagrams by a fixed seed. The same datagrams go out at any speed of the machine.
"""

import argparse
import contextlib
import json
import random
import select
import socket
import struct
import sys
import time
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.frame import VideoFrame

LOOPBACK = "127.0.0.1"
TS_DATAGRAM = 7 * 188
# A receiver's buffer is never filled further than this, however slow it is: the least that Linux
# gives holds five times as much.
MAX_WAITING_BYTES, LOOK_EVERY = 40_000, 16


def make_clip(path, size, n_frames, *, gop=25, bitrate=2_000_000, content=None, **options):
    """Encode moving pictures at 25 frames a second, key frame first; returns the path."""
    fps = 25
    codec = av.CodecContext.create("libx264", "w")
    codec.width, codec.height = size
    codec.pix_fmt = "yuv420p"
    codec.time_base, codec.framerate = Fraction(1, fps), fps
    codec.bit_rate, codec.gop_size = bitrate, gop
    # One thread: with more, a picture has as many slices as the machine has cores.
    codec.options = {"preset": "ultrafast", "tune": "zerolatency", "threads": "1", **options}
    packets = []
    for i, image in enumerate((content or moving_pattern)(size, n_frames)):
        frame = VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts = i
        packets += codec.encode(frame)
    packets += codec.encode(None)
    lengths = [packet.size for packet in packets]
    head = json.dumps({"size": size, "fps": fps, "lengths": lengths})
    path.write_bytes(head.encode() + b"\n" + b"".join(bytes(p) for p in packets))
    return path


def read_clip(path):
    """Return the head of a clip and its pictures."""
    head, _, body = path.read_bytes().partition(b"\n")
    head = json.loads(head)
    ends = np.cumsum(head["lengths"]).tolist()
    return head, [body[end - n : end] for end, n in zip(ends, head["lengths"], strict=True)]


def moving_pattern(size, n_frames):
    """Yield coarse noise that slides, so that every picture differs and predicts the next one."""
    import cv2

    width, height = size
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 256, (height // 16 + 20, width // 16 + 40, 3), dtype=np.uint8)
    board = cv2.resize(coarse, None, fx=16, fy=16, interpolation=cv2.INTER_CUBIC)
    for i in range(n_frames):
        x, y = (5 * i) % 500, (2 * i) % 200
        yield np.ascontiguousarray(board[y : y + height, x : x + width])


def moving_stripes(size, n_frames):
    """Yield dark pictures with three bright stripes that turn, like those of lasers."""
    import cv2

    width, height = size
    rng = np.random.default_rng(2)
    dark = cv2.resize(rng.integers(8, 24, (height // 32, width // 32, 3), dtype=np.uint8), size)
    for i in range(n_frames):
        image = dark.copy()
        for k in (1, 2, 3):
            y = k * height // 4 + (3 * i) % 40
            cv2.line(image, (0, y), (width, y + 4 * k - 2 * i % 30), (40, 250, 40), 3)
        yield image


class Relay:
    """Passes on datagrams, all but those it loses."""

    def __init__(self, send, options):
        self.n_sent = self.n_lost = self.n_damaged = 0
        self.loses = True
        self._send = send
        self._options = options
        self._random = random.Random(options.seed)
        self._shift = None

    def push(self, datagram):
        if self.loses and self._random.random() < self._options.loss:
            self.n_lost += 1
            return
        self._send(self._spoilt(datagram))
        self.n_sent += 1

    def _spoilt(self, datagram):
        data = bytearray(datagram)
        if self._options.first_time is not None:
            stamp = int.from_bytes(data[4:8], "big")
            if self._shift is None:
                self._shift = self._options.first_time - stamp
            data[4:8] = ((stamp + self._shift) % 2**32).to_bytes(4, "big")
        if self.loses and self._random.random() < self._options.damage and len(data) > 100:
            self.n_damaged += 1
            for _ in range(8):
                data[self._random.randrange(20, len(data))] ^= 1 << self._random.randrange(8)
        return bytes(data)


class Muxer:
    """FFmpeg's packing into RTP or MPEG-TS; or none."""

    def __init__(self, kind, push, head, ssrc):
        self._kind, self._push, self._written = kind, push, []
        if kind == "bare":
            return
        if kind == "rtp":
            options = {"payload_type": "96", "ssrc": str(ssrc), "packetsize": "1200"}
        else:
            options = {"flush_packets": "1"}
        self._container = av.open(self, "w", format=kind, options=options)
        self._stream = self._container.add_stream("libx264", rate=head["fps"])
        self._stream.width, self._stream.height = head["size"]
        self._stream.pix_fmt = "yuv420p"
        self._fps = head["fps"]

    def write(self, data):
        """Take what FFmpeg writes: one packet of RTP, or any number of those of MPEG-TS."""
        self._written.append(bytes(data))
        return len(data)

    def send(self, i, data, *, is_key):
        if self._kind == "bare":
            self._written.append(data)
        else:
            packet = av.Packet(data)
            packet.pts = packet.dts = i
            packet.time_base = Fraction(1, self._fps)
            packet.stream = self._stream
            packet.is_keyframe = is_key
            self._container.mux(packet)
        self._push_written()

    def close(self):
        if self._kind != "bare":
            self._container.close()
            self._push_written()

    def _push_written(self):
        written, self._written = self._written, []
        if self._kind == "rtp":
            # RTCP has a port of its own.
            datagrams = [data for data in written if not 200 <= data[1] <= 211]
        else:
            size, data = TS_DATAGRAM if self._kind == "mpegts" else 1400, b"".join(written)
            datagrams = [data[at : at + size] for at in range(0, len(data), size)]
        for datagram in datagrams:
            self._push(datagram)


def send_clips(options, send):
    """Send the clips one after the other, no faster than in real time."""
    relay = Relay(send, options)
    n_frames, began = 0, time.monotonic()
    first = began
    for repeat in range(options.repeat):
        for path in options.clips:
            head, pictures = read_clip(Path(path))
            if n_frames == 0 or len(options.clips) > 1:
                muxer = Muxer(options.kind, relay.push, head, options.ssrc + repeat)
            for i, data in in_order(pictures, options.again):
                if n_frames in options.hold:
                    held = time.monotonic()
                    sys.stdin.readline()
                    began += time.monotonic() - held
                relay.loses = n_frames < options.sound_from
                due = began + n_frames / (head["fps"] * options.speed)
                time.sleep(max(0.0, due - time.monotonic()))
                muxer.send(n_frames, data, is_key=i == 0)
                n_frames += 1
    muxer.close()
    return {
        "began": first,
        "frames": n_frames,
        "packets": relay.n_sent,
        "lost": relay.n_lost,
        "damaged": relay.n_damaged,
    }


def in_order(pictures, n_again):
    """Give the pictures with their numbers; before, the first ones until there is a line of input.

    So a test can wait for what comes of the first ones, however long that takes.
    """
    while n_again and not select.select([sys.stdin], [], [], 0.0)[0]:
        yield from enumerate(pictures[:n_again])
    yield from enumerate(pictures)


@contextlib.contextmanager
def to_port(port):
    """Give what sends a datagram to a port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as outlet:
        n_sent = 0

        def send(datagram):
            nonlocal n_sent
            if n_sent % LOOK_EVERY == 0:
                while waiting_bytes(port) > MAX_WAITING_BYTES:
                    time.sleep(0.005)
            n_sent += 1
            with contextlib.suppress(ConnectionRefusedError):
                outlet.sendto(datagram, (LOOPBACK, port))

        yield send


def waiting_bytes(port):
    """What the receiver has not taken yet, where the system tells it."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
            _, local, _, _, queues, *_ = line.split()
            if int(local.partition(":")[2], 16) == port:
                return int(queues.partition(":")[2], 16)
    return 0


class RtspServer:
    """The least of RTSP (RFC 2326): one client at a time, RTP interleaved in its connection."""

    def __init__(self, options):
        self._options = options
        self._listener = socket.create_server((LOOPBACK, options.port))

    def serve(self):
        connection, _ = self._listener.accept()
        with connection, connection.makefile("rb") as lines:
            while self._answer(connection, lines) != "PLAY":
                pass
            return send_clips(self._options, self._interleaved(connection))

    def _answer(self, connection, lines):
        method = lines.readline().split()[0].decode()
        fields = {}
        while line := lines.readline().strip():
            key, _, value = line.decode().partition(":")
            fields[key.lower()] = value.strip()
        extra, body = {}, ""
        if method == "OPTIONS":
            extra["Public"] = "OPTIONS, DESCRIBE, SETUP, PLAY, TEARDOWN"
        elif method == "DESCRIBE":
            body = (
                "v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=test\r\nt=0 0\r\n"
                "m=video 0 RTP/AVP 96\r\na=rtpmap:96 H264/90000\r\n"
                "a=fmtp:96 packetization-mode=1\r\na=control:track1\r\n"
            )
            extra["Content-Type"] = "application/sdp"
        elif method == "SETUP":
            extra["Transport"] = "RTP/AVP/TCP;unicast;interleaved=0-1"
        answer = f"RTSP/1.0 200 OK\r\nCSeq: {fields['cseq']}\r\nSession: 1\r\n"
        answer += "".join(f"{k}: {v}\r\n" for k, v in extra.items())
        connection.sendall(f"{answer}Content-Length: {len(body)}\r\n\r\n{body}".encode())
        return method

    def _interleaved(self, connection):
        def send(datagram):
            channel = 1 if 200 <= datagram[1] <= 211 else 0
            with contextlib.suppress(OSError):
                connection.sendall(struct.pack("!BBH", 0x24, channel, len(datagram)) + datagram)

        return send


def parse_options(arguments=None):
    parser = argparse.ArgumentParser()
    parser.add_argument("clips", nargs="+")
    parser.add_argument("--kind", choices=("rtp", "mpegts", "bare"), default="rtp")
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--rtsp", action="store_true", help="serve on the port, do not send to it")
    parser.add_argument("--repeat", type=int, default=1)
    parser.add_argument("--again", type=int, default=0, help="so many first, until a line of input")
    parser.add_argument("--speed", type=float, default=1.0)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--damage", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ssrc", type=int, default=1000)
    parser.add_argument("--first-time", type=int, default=None, help="of RTP, 32 bits")
    parser.add_argument("--sound-from", type=int, default=10**9, help="no loss from this frame on")
    parser.add_argument(
        "--hold", type=int, nargs="*", default=[], help="before these frames, for a line of input"
    )
    return parser.parse_args(arguments)


def words_of(clips, port, options):
    """Return the words of a command line; an option that is True is a switch."""
    words = [*map(str, clips), "--port", str(port)]
    for name, value in options.items():
        words.append("--" + name.replace("_", "-"))
        words += [] if value is True else [str(value)]
    return words


def send_here(*clips, port, **options):
    """Send clips from this process and return what the program would print."""
    asked = parse_options(words_of(clips, port, options))
    with to_port(port) as send:
        return send_clips(asked, send)


def main():
    options = parse_options()
    if options.rtsp:
        server = RtspServer(options)
        print("ready", flush=True)
        print(json.dumps(server.serve()), flush=True)
    else:
        print("ready", flush=True)
        with to_port(options.port) as send:
            print(json.dumps(send_clips(options, send)), flush=True)


if __name__ == "__main__":
    main()
