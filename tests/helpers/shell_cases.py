"""Small videos, scans and a stand-in scanner for the tests of the application shell."""

from pathlib import Path

import av
import cv2
import numpy as np
from av.video.frame import VideoFrame

from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import save_rig
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Frame, Scan, ScanPoints
from aqualvs.simulation.scenarios import example_rig

SIZE = (720, 576)
"""Width and height of `example_rig`."""


def rig_file(folder: Path) -> Path:
    path = folder / "rig.yaml"
    save_rig(example_rig(), path)
    return path


def picture(i, size=SIZE):
    """A BGR picture whose grey level tells its number."""
    return np.full((size[1], size[0], 3), grey(i), np.uint8)


def grain(i, size=SIZE):
    """A BGR picture of coarse noise, so that its packet is not tiny."""
    rng = np.random.default_rng(i)
    coarse = rng.integers(0, 256, (size[1] // 4, size[0] // 4, 3), dtype=np.uint8)
    return cv2.resize(coarse, size)


def grey(i):
    return (16 + 12 * i) % 240


def luma_level(i):
    """Luma of `picture(i)` in limited range (BT.601)."""
    return 16 + grey(i) * 219 / 255


def write_video(
    path,
    n_frames=8,
    *,
    size=SIZE,
    codec="libx264",
    pix_fmt="yuv420p",
    options=None,
    mux=None,
    content=picture,
):
    """Encode `n_frames` pictures of `content(i, size)`; returns the path."""
    with av.open(str(path), "w", options=mux or {}) as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height = size
        stream.pix_fmt = pix_fmt
        stream.options = {"preset": "ultrafast"} if options is None else options
        for i in range(n_frames):
            frame = VideoFrame.from_ndarray(content(i, size), format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def all_key_frames(path, n_frames=8, **more):
    """A video in which no picture depends on another and the index comes first."""
    options = {"preset": "ultrafast", "g": "1"}
    return write_video(path, n_frames, options=options, mux={"movflags": "faststart"}, **more)


def packets(path):
    """Position and size in the file of every packet, in file order."""
    with av.open(str(path)) as container:
        return [(p.pos, p.size) for p in container.demux(video=0) if p.size]


def destroy_frame(path, i):
    """Zero the content of packet `i`, all but its length field."""
    position, size = packets(path)[i]
    data = bytearray(path.read_bytes())
    data[position + 4 : position + size] = bytes(size - 4)
    path.write_bytes(data)


def damage_frame(path, i):
    """Overwrite 40 bytes in the middle of packet `i`, which the decoder patches up."""
    position, size = packets(path)[i]
    start = position + size // 2
    data = bytearray(path.read_bytes())
    data[start : start + 40] = np.random.default_rng(0).integers(1, 256, 40, np.uint8).tobytes()
    path.write_bytes(data)


def cut_after(path, n_packets):
    """Cut a video in the middle of packet number `n_packets`."""
    position, size = packets(path)[n_packets]
    path.write_bytes(path.read_bytes()[: position + size // 2])


def wall_picture(rig: Rig, distance=0.5):
    """What the lasers draw on a wall square to the forward axis: a dark BGR picture with lines."""
    image = np.full((rig.size_px[1], rig.size_px[0], 3), 20, np.uint8)
    for laser in rig.lasers:
        a, b, c = laser.plane.normal
        along = np.array([c, 0.0, -a]) / np.hypot(a, c)
        foot = np.array([a, 0.0, c]) * (laser.plane.offset - b * distance) / (a * a + c * c)
        reach = np.linspace(-0.6, 0.6, 4000)[:, None]
        pixels, valid = rig.camera().project(foot + [0.0, distance, 0.0] + reach * along)
        spots = np.round(pixels[valid & rig.camera().inside_image(pixels)]).astype(int)
        image[spots[:, 1], spots[:, 0]] = (60, 255, 60)
    return cv2.GaussianBlur(cv2.dilate(image, np.ones((3, 3))), (0, 0), 1.2)


def scan(index=0, n=60, *, time_s=None, reason=None, seed=0):
    """A scan with `n` points, valid unless a reason is given."""
    rng = np.random.default_rng([seed, index])
    posture = Refusal(reason) if reason else posture_at(0.5 + 0.01 * index)
    points = ScanPoints(
        laser=np.sort(rng.integers(0, 3, n)).astype(np.int8),
        pixels=rng.uniform(0, 700, (n, 2)),
        points_in_dome=rng.uniform(0.3, 1.0, (n, 3)),
        sigma=rng.uniform(1e-4, 1e-3, n),
        intensity=rng.uniform(10, 200, n),
        width=rng.uniform(1, 5, n),
        quality=rng.uniform(0, 1, n),
        label=rng.integers(0, 5, n).astype(np.uint8),
        used=rng.random(n) < 0.5,
    )
    return Scan(index, index / 25 if time_s is None else time_s, posture, points, 1.3333)


def posture_at(distance):
    return Posture(
        range=distance,
        pitch=np.deg2rad(3.0),
        yaw=np.deg2rad(-7.0),
        covariance=np.diag([1e-3, 2e-3, 3e-3]) ** 2,
        normal_in_dome=np.array([0.0, 1.0, 0.0]),
        slant_range=distance + 0.01,
        nearest=distance - 0.01,
        n_points=60,
        rms=1e-3,
    )


class LumaScanner:
    """Stand-in for `Scanner`: range in metres is the mean luma over 100, yaw and pitch fixed.

    Frames darker than `dark` are refused. `after` is called with every frame.
    """

    def __init__(self, *, dark=0.0, after=None):
        self.dark = dark
        self.after = after

    def __call__(self, *_rig_and_options):
        return self

    def process(self, frame: Frame) -> Scan:
        made = scan(frame.index, time_s=frame.time_s)
        level = float(frame.luma.mean())
        if self.after is not None:
            self.after(frame)
        refused = level < self.dark
        posture = Refusal(Reason.NO_STRIPES) if refused else posture_at(level / 100)
        return Scan(frame.index, frame.time_s, posture, made.points, 1.3333)
