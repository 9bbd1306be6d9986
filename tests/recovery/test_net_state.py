"""The state of a simulated net from a few seconds of passing it: mesh, twine, cover, holes."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.scanning.net_condition import NetCondition, NetConditionOptions
from aqualvs.simulation.example_rigs import bluerov2_rig, example_rig
from aqualvs.simulation.scene import Net
from net_cases import NetCamera, passing
from net_dives import true_solidity

NETS = [
    Net(mesh="square", bar=0.025, twine=0.0025, roll=0.3),
    Net(mesh="diamond", bar=0.030, twine=0.002, roll=0.2),
    Net(mesh="hexagon", bar=0.022, twine=0.003, roll=0.6),
]


def condition_of(net: Net, rig_name: str = "example", **how: object) -> NetCondition:
    rig = example_rig() if rig_name == "example" else bluerov2_rig()
    scans = passing(net, camera=NetCamera(rig), **how)  # type: ignore[arg-type]
    condition = NetCondition(rig, NetConditionOptions(stretch_s=10.0, stretch=5.0))
    condition.add_all(scans)
    return condition


@pytest.mark.parametrize("net", NETS, ids=lambda net: f"{net.mesh}-{1e3 * net.bar:.0f}")
def test_mesh_twine_and_cover_are_found_within_their_bars(net: Net) -> None:
    condition = condition_of(net)
    (stretch,) = condition.stretches
    assert stretch.n_strands >= 5
    assert stretch.lattice is not None
    assert stretch.lattice.bar == pytest.approx(net.bar, rel=0.05)
    assert stretch.twine is not None
    assert stretch.twine.thickness == pytest.approx(net.twine, rel=0.2)
    assert abs(stretch.twine.thickness - net.twine) < 3.0 * stretch.twine.sigma
    assert stretch.solidity is not None
    assert stretch.sigma_solidity is not None
    true = true_solidity(net)
    assert stretch.solidity == pytest.approx(true, abs=0.05)
    assert abs(stretch.solidity - true) < 3.0 * stretch.sigma_solidity
    assert condition.holes == []
    assert condition.area > 0.04


def test_growth_is_told_from_bare_twine() -> None:
    clean, fouled = (
        condition_of(replace(NETS[0], fouling=share)).stretches[0] for share in (0.0, 0.4)
    )
    assert clean.solidity is not None
    assert fouled.solidity is not None
    true = true_solidity(replace(NETS[0], fouling=0.4)) - true_solidity(NETS[0])
    assert fouled.solidity - clean.solidity == pytest.approx(true, abs=0.05)


def test_a_hole_that_is_passed_is_found_at_its_place_and_nothing_else() -> None:
    net = replace(NETS[0], holes=((0.25, 0.0, 0.05),))
    condition = condition_of(net, n_frames=90)
    (hole,) = condition.holes
    # The track begins at the vehicle's foot on the net, a little beside the scene's origin.
    assert hole.place == pytest.approx([0.25, 0.0], abs=0.08)
    assert 0.06 < hole.diameter < 0.13
    assert hole.missing_meshes >= 3.0
    assert hole.n_looks >= 3


def test_the_far_field_of_another_camera_gives_the_same_mesh() -> None:
    net = NETS[1]
    (stretch,) = condition_of(net, "bluerov2", distance=0.8).stretches
    assert stretch.lattice is not None
    assert stretch.lattice.bar == pytest.approx(net.bar, rel=0.05)


def test_options_that_cannot_work_are_refused() -> None:
    from aqualvs.errors import OptionError

    for bad in ({"stretch_s": 0.0}, {"stretch": -1.0}, {"twine": 0.0}):
        with pytest.raises(OptionError):
            NetConditionOptions(**bad)
    assert np.isfinite(NetConditionOptions().stretch_s)
