"""Pictures that stand still while time runs on: when they are noticed, and what is none of them."""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from functools import cache

import av
import cv2
import numpy as np
import pytest

from agreement_cases import Diver, Target
from aqualvs.geometry.arrays import FloatArray
from aqualvs.live.health_monitor import FrozenOptions, FrozenPicture, suspects_of
from aqualvs.optics.rig import rig_moved_by
from aqualvs.results.agreement import LaserAgreement
from aqualvs.scanning.scan import ImagePlane
from aqualvs.simulation.scenarios import example_rig
from live_cases import demo_frames
from whole import part_of

FPS = 25.0
CELL, PLACES = 8, 64


@cache
def plate(height: int, width: int) -> FloatArray:
    """Normal noise for windows of a size, of which there are `PLACES` along each side."""
    size = (height + CELL * (PLACES - 1), width + CELL * (PLACES - 1))
    return np.random.default_rng(0).standard_normal(size, np.float32)


def noisy(luma: ImagePlane, rng: np.random.Generator) -> ImagePlane:
    """A picture with shot and read noise of a small camera.

    Its noise is a window of one plate: to draw it anew would be most of the time. Windows are whole
    cells apart, so that no cell of two pictures shares a part of its noise only.
    """
    light = np.arange(256, dtype=np.float32)
    sigma = np.sqrt(np.float32(0.1) * np.maximum(light - 16.0, 0.0) + 1.0)
    (row, column), (height, width) = CELL * rng.integers(0, PLACES, 2), luma.shape
    noise = plate(height, width)[row : row + height, column : column + width]
    return np.clip(luma + sigma[luma] * noise, 0, 255).astype(np.uint8)


@cache
def hovering() -> tuple[ImagePlane, ...]:
    """A vehicle that all but stands still: it swings by half a pixel."""
    rng, luma = np.random.default_rng(1), np.ascontiguousarray(demo_frames(1)[0].luma)
    pictures = []
    for i in range(110):
        move = np.float32([[1, 0, 0.6 * np.sin(i / 9.0)], [0, 1, 0.5 * np.sin(i / 7.0)]])
        pictures.append(noisy(cv2.warpAffine(luma, move, luma.shape[::-1]), rng))
    return tuple(pictures)


def swinging(n: int, amplitude_px: float, period_s: float) -> list[ImagePlane]:
    """A vehicle that swings along the diagonal, and turns round again and again."""
    rng, luma = np.random.default_rng(7), np.ascontiguousarray(demo_frames(1)[0].luma)
    pictures = []
    for i in range(n):
        by = amplitude_px * np.sin(2.0 * np.pi * i / (period_s * FPS))
        move = np.float32([[1, 0, by], [0, 1, 0.7 * by]])
        pictures.append(noisy(cv2.warpAffine(luma, move, luma.shape[::-1]), rng))
    return pictures


