"""The rig file: what is read, what is refused and in which words, and that nothing drifts."""

import copy
import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.demo import bundled_dive
from aqualvs.errors import OutputError, RigError
from aqualvs.geometry import SE3, Plane, rotation_from_rotvec
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Laser, Rig
from aqualvs.optics.rigfile import load_rig, rig_from_mapping, rig_to_mapping, save_rig
from aqualvs.optics.rigschema import (
    CameraPart,
    DomePart,
    ImagePart,
    LaserPart,
    RigFile,
    WaterPart,
    WindowPart,
    rig_json_schema,
)
from aqualvs.optics.sheet import sheets_of
from aqualvs.optics.water import seawater_index_vacuum
from aqualvs.yamlfile import parse_yaml
from json_schema import is_valid
from repository import ROOT

HAND_WRITTEN = """\
aqualvs_rig: 1
name: paper
image: {width_px: 720, height_px: 576}
camera:
  fx_px: 817.5
  fy_px: 878
  cx_px: 368.9
  cy_px: 281.7
  distortion: [-0.126, 0.0827, 0.0006, -0.0004, 0.0]
  position_mm: [3.1, 41.9, 3.0]
  rotation_deg: [2.3, 1.7, 0.9]
dome: {inner_radius_mm: 44.25, thickness_mm: 5.75, n_acrylic: 1.49}
water: {n: 1.3333}
lasers:
  - {name: horizontal, normal: [-0.02, -0.34, 0.94], offset_mm: -142.8}
  - {name: vertical, normal: [3, 0, 4], offset_mm: -137.7}
"""


def hand_written(**changes: Any) -> dict[str, Any]:
    """Return the file above with dotted keys set, or deleted where the value is `...`."""
    content = yaml.safe_load(HAND_WRITTEN)
    for dotted, value in changes.items():
        *parents, key = dotted.split("__")
        part = content
        for parent in parents:
            part = part[int(parent)] if parent.isdigit() else part[parent]
        if value is ...:
            del part[key]
        else:
            part[key] = copy.deepcopy(value)
    return content


def same(one: Rig, other: Rig, *, rotation_atol: float = 0.0) -> bool:
    """Whether two rigs are the same bit for bit, the rotation to `rotation_atol`."""
    turn, other_turn = one.dome_from_cam.rotation, other.dome_from_cam.rotation
    return (
        np.allclose(turn, other_turn, rtol=0.0, atol=rotation_atol)
        and np.array_equal(one.dome_from_cam.translation, other.dome_from_cam.translation)
        and (one.name, one.size_px, one.lens, one.housing)
        == (other.name, other.size_px, other.lens, other.housing)
        and (one.n_air, one.n_water, one.working_range)
        == (other.n_air, other.n_water, other.working_range)
        and [laser.name for laser in one.lasers] == [laser.name for laser in other.lasers]
        and all(
            np.array_equal(a.plane.normal, b.plane.normal)
            and a.plane.offset == b.plane.offset
            and a.wavelength_nm == b.wavelength_nm
            for a, b in zip(one.lasers, other.lasers, strict=True)
        )
        and dict(one.solved_from) == dict(other.solved_from)
    )


def fault(content: object) -> str:
    """Return what is said about a faulty file: one line that begins with the file's name."""
    with pytest.raises(RigError) as caught:
        rig_from_mapping(content, source_name="my.yaml")
    message = str(caught.value)
    assert message.startswith("my.yaml: ")
    assert "\n" not in message
    return message


