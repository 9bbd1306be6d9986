"""A dive's scans taken together: stretches, look-back, places and holes."""

from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from aqualvs.nets import condition as net_condition
from aqualvs.nets.condition import NetCondition, NetConditionOptions
from aqualvs.nets.lattice import NetLattice, find_lattice
from aqualvs.nets.spectrum import Mesh
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.scan import Label, Scan
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Net
from net_cases import NetCamera, passing

RIG = example_rig()
SPEED = (0.12, 0.05)
HOLED = Net(mesh="square", bar=0.03, twine=0.0025, roll=0.5, holes=((0.15, 0.08, 0.07),))


@cache
def dive() -> tuple[Scan, ...]:
    """Two and a half seconds past a hole."""
    return tuple(passing(HOLED, speed=SPEED, n_frames=50, camera=NetCamera(RIG, missed=0.03)))


def test_a_dive_is_measured_stretch_by_stretch() -> None:
    condition = NetCondition(RIG, NetConditionOptions(stretch_s=1.2, stretch=9.0))
    finished = [condition.add(scan) for scan in dive()]
    condition.finish()
    stretches = condition.stretches
    assert [one for one in finished if one is not None] == stretches[:-1]
    assert len(stretches) == 3
    assert stretches[0].first_frame == 0
    assert stretches[-1].last_frame == 49
    for one in stretches:
        assert one.lattice is not None
        assert one.lattice.mesh is Mesh.FOUR_SIDED
        assert one.lattice.bar == pytest.approx(0.03, rel=0.01)
        assert one.range == pytest.approx(0.5, rel=0.01)
        assert one.n_strands > 8.0
        np.testing.assert_allclose(one.place, np.array(SPEED) * one.end_s, atol=5e-3)
    for one, after in pairwise(stretches):
        np.testing.assert_array_equal(one.place, after.begin_place)
        assert one.end_s < after.begin_s


def test_solidity_is_near_that_of_the_bare_twine() -> None:
    condition = NetCondition(RIG, NetConditionOptions(twine=0.0025))
    stretch = condition.add_all(dive())[0]
    assert stretch.twine is not None
    assert stretch.twine.thickness == pytest.approx(0.0025)
    assert stretch.clean_solidity == pytest.approx(2.0 / 12.0 - 1.0 / 144.0, rel=0.02)
    assert stretch.solidity == pytest.approx(stretch.clean_solidity, abs=0.03)


def test_the_hole_is_found_where_it_is() -> None:
    condition = NetCondition(RIG)
    condition.add_all(dive())
    (hole,) = condition.holes
    np.testing.assert_allclose(hole.place, [0.15, 0.08], atol=0.015)
    assert hole.diameter == pytest.approx(0.14, abs=0.04)
    np.testing.assert_allclose(
        np.array(SPEED) * hole.time_s + hole.from_foot, hole.place, atol=5e-3
    )
    assert 0.05 < condition.area < 0.6


def test_what_was_seen_before_the_lattice_is_looked_back_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refused = [True]

    def not_at_first(*arguments: Any) -> NetLattice | None:
        return None if refused and refused.pop() else find_lattice(*arguments)

    monkeypatch.setattr(net_condition, "find_lattice", not_at_first)
    condition = NetCondition(RIG, NetConditionOptions(stretch_s=1.2, stretch=9.0))
    for scan in dive()[:30]:
        condition.add(scan)
    assert condition.area == 0.0
    for scan in dive()[30:]:
        condition.add(scan)
    condition.finish()
    first, second, _ = condition.stretches
    assert first.lattice is None
    assert first.solidity is None
    assert second.lattice is not None
    # Places are known from the first one's start, and so is what was looked at then.
    np.testing.assert_allclose(second.place, np.array(SPEED) * second.end_s, atol=5e-3)
    np.testing.assert_allclose(first.place, np.array(SPEED) * first.end_s, atol=5e-3)
    assert len(condition.holes) == 1
    later = NetCondition(RIG)
    later.add_all(scan for scan in dive() if scan.index > first.last_frame)
    assert condition.area > 1.2 * later.area


def test_frames_without_posture_or_net_are_passed_over() -> None:
    refused = [replace(scan, posture=Refusal(Reason.NO_TARGET)) for scan in dive()]
    wall = [
        replace(
            scan, points=replace(scan.points, label=np.full_like(scan.points.label, Label.SOLID))
        )
        for scan in dive()
    ]
    for scans in (refused, wall, []):
        condition = NetCondition(RIG)
        assert condition.add_all(scans) == []
        assert condition.finish() is None
        assert condition.holes == []
        assert condition.area == 0.0


def test_scans_read_back_in_single_precision_say_the_same() -> None:
    def single(scan: Scan) -> Scan:
        p = scan.points
        rounded = {
            name: getattr(p, name).astype(np.float32).astype(np.float64)
            for name in ("pixels", "points_in_dome", "sigma", "intensity", "width", "quality")
        }
        return replace(scan, points=replace(p, **rounded))

    one, other = NetCondition(RIG), NetCondition(RIG)
    a, b = one.add_all(dive())[0], other.add_all([single(scan) for scan in dive()])[0]
    assert a.lattice is not None
    assert b.lattice is not None
    assert b.lattice.bar == pytest.approx(a.lattice.bar, rel=1e-3)
    assert b.solidity == pytest.approx(a.solidity, abs=2e-3)
    np.testing.assert_allclose(b.place, a.place, atol=1e-3)
