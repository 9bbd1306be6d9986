"""`design.yaml`: strict, in millimetres and degrees, with faults that name the remedy."""

import math
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from aqualvs.design.file import EXAMPLE, design_from, design_of_rig, load_design
from aqualvs.design.settings import Tolerances
from aqualvs.errors import AqualvsError, RigError
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.rigfile import save_rig
from aqualvs.simulation.scenarios import example_rig


def changed(**parts):
    """The example's content with whole parts replaced; None takes a part out."""
    content = {**yaml.safe_load(EXAMPLE), **parts}
    return {key: value for key, value in content.items() if value is not None}


def read(**parts):
    return design_from(changed(**parts), name="design.yaml", folder=Path())


def test_the_example_is_read_in_si_units(tmp_path):
    path = tmp_path / "design.yaml"
    path.write_text(EXAMPLE)
    design = load_design(path)
    rig = design.rig
    assert rig.size_px == (1920, 1080)
    # Half the width over the tangent of half the angle.
    assert rig.lens.fx == pytest.approx(960.0 / math.tan(math.radians(34.5)))
    assert rig.dome.inner_radius == pytest.approx(0.051)
    np.testing.assert_allclose(rig.dome_from_cam.translation, [0.0, 0.006, 0.0])
    assert rig.working_range == pytest.approx((0.3, 1.2))
    # Quan & Fry at 12 degrees and 35 per mille, times the index of air.
    assert rig.n_water == pytest.approx(1.3426, abs=2e-4)
    assert [mount.name for mount in design.mounts] == ["lower", "upper_left", "upper_right"]
    assert design.net.bar == pytest.approx(0.015)
    assert design.goals.range_share == pytest.approx(0.005)
    # Millimetres and degrees of the file against metres and radians: rounding only.
    assert astuple(design.tolerances) == pytest.approx(astuple(Tolerances()))


def test_mounts_one_by_one_keep_what_is_given():
    mounts = [
        {"name": "lower", "position_mm": [10, -20, -150]},
        {"name": "left", "position_mm": [-160, 0, 0], "stripe_deg": 90, "tilt_deg": 12},
        {"name": "any", "position_mm": [100, 0, 100], "stripe_deg": "best", "fan_deg": 60},
    ]
    lower, left, free = read(lasers=None, mounts=mounts).mounts
    assert lower.free_tilt
    assert not lower.free_stripe
    # Square to the way from the axis to the mount.
    assert lower.baseline == pytest.approx(math.hypot(0.01, 0.15))
    assert left.tilt == pytest.approx(math.radians(12.0))
    assert not left.free_tilt
    assert free.free_stripe
    assert free.fan == pytest.approx(math.radians(60.0))


def test_a_calibrated_camera_is_taken_from_its_rig_file(tmp_path):
    save_rig(example_rig(), tmp_path / "calibrated.yaml")
    content = changed(camera={"rig": "calibrated.yaml"})
    design = design_from(content, name="design.yaml", folder=tmp_path)
    assert design.rig.lens == example_rig().lens
    assert design.rig.size_px == example_rig().size_px


def test_fisheyes_and_bare_lenses():
    wide = read(camera={"width_px": 1000, "height_px": 800, "fov_deg": 160, "model": "fisheye"})
    assert wide.rig.lens.fx == pytest.approx(500.0 / math.radians(80.0))
    assert read(dome=None).rig.dome is None


def test_flat_ports():
    flat = {"distance_mm": 12, "thickness_mm": 5, "n_port": 1.5, "tilt_deg": [1, 0]}
    rig = read(dome=None, flat=flat).rig
    assert rig.housing == FlatPort(0.012, 0.005, 1.5, math.radians(1.0))
    with pytest.raises(RigError, match="dome and flat: both are given"):
        read(flat=flat)


def test_a_rig_that_exists_is_a_design_with_its_own_lasers():
    rig = example_rig()
    design = design_of_rig(rig, 90.0)
    planes = [laser.plane for laser in design.nominal_rig().lasers]
    for plane, laser in zip(planes, rig.lasers, strict=True):
        assert abs(plane.normal @ laser.plane.normal) == pytest.approx(1.0)
        assert abs(plane.offset) == pytest.approx(abs(laser.plane.offset))
    assert design.mounts[0].fan == pytest.approx(math.pi / 2.0)
    red = replace(rig, lasers=tuple(replace(one, wavelength_nm=650.0) for one in rig.lasers))
    kept = design_of_rig(red, 90.0).nominal_rig().lasers
    assert [laser.wavelength_nm for laser in kept] == [650.0] * len(rig.lasers)


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"aqualvs_design": 2}, "reads version 1"),
        ({"aqualvs_design": None}, "begins with 'aqualvs_design: 1'"),
        ({"dome": {"inner_radius_mm": 51, "thicknes_mm": 6}}, "did you mean 'thickness_mm'"),
        ({"mounts": [{"name": "a", "position_mm": [0, 0, -150]}]}, "either 'lasers'"),
        ({"lasers": None}, "either 'lasers'"),
        ({"working_range_mm": [900, 300]}, "nearest range first"),
        ({"camera": {"width_px": 1920}}, "write width_px, height_px and fov_deg"),
        ({"camera": {"rig": "a.yaml", "fov_deg": 60}}, "keep either 'rig'"),
        ({"camera": {"rig": "no.yaml"}}, "no such file"),
        ({"camera": {"width_px": 9, "height_px": 9, "fov_deg": 170}}, "model: fisheye"),
        ({"lens": {"position_mm": [0, 60, 0]}}, "inner"),
        ({"water": {"n": 1.33, "temperature_c": 4}}, "keep either n"),
        ({"water": {"temperature_c": 4}}, "water has no index"),
        ({"water": {"temperature_c": 90, "salinity_permille": 35}}, "90"),
        ({"lasers": {"count": 0, "baseline_mm": 100}}, "lasers.count is 0"),
        ({"lasers": {"count": 2, "baseline_mm": 100, "fan_deg": 190}}, "fan_deg is 190"),
        (
            {"lasers": None, "mounts": [{"name": "a", "position_mm": [0, 0, -150]}] * 2},
            "a name of its own",
        ),
        ({"net": {"bar_mm": "15"}}, "net.bar_mm is '15'"),
        ({"net": {"bar_mm": 2}}, "net.twine_mm is 2.5, not thinner than the bar of 2 mm"),
        (
            {
                "lasers": None,
                "mounts": [{"name": "a", "position_mm": [0, 0, -150], "stripe_deg": "bets"}],
            },
            "mounts[0].stripe_deg is 'bets'; write a plain number, or 'best'",
        ),
    ],
)
def test_faults_name_file_value_and_remedy(parts, words):
    with pytest.raises(AqualvsError) as fault:
        read(**parts)
    message = str(fault.value)
    assert words in message
    assert message.startswith("design.yaml: ")
    assert "\n" not in message


def test_what_is_no_mapping_is_no_design(tmp_path):
    path = tmp_path / "list.yaml"
    path.write_text("- 1\n")
    with pytest.raises(AqualvsError, match="is not a design"):
        load_design(path)
