"""The condition of simulated nets against what they are, and of independently rendered ones."""

from functools import cache
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from benchmarks.random_scenes import Difficulty

from aqualvs.geometry.transforms import SE3
from aqualvs.nets.condition import NetCondition, NetStretch
from aqualvs.nets.spectrum import Mesh
from aqualvs.scanner import Scanner
from aqualvs.simulation.scenarios import example_rig
from aqualvs.simulation.scene import Net, Scene
from aqualvs.sources import open_source
from net_cases import NetCamera
from net_dives import Dive, passed_holes, random_dive, true_solidity
from quick_pictures import quick_scans
from rig_from_sample_truth import load_truth
from whole import WHOLE

RIG = example_rig()
# Dives that are rendered: seed and difficulty; one of each shape, with twine near 3 mm (what
# is thinner is told less well, see the table in docs/net-condition.md).
RENDERED: tuple[tuple[int, Difficulty], ...] = ((6, "usual"), (0, "clean"), (2, "hard"))


@cache
def rendered(seed: int, difficulty: Difficulty) -> tuple[Dive, NetStretch]:
    """A third of a second along a net, from pictures."""
    dive = random_dive(np.random.default_rng([31, seed]), difficulty, seconds=0.32)
    condition = NetCondition(RIG)
    return dive, condition.add_all(quick_scans(dive, RIG, seed=seed))[0]


def test_the_rendered_nets_differ() -> None:
    assert {rendered(*which)[0].net.mesh for which in RENDERED} == {"diamond", "square", "hexagon"}


@pytest.mark.parametrize("which", RENDERED)
def test_mesh_twine_and_solidity_are_what_they_are(which: tuple[int, Difficulty]) -> None:
    dive, stretch = rendered(*which)
    net = dive.net
    assert stretch.n_strands >= 5.0
    assert stretch.lattice is not None
    assert (stretch.lattice.mesh is Mesh.SIX_SIDED) == (net.mesh == "hexagon")
    assert stretch.lattice.bar == pytest.approx(net.bar, rel=0.01)
    assert abs(stretch.lattice.bar - net.bar) < 3.0 * stretch.lattice.sigma_bar
    assert stretch.lattice.sigma_bar < 0.02 * net.bar
    assert stretch.twine is not None
    # One in ten is off by more than 20 %, of so short dives; see below.
    assert stretch.twine.thickness == pytest.approx(net.twine, rel=0.3)
    assert abs(stretch.twine.thickness - net.twine) < 3.0 * stretch.twine.sigma
    assert 0.05 < stretch.twine.sigma / net.twine < 0.35
    assert stretch.solidity is not None
    assert stretch.sigma_solidity is not None
    assert stretch.solidity == pytest.approx(true_solidity(dive), abs=0.05)
    assert 0.002 < stretch.sigma_solidity < 0.05


def test_twine_is_mostly_right_by_a_fifth() -> None:
    off = []
    for which in RENDERED:
        dive, stretch = rendered(*which)
        assert stretch.twine is not None
        off.append(abs(stretch.twine.thickness / dive.net.twine - 1.0))
    assert np.median(off) < 0.15


@pytest.mark.parametrize("which", RENDERED)
def test_the_way_is_what_the_vehicle_went(which: tuple[int, Difficulty]) -> None:
    dive, stretch = rendered(*which)
    np.testing.assert_allclose(stretch.place, dive.velocity * dive.times[-1], atol=5e-3)


@pytest.mark.parametrize("roll_deg", [-3.0, 3.0])
def test_a_level_square_net_is_no_other(roll_deg: float) -> None:
    """A slanting laser crosses both families in turn, which looks like a family of its own."""
    net = Net(mesh="square", bar=0.015, twine=0.0015, roll=np.deg2rad(roll_deg))
    dive = Dive(
        scene=Scene(dome_from_scene=SE3.identity(), nets=(net,), target="net"),
        fps=25.0,
        n_frames=20,
        range=(0.45, 0.48),
        pitch=(0.0, 0.0),
        yaw=(np.deg2rad(-5.0), np.deg2rad(3.0)),
        phase=(0.0, 0.0),
        velocity=np.array([0.125, 0.0]),
    )
    (stretch,) = NetCondition(RIG).add_all(quick_scans(dive, RIG))
    assert stretch.lattice is not None
    assert stretch.lattice.mesh is Mesh.FOUR_SIDED
    assert stretch.lattice.bar == pytest.approx(net.bar, rel=0.01)