def test_hand_written_file_becomes_si(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text(HAND_WRITTEN)
    rig = load_rig(path)
    assert rig.name == "paper"
    assert rig.size_px == (720, 576)
    assert rig.lens == Lens(
        fx=817.5, fy=878.0, cx=368.9, cy=281.7, distortion=(-0.126, 0.0827, 0.0006, -0.0004, 0.0)
    )
    assert rig.dome == Dome(0.04425, 0.00575, 1.49)
    assert (rig.n_air, rig.n_water) == (1.0003, 1.3333)
    assert rig.working_range == (0.25, 1.3)
    np.testing.assert_array_equal(rig.dome_from_cam.translation, [0.0031, 0.0419, 0.003])
    turn = rotation_from_rotvec(np.deg2rad([2.3, 1.7, 0.9]))
    np.testing.assert_array_equal(rig.dome_from_cam.rotation, turn @ DOME_FROM_CAM_NOMINAL)


def test_nominal_camera_looks_forward() -> None:
    rig = rig_from_mapping(hand_written(camera__rotation_deg=[0, 0, 0]), source_name="x")
    np.testing.assert_array_equal(rig.dome_from_cam.rotate([0.0, 0.0, 1.0]), [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(rig.dome_from_cam.rotate([0.0, 1.0, 0.0]), [0.0, 0.0, -1.0])
    np.testing.assert_array_equal(rig.dome_from_cam.rotate([1.0, 0.0, 0.0]), [1.0, 0.0, 0.0])


def test_offset_belongs_to_the_unit_normal() -> None:
    rig = rig_from_mapping(hand_written(), source_name="x")
    # 1e-15: two roundings of a division.
    np.testing.assert_allclose(rig.lasers[1].plane.normal, [0.6, 0.0, 0.8], rtol=1e-15)
    assert rig.lasers[1].plane.offset == -0.1377


def test_water_from_temperature_and_salinity() -> None:
    rig = rig_from_mapping(
        hand_written(water={"temperature_c": 15, "salinity_permille": 38, "wavelength_nm": 520}),
        source_name="x",
    )
    assert rig.n_water == seawater_index_vacuum(15.0, 38.0, 520.0, n_air=1.0003)
    default = rig_from_mapping(
        hand_written(water={"temperature_c": 15, "salinity_permille": 38}), source_name="x"
    )
    assert default.n_water == seawater_index_vacuum(15.0, 38.0, 532.0)


@pytest.mark.parametrize(
    ("wavelengths", "light_nm"),
    [((650, 650), 650.0), ((450, 650), 532.0), ((None, 650), 532.0), ((780, 780), 700.0)],
)
def test_water_has_the_index_of_the_lasers_light(
    wavelengths: tuple[int | None, int | None], light_nm: float
) -> None:
    content = hand_written(water={"temperature_c": 15, "salinity_permille": 38})
    for laser, nm in zip(content["lasers"], wavelengths, strict=True):
        if nm is not None:
            laser["wavelength_nm"] = nm
    expected = seawater_index_vacuum(15.0, 38.0, light_nm)
    assert rig_from_mapping(content, source_name="x").n_water == expected


def test_bare_lens_and_fisheye() -> None:
    content = hand_written(
        dome=..., camera__model="fisheye", camera__distortion=[0.1, 0.0, 0.0, 0.0]
    )
    rig = rig_from_mapping(content, source_name="x")
    assert rig.dome is None
    assert rig.lens.model is LensModel.FISHEYE
    assert same(rig, rig_from_mapping(rig_to_mapping(rig), source_name="y"))


@pytest.mark.parametrize("housing", [..., "flat"])
def test_a_flat_port(housing: object) -> None:
    changes = FLAT if housing is ... else FLAT | {"housing": housing}
    rig = rig_from_mapping(hand_written(**changes), source_name="x")
    tilt = math.radians(0.4), math.radians(-0.2)
    assert rig.housing == FlatPort(0.012, 0.005, 1.49, *tilt)
    assert (rig.dome, rig.flat_port) == (None, rig.housing)
    camera = rig.camera()
    assert camera.housing is not None
    assert isinstance(camera.housing, FlatPort)
    np.testing.assert_array_equal(rig.dome_from_cam.translation, np.zeros(3))
    assert rig_to_mapping(rig)["housing"] == "flat"
    again = rig_from_mapping(rig_to_mapping(rig), source_name="y")
    assert again.housing == rig.housing


def test_the_housing_may_be_named() -> None:
    named = rig_from_mapping(hand_written(housing="dome"), source_name="x")
    assert same(named, rig_from_mapping(hand_written(), source_name="x"))
    assert "housing" not in rig_to_mapping(named)
    bare = rig_from_mapping(hand_written(dome=..., housing="none"), source_name="x")
    assert bare.housing is None


def test_lasers_may_be_missing_only_before_their_calibration() -> None:
    content = hand_written(lasers=...)
    assert rig_from_mapping(content, source_name="x", need_lasers=False).lasers == ()
    assert "calibrate lasers" in fault(content)
    assert "lasers is empty" in fault(hand_written(lasers=[]))


WINDOW = {"normal": [0.0, 1.0, 0.0], "offset_mm": 40.0, "source_mm": [0.0, 0.0, -152.0]}

FLAT: dict[str, Any] = {
    "dome": ...,
    "camera__position_mm": ...,
    "flat": {"distance_mm": 12.0, "thickness_mm": 5.0, "n_port": 1.49, "tilt_deg": [0.4, -0.2]},
}

FAULTS: list[tuple[dict[str, Any], tuple[str, ...]]] = [
    ({"aqualvs_rig": ...}, ("aqualvs_rig is missing", "aqualvs_rig: 1")),
    ({"aqualvs_rig": 2}, ("aqualvs_rig is 2", "version 1")),
    ({"aqualvs_rig": "1"}, ("aqualvs_rig is '1'",)),
    ({"aqualvs_rig": True}, ("aqualvs_rig is True",)),
    ({"camera__fx_px": ...}, ("camera.fx_px is missing", "fx_px: 817.5")),
    ({"image__width": 720}, ("image.width is not a key", "'width_px'")),
    ({"image__width": 720, "image__width_px": ...}, ("image.width is not a key", "'width_px'")),
    ({"lasers__1__ofset_mm": 1.0}, ("lasers[1].ofset_mm is not a key", "'offset_mm'")),
    ({"fps": 25}, ("fps is not a key", "allowed here: aqualvs_rig, name")),
    ({"camera__fx_px": "817.5"}, ("camera.fx_px is '817.5'", "plain number")),
    ({"camera__fx_px": True}, ("camera.fx_px is True", "plain number")),
    ({"camera__fx_px": -817.5}, ("camera.fx_px is -817.5", "greater than 0")),
    ({"camera__fx_px": 1e300}, ("camera.fx_px is 1e+300", "at most 1e+07")),
    ({"camera__fx_px": None}, ("camera.fx_px is empty", "plain number")),
    ({"camera__cx_px": float("nan")}, ("camera.cx_px is nan", "finite")),
    ({"camera__distortion": [0.1, float("inf"), 0, 0]}, ("camera.distortion[1] is inf", "finite")),
    ({"camera__distortion": [0.1, 0.2, 0.3]}, ("camera.distortion has 3 values", "0, 4, 5 or 8")),
    (
        {"camera__model": "fisheye", "camera__distortion": [0.1] * 5},
        ("camera.distortion has 5 values", "fisheye", "0 or 4"),
    ),
    ({"camera__model": "pinhole"}, ("camera.model is 'pinhole'", "'opencv' or 'fisheye'")),
    ({"camera__position_mm": [1.0, 2.0]}, ("camera.position_mm", "3 values")),
    ({"camera__position_mm": [0, 44.25, 0]}, ("camera.position_mm", "44.2 mm", "44.25 mm")),
    ({"camera": [1, 2]}, ("camera is [1, 2]", "keys and values")),
    ({"image__width_px": 720.5}, ("image.width_px is 720.5", "whole number")),
    ({"image__height_px": 0}, ("image.height_px is 0", "greater than 0")),
    ({"dome__thickness_mm": -1}, ("dome.thickness_mm is -1", "at least 0")),
    ({"dome__inner_radius_mm": 0}, ("dome.inner_radius_mm is 0", "greater than 0")),
    ({"dome__n_acrylic": 0.9}, ("dome.n_acrylic is 0.9", "at least 1")),
    ({"flat": FLAT["flat"]}, ("dome and flat: both are given", "leave one out")),
    ({"housing": "flat"}, ("housing is 'flat' but 'dome' is given", "agree")),
    ({"housing": "none"}, ("housing is 'none' but 'dome' is given", "agree")),
    ({"housing": "dome", "dome": ...}, ("housing is 'dome' but neither",)),
    ({"housing": "window"}, ("housing is 'window'", "'dome', 'flat' or 'none'")),
    ({**FLAT, "housing": "dome"}, ("housing is 'dome' but 'flat' is given", "agree")),
    ({**FLAT, "flat__distance_mm": 0}, ("flat.distance_mm is 0", "greater than 0")),
    ({**FLAT, "flat__distance_mm": ...}, ("flat.distance_mm is missing", "distance_mm: 12")),
    ({**FLAT, "flat__thickness_mm": -1}, ("flat.thickness_mm is -1", "at least 0")),
    ({**FLAT, "flat__n_port": 0.9}, ("flat.n_port is 0.9", "at least 1")),
    ({**FLAT, "flat__n_glass": 1.5}, ("flat.n_glass is not a key", "allowed here: distance_mm")),
    ({**FLAT, "flat__tilt_deg": [1.0]}, ("flat.tilt_deg", "2 values")),
    ({**FLAT, "flat__tilt_deg": [0, 60]}, ("flat.tilt_deg[1] is 60", "at most 45")),
    ({**FLAT, "water": ...}, ("water is missing", "water: {n: 1.3333}")),
    ({"n_air": 1333}, ("n_air is 1333", "at most 2")),
    ({"water__n": 2.1}, ("water.n is 2.1", "at most 2")),
    ({"water": ...}, ("water is missing", "water: {n: 1.3333}")),
    (
        {"water": ..., "dome": ..., "lasers__0__window": WINDOW},
        ("water is missing", "water: {n: 1.3333}"),
    ),
    ({"camera__position_mm": ...}, ("camera.position_mm is missing", "position_mm: [0.0, 0.0")),
    ({"camera__position_mm": None}, ("camera.position_mm is missing",)),
    ({"water": {}}, ("water has no index", "temperature_c and salinity_permille")),
    ({"water": {"temperature_c": 15}}, ("water has no index", "salinity_permille")),
    ({"water__temperature_c": 15}, ("water gives n and", "keep either")),
    (
        {"water": {"temperature_c": 90, "salinity_permille": 0}},
        ("water.temperature_c is 90", "give degrees Celsius, from 0 to 30"),
    ),
    ({"lasers": {"name": "a"}}, ("lasers is {'name': 'a'}", "square brackets")),
    ({"lasers__1__normal": [0, 0, 0]}, ("lasers[1].normal is [0", "no direction")),
    ({"lasers__0__normal": [1, float("nan"), 0]}, ("lasers[0].normal[1] is nan", "finite")),
    ({"lasers__0__offset_mm": ...}, ("lasers[0].offset_mm is missing", "offset_mm: -140")),
    ({"lasers__1__name": "horizontal"}, ("lasers[1].name is 'horizontal'", "lasers[0]")),
    ({"lasers__1__name": ""}, ("lasers[1].name is ''", "name")),
    (
        {"lasers__1__wavelength_nm": 5320},
        ("lasers[1].wavelength_nm is 5320;", "in nanometres, 380 to 780, for example 532"),
    ),
    ({"lasers__0__wavelength_nm": 0.532}, ("lasers[0].wavelength_nm is 0.532;", "nanometres")),
    ({"lasers__0__wavelength_nm": float("nan")}, ("lasers[0].wavelength_nm is nan", "nanom")),
    ({"lasers__0__wavelength_nm": "red"}, ("lasers[0].wavelength_nm is 'red'", "nanometres")),
    ({"lasers__0__wave_nm": 532}, ("lasers[0].wave_nm is not a key", "'wavelength_nm'")),
    ({"working_range_mm": [1300, 250]}, ("working_range_mm is [1300, 250]", "nearest")),
    ({"working_range_mm": [0, 250]}, ("working_range_mm[0] is 0", "greater than 0")),
    ({"working_range_mm": [250, 500, 800]}, ("working_range_mm", "2 values")),
    ({"solved_from": "boards"}, ("solved_from is 'boards'", "keys and values")),
]

# Of the rig as a whole, or of what a number means: only the reader checks them.
BEYOND_SCHEMA: list[dict[str, Any]] = [
    {"camera__position_mm": [0, 44.25, 0]},
    {"water": {"temperature_c": 90, "salinity_permille": 0}},
    {"lasers__1__normal": [0, 0, 0]},
    {"lasers__1__name": "horizontal"},
    {"working_range_mm": [1300, 250]},
]


@pytest.mark.parametrize(("changes", "words"), FAULTS)
def test_fault_names_place_value_and_remedy(
    changes: dict[str, Any], words: tuple[str, ...]
) -> None:
    message = fault(hand_written(**changes))
    for word in words:
        assert word in message


@pytest.mark.parametrize("changes", [changes for changes, _ in FAULTS])
def test_the_json_schema_refuses_what_the_reader_refuses(changes: dict[str, Any]) -> None:
    assert is_valid(hand_written(**changes), rig_json_schema()) is (changes in BEYOND_SCHEMA)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"camera__model": "fisheye", "camera__distortion": [0.1, 0.0, 0.0, 0.0]},
        {"camera__distortion": ...},
        {"water": {"temperature_c": 15, "salinity_permille": 38, "wavelength_nm": 520}},
        {"dome": ..., "water": ..., "camera__position_mm": ...},
        {"dome": None, "water": None, "camera__position_mm": None},
        {"dome": ..., "lasers__0__window": WINDOW},
        {"lasers__0__wavelength_nm": 650},
        FLAT,
        FLAT | {"housing": "flat"},
        {"housing": "dome"},
        {"housing": "none", "dome": ...},
    ],
)
def test_the_json_schema_takes_what_the_reader_takes(changes: dict[str, Any]) -> None:
    content = hand_written(**changes)
    rig = rig_from_mapping(content, source_name="x")
    assert is_valid(content, rig_json_schema())
    assert is_valid(rig_to_mapping(rig), rig_json_schema())


