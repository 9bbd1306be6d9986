"""`aqualvs calibrate dome`: the rig that it begins with."""

from dataclasses import fields, replace

import pytest

from aqualvs.calibrate.common import WATER_N
from aqualvs.calibrate.dome import DomeRequest, _with_dome
from aqualvs.optics.dome import Dome
from aqualvs.simulation.scenarios import example_rig


def request(**given):
    nothing = dict.fromkeys(field.name for field in fields(DomeRequest))
    return DomeRequest(**nothing | given)


@pytest.mark.parametrize(("n_water", "n_expected"), [(1.0003, WATER_N), (1.3412, 1.3412)])
def test_a_camera_that_was_bare_in_air_goes_into_the_water_with_its_dome(n_water, n_expected):
    bare = replace(example_rig().in_water(n_water), housing=None)
    rig = _with_dome(bare, request(inner_radius_mm=44.25, thickness_mm=5.75))
    assert rig.dome == Dome(0.04425, 0.00575, 1.49)
    assert rig.n_water == n_expected


def test_a_rig_with_a_dome_on_the_bench_stays_there():
    assert _with_dome(example_rig().in_water(1.0003), request()).n_water == 1.0003
