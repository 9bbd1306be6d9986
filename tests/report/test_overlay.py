from pathlib import Path

import av
import numpy as np
import pytest

from aqualvs.errors import OutputError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.report.overlay import OverlayWriter, draw_overlay, draw_points, posture_lines
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Label, ScanPoints
from aqualvs.simulation.scenarios import example_rig
from aqualvs.text import LASER_COLOURS, bgr

GREY = np.full((240, 320, 3), 90, np.uint8)
REFUSAL = Refusal(Reason.ONE_LASER)


def scan_points(pixels: FloatArray, laser: list[int], used: list[bool]) -> ScanPoints:
    n = len(pixels)
    one = np.ones(n)
    return ScanPoints(
        laser=np.array(laser, np.int8),
        pixels=pixels,
        points_in_dome=np.zeros((n, 3)),
        sigma=one,
        intensity=one,
        width=one,
        quality=one,
        label=np.full(n, Label.NET, np.uint8),
        used=np.array(used),
    )


def a_posture() -> Posture:
    return Posture(
        range=0.5321,
        pitch=np.deg2rad(3.2),
        yaw=np.deg2rad(-1.5),
        covariance=np.diag([0.0004, np.deg2rad(0.1), np.deg2rad(0.25)]) ** 2,
        normal_in_dome=np.array([0.0, 1.0, 0.0]),
        slant_range=0.54,
        nearest=0.52,
        n_points=300,
        rms=0.001,
    )


def test_target_points_take_the_colour_of_their_laser_and_rejected_ones_are_faint() -> None:
    pixels = np.array([[100.0, 120.0], [200.0, 120.0], [150.0, 60.0]])
    points = scan_points(pixels, [0, 1, 0], [True, True, False])
    drawn = draw_points(GREY, points.laser, points.pixels, points.used)
    first, second = bgr(LASER_COLOURS[0]), bgr(LASER_COLOURS[1])
    assert tuple(drawn[120, 100]) == first
    assert tuple(drawn[120, 200]) == second
    rejected = drawn[62, 152].astype(float)
    assert 0.0 < np.abs(rejected - 90.0).max() < np.abs(np.array(first) - 90.0).max()
    # The middle of a cross stays free: the stripe below it remains visible.
    assert tuple(drawn[60, 150]) == (90, 90, 90)
    assert (GREY == 90).all()


def test_points_outside_or_not_finite_are_left_out() -> None:
    pixels = np.array([[-50.0, 10.0], [np.nan, 5.0], [1e12, 5.0], [319.0, 239.0]])
    drawn = draw_points(GREY, np.zeros(4, np.int8), pixels, np.ones(4, np.bool_))
    changed = np.argwhere((drawn != 90).any(axis=-1))
    assert len(changed)
    assert changed.min(axis=0).tolist() == [238, 318]


def test_posture_reads_in_millimetres_and_degrees_with_its_sigma() -> None:
    assert posture_lines(a_posture()) == [
        "range   532.1 ± 0.4 mm",
        "pitch   +3.20 ± 0.10°",
        "yaw     -1.50 ± 0.25°",
    ]


@pytest.mark.parametrize("reason", list(Reason))
def test_a_refusal_reads_in_words(reason: Reason) -> None:
    lines = posture_lines(Refusal(reason, "12 points"))
    assert lines[0] == "no posture"
    assert "_" not in lines[1]
    assert lines[2] == "12 points"


def test_overlay_tells_postures_and_refusals_apart() -> None:
    points = scan_points(np.zeros((0, 2)), [], [])
    fine = draw_overlay(GREY, points, a_posture(), example_rig())
    refused = draw_overlay(GREY, points, REFUSAL, example_rig())
    corner = (slice(0, 60), slice(0, 120))
    assert (fine[corner] != refused[corner]).any()
    # Text is drawn on a darkened ground, else it would drown in a bright veil.
    assert np.median(fine[:40, :60]) < 45
    # Lasers' names stand along the lower edge, in their colours.
    near = np.abs(fine[-30:].astype(int) - bgr(LASER_COLOURS[0])).max(axis=-1)
    assert (near < 30).any()


def test_names_that_the_font_lacks_do_not_stop_the_overlay() -> None:
    lines = draw_overlay(
        GREY, scan_points(np.zeros((0, 2)), [], []), Refusal(Reason.COLLINEAR, "±°ж"), example_rig()
    )
    assert lines.shape == GREY.shape


@pytest.mark.parametrize("size", [(320, 240), (321, 239)])
def test_video_can_be_read_back(tmp_path: Path, size: tuple[int, int]) -> None:
    path = tmp_path / "overlay.mp4"
    levels = (30, 120, 210)
    with OverlayWriter(path, size, 12.5) as writer:
        for level in levels:
            writer.write(np.full((size[1], size[0], 3), level, np.uint8))
    writer.close()
    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == pytest.approx(12.5)
        frames = [frame.to_ndarray(format="bgr24") for frame in container.decode(video=0)]
    assert len(frames) == len(levels)
    assert frames[0].shape[:2] == (size[1] + size[1] % 2, size[0] + size[0] % 2)
    # H.264 keeps flat grey within a few levels.
    assert [float(f.mean()) for f in frames] == pytest.approx(levels, abs=6.0)


def test_video_is_readable_though_the_program_died(tmp_path: Path) -> None:
    path = tmp_path / "overlay.mp4"
    writer = OverlayWriter(path, (320, 240), 5.0)
    for level in range(40):
        writer.write(np.full((240, 320, 3), 3 * level, np.uint8))
    dead = tmp_path / "dead.mp4"
    dead.write_bytes(path.read_bytes())
    writer.close()
    with av.open(str(dead)) as container:
        n_frames = sum(1 for _ in container.decode(video=0))
    # A key frame, and with it a fragment, comes every two seconds.
    assert n_frames >= 20


def test_video_without_pictures_closes_quietly(tmp_path: Path) -> None:
    with OverlayWriter(tmp_path / "overlay.mp4", (320, 240), 25.0):
        pass


def test_video_refuses_another_size(tmp_path: Path) -> None:
    with (
        OverlayWriter(tmp_path / "overlay.mp4", (320, 240), 25.0) as writer,
        pytest.raises(ValueError, match=r"\(240, 320, 3\)"),
    ):
        writer.write(np.zeros((100, 100, 3), np.uint8))


def test_video_that_cannot_be_written_names_file_and_remedy(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"no-folder/overlay\.mp4: cannot write.*choose"):
        OverlayWriter(tmp_path / "no-folder" / "overlay.mp4", (320, 240), 25.0)
