"""What an offset of the lens costs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.design.calibrated import offset_costs
from aqualvs.design.changes import best_angles
from aqualvs.design.settings import Design, ring
from aqualvs.simulation.scenarios import bluerov2_rig

RANGES = (0.35, 1.0)


@pytest.fixture(scope="module")
def design() -> Design:
    mounts = ring(3, 0.15, 0.0, math.radians(68.0))
    return best_angles(Design(rig=bluerov2_rig(), mounts=mounts), quick=True)


@pytest.fixture(scope="module")
def costs(design):
    return offset_costs(design, RANGES)


def test_no_offset_costs_nothing(costs):
    none = costs[0]
    assert none.offset == 0.0
    for errors in (none.neglected, none.aside):
        # Projection and its inverse agree to 1e-11 px.
        np.testing.assert_allclose(errors, 0.0, atol=1e-9)
    # Rays through the centre are not bent, whatever the index; with boards it takes a fit.
    np.testing.assert_allclose(none.index_error, 0.0, atol=1e-9)
    np.testing.assert_allclose(none.calibrated, 0.0, atol=1e-5)
    assert none.index_sigma > 0.1


def test_costs_grow_with_the_offset(costs):
    for errors in ([c.neglected[0, 0] for c in costs], [c.calibrated[0, 0] for c in costs]):
        assert np.all(np.diff(np.abs(errors)) > 0.0)
    assert np.all(np.diff([abs(c.index_error[-1, 0]) for c in costs]) > 0.0)
    assert np.all(np.diff([c.index_sigma for c in costs[1:]]) < 0.0)
    # The first millimetre of offset is neglected at a cost in proportion.
    by_offset = {c.offset: c for c in costs}
    ratio = by_offset[1e-3].neglected / by_offset[0.5e-3].neglected
    assert ratio[0, 0] == pytest.approx(2.0, rel=0.02)


def test_the_designs_own_offset_and_its_centring_are_among_them(design):
    odd = replace(design, centring=0.3e-3)
    offsets = [cost.offset for cost in offset_costs(odd, RANGES)]
    own = float(np.linalg.norm(design.rig.dome_from_cam.translation))
    assert 0.3e-3 in offsets
    assert round(own, 5) in offsets
    assert max(offsets) < design.rig.dome.inner_radius
    assert offset_costs(replace(design, rig=replace(design.rig, housing=None)), RANGES) == ()