def test_the_json_schema_takes_the_rigs_that_come_with_the_package() -> None:
    data = Path(str(bundled_dive())).parent
    rigs = [*data.rglob("rig*.yaml"), *(ROOT / "tests").rglob("rig*.yaml")]
    assert rigs
    for path in rigs:
        assert is_valid(parse_yaml(path.read_text(), str(path), RigError), rig_json_schema()), path


def test_the_published_json_schema_is_that_of_the_reader() -> None:
    published = json.loads((ROOT / "docs/rig.schema.json").read_text())
    assert published == rig_json_schema(), "run: aqualvs schema > docs/rig.schema.json"


def test_every_key_of_the_json_schema_says_what_it_is() -> None:
    schema = rig_json_schema()
    for part in (schema, *schema["$defs"].values()):
        for key, value in part["properties"].items():
            assert "description" in value or "$ref" in value or key == "window", key


def test_a_bare_lens_in_air_needs_neither_water_nor_position() -> None:
    rig = rig_from_mapping(
        hand_written(dome=..., water=..., camera__position_mm=...), source_name="x"
    )
    assert rig.n_water == rig.n_air
    np.testing.assert_array_equal(rig.dome_from_cam.translation, np.zeros(3))
    assert same(rig, rig_from_mapping(rig_to_mapping(rig), source_name="y"), rotation_atol=1e-13)