def test_a_rendered_hole_is_found_and_nothing_else() -> None:
    rng = np.random.default_rng([32, 0])
    dive = random_dive(rng, "usual", seconds=1.6, fps=15.0, speed=(0.15, 0.2), hole_bars=(4.0, 5.0))
    condition = NetCondition(RIG)
    condition.add_all(quick_scans(dive, RIG))
    ((middle, radius),) = passed_holes(dive, RIG)
    (hole,) = condition.holes
    place = dive.velocity * hole.time_s + hole.from_foot
    assert np.hypot(*(place - middle)) < dive.net.bar
    assert abs(hole.diameter - 2.0 * radius) < 3.0 * hole.sigma_diameter + 0.25 * radius


def test_holes_of_three_meshes_are_found_and_no_others() -> None:
    # The true lit points as a good detector sees them, but for drop-outs: 5 % of the lights on
    # strands in every frame, 1 % always.
    camera = NetCamera(RIG, missed=0.05, dark=0.01)
    found, passed, false, area = 0, 0, 0, 0.0
    # Four have all three meshes, and two with holes.
    n_dives = 6 if WHOLE else 4
    for seed in range(n_dives):
        rng = np.random.default_rng([33, seed])
        bars = (3.0, 7.0) if seed % 2 else None
        dive = random_dive(rng, "hard", seconds=5.0, fps=8.0, speed=(0.1, 0.15), hole_bars=bars)
        condition = NetCondition(RIG)
        # So few frames a second leave the move between them open.
        for i, t in enumerate(dive.times):
            scan = camera.scan(dive.scene_at(t), float(t), i)
            condition.add(scan, dive.velocity + rng.normal(0.0, 0.01, 2))
        condition.finish()
        area += condition.area
        places = [dive.velocity * h.time_s + h.from_foot for h in condition.holes]
        real = [(np.array([x, z]), r) for x, z, r in dive.net.holes]
        near = dive.net.bar
        false += sum(all(np.hypot(*(p - m)) > r + near for m, r in real) for p in places)
        for middle, radius in passed_holes(dive, RIG):
            passed += 1
            found += any(np.hypot(*(place - middle)) < radius + near for place in places)
    assert passed >= 2
    assert found == passed
    assert false == 0
    assert area > n_dives / 6.0


@pytest.mark.samples
@pytest.mark.parametrize("name", ["net_diamond", "net_clutter"])
def test_independent_nets_have_the_mesh_of_their_true_points(samples: Path, name: str) -> None:
    folder = samples / "lab-paper"
    rig = load_truth(folder / "truth" / "rig_truth.json")
    scanner, condition = Scanner(rig), NetCondition(rig)
    with open_source(folder / "dives" / f"{name}.mp4") as source:
        frames = islice(source, None if WHOLE else 60)
        condition.add_all(scanner.process(frame) for frame in frames)
    measured = [one for one in condition.stretches if one.lattice is not None]
    assert len(measured) >= 1
    for stretch in measured:
        assert stretch.lattice is not None
        assert stretch.lattice.mesh is Mesh.FOUR_SIDED
        # No file states it. The power spectrum of the true points peaks at strands 25.0 mm apart,
        # square to one another.
        np.testing.assert_allclose(stretch.lattice.pitch, 0.025, rtol=0.01)
        assert stretch.lattice.bar == pytest.approx(0.025, rel=0.01)
    # The nets are whole; behind clutter one hole of four meshes is claimed.
    assert len(condition.holes) <= (name == "net_clutter")
