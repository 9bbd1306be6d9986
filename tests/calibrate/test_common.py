"""What is known of a rig before any calibration, and the pictures of one."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from aqualvs.calibrate.common import detect_targets, load_nominal
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError, RigError
from aqualvs.optics.dome import Dome
from aqualvs.optics.rigfile import save_rig
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.simulation.scenarios import example_rig


def test_a_nominal_file(tmp_path):
    path = tmp_path / "nominal.yaml"
    path.write_text(
        "name: blue\nimage: {width: 720, height: 576}\nn_air: 1.0002\nfps: 25\n"
        "dome: {inner_radius_mm: 44.25, thickness_mm: 5.75, n_acrylic: 1.48}\n"
        "lasers: {count: 3, wavelength_nm: 650}\nworking_range_mm: [300, 900]\n"
    )
    nominal = load_nominal(path)
    assert nominal.working_range == (0.3, 0.9)
    assert nominal.wavelength_nm == 650.0
    assert (nominal.name, nominal.size_px, nominal.n_lasers) == ("blue", (720, 576), 3)
    assert nominal.n_air == 1.0002
    assert isinstance(nominal.housing, Dome)
    assert nominal.housing.inner_radius == pytest.approx(0.04425, rel=1e-12)
    assert nominal.housing.n_acrylic == 1.48


def test_a_nominal_file_states_the_shutter_as_a_rig_file_does(tmp_path):
    path = tmp_path / "nominal.yaml"
    path.write_text("camera: {shutter: {kind: interlaced, readout_ms: 20, first_field: bottom}}\n")
    shutter = Shutter(kind=ShutterKind.INTERLACED, readout=0.02, first_field="bottom")
    assert load_nominal(path).shutter == shutter


def test_a_rig_file_serves_too(tmp_path):
    rig = example_rig()
    save_rig(rig, tmp_path / "rig.yaml")
    nominal = load_nominal(tmp_path / "rig.yaml")
    assert nominal.size_px == rig.size_px
    assert nominal.housing == rig.dome
    assert nominal.n_lasers == len(rig.lasers)
    assert nominal.n_water == rig.n_water
    assert nominal.wavelength_nm is None


@pytest.mark.parametrize(
    ("wavelengths", "common"), [((450.0, 450.0, 450.0), 450.0), ((450.0, 450.0, 532.0), None)]
)
def test_a_rig_says_what_its_lasers_agree_on(tmp_path, wavelengths, common):
    rig = example_rig()
    lasers = tuple(
        replace(laser, wavelength_nm=nm) for laser, nm in zip(rig.lasers, wavelengths, strict=True)
    )
    save_rig(replace(rig, lasers=lasers), tmp_path / "rig.yaml")
    assert load_nominal(tmp_path / "rig.yaml").wavelength_nm == common


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("dome: {inner_radius_mm: -3, thickness_mm: 5}", "dome.inner_radius_mm is -3"),
        ("lasers: {cuont: 3}", "lasers"),
        ("lasers: {count: 3, wavelength_nm: 5320}", "lasers.wavelength_nm is 5320"),
        ("working_range_mm: [900, 300]", "working_range_mm is [900, 300]"),
        ("working_range_mm: [0.3, 0.9]", "write [300, 900] if metres are meant"),
        ("camera: {shutter: {kind: rolling}}", "camera.shutter.readout_ms is missing or 0"),
        ("just words", "is not a nominal rig"),
    ],
)
def test_faults_name_file_place_and_value(tmp_path, text, words):
    path = tmp_path / "nominal.yaml"
    path.write_text(text)
    with pytest.raises(RigError, match=r"nominal\.yaml") as caught:
        load_nominal(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def seen(name, image):
    """Find a target in every picture, at its mean grey."""
    return View(name, np.arange(1), np.zeros((1, 3)), np.array([[image.mean(), 0.0]]))


def test_a_folder_a_pattern_and_an_iterable_are_pictures(tmp_path):
    for i in range(3):
        cv2.imwrite(str(tmp_path / f"view_{i}.png"), np.full((8, 10), i, np.uint8))
    for pictures in (str(tmp_path), tmp_path, f"{tmp_path}/*.png", tmp_path.glob("*.png")):
        assert len(detect_targets(pictures, seen, "board").views) == 3


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.zeros((8, 10), np.uint16), "picture 1: uint16 of shape"),
        (np.zeros((8, 10, 3), np.float32), "picture 1: float32 of shape"),
        (np.zeros((8, 10, 4), np.uint8), r"picture 1: uint8 of shape \(8, 10, 4\)"),
        (7, "picture 1: int; give the path of a file"),
    ],
    ids=["deep", "float", "transparent", "number"],
)
def test_an_array_that_is_no_picture_of_8_bits_is_refused(picture, words):
    with pytest.raises(CalibrationError, match=words):
        detect_targets([np.zeros((8, 10), np.uint8), picture], seen, "board")


def test_copies_of_a_picture_are_left_out_and_named(tmp_path):
    for name, grey in (("a", 1), ("b", 2), ("c", 3), ("d", 2)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((8, 10), grey, np.uint8))
    found = detect_targets(tmp_path, seen, "board")
    assert [view.name for view in found.views] == ["a.png", "b.png", "c.png"]
    assert found.missed == {"d.png": "it is a copy of b.png"}
    assert found.copies == {"d.png": "b.png"}
    assert "d.png: left out, it is a copy of b.png" in found.remarks
