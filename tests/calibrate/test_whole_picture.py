"""Stripes in a whole picture, with no laser known."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from aqualvs.calibrate import uncalibrated_stripes
from aqualvs.calibrate.uncalibrated_stripes import StripePixels, find_stripes
from aqualvs.scanning.scan import Frame

SIZE = (360, 240)


def picture(
    *lines: tuple[float, float, float], width: float = 4.0, green: float = 170.0, noise: float = 1.5
) -> NDArray[np.uint8]:
    """BGR of a grey wall with green lines n_x x + n_y y = c, one (n_x, n_y, c) each."""
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    light = np.zeros(x.shape)
    for n_x, n_y, c in lines:
        off = (n_x * x + n_y * y - c) / np.hypot(n_x, n_y)
        light += np.exp(-0.5 * (off / (width / 2.355)) ** 2)
    rng = np.random.default_rng(3)
    image = 60.0 + noise * rng.standard_normal((*x.shape, 3))
    image[..., 1] += green * light
    image[..., [0, 2]] += 0.15 * green * light[..., None]
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def distances(found: StripePixels, line: tuple[float, float, float]) -> NDArray[np.float64]:
    n_x, n_y, c = line
    off: NDArray[np.float64] = (found.pixels @ [n_x, n_y] - c) / np.hypot(n_x, n_y)
    return off


@pytest.mark.parametrize(
    "line",
    [
        (0.0, 1.0, 100.3),
        (1.0, 0.0, 150.7),
        (1.0, 1.0, 300.2),
        (1.0, -1.02, 40.0),
        (0.3, 1.0, 160.0),
    ],
    ids=["level", "upright", "falling", "rising", "slanted"],
)
def test_a_line_is_found_all_along_and_to_a_fraction_of_a_pixel(
    line: tuple[float, float, float],
) -> None:
    found = find_stripes(picture(line))
    off = distances(found, line)
    # Noise of 1.5 grey levels on a height of 120 moves a centre by hundredths of a pixel.
    assert np.sqrt(np.mean(off**2)) < 0.05
    normal = np.array(line[:2]) / np.hypot(*line[:2])
    # The slope comes from 13 returns, each a hundredth of a pixel off.
    assert np.min(np.abs(found.across @ normal)) > 0.999
    length = np.hypot(*np.ptp(found.pixels, axis=0))
    assert len(found) > 0.6 * length
    assert np.median(found.width) == pytest.approx(4.0, abs=0.3)


def test_each_piece_is_searched_along_one_axis_only() -> None:
    found = find_stripes(picture((0.0, 1.0, 60.0), (1.0, 0.02, 200.0)))
    level = np.abs(distances(found, (0.0, 1.0, 60.0))) < 1.0
    upright = np.abs(distances(found, (1.0, 0.02, 200.0))) < 1.0
    assert len(np.unique(found.pixels[level, 0])) == np.count_nonzero(level)
    assert len(np.unique(found.pixels[upright, 1])) == np.count_nonzero(upright)
    # Points pulled by the crossing aside, everything is on one of the two.
    assert np.mean(level | upright) > 0.97


def test_white_edges_and_stripes_of_paint_are_no_laser() -> None:
    image = picture((0.0, 1.0, 100.0))
    image[150:156, 40:300] = 200
    image[170:220, 60:120] = 220
    found = find_stripes(image)
    assert np.all(np.abs(distances(found, (0.0, 1.0, 100.0))) < 2.0)


def test_a_piece_must_be_likely_to_be_laser_light(monkeypatch: pytest.MonkeyPatch) -> None:
    line = (0.0, 1.0, 200.0)
    image = picture(line, noise=0.5)
    image[100:104, 40:300] = (100, 103, 100)
    assert np.all(np.abs(distances(find_stripes(image), line)) < 2.0)
    # Paint that is less green than the line beside it.
    image[100:104, 40:300] = (100, 118, 100)
    paint = []
    for likelihood in (0.3, 0.99):
        monkeypatch.setattr(uncalibrated_stripes, "_MIN_LIKELIHOOD", likelihood)
        paint.append(np.count_nonzero(np.abs(distances(find_stripes(image), line)) > 2.0))
    assert paint[0] > 200
    assert paint[1] == 0


def test_in_a_grey_picture_every_thin_line_counts() -> None:
    image = picture((0.0, 1.0, 100.0))[..., 1].copy()
    image[150:154, 40:300] = 200
    found = find_stripes(image)
    assert np.any(np.abs(found.pixels[:, 1] - 100.0) < 1.0)
    assert np.any(np.abs(found.pixels[:, 1] - 151.5) < 1.0)


def test_dots_and_blobs_are_left_out() -> None:
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    image = picture((1.0, 0.0, 250.0)).astype(np.float64)
    dot = np.exp(-0.5 * ((x - 80) ** 2 + (y - 90) ** 2) / 6.0**2)
    image[..., 1] += 180.0 * dot
    found = find_stripes(np.clip(image, 0, 255).astype(np.uint8))
    assert np.all(np.abs(distances(found, (1.0, 0.0, 250.0))) < 2.0)


def test_thin_faint_lines_of_a_wide_picture_are_found() -> None:
    rng = np.random.default_rng(4)
    image = 120.0 + 2.0 * rng.standard_normal((400, 1600, 3))
    at = 300.0 + 40.3 * np.arange(15)
    x = np.arange(1600)
    light = sum(np.exp(-0.5 * ((x - place) / 0.8) ** 2) for place in at)
    image += np.asarray(light)[None, :, None] * np.array([16.0, 26.0, 4.0])
    found = find_stripes(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    nearest = np.argmin(np.abs(found.pixels[:, :1] - at), axis=1)
    counts = np.bincount(nearest, minlength=15)
    # Half of what there is, and a search line is two rows.
    assert np.all(counts > 100)
    good = np.abs(found.pixels[:, 0] - at[nearest]) < 2.0
    assert np.mean(good) > 0.97
    for i in range(15):
        # Light of 20 grey levels, a pixel or two wide: eight bits alone pull it by some hundredths.
        mean = np.mean(found.pixels[good & (nearest == i), 0])
        assert mean == pytest.approx(at[i], abs=0.1)


def test_paint_beside_a_stripe_is_told_by_sigma() -> None:
    image = picture((0.0, 1.0, 100.0))
    image[101:, 100:200] = np.minimum(image[101:, 100:200].astype(int) + 80, 255)
    found = find_stripes(image)
    beside = (found.pixels[:, 0] > 110) & (found.pixels[:, 0] < 190)
    clear = found.pixels[:, 0] < 90
    assert np.median(found.sigma_px[beside]) > 2.0 * np.median(found.sigma_px[clear])


def test_a_frame_of_a_video_does_as_well() -> None:
    image = picture((0.0, 1.0, 100.0))
    height, width = image.shape[:2]
    blue, green, red = (image[..., i].astype(np.float64) for i in range(3))
    luma = 0.299 * red + 0.587 * green + 0.114 * blue

    def halved(values: NDArray[np.float64]) -> NDArray[np.uint8]:
        blocks = values.reshape(height // 2, 2, width // 2, 2).mean(axis=(1, 3))
        return np.clip(np.rint(blocks), 0, 255).astype(np.uint8)

    chroma = halved(128 + 0.564 * (blue - luma)), halved(128 + 0.713 * (red - luma))
    frame = Frame(0, 0.0, np.rint(luma).astype(np.uint8), chroma)
    off = distances(find_stripes(frame), (0.0, 1.0, 100.0))
    assert len(off) > 0.9 * width
    assert np.sqrt(np.mean(off**2)) < 0.1


def test_nothing_in_nothing() -> None:
    found = find_stripes(picture())
    assert len(found) == 0
    assert found.pixels.shape == (0, 2)


def test_a_piece_must_be_long(monkeypatch: pytest.MonkeyPatch) -> None:
    image = picture((0.0, 1.0, 100.0))
    image[:, :200] = picture()[:, :200]
    image[:, 280:] = picture()[:, 280:]
    assert len(find_stripes(image)) > 60
    # 80 px of 360.
    monkeypatch.setattr(uncalibrated_stripes, "_MIN_LENGTH_SHARE", 0.25)
    assert len(find_stripes(image)) == 0


def test_a_bright_stripe_without_colour_is_no_laser() -> None:
    """A highlight on steel is thin, long and straight, but white."""
    image = picture(noise=2.0)
    image[150:154, 40:300] = 200
    assert len(find_stripes(image)) == 0


def test_a_line_broken_by_dark_squares_is_found_in_its_pieces() -> None:
    image = picture((0.0, 1.0, 100.0))
    dark = picture(noise=1.5) // 6
    for first in range(0, SIZE[0], 72):
        image[:, first : first + 36] = dark[:, first : first + 36]
    found = find_stripes(image)
    assert np.all(np.abs(distances(found, (0.0, 1.0, 100.0))) < 2.0)
    assert len(found) > 0.9 * 0.5 * SIZE[0]


def test_short_dashes_without_a_certain_line_are_left_out() -> None:
    image = picture((0.0, 1.0, 100.0))
    for first in range(0, SIZE[0], 72):
        image[:, first : first + 58] = picture()[:, first : first + 58]
    assert len(find_stripes(image)) == 0


# Channels as OpenCV has them (blue, green, red) of which two change places.
@pytest.mark.parametrize(("wavelength", "channels"), [(450.0, [1, 0, 2]), (650.0, [0, 2, 1])])
def test_a_line_of_another_wavelength(wavelength: float, channels: list[int]) -> None:
    line = (0.3, 1.0, 160.0)
    image = np.ascontiguousarray(picture(line)[..., channels])
    off = distances(find_stripes(image, wavelength), line)
    # Chroma, of half the size, makes half of what is searched, with its noise.
    assert np.sqrt(np.mean(off**2)) < 0.1
    assert len(off) > 0.6 * SIZE[0]
    assert len(find_stripes(image)) == 0


def blurred_red(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return a picture of a red line with chroma as coarse as a codec can make it."""
    luma, *chroma = cv2.split(cv2.cvtColor(image, cv2.COLOR_BGR2YCrCb))
    coarse = [cv2.blur(plane, (17, 17)) for plane in chroma]
    return np.asarray(cv2.cvtColor(cv2.merge([luma, *coarse]), cv2.COLOR_YCrCb2BGR), np.uint8)


