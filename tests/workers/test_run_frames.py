"""Following the water's index during a run, for lasers of any colour."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.calibration.detection import detection
from aqualvs.calibration.targets import target_files
from aqualvs.optics.water import index_in_seawater
from aqualvs.results.run_request import Water
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.scan import Frame
from aqualvs.simulation.scenarios import example_rig
from aqualvs.workers.run_frames import WaterFollowingScanner
from target_cases import index_target, index_view


@pytest.mark.parametrize("given", [Water(), Water(temperature_c=8.0, salinity=34.0)])
def test_the_index_that_is_followed_is_that_for_the_lasers(monkeypatch, tmp_path, given):
    rig = example_rig()
    lasers = tuple(replace(laser, wavelength_nm=640.0) for laser in rig.lasers)
    rig = replace(rig, lasers=lasers)
    green, red = (index_in_seawater(8.0, 34.0, nm, rig.n_air) for nm in (None, 640.0))
    monkeypatch.setattr(target_files, "load_target", lambda _: index_target())
    monkeypatch.setattr(detection, "detect_markers", lambda *_: index_view(rig.in_water(green)))
    following = WaterFollowingScanner(rig, ScannerOptions(), tmp_path / "target.yaml", given)
    width, height = rig.size_px
    following.look(Frame(0, 0.0, np.zeros((height, width), np.uint8)))
    # The dispersion of water in general, see `Dispersion`, and the noise-free prior's pull.
    assert following.scanner.rig.n_water == pytest.approx(red, abs=6e-5)
    assert f"water index {following.scanner.rig.n_water:.5f}" in following.lines()[0]
    assert 2e-4 < following.sigma_n_water < 4e-3
