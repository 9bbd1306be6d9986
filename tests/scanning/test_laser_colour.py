"""Colour as evidence: how likely returns of painted pictures are laser light."""

from typing import NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.detection import FrameDetector
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis
from aqualvs.scanning.laser_colour import (
    LaserColour,
    channel_image,
    expected_colour,
    laser_likelihood,
    learn_colour,
    learn_paint,
    useful_height,
)
from aqualvs.scanning.scan import Frame, planes_of_image, without_neutral_chroma
from aqualvs.scanning.stripe import N_MEASURES, StripeOptions, StripePeaks

U8 = NDArray[np.uint8]
Colour = tuple[float, float, float]
WIDTH, HEIGHT = 400, 240
# What lines add to red, green and blue, for each level of their height: the rendered ones, a
# webcam with white balance, two action cameras. Measured on photographs of green lines.
CAMERAS: dict[str, Colour] = {
    "rendered": (0.05, 1.0, 0.1),
    "crosstalk": (0.07, 1.0, 0.7),
    "strong crosstalk": (0.3, 1.0, 0.6),
    "white balance": (-0.4, 1.0, 0.5),
}
# Of pure light through a camera's filters, by wavelength.
LIGHTS: dict[float, Colour] = {
    445.0: (0.1, 0.15, 1.0),
    520.0: (0.05, 1.0, 0.3),
    532.0: (0.1, 1.0, 0.15),
    635.0: (1.0, 0.25, 0.1),
    660.0: (1.0, 0.1, 0.1),
}


class Bar(NamedTuple):
    """A bright bar, level at y; of Gaussian profile, with this added to red, green and blue."""

    y: float
    rgb: Colour
    height: float = 80.0
    sigma: float = 1.8


def picture(
    *bars: Bar, ground: Colour = (90.0, 90.0, 90.0), noise: float = 2.0, gains: Colour = (1, 1, 1)
) -> U8:
    """BGR of bars on a ground, by a camera with noise and these gains of red, green and blue."""
    rows = np.arange(HEIGHT)[:, None, None]
    image = np.broadcast_to(np.array(ground), (HEIGHT, WIDTH, 3)).copy()
    for bar in bars:
        light = np.exp(-0.5 * ((rows - bar.y) / bar.sigma) ** 2)
        image += bar.height * light * np.array(bar.rgb)
    image *= np.array(gains)
    image += noise * np.random.default_rng(5).standard_normal(image.shape)
    return np.clip(np.rint(image[..., ::-1]), 0, 255).astype(np.uint8)


def detect(image: U8, wavelength: float = 532.0, *, min_likelihood: float = 0.0) -> StripePeaks:
    """All returns of a picture, however likely."""
    frame = Frame(0, 0.0, *planes_of_image(image))
    return detect_in(frame, wavelength, min_likelihood=min_likelihood)


