"""Calibration files of other programs: there and back, what is refused, what is recognised."""

import ast
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from aqualvs.calibrate.common import load_nominal
from aqualvs.calibration.targets.target_files import load_board
from aqualvs.calibration.targets.targets import BoardKind
from aqualvs.calibration_files import (
    EXPORTS,
    camera_of_rig,
    camera_text,
    read_board,
    read_camera,
    rig_of_camera,
)
from aqualvs.calibration_files.command import ExportRequest, run_export
from aqualvs.calibration_formats import CalibrationFormat, recognised
from aqualvs.demo import bundled_dive
from aqualvs.errors import AqualvsError, CalibrationError, RigError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.simulation.scenarios import flat_port_rig
from repository import ROOT

DEMO = Path(str(bundled_dive()))
RIG = load_rig(DEMO / "rig.yaml")
FOUR = (-0.126, 0.0827, 0.0006, -0.0004)
LENSES = {
    n: Lens(fx=817.123456789, fy=878.1, cx=368.9, cy=281.7, distortion=values)
    for n, values in {
        0: (),
        4: FOUR,
        5: (*FOUR, -0.021),
        8: (*FOUR, -0.021, 0.031, -0.012, 0.004),
    }.items()
}
FISHEYE = Lens(
    model=LensModel.FISHEYE,
    fx=400.1,
    fy=401.3,
    cx=368.9,
    cy=281.7,
    distortion=(-0.013, 0.005, -0.0045, 0.0012),
)


def written(tmp_path, rig, to, name="file.yaml"):
    path = tmp_path / name
    path.write_text(camera_text(camera_of_rig(rig), to, suffix=path.suffix))
    return path


def same_lens(one, other, atol=0.0):
    assert one.model is other.model
    core = [(lens.fx, lens.fy, lens.cx, lens.cy) for lens in (one, other)]
    np.testing.assert_allclose(*core, rtol=0.0, atol=atol)
    n = max(len(one.distortion), len(other.distortion))
    padded = [[*lens.distortion, *[0.0] * (n - len(lens.distortion))] for lens in (one, other)]
    np.testing.assert_array_equal(*padded)


HOLDS = {
    "ros": (0, 4, 5, 8, "fisheye"),
    "opencv": (0, 4, 5, 8, "fisheye"),
    "kalibr": (0, 4, "fisheye"),
    "mrcal": (0, 4, 5, 8),
    "colmap": (0, 4, 5, 8, "fisheye"),
    "colmap-underwater": (0, 4, 5, 8, "fisheye"),
}


@pytest.mark.parametrize(("to", "n"), [(to, n) for to, held in HOLDS.items() for n in held])
def test_what_is_exported_comes_back_the_same(tmp_path, to, n):
    rig = replace(RIG, lens=FISHEYE if n == "fisheye" else LENSES[n])
    back = read_camera(written(tmp_path, rig, to))
    assert back.size_px == rig.size_px
    # Half a pixel is added and taken away again for COLMAP: a rounding error.
    same_lens(back.lens, rig.lens, atol=1e-12 if to.startswith("colmap") else 0.0)
    assert (back.port is not None) == (to == "colmap-underwater")


@pytest.mark.parametrize(
    ("to", "n"), [(to, n) for to in HOLDS for n in (0, 4, 5, 8, "fisheye") if n not in HOLDS[to]]
)
def test_a_format_that_lacks_a_coefficient_says_so(to, n):
    rig = replace(RIG, lens=FISHEYE if n == "fisheye" else LENSES[n])
    with pytest.raises(RigError, match="choose another format"):
        camera_text(camera_of_rig(rig), to)


def test_a_second_time_there_and_back_changes_nothing(tmp_path):
    for to in EXPORTS:
        first = written(tmp_path, RIG, to, "file.yaml")
        text = first.read_text()
        rig = rig_of_camera(read_camera(first), str(first))
        assert camera_text(camera_of_rig(replace(rig, name=RIG.name)), to) == text


def test_the_flat_port_comes_back_from_refractive_colmap(tmp_path):
    rig = replace(flat_port_rig(), housing=FlatPort(0.012, 0.005, 1.49, 0.3, -0.2))
    path = written(tmp_path, rig, "colmap-underwater", "cameras.txt")
    back = rig_of_camera(read_camera(path), str(path))
    assert back.flat_port.numbers() == pytest.approx(rig.flat_port.numbers(), abs=1e-12)
    assert (back.n_air, back.n_water) == (rig.n_air, rig.n_water)