def coded(pictures: Sequence[ImagePlane], bit_rate: int, n_slices: int = 1) -> list[ImagePlane]:
    """What comes out of H.264 without delay, with a key frame each second."""
    encoder, decoder = av.CodecContext.create("libx264", "w"), av.CodecContext.create("h264", "r")
    height, width = pictures[0].shape
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "yuv420p"
    encoder.framerate, encoder.time_base = Fraction(25), Fraction(1, 25)
    encoder.bit_rate = bit_rate
    # Tuned to no latency, x264 cuts as many slices as it has threads: left out, as there are cores.
    encoder.thread_count = n_slices
    rate = f"vbv-maxrate={bit_rate // 1000}:vbv-bufsize={bit_rate // 1000}"
    encoder.options = {
        "preset": "veryfast",
        "tune": "zerolatency",
        "x264-params": f"keyint=25:min-keyint=25:scenecut=0:{rate}",
    }
    packets = []
    for i, luma in enumerate(pictures):
        planes = np.vstack([luma, np.full((height // 2, width), 128, np.uint8)])
        frame = av.VideoFrame.from_ndarray(planes, "yuv420p")
        frame.pts = i
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    found = [frame for packet in (*packets, None) for frame in decoder.decode(packet)]
    return [np.ascontiguousarray(frame.to_ndarray()[:height]) for frame in found]


def watched(
    pictures: Sequence[ImagePlane], fps: float = FPS, options: FrozenOptions | None = None
) -> list[float]:
    watch = FrozenPicture(options)
    return [watch.update(i / fps, one) for i, one in enumerate(pictures)]


def test_repeated_pictures_are_noticed_within_a_quarter_of_a_second_and_forgotten_again() -> None:
    live = [*hovering()]
    found = watched(live[:60] + [live[59]] * 40 + live[60:])
    assert not any(found[:60])
    first = next(i for i, still_s in enumerate(found) if still_s > 0.0)
    # Frame 59 was live; the quarter counts from it.
    assert first - 59 <= 7
    assert found[99] == pytest.approx(40 / FPS)
    assert all(found[first:100])
    # It is believed again half a second after the picture moves.
    assert not any(found[100 + 14 :])


def test_noise_alone_tells_a_live_picture() -> None:
    """A vehicle on deck, or on a stand before a wall."""
    rng, luma = np.random.default_rng(2), demo_frames(1)[0].luma
    assert not any(watched([noisy(luma, rng) for _ in range(100)]))


@pytest.mark.parametrize("each", [2, 4])
def test_cameras_that_repeat_pictures_in_dim_light_are_live(each: int) -> None:
    live = hovering()[:40]
    repeated = [one for one in live for _ in range(each)]
    assert not any(watched(repeated, fps=30.0))


def test_what_an_encoder_improves_in_a_still_is_no_motion() -> None:
    """Detail comes in within the cells; their means stay but for rounding."""
    rng = np.random.default_rng(3)
    live = [*hovering()[:60]]
    coarse = cv2.GaussianBlur(live[-1], (0, 0), 3.0)
    still = [
        cv2.addWeighted(coarse, 0.7**i, live[-1], 1.0 - 0.7**i, rng.uniform(-0.2, 0.2))
        for i in range(20)
    ]
    found = watched(live + still)
    assert not any(found[:60])
    assert all(found[60 + 12 :])


@pytest.mark.parametrize(("moving", "n_slices"), part_of([(47, 1), (54, 3), (58, 8)]))
def test_a_still_of_few_bits_is_noticed_within_half_a_second(moving: int, n_slices: int) -> None:
    """At 0.3 Mbit/s its changes alone tell it later."""
    live = swinging(moving, 6.0, 4.0)
    pictures = coded(live + live[-1:] * 20, 300_000, n_slices)
    found = watched(pictures)
    assert not any(found[:moving])
    first = next(i for i, still_s in enumerate(found) if still_s > 0.0)
    assert first + 1 - moving <= 0.5 * FPS
    assert all(found[first:])
    by_changes = watched(pictures, options=FrozenOptions(motion=1e6))
    assert not any(by_changes[: first + 1])


@pytest.mark.parametrize(
    ("amplitude_px", "period_s", "n_slices"),
    part_of([(4.0, 3.0, 4), (4.0, 3.0, 1), (4.0, 2.0, 1), (1.5, 4.0, 1)], every=4),
)
def test_a_vehicle_that_turns_round_is_live(
    amplitude_px: float, period_s: float, n_slices: int
) -> None:
    live = swinging(90, amplitude_px, period_s)
    assert not any(watched(coded(live, 300_000, n_slices)))


def test_a_camera_that_is_put_to_rest_is_live_again_by_its_noise() -> None:
    live = swinging(60, 6.0, 4.0)
    rng = np.random.default_rng(8)
    still = cv2.GaussianBlur(live[-1], (0, 0), 2.0)
    found = watched(live + [noisy(still, rng) for _ in range(80)])
    assert not any(found[:60])
    assert any(found[60:75])
    # The stop is withdrawn after two seconds, and the rest is none.
    assert not any(found[60 + 13 + 51 :])


def test_text_in_the_picture_does_not_stand_for_it() -> None:
    # It swings to and fro once.
    pictures = swinging(75, 4.0, 3.0)
    for luma in pictures:
        for row in range(40, 200, 40):
            cv2.putText(luma, "DEPTH 12.3 HDG 270", (8, row), 0, 1.0, 255, 2)
    assert not any(watched(coded(pictures, 1_000_000)))


def test_another_size_and_a_stream_that_was_away_begin_anew() -> None:
    luma = demo_frames(1)[0].luma
    watch = FrozenPicture()
    for i in range(20):
        watch.update(i / FPS, luma)
    assert watch.update(20 / FPS, luma) > 0.0
    assert watch.update(21 / FPS, luma[:-40]) == 0.0
    for i in range(22, 40):
        watch.update(i / FPS, luma)
    assert watch.update(40 / FPS, luma) > 0.0
    assert watch.update(43.0, luma) == 0.0
    # Time that jumps back is another stream.
    assert watch.update(1.0, luma) == 0.0


def test_pictures_smaller_than_a_cell_are_never_frozen() -> None:
    tiny = np.zeros((4, 4), np.uint8)
    assert not any(watched([tiny] * 30))


@pytest.mark.parametrize(
    ("turn_deg", "zoom", "lasers"), [(0.0, 1.0, []), (0.4, 1.0, [1]), (0.0, 1.05, [0, 1, 2])]
)
def test_lasers_that_are_off_are_named_and_all_under_zoom(
    turn_deg: float, zoom: float, lasers: list[int]
) -> None:
    rig = example_rig()
    turned = rig_moved_by(rig, ("left:tilt_1",), np.tan(np.deg2rad([turn_deg])))
    lens = replace(rig.lens, fx=zoom * rig.lens.fx, fy=zoom * rig.lens.fy)
    diver, agreement = Diver(replace(turned, lens=lens), rig), LaserAgreement(rig)
    for i in range(8):
        target = Target(0.45 + 0.05 * i, pitch_deg=8.0 * (-1) ** i)
        agreement.add(diver.scan(target, index=3 * i))
    off = suspects_of(agreement)
    assert list(off) == lasers
    assert set(off.values()) == ({agreement.verdict().sentence()} if lasers else set())
