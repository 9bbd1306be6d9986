"""The medium that a command is told."""

from dataclasses import replace

import pytest

from aqualvs.errors import OptionError
from aqualvs.optics.water import seawater_index_vacuum
from aqualvs.results.run_request import Water
from aqualvs.simulation.scenarios import example_rig


def test_water_of_red_lasers_has_the_index_of_red_light() -> None:
    rig = example_rig()
    red = replace(rig, lasers=tuple(replace(laser, wavelength_nm=650.0) for laser in rig.lasers))
    water = Water(temperature_c=12.0, salinity=35.0)
    assert water.applied_to(rig).n_water == seawater_index_vacuum(12.0, 35.0, n_air=rig.n_air)
    assert water.applied_to(red).n_water == seawater_index_vacuum(
        12.0, 35.0, 650.0, n_air=rig.n_air
    )


@pytest.mark.parametrize(
    ("values", "words"),
    [({"n_water": 3.0}, "--water-n 3: no water"), ({"salinity": 0.035}, "--salinity 0.035: give")],
)
def test_what_is_no_water_is_refused(values, words):
    with pytest.raises(OptionError, match=words):
        Water(**values)
