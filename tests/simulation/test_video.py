"""Video files."""

import av
import cv2
import numpy as np
import pytest

from aqualvs.errors import OptionError, OutputError
from aqualvs.simulation.video import Compression, VideoWriter, jpeg


def _frames(n=5, size=(64, 48)):
    """Smooth pictures that change from frame to frame."""
    y, x = np.mgrid[: size[1], : size[0]]
    return [
        np.stack([3 * x + 5 * i, 4 * y, 2 * x + 2 * y], axis=-1).clip(0, 255).astype(np.uint8)
        for i in range(n)
    ]


def _read(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = list(container.decode(stream))
        return stream.codec_context.pix_fmt, frames


def test_lossless_gives_back_every_value(tmp_path):
    path, frames = tmp_path / "a.mp4", _frames()
    with VideoWriter(path, (64, 48), 25.0, Compression(codec="lossless")) as writer:
        for frame in frames:
            writer.write(frame)
    _, read = _read(path)
    assert len(read) == len(frames)
    for expected, frame in zip(frames, read, strict=True):
        assert np.array_equal(frame.to_ndarray(format="rgb24"), expected)


def test_h264_is_420_with_the_right_clock(tmp_path):
    path, frames = tmp_path / "a.mp4", _frames()
    with VideoWriter(path, (64, 48), 29.97) as writer:
        for frame in frames:
            writer.write(frame)
    pixel_format, read = _read(path)
    assert pixel_format == "yuv420p"
    assert [frame.time for frame in read] == pytest.approx(np.arange(5) / 29.97, abs=2e-4)
    for expected, frame in zip(frames, read, strict=True):
        # H.264 at crf 20 on a smooth picture.
        error = frame.to_ndarray(format="rgb24").astype(int) - expected
        assert np.abs(error).mean() < 4.0


def test_mjpeg_holds_every_frame_as_a_jpeg_in_full_range(tmp_path):
    path, frames = tmp_path / "a.mp4", _frames()
    with VideoWriter(path, (64, 48), 29.97, Compression(codec="mjpeg", jpeg_quality=90)) as writer:
        for frame in frames:
            writer.write(frame)
    pixel_format, read = _read(path)
    assert pixel_format == "yuvj420p"
    assert [frame.time for frame in read] == pytest.approx(np.arange(5) / 29.97, abs=2e-4)
    with av.open(str(path)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    assert packets == [jpeg(frame, 90) for frame in frames]
    for expected, frame in zip(frames, read, strict=True):
        # JPEG at quality 90 on a smooth picture.
        error = frame.to_ndarray(format="rgb24").astype(int) - expected
        assert np.abs(error).mean() < 3.0


def test_smaller_crf_or_more_bits_make_a_larger_file(tmp_path):
    rng = np.random.default_rng(0)
    frames = [rng.integers(0, 255, (96, 128, 3), dtype=np.uint8) for _ in range(4)]
    sizes = {}
    for name, options in {
        "fine": {"crf": 10},
        "coarse": {"crf": 40},
        "bits": {"bit_rate": 8_000_000},
        "few_bits": {"bit_rate": 100_000},
    }.items():
        path = tmp_path / f"{name}.mp4"
        with VideoWriter(path, (128, 96), 25.0, Compression(**options)) as writer:
            for frame in frames:
                writer.write(frame)
        sizes[name] = path.stat().st_size
    assert sizes["fine"] > 2 * sizes["coarse"]
    assert sizes["bits"] > sizes["few_bits"]


def test_the_same_pictures_give_the_same_file(tmp_path):
    """With AVX-512 and the encoder's own choice of instructions 5 of 8 files differ."""
    width, height, n_frames = 160, 120, 60
    ground = np.random.default_rng(0).integers(0, 256, (height + n_frames, 280, 3), dtype=np.uint8)
    ground, path, files = cv2.GaussianBlur(ground, (0, 0), 1.5), tmp_path / "a.mp4", set()
    for _ in range(8):
        with VideoWriter(path, (width, height), 25.0) as writer:
            for i in range(n_frames):
                writer.write(ground[i : i + height, 2 * i : 2 * i + width])
        files.add(path.read_bytes())
    assert len(files) == 1


def test_an_interrupted_file_can_be_read(tmp_path):
    path = tmp_path / "a.mp4"

    def interrupted():
        with VideoWriter(path, (64, 48), 25.0) as writer:
            for frame in _frames(3):
                writer.write(frame)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        interrupted()
    assert len(_read(path)[1]) == 3


@pytest.mark.parametrize(
    "options",
    [{"codec": "best"}, {"crf": 60}, {"bit_rate": 0}, {"jpeg_quality": 0}, {"jpeg_quality": 101}],
)
def test_senseless_compression_is_refused(options):
    with pytest.raises(OptionError):
        Compression(**options)


@pytest.mark.parametrize("options", [{"size_px": (63, 48)}, {"fps": 0.0}])
def test_senseless_options_are_refused(tmp_path, options):
    given = {"size_px": (64, 48), "fps": 25.0, **options}
    with pytest.raises(OptionError):
        VideoWriter(tmp_path / "a.mp4", **given)


@pytest.mark.parametrize(
    ("size_px", "first_field", "codec", "written"),
    [
        ((63, 48), None, "h264", "64x48"),
        ((64, 49), None, "h264", "64x50"),
        ((64, 50), "top", "h264", "64x52"),
        ((63, 48), "bottom", "h264", "64x48"),
        ((64, 50), None, "h264", None),
        ((63, 49), "top", "lossless", None),
        ((63, 49), None, "mjpeg", None),
    ],
)
def test_a_size_that_420_video_cannot_hold_is_refused_with_the_next(
    tmp_path, size_px, first_field, codec, written
):
    path, recording = tmp_path / "a.mp4", Compression(codec=codec)
    if written is not None:
        with pytest.raises(OptionError, match=rf"size is {size_px[0]}x.*; write {written}$"):
            VideoWriter(path, size_px, 25.0, recording, first_field=first_field)
        size_px = tuple(map(int, written.split("x")))
    with VideoWriter(path, size_px, 25.0, recording, first_field=first_field) as writer:
        writer.write(np.zeros((size_px[1], size_px[0], 3), np.uint8))
    assert path.stat().st_size > 0


def test_a_folder_that_does_not_exist_is_named(tmp_path):
    path = tmp_path / "none" / "a.mp4"
    with pytest.raises(OutputError, match="none"):
        VideoWriter(path, (64, 48), 25.0)
