"""The index of the water for lasers of any colour, from corners that need no picture."""

from dataclasses import replace

import numpy as np
import pytest

import aqualvs
from aqualvs.calibrate import water
from aqualvs.optics.rigfile import load_rig, save_rig
from aqualvs.optics.solved import rig_uncertainty, solved_steps
from aqualvs.optics.water import index_in_seawater
from aqualvs.simulation.scenarios import example_rig
from target_cases import index_target, index_view

# Degrees Celsius, per mille.
SEA = (8.0, 34.0)


def in_colour(light_nm):
    rig = example_rig()
    return replace(
        rig, lasers=tuple(replace(laser, wavelength_nm=light_nm) for laser in rig.lasers)
    )


@pytest.fixture
def calibrated(monkeypatch):
    """Calibrate the water for a rig, by a plate seen in green light."""

    def run(rig, collect=list, n=None):
        view = index_view(rig.in_water(n or index_in_seawater(*SEA, None, rig.n_air)))
        monkeypatch.setattr(water, "detect_markers", lambda *_: view)
        width, height = rig.size_px
        pictures = collect([np.zeros((height, width), np.uint8)])
        return aqualvs.calibrate_water(pictures, index_target(), rig)

    return run


@pytest.mark.parametrize("light_nm", [450.0, 640.0])
def test_the_index_is_that_for_the_lasers(calibrated, light_nm, tmp_path):
    green, done = calibrated(in_colour(None)), calibrated(in_colour(light_nm))
    expected = index_in_seawater(*SEA, light_nm, done.rig.n_air)
    # Water of another temperature and salinity than the middle's, see `Dispersion`.
    assert done.solution.n == done.rig.n_water == pytest.approx(expected, abs=6e-5)
    assert abs(done.rig.n_water - green.rig.n_water) > 3e-3
    # 5 nm of the colour in which the plate is seen.
    assert done.solution.sigma == pytest.approx(
        np.hypot(green.solution.sigma, 2e-4), rel=0.02, abs=2e-5
    )
    assert done.uncertainty.sigmas["n_water"] == pytest.approx(done.solution.sigma)
    assert f"{light_nm:g} nm" in done.notes[0]
    save_rig(done.rig, tmp_path / "rig.yaml")
    written = load_rig(tmp_path / "rig.yaml")
    extras = solved_steps(written)["water"].extras
    assert extras["n_green"] == pytest.approx(green.rig.n_water, abs=1e-6)
    # A rig file keeps five digits of a sigma.
    sigma = rig_uncertainty(written).sigmas["n_water"]
    assert sigma == pytest.approx(done.solution.sigma, rel=1e-4)


def test_a_rig_without_lasers_yet_has_the_planned_colour(calibrated):
    planned = replace(example_rig(), lasers=(), solved_from={"wavelength_nm": 640.0})
    assert calibrated(planned).rig.n_water == calibrated(in_colour(640.0)).rig.n_water


def test_for_green_lasers_it_is_what_the_plate_shows(calibrated):
    done = calibrated(in_colour(532.0))
    assert done.rig.n_water == calibrated(in_colour(None)).rig.n_water
    assert not [note for note in done.notes if "dispersion" in note]
    assert "n_green" not in solved_steps(done.rig)["water"].extras


@pytest.mark.parametrize("collect", [iter, np.stack])
def test_pictures_may_come_one_by_one_or_in_one_array(calibrated, collect):
    assert calibrated(example_rig(), collect).rig.n_water == calibrated(example_rig()).rig.n_water


@pytest.mark.parametrize(("n", "said"), [(1.378, True), (1.31, True), (1.341, False)])
def test_an_index_that_no_water_has_is_told(calibrated, n, said):
    notes = calibrated(example_rig(), n=n).notes
    assert any("not that of water" in note for note in notes) is said