def test_a_thin_line_is_known_by_the_colour_beside_it() -> None:
    """Half of it shows its own colour, the other half what a codec has left of that."""
    line, half = (0.0, 1.0, 100.3), SIZE[0] // 2
    image = np.ascontiguousarray(picture(line, width=2.0, green=110.0)[..., [0, 2, 1]])
    image[:, half:] = blurred_red(image)[:, half:]
    found = find_stripes(image, 650.0)
    assert np.all(np.abs(distances(found, line)) < 1.0)
    assert np.count_nonzero(found.pixels[:, 0] > half + 8) > 0.95 * (half - 8)


def test_what_continues_a_line_faintly_does_not_hide_it() -> None:
    """A seam without colour, a ninth as bright, goes on where a short line ends."""
    line, end = (0.0, 1.0, 60.0), 80
    image = picture((0.0, 1.0, 160.0), line)
    seam = picture(noise=1.5)
    seam[59:62] += 12
    image[30:90, end:] = seam[30:90, end:]
    found = find_stripes(image)
    on_line = np.abs(distances(found, line)) < 1.0
    assert np.count_nonzero(on_line & (found.pixels[:, 0] < end)) > 0.9 * end
    assert np.count_nonzero(on_line & (found.pixels[:, 0] > end + 10)) < 0.1 * (SIZE[0] - end)


def test_a_wide_stretch_of_a_line_is_no_dot() -> None:
    line = (0.0, 1.0, 100.0)
    image = picture(line)
    image[:, 150:220] = picture(line, width=12.0)[:, 150:220]
    found = find_stripes(image)
    wide = (found.pixels[:, 0] > 155) & (found.pixels[:, 0] < 215)
    assert np.count_nonzero(wide & (np.abs(distances(found, line)) < 1.0)) > 50


def test_a_line_thinner_than_two_pixels_has_no_dots() -> None:
    """Its measured width doubles where it lies between two pixels."""
    line = (0.1, 1.0, 100.0)
    found = find_stripes(picture(line, width=0.8, noise=0.5))
    assert np.max(np.abs(distances(found, line))) < 0.5
    assert len(np.unique(found.pixels[:, 0])) > 0.99 * SIZE[0]