@pytest.mark.parametrize("content", [None, [], "rig", 3])
def test_something_else_than_a_mapping(content: object) -> None:
    assert "not a rig" in fault(content)


def test_a_long_value_is_cut() -> None:
    assert len(fault(hand_written(camera__fx_px="8" * 500))) < 200


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"camera: {fx_px: 1", ("is not YAML", "line 1")),
        (b"a: 1\nb: [1, 2\nc: }\n", ("is not YAML", "line 3")),
        (b"aqualvs_rig: 1\nn_air: 1.0003\nn_air: 1.0\n", ("'n_air' appears twice", "line 3")),
        (b"\xff\xfe\x00\x01", ("is not text",)),
        (b"\x00\x01\x02", ("is not YAML",)),
        (b"", ("not a rig", "aqualvs_rig: 1")),
    ],
)
def test_unreadable_content(tmp_path: Path, data: bytes, words: tuple[str, ...]) -> None:
    path = tmp_path / "rig.yaml"
    path.write_bytes(data)
    with pytest.raises(RigError) as caught:
        load_rig(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_no_such_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(RigError, match=r"none\.yaml: no such file"):
        load_rig(tmp_path / "none.yaml")
    with pytest.raises(RigError, match="is a folder"):
        load_rig(tmp_path)


def test_yaml_number_without_a_point_gets_its_remedy() -> None:
    # YAML 1.1 reads 1e-3 as a word.
    content = yaml.safe_load(HAND_WRITTEN.replace("0.0006", "6e-4"))
    assert "camera.distortion[2] is '6e-4'; write a plain number" in fault(content)


finite = st.floats(-1e3, 1e3, allow_subnormal=False)


@st.composite
def files(draw: st.DrawFn) -> dict[str, Any]:
    """Draw the content of a valid rig file, with every optional key there or not."""
    content = hand_written(
        camera__fx_px=draw(st.floats(1.0, 1e4)),
        camera__cx_px=draw(finite),
        camera__distortion=[draw(finite) for _ in range(draw(st.sampled_from([0, 4, 5, 8])))],
        camera__position_mm=[draw(st.floats(-25.0, 25.0)) for _ in range(3)],
        # Twelve decimals and an angle below 180 degrees are what the file keeps.
        camera__rotation_deg=[round(draw(st.floats(-100.0, 100.0)), 12) for _ in range(3)],
        dome__thickness_mm=draw(st.floats(0.0, 50.0)),
        water__n=draw(st.floats(1.0, 2.0)),
        working_range_mm=[draw(st.floats(1.0, 400.0)), draw(st.floats(401.0, 1e4))],
    )
    for laser in content["lasers"]:
        normal = st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3)
        laser["normal"] = draw(normal.filter(lambda n: np.linalg.norm(n) > 1e-3))
        laser["offset_mm"] = draw(finite)
        if draw(st.booleans()):
            laser["wavelength_nm"] = draw(st.floats(380.0, 780.0))
    if draw(st.booleans()):
        content["solved_from"] = {"views": draw(st.integers(0, 99)), "rms_px": draw(finite)}
    return content