def detect_in(
    frame: Frame, wavelength: float = 532.0, *, min_likelihood: float = 0.0
) -> StripePeaks:
    free = np.zeros((-(-HEIGHT // 8), -(-WIDTH // 8)))
    search = LaserBand(
        SearchAxis.ALONG_Y,
        1,
        np.zeros(WIDTH, np.int64),
        np.full(WIDTH, HEIGHT - 1),
        free - 5.0,
        free + 5.0,
        LaserColour.of(wavelength),
    )
    options = StripeOptions(reach_share=0.06, min_likelihood=min_likelihood, min_share=0.0)
    return FrameDetector((WIDTH, HEIGHT), [search], options).detect(frame)[SearchAxis.ALONG_Y]


def likelihood_at(found: StripePeaks, y: float) -> FloatArray:
    """Likelihoods of the returns on the bar at y; there is one on nearly every search line."""
    there: FloatArray = found.likelihood[np.abs(found.position - y) < 1.5]
    assert len(there) > 0.95 * WIDTH
    return there


@pytest.mark.parametrize("rgb", CAMERAS.values(), ids=CAMERAS)
@pytest.mark.parametrize("height", [40.0, 80.0, 150.0])
def test_lines_of_many_cameras_are_likely_laser_light(rgb: Colour, height: float) -> None:
    found = detect(picture(Bar(120.0, rgb, height)))
    assert np.mean(likelihood_at(found, 120.0)) > 0.9


def test_noise_is_not() -> None:
    # A camera whose noise is coloured: thousands of peaks, of which few look green by chance.
    found = detect(picture(noise=8.0))
    assert np.count_nonzero(found.likelihood > 0.5) < 0.05 * WIDTH
    # Nor beside a line.
    found = detect(picture(Bar(120.0, CAMERAS["crosstalk"], 100.0), noise=8.0))
    away = np.abs(found.position - 120.0) > 8.0
    assert np.mean(likelihood_at(found, 120.0)) > 0.9
    assert np.count_nonzero(found.likelihood[away] > 0.5) < 0.05 * WIDTH


@pytest.mark.parametrize(
    "paint", [(1.0, 1.0, 1.0), (1.0, 0.95, 0.8), (0.9, 0.95, 1.0)], ids=["white", "warm", "cold"]
)
@pytest.mark.parametrize("with_line", [True, False])
def test_paint_and_glare_are_not(paint: Colour, with_line: bool) -> None:
    line = [Bar(60.0, CAMERAS["crosstalk"])] if with_line else []
    found = detect(picture(*line, Bar(160.0, paint, 100.0)))
    assert np.mean(likelihood_at(found, 160.0)) < 0.2
    if with_line:
        assert np.mean(likelihood_at(found, 60.0)) > 0.9


def test_a_core_that_is_white_keeps_its_green_halo() -> None:
    # 600 levels of light, cut at 255: white over six pixels, green beside them.
    rgb = (0.5, 1.0, 0.6)
    found = detect(picture(Bar(120.0, rgb, 600.0, 3.0)), min_likelihood=0.3)
    assert np.count_nonzero(np.abs(found.position - 120.0) < 0.5) > 0.95 * WIDTH


@pytest.mark.xfail(
    strict=True, reason="paint that shows all of a green scene's tint is taken for a line"
)
@pytest.mark.parametrize("ground", [(30.0, 90.0, 60.0), (20.0, 110.0, 100.0)])
def test_in_a_green_scene_a_line_is_told_from_what_is_as_green_as_all(ground: Colour) -> None:
    tint = np.array(ground) / ground[1]
    paint = Bar(170.0, (float(tint[0]), 1.0, float(tint[2])), 60.0)
    found = detect(picture(Bar(60.0, (0.05, 1.0, 0.15), 70.0), paint, ground=ground))
    assert np.mean(likelihood_at(found, 60.0)) > 0.9
    assert np.mean(likelihood_at(found, 170.0)) < 0.3


def test_a_grey_source_says_nothing() -> None:
    grey = cv2.cvtColor(picture(Bar(120.0, (1.0, 1.0, 1.0))), cv2.COLOR_BGR2GRAY)
    found = detect(np.asarray(grey, np.uint8))
    np.testing.assert_array_equal(found.likelihood, 1.0)
    assert np.count_nonzero(np.abs(found.position - 120.0) < 0.5) == WIDTH


@pytest.mark.parametrize("wavelength", LIGHTS)
def test_every_wavelength_has_its_colour(wavelength: float) -> None:
    found = detect(picture(Bar(120.0, LIGHTS[wavelength])), wavelength)
    assert np.mean(likelihood_at(found, 120.0)) > 0.9
    # White paint is none of them.
    found = detect(picture(Bar(120.0, (1.0, 1.0, 1.0))), wavelength)
    assert np.mean(likelihood_at(found, 120.0)) < 0.2


@pytest.mark.parametrize("seen", LIGHTS)
@pytest.mark.parametrize("searched", [445.0, 532.0, 650.0])
def test_light_of_another_laser_is_not_that_of_this_one(searched: float, seen: float) -> None:
    if LaserColour.of(searched) is LaserColour.of(seen):
        pytest.skip("the same colour")
    found = detect(picture(Bar(120.0, LIGHTS[seen], 120.0)), searched, min_likelihood=0.4)
    assert np.count_nonzero(np.abs(found.position - 120.0) < 2.0) < 0.05 * WIDTH


@pytest.mark.parametrize(
    "gains",
    [
        (1.0, 1.0, 1.0),
        (1.5, 1.0, 0.7),
        pytest.param(
            (0.6, 1.0, 1.5),
            marks=pytest.mark.xfail(
                strict=True, reason="white paint under greenish light is taken for a line"
            ),
        ),
    ],
)
def test_the_frame_teaches_what_white_balance_makes_of_a_line(gains: Colour) -> None:
    bars = Bar(60.0, (0.1, 1.0, 0.4)), Bar(160.0, (1.0, 1.0, 1.0), 60.0)
    found = detect(picture(*bars, gains=gains))
    assert np.mean(likelihood_at(found, 60.0)) > 0.9
    # White paint has the tint of the white ground.
    assert np.mean(likelihood_at(found, 160.0)) < 0.3


@pytest.mark.parametrize(
    ("wavelength", "colour"),
    [
        (None, LaserColour.GREEN),
        (405.0, LaserColour.BLUE),
        (450.0, LaserColour.BLUE),
        (520.0, LaserColour.GREEN),
        (532.0, LaserColour.GREEN),
        (635.0, LaserColour.RED),
        (660.0, LaserColour.RED),
    ],
)
def test_colour_of_a_wavelength(wavelength: float | None, colour: LaserColour) -> None:
    assert LaserColour.of(wavelength) is colour
    # Unit vectors, and light of the primary moves the chroma that way.
    assert np.hypot(*colour.value) == pytest.approx(1.0, abs=0.01)
    primary = {LaserColour.BLUE: 0, LaserColour.GREEN: 1, LaserColour.RED: 2}[colour]
    image = np.full((4, 4, 3), 60, np.uint8)
    image[..., primary] = 160
    _, chroma = planes_of_image(image)
    assert chroma is not None
    step = np.array([float(plane[0, 0]) - 128.0 for plane in chroma])
    assert colour.value @ step > 0.7 * np.hypot(*step)


@pytest.mark.parametrize("colour", list(LaserColour))
@pytest.mark.parametrize("size", [(12, 9), (13, 8)])
def test_the_picture_in_which_a_colour_stands_out_is_its_channel(
    colour: LaserColour, size: tuple[int, int]
) -> None:
    width, height = size
    image = np.full((height, width, 3), (70, 80, 90), np.uint8)
    frame = Frame(0, 0.0, *planes_of_image(image))
    found = channel_image(frame, colour)
    assert found.shape == (height, width)
    if colour is LaserColour.GREEN:
        assert found is frame.luma
        return
    # As luma has it: 16 to 235. Chroma is rounded to a level, and counts up to 1.7 times.
    level = 16.0 + 219.0 / 255.0 * (70.0 if colour is LaserColour.BLUE else 90.0)
    np.testing.assert_allclose(found, level, atol=2.0)
    bright = np.full_like(image, 255)
    bright[..., 1] = 0
    assert channel_image(Frame(0, 0.0, *planes_of_image(bright)), colour).max() >= 230
    grey = Frame(0, 0.0, frame.luma)
    assert channel_image(grey, colour) is grey.luma


def test_heights_at_which_hardly_any_peak_is_a_line_are_not_worth_a_look() -> None:
    rng = np.random.default_rng(2)
    noise, lines = rng.uniform(6.0, 12.0, 3000), rng.uniform(40.0, 90.0, 300)
    height = np.concatenate([noise, lines])
    likelihood = np.concatenate([np.full(3000, 0.01), np.ones(300)])
    assert 11 <= useful_height(height, likelihood) <= 40
    # Where faint ones are lines, all are looked at.
    faint = np.concatenate([np.full(2000, 0.01), np.ones(1300)])
    assert useful_height(height, faint) <= 9
    assert useful_height(np.empty(0), np.empty(0)) <= 32


def test_a_few_likely_peaks_do_not_bring_in_the_noise_above_them() -> None:
    height = np.repeat([9.0, 13.0, 18.0, 27.0], [48, 65, 120, 85])
    likelihood = np.full(len(height), 0.01)
    likelihood[:5] = 1.0
    assert useful_height(height, likelihood) == 32
    # All of the light above them counts.
    likelihood[48:] = 1.0
    assert useful_height(height, likelihood) == 8


def peaks(
    n: int, u: float, v: float, spread: tuple[float, float], *, top: float = 150.0, seed: int = 1
) -> FloatArray:
    """A table of peaks that move the chroma by so much for each level of height, in green water."""
    rng = np.random.default_rng(seed)
    height = rng.uniform(30.0, 90.0, n)
    step_u = height * rng.normal(u, spread[0], n) + rng.normal(0.0, 1.0, n)
    step_v = height * rng.normal(v, spread[1], n) + rng.normal(0.0, 1.0, n)
    imbalance = rng.normal(0.0, 1.4, n)
    rest = np.full((N_MEASURES, n), 3.0)
    rest[1], rest[3:7] = height, (np.full(n, top), step_u, step_v, imbalance)
    rest[7], rest[8] = -0.01, -0.27
    return rest


def as_found(*parts: FloatArray) -> FloatArray:
    """Tables of peaks in one, in rows longer than it, as a scanner has them: kernels are compiled
    for such."""
    n = sum(part.shape[1] for part in parts)
    return np.hstack([*parts, np.zeros((N_MEASURES, 1))])[:, :n]


def test_few_lines_are_told_from_a_crowd_of_paint_as_green() -> None:
    # Caustics on twine: much paint that lowers V as far as lines do, and hardly U.
    paint, lines = peaks(14000, 0.01, -0.15, (0.01, 0.06)), peaks(120, -0.12, -0.17, (0.03, 0.04))
    table = as_found(paint, lines)
    crowd = learn_paint(table[:, ::48], 1900.0 / 48.0)
    assert crowd is not None
    assert abs(crowd.u - 0.01) < 0.02
    assert abs(crowd.v + 0.15) < 0.03
    colour = learn_colour(table, LaserColour.GREEN, crowd)
    line = colour or expected_colour(table, LaserColour.GREEN, crowd)
    likelihood = laser_likelihood(table, line, 14.0, 1900.0)
    assert np.median(likelihood[-120:]) > 0.8
    assert np.mean(likelihood[:-120] > 0.1) < 0.02


def test_lines_are_no_paint_however_many_peaks_they_make() -> None:
    # Of one net before a wall: as many as the lasers can make.
    assert learn_paint(as_found(peaks(1900, -0.3, -0.3, (0.02, 0.02))), 1900.0) is None
    # Mixed with growth, whose colour differs: no one colour.
    growth = peaks(3000, -0.05, -0.12, (0.06, 0.03), seed=2)
    mixed = as_found(growth, peaks(2500, -0.22, -0.16, (0.05, 0.03)))
    assert learn_paint(mixed, 1900.0) is None


def white_dashes(length: int) -> U8:
    """Level stripes on twine, without colour: bars of which pieces of some columns are seen."""
    bars = [Bar(y, (1.0, 1.0, 1.0), 80.0) for y in (60.0, 120.0, 180.0)]
    dark, lit = picture(noise=1.5), picture(*bars, noise=1.5)
    return np.where((np.arange(WIDTH) % 12 < length)[:, None], lit, dark)


@pytest.mark.parametrize("rounding", [0, 1])
def test_a_monochrome_camera_that_is_coded_as_colour_is_grey(rounding: int) -> None:
    image = picture(Bar(60.0, (1.0, 1.0, 1.0), 80.0), Bar(140.0, (1.0, 1.0, 1.0), 60.0))[..., 1]
    rng = np.random.default_rng(3)

    def coded(off: int) -> Frame:
        """As H.264 codes it: neutral chroma, but for rounding."""
        shape = (2, HEIGHT // 2, WIDTH // 2)
        u, v = (128 + rng.integers(-off, off, shape, endpoint=True)).astype(np.uint8)
        return Frame(0, 0.0, image, (u, v))

    assert without_neutral_chroma(coded(rounding)).chroma is None
    # The picture of a red or blue laser is not made with the rounding either.
    for wavelength in (450.0, 532.0, 650.0):
        both = coded(rounding), Frame(0, 0.0, image)
        neutral, grey = (detect_in(one, wavelength) for one in both)
        np.testing.assert_array_equal(neutral.position, grey.position)
        assert np.all(neutral.likelihood == 1.0)
    # A colour camera sees colours somewhere, in the picture or in its noise.
    coloured = coded(2)
    assert without_neutral_chroma(coloured) is coloured
    one_leaf = coded(0)
    assert one_leaf.chroma is not None
    one_leaf.chroma[0][7, 5] = 120
    assert without_neutral_chroma(one_leaf) is one_leaf


def test_dashes_without_any_colour_are_not_ruled_out() -> None:
    # The codec gave them the chroma of the water around.
    found = detect(white_dashes(3))
    on_bars = np.min(np.abs(found.position[:, None] - [60.0, 120.0, 180.0]), axis=1) < 1.5
    assert np.count_nonzero(on_bars) > 0.9 * 3 * WIDTH / 4
    assert np.all(found.likelihood[on_bars] == 1.0)
    # Long ones would have kept their colour.
    assert np.all(detect(white_dashes(12)).likelihood < 0.5)


@pytest.mark.parametrize(("green_share", "is_colour_evidence"), [(0.12, False), (0.4, True)])
def test_some_dashes_may_have_kept_their_colour(green_share, is_colour_evidence) -> None:
    bars = [Bar(y, (0.1, 1.0, 0.3), 80.0) for y in (60.0, 120.0, 180.0)]
    green = np.where((np.arange(WIDTH) % 12 < 3)[:, None], picture(*bars), picture())
    image = white_dashes(3)
    n_green = round(green_share * WIDTH)
    image[:, :n_green] = green[:, :n_green]
    found = detect(image)
    white = found.likelihood[(found.line > n_green + 12) & (found.height > 60.0)]
    assert len(white) > 0.4 * 3 * WIDTH / 4
    assert np.mean(white < 0.5) == (1.0 if is_colour_evidence else 0.0)


def test_an_overexposed_line_shows_less_of_its_colour() -> None:
    # As on rendered stripes: of 0.24 levels of chroma at 170 of luma, 0.13 are left at 220.
    table = as_found(
        peaks(400, -0.15, -0.19, (0.02, 0.02)),
        peaks(300, -0.08, -0.1, (0.02, 0.02), top=220.0),
        peaks(300, 0.0, -0.03, (0.02, 0.02), seed=3),
    )
    colour = learn_colour(table, LaserColour.GREEN, None)
    assert colour is not None
    likelihood = laser_likelihood(table, colour, 14.0)
    assert np.median(likelihood[400:700]) > 0.8
    assert np.median(likelihood[700:]) < 0.1
