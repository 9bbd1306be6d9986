"""Images and folders of them: what arrives is what was written, and what is missing is said."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from aqualvs.calibrate.common import read_grey
from aqualvs.errors import CalibrationError, SourceError
from aqualvs.scanning.scan import planes_of_image
from aqualvs.sources import ImageSource, open_source
from aqualvs.sources.images import read_image
from shell_cases import grain, luma_level, picture

SMALL = (96, 64)


def write_images(folder, names, size=SMALL):
    for i, name in enumerate(names):
        cv2.imwrite(str(folder / name), picture(i, size))


def test_images_come_in_natural_order(tmp_path):
    names = ["img1.png", "img2.png", "img10.png", "img21.png"]
    write_images(tmp_path, names)
    (tmp_path / "notes.txt").write_text("not an image")
    with open_source(tmp_path, fps=10.0) as source:
        assert (source.n_frames, source.size_px, source.fps) == (4, SMALL, 10.0)
        frames = list(source)
    assert [f.index for f in frames] == [0, 1, 2, 3]
    assert [f.time_s for f in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    for i, frame in enumerate(frames):
        assert frame.luma.mean() == pytest.approx(luma_level(i), abs=1.0)


def test_hidden_files_are_no_images(tmp_path):
    """macOS puts one beside each file on the disks of other systems."""
    (tmp_path / "._a.png").write_bytes(b"\x00\x05\x16\x07")
    with pytest.raises(SourceError, match="no images in this folder"):
        open_source(tmp_path)
    write_images(tmp_path, ["a.png"])
    with open_source(tmp_path) as source:
        assert [f.index for f in source] == [0]


def test_one_image_is_a_source(tmp_path):
    write_images(tmp_path, ["a.png"])
    with open_source(tmp_path / "a.png") as source:
        assert [f.index for f in source] == [0]


def test_an_image_is_read_as_the_sensor_read_it_out(tmp_path):
    """A camera that hangs upside down may say so; its video is not turned either."""
    image = np.repeat(np.arange(0, 240, 2, np.uint8)[:, None], 80, axis=1)
    exif = Image.Exif()
    exif[0x0112] = 3  # Orientation: turned by 180 degrees.
    Image.fromarray(image).save(tmp_path / "upside_down.jpg", exif=exif, quality=95)
    with open_source(tmp_path) as source:
        (frame,) = source
    assert frame.luma[:20].mean() < 40 < 200 < frame.luma[-20:].mean()
    for how in (cv2.IMREAD_GRAYSCALE, cv2.IMREAD_COLOR):
        assert read_image(tmp_path / "upside_down.jpg", how)[0, 0].max() < 20


@pytest.mark.parametrize("size", [(6, 4), (7, 5), (7, 4), (6, 5)])
def test_colour_images_become_420_with_rounded_up_chroma(size):
    image = np.random.default_rng(5).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)
    luma, chroma = planes_of_image(image)
    assert luma.shape == (size[1], size[0])
    assert chroma[0].shape == chroma[1].shape == (-(-size[1] // 2), -(-size[0] // 2))
    weights = np.array([24.966, 128.553, 65.481]) / 255  # BT.601 of B, G, R
    # Integer arithmetic inside OpenCV rounds to a grey level.
    np.testing.assert_allclose(luma, 16 + image @ weights, atol=1.0)
    rows, columns = (2 * side for side in chroma[0].shape)
    even = np.pad(image, ((0, rows - size[1]), (0, columns - size[0]), (0, 0)), mode="edge")
    mean = even.reshape(rows // 2, 2, columns // 2, 2, 3).mean(axis=(1, 3))
    for plane, of in zip(
        chroma, ((112.0, -74.203, -37.797), (-18.214, -93.786, 112.0)), strict=True
    ):
        # The mean is rounded, and what is made of it.
        np.testing.assert_allclose(plane, 128.0 + mean @ np.array(of) / 255.0, atol=1.01)


def test_an_unreadable_image_leaves_a_gap_and_is_named_at_the_end(tmp_path, capfd):
    write_images(tmp_path, ["a1.png", "a2.png", "a3.png"])
    (tmp_path / "a2.png").write_bytes(b"broken")
    with open_source(tmp_path) as source:
        assert [f.index for f in source] == [0, 2]
    (tmp_path / "a3.png").write_bytes(b"broken")
    with open_source(tmp_path) as source, pytest.raises(SourceError, match=r"a3\.png"):
        list(source)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_that_is_cut_short_is_no_image(tmp_path, progressive):
    """Decoders fill what is missing with grey; what follows the end is none of theirs."""
    thumbnail = io.BytesIO()
    Image.fromarray(grain(9, (40, 30))).save(thumbnail, "jpeg")
    for i in range(5):
        Image.fromarray(grain(i, (320, 240))).save(
            tmp_path / f"{i}.jpg", progressive=progressive, comment=thumbnail.getvalue()
        )
    for i, share in ((1, 0.5), (2, 0.9)):
        data = (tmp_path / f"{i}.jpg").read_bytes()
        (tmp_path / f"{i}.jpg").write_bytes(data[: int(share * len(data))])
    with (tmp_path / "3.jpg").open("ab") as file:
        file.write(bytes(100_000))
    with open_source(tmp_path) as source:
        assert [f.index for f in source] == [0, 3, 4]
    with pytest.raises(SourceError, match=r"1\.jpg: not a readable image, cut short"):
        open_source(tmp_path / "1.jpg")


def test_images_of_two_sizes_are_refused(tmp_path):
    write_images(tmp_path, ["a1.png"])
    write_images(tmp_path, ["a2.png"], size=(32, 32))
    with open_source(tmp_path) as source, pytest.raises(SourceError, match="32x32 px"):
        list(source)


def test_a_list_of_images_keeps_its_order(tmp_path):
    write_images(tmp_path, ["b.png", "a.png"])
    with ImageSource([tmp_path / "b.png", tmp_path / "a.png"]) as source:
        means = [f.luma.mean() for f in source]
    assert means == pytest.approx([luma_level(0), luma_level(1)], abs=1.0)


def huge_png(path, side=60_000):
    """A file of a few bytes that claims a picture of gigabytes."""
    head = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    parts = ((b"IHDR", head), (b"IDAT", zlib.compress(bytes(100_000))), (b"IEND", b""))
    chunks = [
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in parts
    ]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(chunks))


def test_a_huge_picture_is_refused_and_those_before_it_kept(tmp_path):
    huge_png(tmp_path / "img9.png")
    with pytest.raises(SourceError, match=r"img9\.png: .* image, cut short, or too large"):
        open_source(tmp_path)
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"img{i}.png"), picture(i, (64, 48)))
    delivered = []
    with open_source(tmp_path) as source, pytest.raises(SourceError, match="too large"):
        delivered.extend(source)
    assert len(delivered) == 3


def test_one_image_is_called_by_its_path(tmp_path):
    """Reports open the source by its name."""
    write_images(tmp_path, ["a.png", "b.png"])
    with open_source(tmp_path / "a.png") as source:
        assert source.name == str(tmp_path / "a.png")


def write_stack(path, *sizes):
    first, *others = [Image.fromarray(np.zeros((h, w, 3), np.uint8)) for w, h in sizes]
    first.save(path, save_all=True, append_images=others)


def test_several_pictures_in_a_tiff_file_are_refused(tmp_path):
    write_stack(tmp_path / "2.tif", (40, 30), (40, 30), (40, 30))
    with pytest.raises(SourceError, match=r"2\.tif: holds 3 pictures, of which only the first"):
        open_source(tmp_path / "2.tif")
    write_stack(tmp_path / "1.tif", (40, 30))
    with open_source(tmp_path) as source, pytest.raises(SourceError, match="holds 3 pictures"):
        list(source)
    with pytest.raises(CalibrationError, match=r"2\.tif: holds 3 pictures"):
        read_grey(tmp_path / "2.tif")


def test_a_thumbnail_in_a_tiff_file_is_no_picture(tmp_path):
    write_stack(tmp_path / "a.tif", (40, 30), (8, 6))
    with open_source(tmp_path / "a.tif") as source:
        assert len(list(source)) == 1