@given(files())
@settings(max_examples=60, deadline=None)
def test_what_was_loaded_is_written_back_bit_for_bit(content: dict[str, Any]) -> None:
    rig = rig_from_mapping(content, source_name="x")
    mapping = rig_to_mapping(rig)
    again = rig_from_mapping(mapping, source_name="y")
    # A rotation vector comes from the matrix to within 1e-12 degrees.
    assert same(rig, again, rotation_atol=2e-14)
    assert rig_to_mapping(again) == mapping


def test_usual_file_is_written_back_exactly_as_it_was(tmp_path: Path) -> None:
    path, copy = tmp_path / "rig.yaml", tmp_path / "copy.yaml"
    content = hand_written(
        camera__model="opencv",
        lasers__0__normal=[0.0, -0.6, 0.8],
        lasers__1__normal=[0.6, 0.0, 0.8],
        n_air=1.0003,
        working_range_mm=[250.0, 1300.0],
        solved_from={"views": 14, "sigma_position_mm": [0.05, 0.06, 0.05]},
    )
    rig = rig_from_mapping(content, source_name="x")
    save_rig(rig, path)
    assert yaml.safe_load(path.read_text()) == content
    loaded = load_rig(path)
    assert same(rig, loaded)
    save_rig(loaded, copy)
    assert path.read_bytes() == copy.read_bytes()


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_a_solved_rig_comes_back(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lasers = tuple(
        Laser(f"l{i}", Plane.from_normal(rng.normal(size=3), rng.normal() * 0.1)) for i in range(3)
    )
    rotation = rotation_from_rotvec(rng.normal(size=3) * 0.05) @ DOME_FROM_CAM_NOMINAL
    rig = Rig(
        name="solved",
        size_px=(1920, 1080),
        lens=Lens(fx=rng.uniform(500, 2000), fy=1e3 + rng.normal(), cx=957.3, cy=543.1),
        dome_from_cam=SE3(rotation, rng.normal(size=3) * 0.01),
        housing=Dome(0.051, 0.006, 1.49),
        n_air=1.0003,
        n_water=1.333 + rng.normal() * 1e-3,
        lasers=lasers,
        working_range=(0.3, 1.2),
    )
    back = rig_from_mapping(rig_to_mapping(rig), source_name="x")
    # Millimetres reach all numbers of metres but one in fifty, which are one unit in the last
    # place away: 2.2e-16 relative. Rotations are written to 1e-12 degrees (1.7e-14 rad).
    np.testing.assert_allclose(
        back.dome_from_cam.translation, rig.dome_from_cam.translation, rtol=2.3e-16, atol=0.0
    )
    np.testing.assert_allclose(
        back.dome_from_cam.rotation, rig.dome_from_cam.rotation, rtol=0.0, atol=3e-14
    )
    for a, b in zip(rig.lasers, back.lasers, strict=True):
        np.testing.assert_array_equal(a.plane.normal, b.plane.normal)
        assert b.plane.offset == pytest.approx(a.plane.offset, rel=2.3e-16, abs=0.0)
    assert (back.lens, back.dome, back.n_water) == (rig.lens, rig.dome, rig.n_water)


def test_the_file_is_short_and_tidy(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    save_rig(rig_from_mapping(hand_written(), source_name="x"), path)
    lines = path.read_text().splitlines()
    assert lines[0].startswith("# ")
    assert lines[1] == "aqualvs_rig: 1"
    assert "dome: {inner_radius_mm: 44.25, thickness_mm: 5.75, n_acrylic: 1.49}" in lines
    assert "  position_mm: [3.1, 41.9, 3.0]" in lines
    assert len(lines) == 24
    assert max(map(len, lines)) <= 100


def test_solved_from_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    content = hand_written(solved_from={"dome": {"views": 14, "files": ["a.png", "ü.png"]}})
    save_rig(rig_from_mapping(content, source_name="x"), path)
    assert load_rig(path).solved_from == content["solved_from"]


def test_solved_from_takes_numpy_and_refuses_the_rest() -> None:
    rig = rig_from_mapping(hand_written(), source_name="x")
    noted = {"cov": np.eye(2), "n": np.int64(3), "rms_px": np.float64(0.1), "from": Path("a.png")}
    kept = rig_to_mapping(_with_notes(rig, noted))["solved_from"]
    assert kept == {"cov": [[1.0, 0.0], [0.0, 1.0]], "n": 3, "rms_px": 0.1, "from": "a.png"}
    with pytest.raises(RigError, match=r"solved_from\.a\[1\] is of type object"):
        rig_to_mapping(_with_notes(rig, {"a": [1, object()]}))


def _with_notes(rig: Rig, notes: dict[str, Any]) -> Rig:
    return replace(rig, solved_from=notes)


def test_saving_replaces_whole_files_and_leaves_no_draft(tmp_path: Path) -> None:
    rig = rig_from_mapping(hand_written(), source_name="x")
    path = tmp_path / "rig.yaml"
    save_rig(replace(rig, name="old"), path)
    copy = save_rig(rig, path)
    assert copy is not None
    copy.unlink()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rig.yaml"]
    with pytest.raises(OutputError, match="cannot write the rig"):
        save_rig(rig, tmp_path / "no" / "rig.yaml")


def test_the_example_of_the_documentation(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "rig.md").read_text(encoding="utf-8")
    path = tmp_path / "rig.yaml"
    path.write_text(page.split("```yaml\n")[1].split("```")[0])
    rig = load_rig(path)
    assert [laser.name for laser in rig.lasers] == ["horizontal", "vertical", "diagonal"]
    assert rig.n_water == seawater_index_vacuum(15.0, 38.0)
    assert rig.working_range == (0.3, 1.0)


def test_the_documentations_examples_of_windows() -> None:
    page = (ROOT / "docs" / "rig.md").read_text(encoding="utf-8")
    flat = yaml.safe_load(page.split("```yaml\n")[2].split("```")[0])
    port = rig_from_mapping(hand_written(dome=...) | flat, source_name="x").flat_port
    assert port is not None
    assert port.distance == 0.012
    lasers = yaml.safe_load(page.split("```yaml\n")[3].split("```")[0])
    rig = rig_from_mapping(hand_written() | lasers, source_name="x")
    window = rig.lasers[0].window
    assert window is not None
    # As drawn: the face 20 mm before the source, tilted by 15 degrees.
    assert window.face.signed_distance(window.source) == pytest.approx(-0.02, abs=1e-5)
    assert window.face.normal @ rig.lasers[0].plane.normal == pytest.approx(
        np.sin(np.deg2rad(15.0)), abs=1e-4
    )


OBLIQUE_WINDOW: dict[str, Any] = {
    "normal": [0.28, 0.96, 0.0],
    "offset_mm": 30.0,
    "source_mm": [-140.0, 20.0, 5.0],
}
BEHIND_WINDOW = {
    "name": "left",
    "normal": [1.0, 0.0, 0.0],
    "offset_mm": -140.0,
    "window": OBLIQUE_WINDOW,
}


def behind_window(**changes: Any) -> dict[str, Any]:
    """Return the file above with a laser behind a window, some of whose keys are changed."""
    window = {key: value for key, value in (OBLIQUE_WINDOW | changes).items() if value is not ...}
    return hand_written(lasers=[BEHIND_WINDOW | {"window": window}])


def test_a_window_becomes_si_and_comes_back(tmp_path: Path) -> None:
    path, copy = tmp_path / "rig.yaml", tmp_path / "copy.yaml"
    rig = rig_from_mapping(behind_window(), source_name="x")
    window = rig.lasers[0].window
    assert window is not None
    np.testing.assert_array_equal(window.face.normal, [0.28, 0.96, 0.0])
    assert window.face.offset == 0.03
    np.testing.assert_array_equal(window.source, [-0.14, 0.02, 0.005])
    save_rig(rig, path)
    assert yaml.safe_load(path.read_text())["lasers"] == [BEHIND_WINDOW]
    save_rig(load_rig(path), copy)
    assert path.read_bytes() == copy.read_bytes()
    assert rig_from_mapping(hand_written(), source_name="x").lasers[0].window is None
    plain = rig_to_mapping(rig_from_mapping(hand_written(), source_name="x"))
    assert all("window" not in laser for laser in plain["lasers"])


def test_a_wavelength_is_kept_and_none_is_needed(tmp_path: Path) -> None:
    rig = rig_from_mapping(hand_written(lasers__0__wavelength_nm=650), source_name="x")
    assert [laser.wavelength_nm for laser in rig.lasers] == [650.0, None]
    save_rig(rig, tmp_path / "rig.yaml")
    written = yaml.safe_load((tmp_path / "rig.yaml").read_text())["lasers"]
    assert written[0]["wavelength_nm"] == 650.0
    assert "wavelength_nm" not in written[1]
    assert same(load_rig(tmp_path / "rig.yaml"), rig)
    bent = behind_window()
    bent["lasers"][0]["wavelength_nm"] = 450
    laser = rig_from_mapping(bent, source_name="x").lasers[0]
    assert laser.window is not None
    assert laser.wavelength_nm == 450.0


def test_a_windows_normal_may_have_any_length_and_way_round() -> None:
    for scale in (3.0, -2.0):
        normal = [scale * value for value in OBLIQUE_WINDOW["normal"]]
        content = behind_window(normal=normal, offset_mm=np.sign(scale) * 30.0)
        window = rig_from_mapping(content, source_name="x").lasers[0].window
        assert window is not None
        np.testing.assert_allclose(
            window.face.normal, np.sign(scale) * np.array([0.28, 0.96, 0.0]), rtol=1e-15
        )


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"normal": ...}, ("lasers[0].window.normal is missing", "normal: [1.0")),
        ({"source_mm": ...}, ("lasers[0].window.source_mm is missing", "source_mm: [-140")),
        ({"source": [1, 2, 3]}, ("lasers[0].window.source is not a key", "'source_mm'")),
        ({"offset_mm": "far"}, ("lasers[0].window.offset_mm is 'far'", "plain number")),
        ({"normal": [0, 0, 0]}, ("lasers[0].window.normal is [0", "normal of the window")),
        (
            {"source_mm": [-134.0, 20.0, 5.0]},
            ("lasers[0].window.source_mm is [-134.0, 20.0, 5.0]", "6.0 mm off", "correct"),
        ),
        (
            {"source_mm": [-140.0, 120.0, 5.0]},
            ("lasers[0].window.source_mm is [-140.0, 120.0", "not behind", "correct source_mm"),
        ),
        ({"offset_mm": -20.0}, ("lasers[0].window.source_mm", "not behind", "outer face")),
        ({"normal": [0.96, 0.28, 0.0]}, ("lasers[0].window.normal", "16 degrees", "window")),
    ],
)
def test_windows_that_cannot_be_are_refused(changes: dict[str, Any], said: tuple[str, ...]) -> None:
    message = fault(behind_window(**changes))
    for words in said:
        assert words in message


def test_a_source_measured_with_a_ruler_is_accepted() -> None:
    rig = rig_from_mapping(behind_window(source_mm=[-137.0, 20.0, 5.0]), source_name="x")
    assert rig.lasers[0].window is not None
    # What is off the plane is left to the sheet to project: the file comes back as it was.
    assert rig.lasers[0].window.source[0] == -0.137
    np.testing.assert_allclose(sheets_of(rig)[0].source, [-0.14, 0.02, 0.005], atol=1e-17)


def test_the_documentation_names_every_key() -> None:
    page = (ROOT / "docs" / "rig.md").read_text(encoding="utf-8")
    keys = set(RigFile.model_fields)
    for part in (ImagePart, CameraPart, DomePart, WaterPart, LaserPart, WindowPart):
        keys |= set(part.model_fields)
    table = page.split("## Keys")[1].split("## In Python")[0]
    # `fy_px` and its like stand behind their part's first key; `n` is `water.n`.
    named = {cell.rsplit(".", 1)[-1] for cell in re.findall(r"`([a-z_.\[\]]+)`", table)}
    assert keys - named == {"image", "camera", "lasers"}