def test_the_dome_comes_back_from_refractive_colmap(tmp_path):
    turn = rotation_from_rotvec(np.radians([2.0, -1.5, 0.7])) @ DOME_FROM_CAM_NOMINAL
    rig = replace(RIG, dome_from_cam=SE3(turn, np.array([3.1, 41.9, 3.0]) * 1e-3))
    path = written(tmp_path, rig, "colmap-underwater", "cameras.txt")
    back = rig_of_camera(read_camera(path), str(path))
    assert back.dome == rig.dome
    assert (back.n_air, back.n_water) == (rig.n_air, rig.n_water)
    # The axes of the dome's frame are not in the file; the light's way is the same.
    pixels = np.random.default_rng(1).uniform([0, 0], [719, 575], (200, 2))
    rays = [one.camera().rays(pixels) for one in (rig, back)]
    in_cam = [
        one.dome_from_cam.inverse().apply(ray.origins + 0.5 * ray.directions)
        for one, ray in zip((rig, back), rays, strict=True)
    ]
    np.testing.assert_allclose(*in_cam, atol=1e-12)


def test_opencv_reads_the_file_storage_that_is_written(tmp_path):
    for suffix in (".yml", ".xml", ".json"):
        storage = cv2.FileStorage(
            str(written(tmp_path, RIG, "opencv", f"camera{suffix}")), cv2.FileStorage_READ
        )
        matrix = storage.getNode("camera_matrix").mat()
        assert (matrix[0, 0], matrix[1, 2]) == (RIG.lens.fx, RIG.lens.cy)
        distortion = storage.getNode("distortion_coefficients").mat().ravel()
        np.testing.assert_array_equal(distortion, RIG.lens.distortion)


def test_readers_of_python_read_the_yaml_and_the_literal(tmp_path):
    tiny = replace(RIG, lens=replace(LENSES[4], distortion=(1e-7, -2e-9, 3e-5, 0.0)))
    ros = yaml.safe_load(camera_text(camera_of_rig(tiny), "ros"))
    assert ros["distortion_coefficients"]["data"][:2] == [1e-7, -2e-9]
    kalibr = yaml.safe_load(camera_text(camera_of_rig(tiny), "kalibr"))
    assert kalibr["cam0"]["distortion_coeffs"] == [*tiny.lens.distortion]
    mrcal = ast.literal_eval(camera_text(camera_of_rig(tiny), "mrcal"))
    assert mrcal["intrinsics"][4:] == [*tiny.lens.distortion]


def test_refractive_colmap_needs_a_housing():
    with pytest.raises(RigError, match="has no housing"):
        camera_text(camera_of_rig(replace(RIG, housing=None)), "colmap-underwater")


def test_a_flat_port_is_left_out_by_name(tmp_path):
    save_rig(flat_port_rig(), tmp_path / "rig.yaml")
    said = []
    run_export(
        ExportRequest(rig=tmp_path / "rig.yaml", to="opencv", out=tmp_path / "camera.yml"),
        said.append,
    )
    assert "the flat port (the intrinsics are those in air)" in said[-1]


# What is refused. ---------------------------------------------------------------------------------

ROS = camera_text(camera_of_rig(RIG), "ros")
KALIBR = camera_text(camera_of_rig(RIG), "kalibr")
MRCAL = camera_text(camera_of_rig(RIG), "mrcal")
OPENCV = camera_text(camera_of_rig(RIG), "opencv")
XML = camera_text(camera_of_rig(RIG), "opencv", suffix=".xml")
COLMAP = camera_text(camera_of_rig(RIG), "colmap")
DOME = camera_text(camera_of_rig(RIG), "colmap-underwater")
PORT = DOME.splitlines()[-1].split("DOMEPORT ")[1]

