"""A field is measured by the camera of its whole picture, as if the other field were not there."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.live.runner import wall_frame
from aqualvs.optics.camera import Camera
from aqualvs.optics.lens import Lens
from aqualvs.optics.shutter import FIRST_ROW, Shutter, ShutterKind
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.stripe import ThresholdOptions
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from aqualvs.sources.fields import field_of, frames_of

_FIELDS = Shutter(kind=ShutterKind.INTERLACED, readout=0.02)


def with_fields(rig, first="top"):
    return replace(rig, shutter=replace(_FIELDS, first_field=first))


@pytest.mark.parametrize("field", ["top", "bottom"])
@pytest.mark.parametrize("rig", [example_rig(), bluerov2_rig()], ids=["pal", "1080i"])
def test_rows_of_a_field_are_those_of_a_camera_of_half_the_height(rig, field):
    """The bands' lines and the peaks' positions are where that camera's own model puts them."""
    row = FIRST_ROW[field]
    whole, lens = rig.bare_camera(), rig.lens
    half = Camera(
        size_px=(rig.size_px[0], rig.size_px[1] // 2),
        lens=Lens(
            model=lens.model,
            fx=lens.fx,
            fy=0.5 * lens.fy,
            cx=lens.cx,
            cy=0.5 * (lens.cy - row),
            distortion=lens.distortion,
        ),
        dome_from_cam=rig.dome_from_cam,
    )
    width, height = half.size_px
    x, y = np.meshgrid(np.arange(0, width, 37.0), np.arange(0, height, 19.0))
    in_field = np.stack([x, y], axis=-1)
    rays = half.rays(in_field)
    in_picture, valid = whole.project(rays.origins + 0.7 * rays.directions)
    assert valid.all()
    assert np.abs(in_picture[..., 0] - x).max() < 1e-9
    for search in plan_bands(rig, rig.camera(), field):
        lines = np.arange(len(search.lowest))
        across = (lines + 0.5) * search.line_px - 0.5 + search.shift_px
        if search.axis is SearchAxis.ALONG_X:
            assert len(lines) == height
            assert np.abs(across[::19] - in_picture[:, 0, 1]).max() < 1e-9
    assert np.abs(in_picture[..., 1] - (2.0 * y + row)).max() < 1e-9


@pytest.mark.parametrize("first", ["top", "bottom"])
@pytest.mark.parametrize("rig", [example_rig(), bluerov2_rig()], ids=["pal", "1080i"])
def test_both_fields_of_a_still_picture_give_the_posture_of_the_whole(rig, first):
    picture = wall_frame(rig)
    whole = Scanner(rig).process(picture).posture
    scanner = Scanner(with_fields(rig, first))
    for frame in frames_of([picture], scanner.rig.shutter):
        found = scanner.process(frame).posture
        # One row to the other side would shift the range by half a percent.
        assert found.range == pytest.approx(whole.range, rel=5e-4)
        assert [found.pitch, found.yaw] == pytest.approx([whole.pitch, whole.yaw], abs=1e-3)


@pytest.mark.parametrize("options", [ScannerOptions(), ScannerOptions(detector=ThresholdOptions())])
def test_the_other_field_is_not_looked_at(options):
    scanner = Scanner(with_fields(example_rig()), options)
    picture = wall_frame(example_rig())
    other = picture.luma.copy()
    other[1::2] = 255
    results = [
        scanner.process(field_of(one, "top")) for one in (picture, replace(picture, luma=other))
    ]
    assert results[0].posture
    assert np.array_equal(results[0].points.pixels, results[1].points.pixels)


def test_a_frame_that_is_no_field_or_the_other_one_is_refused():
    picture = wall_frame(example_rig())
    with pytest.raises(ValueError, match="a whole picture but expected top"):
        Scanner(with_fields(example_rig())).process(picture)
    with pytest.raises(ValueError, match="is top but expected bottom"):
        Scanner(with_fields(example_rig(), "bottom")).process(field_of(picture, "top"))
    with pytest.raises(ValueError, match="is top but expected a whole picture"):
        Scanner(example_rig()).process(field_of(picture, "top"))
