"""The sub-pixel detector: where it finds a stripe, how well, and where it finds none."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import ndtr

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.detection import FrameDetector, are_colourless_dashes
from aqualvs.scanning.laser_bands import LaserBand, SearchAxis, plan_bands
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.stripe import (
    HEIGHT,
    N_MEASURES,
    POSITION,
    PULL_OF_STEP,
    STEP_U,
    PeakFinder,
    SearchImage,
    StripeOptions,
    StripePeaks,
    flank_difference,
)
from aqualvs.simulation.scenarios import bluerov2_rig

U8 = NDArray[np.uint8]
Chroma = tuple[U8, U8]
ALONG_X, ALONG_Y = SearchAxis.ALONG_X, SearchAxis.ALONG_Y
FWHM = 2.3548  # full width at half height of a Gaussian over its sigma
# A seventh of the width of the small pictures here: wider than any stripe in them.
WIDE = StripeOptions(reach_share=0.15)


def detector_for(
    image: U8,
    axis: SearchAxis = ALONG_Y,
    band: tuple[int, int] | None = None,
    options: StripeOptions = WIDE,
) -> FrameDetector:
    """Search the whole picture, or the same stretch of every search line."""
    height, width = image.shape
    length, n_lines = (height, width) if axis is ALONG_Y else (width, height)
    low, high = band or (0, length - 1)
    free = np.zeros((-(-length // 8), -(-n_lines // 8)))
    search = LaserBand(
        axis=axis,
        line_px=1,
        lowest=np.full(n_lines, low),
        highest=np.full(n_lines, high),
        slope_low=free - 5.0,
        slope_high=free + 5.0,
    )
    return FrameDetector((width, height), [search], options)


def detect(
    image: U8,
    chroma: Chroma | None = None,
    axis: SearchAxis = ALONG_Y,
    band: tuple[int, int] | None = None,
    options: StripeOptions = WIDE,
) -> StripePeaks:
    found = detector_for(image, axis, band, options).detect(Frame(0, 0.0, image, chroma))
    return found[axis]


def gaussian(
    centres: FloatArray, *, sigma: float = 2.5, height: float = 120.0, length: int = 200
) -> FloatArray:
    """Light of one stripe, shape (length, n_lines)."""
    v = np.arange(length)[:, None]
    light: FloatArray = height * np.exp(-0.5 * ((v - centres) / sigma) ** 2)
    return light


def as_image(light: FloatArray) -> U8:
    return np.clip(np.rint(light), 0, 255).astype(np.uint8)


def assert_same(found: StripePeaks, expected: StripePeaks) -> None:
    assert found.n > 0
    for name in StripePeaks._fields:
        one, other = getattr(found, name), getattr(expected, name)
        np.testing.assert_array_equal(one, other, err_msg=name)


CENTRES = 100.0 + np.linspace(-8.0, 8.0, 161)


@pytest.mark.parametrize("sigma", [1.2, 2.5, 5.0])
def test_centre_width_and_height_of_a_clean_stripe(sigma: float) -> None:
    found = detect(as_image(40.0 + gaussian(CENTRES, sigma=sigma)))
    np.testing.assert_array_equal(found.line, np.arange(161))
    error = found.position - CENTRES
    # Rounding to grey levels, against flanks of 120 grey levels, and what straight lines from pixel
    # to pixel leave of the profile. Sums over whole pixels would be off by up to 0.09.
    assert abs(error.mean()) < 0.003
    assert np.abs(error).max() < 0.025
    assert abs(found.width.mean() / (FWHM * sigma) - 1.0) < 0.05
    # A peak between two pixels is up to 8 % lower than a narrow stripe.
    assert 109.0 < found.height.min() <= found.height.max() <= 120.0
    np.testing.assert_array_equal(found.likelihood, 1.0)


@pytest.mark.parametrize("width", [1.2, 1.5, 2.0, 2.5, 3.0])
def test_a_narrow_stripe_is_not_drawn_to_the_pixel_grid(width: float) -> None:
    """Sums over whole pixels draw it by 0.06 to 0.25 px, straight lines the narrowest by 0.1."""
    found = detect(as_image(40.0 + gaussian(CENTRES, sigma=width / FWHM)))
    assert np.abs(found.position - CENTRES).max() < 0.025


@pytest.mark.parametrize("slope", [-0.3, 0.0, 0.3])
@pytest.mark.parametrize("sigma", [2.5, 4.0])
def test_the_pull_is_what_a_ramp_below_a_stripe_moves_its_centre_by(
    sigma: float, slope: float
) -> None:
    ramp = 100.0 + slope * (np.arange(200.0)[:, None] - 100.0)
    found = detect(as_image(ramp + gaussian(CENTRES, sigma=sigma)))
    moved = found.position - CENTRES
    # First order in slope * width / height, up to 0.02 here; the Gaussian reaches the flanks.
    expected = 0.269 * (FWHM * sigma) ** 2 * slope / 120.0
    assert found.pull.mean() == pytest.approx(expected, abs=0.15 * abs(expected) + 4e-3)
    assert abs((moved - found.pull).mean()) < 0.25 * abs(expected) + 3e-3


@pytest.mark.parametrize("step", [-9.0, 4.0, 9.0])
@pytest.mark.parametrize("sigma", [2.0, 3.0])
def test_a_step_as_wide_as_the_stripe_moves_its_centre_by_a_share_of_its_width(
    sigma: float, step: float
) -> None:
    """Glow of the water, which ends where the laser sheet meets a strand."""
    place = np.arange(200.0)[:, None] - CENTRES
    found = detect(as_image(100.0 + step * ndtr(place / sigma) + gaussian(CENTRES, sigma=sigma)))
    moved = found.position - CENTRES
    difference = np.array(
        [flank_difference(*one) for one in zip(found.pull, found.width, strict=True)]
    )
    expected = (PULL_OF_STEP * found.width * difference).mean()
    # Grey levels hide up to a half of one at each flank.
    assert moved.mean() == pytest.approx(expected, abs=0.15 * abs(expected) + 3e-3)
    assert abs(expected) > 0.015


def test_a_brighter_stripe_beside_a_peak_is_no_pull() -> None:
    light = gaussian(np.full(20, 100.0)) + gaussian(np.full(20, 112.0), height=150.0)
    np.testing.assert_array_equal(detect(as_image(30.0 + light)).pull, 0.0)


@pytest.mark.parametrize("slope", [-0.4, 0.4])
def test_a_sloping_background_pulls_by_hundredths(slope: float) -> None:
    background = 60.0 + slope * (np.arange(200)[:, None] - 100.0)
    error = detect(as_image(background + gaussian(CENTRES))).position - CENTRES
    # Light of slope g below a Gaussian moves its peak by g sigma²/height = 0.02 px; a centroid
    # above a level moves up to three times as far.
    assert 0.005 < np.sign(slope) * error.mean() < 0.07


def test_a_clipped_top_keeps_its_place() -> None:
    found = detect(as_image(40.0 + gaussian(CENTRES, height=600.0)))
    error = found.position - CENTRES
    assert len(error) == 161
    assert abs(error.mean()) < 0.003
    # Only the flanks tell, two steep pixels each.
    assert np.abs(error).max() < 0.1
    assert found.height.max() <= 215.0


def noisy_errors(noise: float, height: float) -> FloatArray:
    rng = np.random.default_rng(11)
    centres = 100.0 + rng.uniform(-0.5, 0.5, 4000)
    light = 60.0 + gaussian(centres, height=height)
    # What noise alone raises is not asked for here.
    options = StripeOptions(reach_share=24.0 / 4000.0, min_contrast=30)
    found = detect(as_image(light + rng.normal(0.0, noise, light.shape)), options=options)
    return found.position - centres[found.line]


@pytest.mark.parametrize(("noise", "height"), [(2.0, 60.0), (3.0, 60.0), (3.0, 120.0)])
def test_noise_moves_the_centre_as_two_flanks_do(noise: float, height: float) -> None:
    error = noisy_errors(noise, height)
    # Now and then noise parts a stripe in two.
    assert 4000 <= len(error) <= 4004
    # 0.45 width/height per grey level is what readings take for it; two-sided, because too good
    # would mean that something smooths along the stripe.
    expected = 0.45 * noise * FWHM * 2.5 / height
    assert 0.6 * expected < error.std() < 1.4 * expected
    # Four standard errors of the mean, and rounding.
    assert abs(error.mean()) < 4.0 * expected / np.sqrt(len(error)) + 0.003


def test_noise_alone_stays_below_the_least_contrast() -> None:
    rng = np.random.default_rng(12)
    image = as_image(60.0 + rng.normal(0.0, 2.0, (200, 160)))
    # Contrast counts from the darkest pixel of the flanks, here about 3 sigma below the mean.
    assert detect(image, options=StripeOptions(reach_share=0.15, min_contrast=18)).n == 0


def test_in_a_quiet_picture_fainter_green_is_found_but_no_fainter_white() -> None:
    """Nothing else is as high; without colour a stripe may as well be texture."""
    image = as_image(40.0 + gaussian(CENTRES, height=4.4))
    found = detect(image, green_chroma(as_image(40.0 + gaussian(CENTRES)), fall=20.0))
    assert found.n > 0.9 * len(CENTRES)
    assert np.abs(found.position - CENTRES[found.line]).max() < 0.6
    assert detect(image).n == 0


@pytest.mark.parametrize("places", [(60.0, 80.3), (50.2, 70.6, 131.4), (40.0, 60.0, 80.5, 100.7)])
def test_several_returns_on_one_line(places: Sequence[float]) -> None:
    n = 24
    light = np.sum([gaussian(np.full(n, place)) for place in places], axis=0)
    found = detect(as_image(30.0 + light))
    np.testing.assert_array_equal(found.line, np.repeat(np.arange(n), len(places)))
    np.testing.assert_allclose(found.position.reshape(n, -1) - places, 0.0, atol=0.03)


def test_two_peaks_part_where_the_valley_is_deep() -> None:
    apart, merged = (
        detect(as_image(30.0 + gaussian(np.full(9, 90.0)) + gaussian(np.full(9, 90.0 + gap))))
        for gap in (10.0, 5.0)
    )
    # At 4 sigma the valley has 27 % of the peaks, at 2 sigma there is none.
    np.testing.assert_allclose(apart.position.reshape(9, 2) - [90.0, 100.0], 0.0, atol=0.3)
    np.testing.assert_allclose(merged.position, 92.5, atol=0.05)


def test_a_return_weaker_than_a_share_of_the_bright_ones_is_noise_unless_in_a_row() -> None:
    strong = gaussian(np.full(90, 80.0), height=180.0)
    # As on a net: eight lines lit, eight dark; and as on a wall.
    dashes = np.arange(90) % 16 < 8
    for height, n in ((50.0, 48), (30.0, 0)):
        faint = gaussian(np.full(90, 120.0), height=height)
        found = detect(as_image(30.0 + strong + dashes * faint))
        assert found.n == 90 + n
        assert np.count_nonzero(np.abs(found.position - 80.0) < 0.1) == 90
        assert detect(as_image(30.0 + strong + faint)).n == 180
    keep_all = StripeOptions(reach_share=0.25, min_share=0.0)
    light = strong + dashes * gaussian(np.full(90, 120.0), height=30.0)
    assert detect(as_image(30.0 + light), options=keep_all).n == 138


@pytest.mark.parametrize("at", [96, 99, 101])
@pytest.mark.parametrize("blur", [0.2, 2.0])
def test_a_step_edge_is_no_return(at: int, blur: float) -> None:
    edge = 20.0 + 180.0 / (1.0 + np.exp(-(np.arange(200)[:, None] - at) / blur))
    image = as_image(np.repeat(edge, 80, axis=1))
    assert detect(image).n == 0
    assert detect(image[::-1].copy()).n == 0


def test_a_stripe_along_the_search_line_is_no_return() -> None:
    image = as_image(30.0 + gaussian(np.full(200, 60.0), length=120).T)
    assert detect(image).n == 0
    assert detect(image, axis=ALONG_X).n == 200


def test_what_is_wider_than_the_reach_is_no_return() -> None:
    broad = as_image(30.0 + gaussian(np.full(160, 100.0), sigma=20.0))
    assert detect(broad).n == 0


@pytest.mark.parametrize("end", ["first", "last"])
def test_near_a_border_a_stripe_is_found_where_it_is_or_not_at_all(end: str) -> None:
    found = {}
    for distance in (0, 2, 30):
        at = distance if end == "first" else 199 - distance
        found[distance] = detect(as_image(30.0 + gaussian(np.full(16, float(at)))))
    assert found[0].n == 0
    # Half height lies three pixels from the centre, beyond the border: what shows of the flank
    # counts as the background, the height is less, and the place is that of the peak.
    np.testing.assert_allclose(found[2].position, 2.0 if end == "first" else 197.0, atol=0.01)
    assert np.all(found[2].height < 0.5 * 120.0)
    np.testing.assert_allclose(found[30].position, 30.0 if end == "first" else 169.0, atol=0.01)


@pytest.mark.parametrize("shape", [(97, 83), (90, 161), (101, 90), (89, 65)])
@pytest.mark.parametrize("with_chroma", [False, True])
def test_odd_sizes_and_both_directions(shape: tuple[int, int], with_chroma: bool) -> None:
    height, width = shape
    centres = 45.0 + 0.02 * np.arange(width)
    image = as_image(30.0 + gaussian(centres, length=height))
    chroma = green_chroma(image) if with_chroma else None
    upright = detect(image, chroma)
    np.testing.assert_array_equal(upright.line, np.arange(width))
    np.testing.assert_allclose(upright.position, centres, atol=0.05)
    turned = None if chroma is None else (chroma[0].T.copy(), chroma[1].T.copy())
    # The reach is a share of the width, the longer side of one picture and the shorter of another.
    same_reach = StripeOptions(reach_share=0.15 * width / height)
    assert_same(detect(image.T.copy(), turned, axis=ALONG_X, options=same_reach), upright)


def green_chroma(image: U8, fall: float = 60.0) -> Chroma:
    """U falls where the picture is bright, as for green light."""
    rows, columns = -(-image.shape[0] // 2), -(-image.shape[1] // 2)
    padded = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2)), mode="edge")
    mean = padded.reshape(rows, 2, columns, 2).mean(axis=(1, 3)) - 30.0
    u = as_image(120.0 - fall * np.clip(mean / 120.0, 0.0, 1.0))
    return u, np.full_like(u, 120)


@pytest.mark.parametrize("size", [(1280, 720), (1366, 768), (1283, 727), (1282, 722)])
@pytest.mark.parametrize("with_chroma", [False, True])
def test_wide_pictures_of_any_size(size: tuple[int, int], with_chroma: bool) -> None:
    width, height = size
    rig = replace(bluerov2_rig(), size_px=size)
    image = as_image(30.0 + gaussian(300.3 + 0.02 * np.arange(width), length=height))
    chroma = green_chroma(image) if with_chroma else None
    laser_bands = [s for s in plan_bands(rig, rig.camera()) if s.axis is ALONG_Y]
    assert len(laser_bands) > 0
    detector = FrameDetector(size, laser_bands, StripeOptions())
    found = detector.detect(Frame(0, 0.0, image, chroma))[ALONG_Y]
    line_px = laser_bands[0].line_px
    assert found.n == len(laser_bands[0].lowest)
    column = found.line * line_px + 0.5 * (line_px - 1)
    np.testing.assert_allclose(found.position, 300.3 + 0.02 * column, atol=0.05)


def test_white_glare_is_rejected_by_its_colour_and_green_light_is_not() -> None:
    glare, laser = gaussian(np.full(160, 60.3)), gaussian(np.full(160, 120.7))
    image = as_image(30.0 + glare + laser)
    chroma = green_chroma(as_image(30.0 + laser))
    assert detect(image).n == 320
    found = detect(image, chroma)
    np.testing.assert_array_equal(found.line, np.arange(160))
    np.testing.assert_allclose(found.position, 120.7, atol=0.05)
    # A fall of 60 levels of U is far from all noise.
    assert np.all((found.likelihood > 0.99) & (found.likelihood <= 1.0))
    assert detect(image, green_chroma(image, fall=0.0)).n == 0


def test_a_saturated_core_is_white_but_its_rim_is_green() -> None:
    light = gaussian(np.full(160, 100.0), sigma=4.0, height=500.0)
    image = as_image(30.0 + light)
    u, v = green_chroma(image)
    core = np.abs(2.0 * np.arange(100) + 0.5 - 100.0) < 5.0
    u[core] = 120
    found = detect(image, (u, v))
    np.testing.assert_array_equal(found.line, np.arange(160))
    np.testing.assert_allclose(found.position, 100.0, atol=0.05)


def test_strange_memory_gives_the_same_returns() -> None:
    rng = np.random.default_rng(8)
    light = 40.0 + gaussian(90.0 + 0.1 * np.arange(101), length=181)
    image = as_image(light + rng.normal(0.0, 2.0, light.shape))
    chroma = green_chroma(image)
    padded = np.full((181, 128), 77, np.uint8)
    padded[:, :101] = image
    luma = padded[:, :101]
    interleaved = np.empty((91, 64, 2), np.uint8)
    interleaved[:, :51, 0], interleaved[:, :51, 1] = chroma
    u, v = interleaved[:, :51, 0], interleaved[:, :51, 1]
    for plane in (luma, u, v):
        plane.flags.writeable = False
    for axis in SearchAxis:
        strange = detector_for(image, axis).detect(Frame(0, 0.0, luma, (u, v)))[axis]
        plain = detect(image, chroma, axis)
        if axis is ALONG_Y:
            assert plain.n >= 101
            assert_same(strange, plain)
        else:
            np.testing.assert_array_equal(strange.position, plain.position)
    np.testing.assert_array_equal(luma, image)


def test_returns_outlive_the_next_frame_and_frames_do_not_mix() -> None:
    bright = as_image(30.0 + gaussian(np.full(80, 90.0)))
    detector = detector_for(bright)
    first = detector.detect(Frame(0, 0.0, bright))[ALONG_Y]
    kept = first.position.copy()
    other = as_image(30.0 + gaussian(np.full(80, 140.4)))
    second = detector.detect(Frame(1, 0.0, other))[ALONG_Y]
    np.testing.assert_array_equal(first.position, kept)
    assert_same(second, detect(other))
    assert detector.detect(Frame(2, 0.0, np.full_like(bright, 30)))[ALONG_Y].n == 0


def test_only_the_band_is_searched_but_its_edge_cuts_no_stripe() -> None:
    image = as_image(30.0 + sum(gaussian(np.full(80, at)) for at in (50.0, 100.0, 150.0)))
    found = detect(image, band=(98, 160))
    np.testing.assert_allclose(found.position.reshape(80, 2), [[100.0, 150.0]] * 80, atol=0.02)


def test_where_there_is_too_much_the_faint_is_left_out() -> None:
    light = gaussian(np.full(80, 50.0), height=150.0) + gaussian(np.full(80, 100.0), height=60.0)
    options = StripeOptions(reach_share=0.2, max_returns=100)
    found = detect(as_image(30.0 + light), options=options)
    np.testing.assert_array_equal(found.line, np.arange(80))
    np.testing.assert_allclose(found.position, 50.0, atol=0.05)


@pytest.mark.parametrize("value", [-0.1, 1.0])
def test_an_impossible_share_is_refused(value: float) -> None:
    with pytest.raises(OptionError, match="min_share is"):
        StripeOptions(min_share=value)


def test_a_foot_beside_a_stripe_does_not_double_it() -> None:
    profile = np.full(96, 20, np.uint8)
    # 13 above the background, then 11: below the least contrast, so a run of its own.
    profile[46:54] = [33, 31, 45, 60, 66, 60, 45, 20]
    found = detect(np.repeat(profile[:, None], 80, axis=1))
    stripe = found.height > 40.0
    assert np.count_nonzero(stripe) == 80
    assert np.all(found.position[~stripe] < 48.0)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 120),
    width=st.integers(1, 90),
    smooth=st.booleans(),
    colour=st.booleans(),
    min_contrast=st.sampled_from([1, 2, 12, 60]),
)
def test_any_picture_gives_orderly_returns(
    seed: int, height: int, width: int, smooth: bool, colour: bool, min_contrast: int
) -> None:
    rng = np.random.default_rng(seed)
    light = rng.uniform(0.0, 255.0, (height, width))
    if smooth:
        light = light.cumsum(axis=0) % 256.0 * 0.3
    image = as_image(light)
    chroma = None
    if colour:
        half = (-(-height // 2), -(-width // 2))
        u = rng.integers(90, 140, half, dtype=np.uint8)
        chroma = u, u
    options = StripeOptions(reach_share=0.2, min_contrast=min_contrast)
    found = detect(image, chroma, options=options)
    reach_px = max(8, round(0.2 * width))
    assert np.all(np.diff(found.line) >= 0)
    assert np.all((found.position >= 0.0) & (found.position <= height - 1))
    assert np.all(found.height >= min_contrast)
    assert np.all((found.width > 0.0) & (found.width <= reach_px))
    least = StripeOptions().min_likelihood if colour else 1.0
    assert np.all((found.likelihood >= least) & (found.likelihood <= 1.0))


@pytest.mark.parametrize("shape", [(0, 0), (200, 0), (0, 160), (160, 200), (200, 161)])
def test_a_frame_of_another_size_is_refused(shape: tuple[int, int]) -> None:
    detector = detector_for(np.zeros((200, 160), np.uint8))
    with pytest.raises(ValueError, match="px but the rig's image is"):
        detector.detect(Frame(0, 0.0, np.zeros(shape, np.uint8)))


@pytest.mark.parametrize("value", [0, 255, -1])
def test_an_impossible_contrast_is_refused(value: int) -> None:
    with pytest.raises(OptionError, match=f"min_contrast is {value};"):
        StripeOptions(min_contrast=value)


@pytest.mark.parametrize("value", [0.0, 0.5, -0.1, float("nan")])
def test_an_impossible_reach_is_refused(value: float) -> None:
    with pytest.raises(OptionError, match="reach_share is"):
        StripeOptions(reach_share=value)


@pytest.mark.parametrize("reach_px", [8, 9, 16, 17, 33, 64, 86])
def test_the_background_is_the_higher_of_the_least_pixels_on_either_side(reach_px: int) -> None:
    rng, length = np.random.default_rng(reach_px), 301
    # In pairs of pixels.
    reach = (reach_px - 1) // 2
    picture = rng.integers(40, 90, (60, length), np.uint8)
    peak = rng.integers(reach_px, length - reach_px, len(picture))
    picture[np.arange(len(picture)), peak] = 200
    anywhere, no_chroma = np.zeros(len(picture), np.int64), np.empty((0, 0), np.uint8)
    finder = PeakFinder(length, anywhere, anywhere + length - 1, reach_px, np.zeros((1, 2)))
    line, table = np.empty(100, np.int64), np.empty((N_MEASURES, 100))
    n = finder.find(SearchImage(picture, no_chroma, no_chroma, 1, True), 100, 1, line, table)
    expected = [
        200 - max(row[k - 2 * reach : k].min(), row[k + 2 : k + 2 + 2 * reach].min())
        for row, k in zip(picture, peak // 2 * 2, strict=True)
    ]
    assert line[:n].tolist() == list(range(len(picture)))
    assert table[HEIGHT, :n].tolist() == expected


@pytest.mark.parametrize(
    ("of_dashes", "of_lines", "n_possible", "expected"),
    [
        (0.2, 0.5, 400.0, True),
        # The lines of the wall have their colour: the dashes had theirs, and are something else.
        (0.2, 1.0, 400.0, False),
        (0.5, 0.5, 400.0, False),
        # Hardly a dash has any, and with the lines there are not many more than the lasers make.
        (0.1, 1.0, 400.0, True),
        (0.1, 1.0, 180.0, False),
        # Far more peaks than the lasers can make; long lines that are few of what they can make.
        (0.2, 0.5, 140.0, False),
        (0.2, 0.5, 500.0, False),
    ],
)
def test_dashes_before_a_wall_have_lost_their_colour_if_its_lines_lost_some(
    of_dashes: float, of_lines: float, n_possible: float, expected: bool
) -> None:
    dashes, wall = np.flatnonzero(np.arange(200) % 16 < 8), np.arange(200)
    line = np.concatenate((dashes, wall))
    position = np.repeat([80.0, 120.0], (len(dashes), len(wall)))
    order = np.lexsort((position, line))
    # Rows longer than the table, as a scanner has them: the kernel is compiled for such.
    table = np.zeros((N_MEASURES, len(line) + 1))[:, : len(line)]
    table[POSITION], table[HEIGHT] = position[order], 60.0
    for place, share in ((80.0, of_dashes), (120.0, of_lines)):
        rows = np.flatnonzero(table[POSITION] == place)
        table[STEP_U, rows[: round(share * len(rows))]] = -60.0
    ends = np.array([0, len(line)])
    assert are_colourless_dashes(line[order], table, ends, n_possible) is expected