REFUSED = [
    (ROS, "plumb_bob", "thin_prism", ("distortion_model", "'thin_prism'", "plumb_bob")),
    (ROS, "plumb_bob", "rational_polynomial", ("5 values", "8")),
    (ROS, "[817.0, 0.0,", "[817.0, 0.3,", ("skew of 0.3",)),
    (ROS, "[817.0, 0.0,", "[817.0,", ("8 values", "rows times cols is 9")),
    (ROS, "[817.0,", "[-817.0,", ("focal lengths",)),
    (ROS, "[817.0,", "[.nan,", ("finite number",)),
    (ROS, "image_width: 720", "image_width: 0", ("width_px",)),
    (ROS, "image_width: 720", "image_width: 7.5", ("image_width is 7.5",)),
    (ROS, "image_width: 720\n", "", ("image_width is missing",)),
    (ROS, "image_width: 720", "image_width: 720\nbinning_x: 2", ("binning_x is 2",)),
    (ROS, "image_width: 720", "image_width: 720\nroi: {x_offset: 8}", ("roi.x_offset is 8",)),
    (OPENCV, "cols: 4", "cols: 2", ("4 values", "rows times cols is 2")),
    (OPENCV, "fisheye_model: 0\n", "", ("--model opencv", "--model fisheye")),
    (OPENCV, "image_width: 720\nimage_height: 576\n", "", ("--image",)),
    (OPENCV, "camera_matrix", "matrix_of_camera", ("camera_matrix is missing",)),
    (XML, "<opencv_storage>", "<opencv_storage><a>", ("is not XML",)),
    (XML, "<opencv_storage>", "<!DOCTYPE a><opencv_storage>", ("declarations",)),
    (KALIBR, "pinhole", "omni", ("cam0.camera_model", "'omni'", "pinhole-radtan")),
    (KALIBR, "pinhole", "eucm", ("cam0.camera_model", "'eucm'", "pinhole-radtan")),
    (KALIBR, "pinhole", "ds", ("cam0.camera_model", "'ds'")),
    (KALIBR, "radtan", "fov", ("cam0.distortion_model", "'fov'", "pinhole-equi")),
    (KALIBR, "resolution", "size", ("cam0.resolution is missing",)),
    (KALIBR, "[817.0, ", "[", ("cam0.intrinsics has 3 values; write 4",)),
    (MRCAL, "LENSMODEL_OPENCV4", "LENSMODEL_CAHVORE_linearity=0.37", ("CAHVORE", "mrcal-convert")),
    (
        MRCAL,
        "LENSMODEL_OPENCV4",
        "LENSMODEL_SPLINED_STEREOGRAPHIC_order=3_Nx=30_Ny=18_fov_x_deg=120",
        ("LENSMODEL_SPLINED", "mrcal-convert-lensmodel"),
    ),
    (MRCAL, "LENSMODEL_OPENCV4", "LENSMODEL_OPENCV5", ("8 values; write 9",)),
    (MRCAL, "[720, 576]", "(", ("not a Python literal",)),
    (MRCAL, "[720, 576]", "open('x')", ("not a Python literal",)),
    (COLMAP, " OPENCV ", " THIN_PRISM_FISHEYE ", ("'THIN_PRISM_FISHEYE'", "FULL_OPENCV")),
    (COLMAP, " OPENCV ", " FULL_OPENCV ", ("8 values; write 12: fx, fy, cx, cy, k1",)),
    (COLMAP, "1 OPENCV", "1 PINHOLE 1 1 1 1 1 1\n2 OPENCV", ("cameras 1, 2", "--camera 1")),
    (DOME, "DOMEPORT", "CUBEPORT", ("'CUBEPORT'", "DOMEPORT and FLATPORT")),
    (DOME, "DOMEPORT", "FLATPORT", ("has the length 0.04", "unit vector")),
    (DOME, f"DOMEPORT {PORT}", "FLATPORT 0 0 -1 0.01 0.005 1 1.49 1.33", ("tilted by -180",)),
    (DOME, PORT, "0 0 0 0.05", ("4 values; write 8: Cx, Cy, Cz, int_radius",)),
    (DOME, PORT, "0 0 -0.06 0.05 0.005 1 1.49 1.33", ("outside its inner radius",)),
    (DOME, PORT, "0 0 0 0.05 0.005 1 1.49 13.3", ("water.n",)),
]


@pytest.mark.parametrize(("text", "old", "new", "words"), REFUSED)
def test_what_the_lens_lacks_or_is_no_camera_is_refused_by_name(tmp_path, text, old, new, words):
    assert old in text
    path = tmp_path / "odd.txt"
    path.write_text(text.replace(old, new))
    with pytest.raises(AqualvsError) as caught:
        rig_of_camera(read_camera(path), str(path))
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert line.count(str(path)) == 1
    assert "\n" not in line
    for word in words:
        assert word in line


def test_thin_prism_terms_of_mrcal_are_refused(tmp_path):
    values = [817.0, 878.0, 369.0, 282.0, *LENSES[8].distortion, 1e-3, 0.0, 0.0, 0.0]
    path = tmp_path / "cam.cameramodel"
    path.write_text(
        f"{{'lensmodel': 'LENSMODEL_OPENCV12', 'intrinsics': {values}, 'imagersize': [720, 576]}}"
    )
    with pytest.raises(RigError, match="thin prism"):
        read_camera(path)


def test_nothing_in_a_cameramodel_is_run(tmp_path):
    path = tmp_path / "cam.cameramodel"
    path.write_text(f"{{'lensmodel': 'LENSMODEL_X', 'a': open({str(tmp_path / 'made')!r}, 'w')}}")
    with pytest.raises(RigError, match="not a Python literal"):
        read_camera(path)
    assert not (tmp_path / "made").exists()


