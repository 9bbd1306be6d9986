"""`aqualvs calibrate dome`: the rig that it begins with."""

from dataclasses import MISSING, fields, replace

import pytest

from aqualvs.calibrate.common import WATER_N
from aqualvs.calibrate.dome import DomeRequest, _with_housing
from aqualvs.errors import OptionError
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.simulation.scenarios import example_rig, flat_port_rig


def request(**given):
    nothing = dict.fromkeys(field.name for field in fields(DomeRequest) if field.default is MISSING)
    return DomeRequest(**nothing | given)


@pytest.mark.parametrize(("n_water", "n_expected"), [(1.0003, WATER_N), (1.3412, 1.3412)])
def test_a_camera_that_was_bare_in_air_goes_into_the_water_with_its_dome(n_water, n_expected):
    bare = replace(example_rig().in_water(n_water), housing=None)
    rig = _with_housing(bare, request(inner_radius_mm=44.25, thickness_mm=5.75))
    assert rig.dome == Dome(0.04425, 0.00575, 1.49)
    assert rig.n_water == n_expected


def test_a_rig_with_a_dome_on_the_bench_stays_there():
    assert _with_housing(example_rig().in_water(1.0003), request()).n_water == 1.0003


def test_a_camera_that_was_bare_in_air_goes_into_the_water_with_its_flat_port():
    bare = replace(flat_port_rig().in_water(1.0003), housing=None)
    rig = _with_housing(bare, request(port_distance_mm=15.0, thickness_mm=4.0, n_acrylic=1.52))
    assert rig.housing == FlatPort(0.015, 0.004, 1.52)
    assert rig.n_water == WATER_N


def test_options_change_a_flat_port_that_is_there():
    rig = flat_port_rig()
    before = rig.flat_port
    after = _with_housing(rig, request(thickness_mm=6.0)).flat_port
    assert after == replace(before, thickness=0.006)


@pytest.mark.parametrize(
    ("rig", "given", "words"),
    [
        (flat_port_rig(), {"inner_radius_mm": 44.0}, "the housing is a flat port"),
        (example_rig(), {"port_distance_mm": 12.0}, "the housing is a dome"),
        (replace(example_rig(), housing=None), {"port_distance_mm": 12.0}, "--thickness-mm"),
    ],
)
def test_options_of_another_housing_are_refused(rig, given, words):
    with pytest.raises(OptionError, match=words):
        _with_housing(rig, request(**given))
