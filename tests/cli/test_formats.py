"""`aqualvs import`, `aqualvs export` and `aqualvs schema` as a user calls them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from aqualvs.calibration.targets.target_files import load_board
from aqualvs.cli.main import main
from aqualvs.demo import bundled_dive
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.rigschema import rig_json_schema
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.optics.solved import assumptions, with_exact_numbers

DEMO_RIG = Path(str(bundled_dive())) / "rig.yaml"
FILES = {
    "ros": "camera_info.yaml",
    "opencv": "camera.xml",
    "kalibr": "camchain.yaml",
    "mrcal": "front.cameramodel",
    "colmap": "cameras.txt",
    "colmap-underwater": "cameras_dome.txt",
}


def said(capture, *arguments):
    code = main([str(one) for one in arguments])
    out, err = capture.readouterr()
    assert code == 0, err
    assert not err
    return out


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("to", FILES)
def test_out_and_in_again(here, capsys, to):
    out = said(capsys, "export", DEMO_RIG, "--to", to, "-o", FILES[to])
    assert f"{to}: {FILES[to]}" in out
    assert "left out, as the format lacks it:" in out
    assert "3 lasers" in out
    out = said(capsys, "import", FILES[to], "--as", "rig", "-o", "rig.yaml")
    rig, before = load_rig("rig.yaml", need_lasers=False), load_rig(DEMO_RIG)
    assert rig.lens.fx == before.lens.fx
    assert (rig.dome is not None) == (to == "colmap-underwater")
    assert rig.solved_from["imported"]["file"] == FILES[to]
    # What is assumed of its uncertainty is what every later command assumes.
    for one in assumptions(rig):
        assert one.words in out
    # The second time changes nothing, and keeps no copy.
    said(capsys, "import", FILES[to], "-o", "rig.yaml")
    assert len(list(here.glob("rig*.yaml"))) == 1


def test_as_camera_leaves_the_dome_out_and_says_so(here, capsys):
    said(capsys, "export", DEMO_RIG, "--to", "colmap-underwater", "-o", "cameras.txt")
    out = said(capsys, "import", "cameras.txt", "--as", "camera", "-o", "rig.yaml")
    assert "left out: the housing" in out
    assert load_rig("rig.yaml", need_lasers=False).dome is None


def test_a_target_becomes_a_board_file(here, capfd, refused):
    (here / "target.yaml").write_text(
        "target_type: checkerboard\ntargetCols: 6\ntargetRows: 7\n"
        "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n"
    )
    assert "board: board.yaml" in said(capfd, "import", "target.yaml", "-o", "board.yaml")
    assert load_board("board.yaml").squares == (7, 8)
    assert "--overwrite" in refused("import", "target.yaml", "-o", "board.yaml")
    said(capfd, "import", "target.yaml", "-o", "board.yaml", "--overwrite")
    assert "--as board" in refused("import", "target.yaml", "--as", "rig", "-o", "rig.yaml")


def test_files_of_others_are_never_overwritten(here, capfd, refused):
    (here / "mine.yaml").write_text("my: notes\n")
    said(capfd, "export", DEMO_RIG, "--to", "ros", "-o", "camera_info.yaml")
    for arguments in (
        ("export", DEMO_RIG, "--to", "ros", "-o", "mine.yaml", "--overwrite"),
        ("import", "camera_info.yaml", "-o", "mine.yaml", "--overwrite"),
    ):
        assert "mine.yaml: exists" in refused(*arguments)
    assert (here / "mine.yaml").read_text() == "my: notes\n"
    again = ("export", DEMO_RIG, "--to", "kalibr", "-o", "camera_info.yaml")
    assert "--overwrite" in refused(*again)
    said(capfd, *again, "--overwrite")
    # A rig that is there is kept under a dated name, as after calibrations.
    save_rig(load_rig(DEMO_RIG), "rig.yaml")
    assert "the one before is" in said(capfd, "import", "camera_info.yaml", "-o", "rig.yaml")
    assert len(list(here.glob("rig.*.yaml"))) == 1


def test_the_size_of_the_pictures_can_be_told(here, capfd, refused):
    (here / "camera.json").write_text('{"K": [[800, 0, 320], [0, 800, 240], [0, 0, 1]]}')
    (here / "camera.yml").write_text(
        "%YAML:1.0\n---\nK: [800, 0, 320, 0, 800, 240, 0, 0, 1]\nD: [0.1, 0.0, 0.0, 0.0, 0.0]\n"
    )
    command = ("import", "camera.yml", "-o", "rig.yaml")
    assert "--image 1920x1080" in refused(*command)
    assert "width x height" in refused(*command, "--image", "640")
    said(capfd, *command, "--image", "640x480")
    assert load_rig("rig.yaml", need_lasers=False).size_px == (640, 480)
    said(capfd, "export", "rig.yaml", "--to", "ros", "-o", "ros.yaml")
    other = refused("import", "ros.yaml", "-o", "rig.yaml", "--image", "64x48")
    assert "says 640x480" in other
    # Without a sign of its program a file is not guessed at.
    assert "not a calibration in a known format" in refused("import", "camera.json", "-o", "r.yaml")


def test_rig_and_nominal_name_the_command(here, capfd, refused):
    said(capfd, "export", DEMO_RIG, "--to", "mrcal", "-o", "a.cameramodel")
    line = refused("run", "dive.mp4", "--rig", "a.cameramodel", "-o", "out")
    command = re.search(r"run '(aqualvs import .*)' and give rig.yaml", line)[1].split()
    said(capfd, *command[1:])
    assert load_rig("rig.yaml", need_lasers=False).lens.distortion
    assert "aqualvs import" in refused("check", "a.cameramodel")


def test_a_bare_camera_in_air_is_no_fault_of_a_rig(here, capsys):
    (here / "rig.yaml").write_text(
        "aqualvs_rig: 1\nimage: {width_px: 720, height_px: 576}\n"
        "camera: {fx_px: 817, fy_px: 878, cx_px: 369, cy_px: 282}\n"
        "lasers:\n"
        "- {name: left, normal: [0.97, -0.24, 0.0], offset_mm: -140}\n"
        "- {name: lower, normal: [0.0, -0.24, 0.97], offset_mm: -140}\n"
    )
    out = said(capsys, "check", "rig.yaml")
    assert "rays start at the lens, in air" in out
    assert "field of view in air" in out
    assert "in the water" not in out


def test_the_covariance_and_the_shutter_that_are_left_out_are_named(here, capsys):
    rolling = Shutter(kind=ShutterKind.ROLLING, readout=0.02)
    save_rig(replace(with_exact_numbers(load_rig(DEMO_RIG)), shutter=rolling), "rig.yaml")
    out = said(capsys, "export", "rig.yaml", "--to", "colmap-underwater", "-o", "cameras.txt")
    assert "the shutter, the covariance" in out


def test_the_schema_is_printed(capsys):
    assert json.loads(said(capsys, "schema")) == rig_json_schema()