def test_one_of_several_cameras_is_chosen_by_name(tmp_path):
    path = tmp_path / "camchain.yaml"
    other = KALIBR.replace("cam0", "cam1").replace("817.0", "500.0")
    path.write_text(KALIBR + other)
    assert read_camera(path, camera="cam1").lens.fx == 500.0
    with pytest.raises(RigError, match="cam0, cam1; say which, such as --camera cam0"):
        read_camera(path)
    with pytest.raises(RigError, match="no camera 'cam7'; give one of cam0, cam1"):
        read_camera(path, camera="cam7")


@pytest.mark.parametrize(
    ("written", "read"), [("15021204", "15021204"), ("''", "file"), ("front", "front")]
)
def test_a_camera_may_be_named_by_its_serial_number(tmp_path, written, read):
    path = tmp_path / "file.yaml"
    path.write_text(ROS.replace("camera_name: example", f"camera_name: {written}"))
    assert rig_of_camera(read_camera(path), str(path)).name == read


def test_a_file_storage_without_its_model_is_read_as_told(tmp_path):
    path = tmp_path / "camera.yml"
    path.write_text(OPENCV.replace("fisheye_model: 0\n", ""))
    for model in LensModel:
        assert read_camera(path, model=model.value).lens.model is model


# Targets of Kalibr. -------------------------------------------------------------------------------

CHECKERBOARD = """target_type: 'checkerboard' #gridtype
targetCols: 6               #number of internal chessboard corners
targetRows: 7               #number of internal chessboard corners
rowSpacingMeters: 0.06      #size of one chessboard square [m]
colSpacingMeters: 0.06      #size of one chessboard square [m]
"""
APRILGRID = "target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 6\ntagSize: 0.088\ntagSpacing: 0.3\n"


def test_a_checkerboard_of_kalibr_becomes_a_board(tmp_path):
    path = tmp_path / "target.yaml"
    path.write_text(CHECKERBOARD)
    board = read_board(path)
    assert board.kind is BoardKind.CHESSBOARD
    assert board.corner_grid == (6, 7)
    assert board.square == 0.06


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (APRILGRID, "aprilgrid.*aqualvs board charuco"),
        (CHECKERBOARD.replace("checkerboard", "circlegrid"), "'circlegrid'"),
        (CHECKERBOARD.replace("colSpacingMeters: 0.06", "colSpacingMeters: 0.05"), "squares"),
        (CHECKERBOARD.replace("targetCols: 6", "targetCols: 1"), "3 each way"),
        (ROS, "holds no board"),
    ],
)
def test_targets_that_are_no_board_are_refused(tmp_path, text, words):
    path = tmp_path / "target.yaml"
    path.write_text(text)
    with pytest.raises(RigError, match=words):
        read_board(path)


# Recognition. -------------------------------------------------------------------------------------

TEXTS = {
    CalibrationFormat.ROS: ROS,
    CalibrationFormat.OPENCV: OPENCV,
    CalibrationFormat.KALIBR: KALIBR,
    CalibrationFormat.KALIBR_TARGET: CHECKERBOARD,
    CalibrationFormat.MRCAL: MRCAL,
    CalibrationFormat.COLMAP: DOME,
}


@pytest.mark.parametrize("known", TEXTS)
def test_foreign_files_are_recognised_and_the_command_is_named(tmp_path, known):
    assert recognised(TEXTS[known]) is known
    path = tmp_path / "of another.txt"
    path.write_text(TEXTS[known])
    for read, error in (
        (load_rig, RigError),
        (load_nominal, RigError),
        (load_board, CalibrationError),
    ):
        with pytest.raises(error) as caught:
            read(path)
        assert f"run 'aqualvs import '{path}' -o " in str(caught.value)
        assert "\n" not in str(caught.value)


def test_files_of_aqualvs_are_not_taken_for_others():
    ours = [
        *DEMO.parent.glob("**/*.yaml"),
        *ROOT.glob("tests/data/**/*.yaml"),
        *ROOT.glob("docs/*.md"),
    ]
    assert len(ours) > 30
    for path in ours:
        if path.name != "formats.md":
            assert recognised(path.read_text()) is None, path


def test_what_is_no_calibration_is_told_what_there_is(tmp_path):
    path = tmp_path / "x.yaml"
    path.write_text("a: 1\n")
    with pytest.raises(RigError, match="not a calibration in a known format; give a camera_info"):
        read_camera(path)
    with pytest.raises(RigError, match="is a rig file already"):
        read_camera(DEMO / "rig.yaml")
