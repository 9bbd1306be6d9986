"""`aqualvs calibrate dome`: the rig that it begins with."""

from dataclasses import MISSING, fields, replace

import numpy as np
import pytest

import aqualvs
from aqualvs.calibrate import common
from aqualvs.calibrate.common import WATER_N, DetectedTargets
from aqualvs.calibrate.dome import DomeRequest, _with_housing
from aqualvs.calibration.dome.problem import DomeOptions
from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL
from aqualvs.optics.solved import rig_uncertainty, with_uncertainty
from aqualvs.optics.water import Dispersion
from aqualvs.simulation.scenarios import example_rig, flat_port_rig
from dome_cases import INTRINSICS, board_points, see


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


@pytest.mark.parametrize("light_nm", [None, 450.0, 640.0])
def test_boards_in_water_give_the_index_for_the_light_of_the_lasers(monkeypatch, light_nm):
    true, light = flat_port_rig().in_water(1.3412), Dispersion.of(light_nm)
    rng, points, views = np.random.default_rng(0), board_points(13, 10), []
    for i, distance in enumerate(np.linspace(0.2, 0.9, 8)):
        turn = rotation_from_rotvec(rng.normal(0.0, 0.35, 3)) @ DOME_FROM_CAM_NOMINAL
        pose = SE3(turn, np.array([0.0, distance, 0.0]) - turn @ points.mean(axis=0))
        # In green light.
        views.append(see(true.camera(), pose, points, rng, name=f"view_{i}"))
    found = DetectedTargets(tuple(views), (), true.size_px, {})
    monkeypatch.setattr(common, "detect_boards", lambda *_: found)
    planned = {} if light_nm is None else {common.WAVELENGTH_NM: light_nm}
    start = replace(true.in_water(WATER_N), lasers=(), solved_from=planned)
    start = with_uncertainty(start, INTRINSICS)
    options = DomeOptions(check_cross_validation=False)
    done = aqualvs.calibrate_dome([], "board", start, medium="water", options=options)
    sigma = done.uncertainty.sigmas["n_water"]
    assert sigma < 8e-4
    assert done.rig.n_water == pytest.approx(light.from_green(1.3412), abs=3.0 * sigma)
    assert rig_uncertainty(done.rig).sigmas["n_water"] == pytest.approx(sigma, rel=1e-3)
    assert any("dispersion" in note for note in done.notes) is (light_nm is not None)
