"""Render, scan with a rig that is wrong about one laser, and see whether that one is named."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from aqualvs.optics.rig import Rig, rig_moved_by
from aqualvs.results.agreement import AgreementState, AgreementVerdict, LaserAgreement
from aqualvs.scanner import Scanner
from aqualvs.scanning.scan import Frame
from aqualvs.simulation.scenarios import example_rig, load_scenario
from aqualvs.sources import open_source
from net_dives import frame_of
from quick_pictures import QuickRenderer
from rig_from_sample_truth import load_truth
from whole import WHOLE, part_of

_TIMES = np.linspace(0.1, 3.7, 8 if WHOLE else 6)
# An ordinary run has every second one.
_DIVES = ("net_clutter", "net_diamond", "wall_range", "wall_pitch", "wall_yaw", "wall")


@cache
def frames(scenario_name: str) -> tuple[Frame, ...]:
    renderer, scenario = QuickRenderer(example_rig()), load_scenario(scenario_name)
    found = []
    for i, t in enumerate(_TIMES.tolist()):
        rng = np.random.default_rng([5, round(1000 * t)])
        picture = renderer.render(scenario.scene_at(t), t, rng)
        # Of the frames of a video, every third is looked at.
        found.append(frame_of(3 * i, t, picture.image))
    return tuple(found)


def turned(rig: Rig, laser: int, degrees: float, towards: float) -> Rig:
    name = rig.lasers[laser].name
    tilt = np.tan(np.deg2rad(degrees)) * np.array([np.cos(towards), np.sin(towards)])
    return rig_moved_by(rig, (f"{name}:tilt_1", f"{name}:tilt_2"), tilt)


def watched(rig: Rig, scenario_name: str) -> AgreementVerdict:
    scanner, agreement = Scanner(rig), LaserAgreement(rig)
    for frame in frames(scenario_name):
        agreement.add(scanner.process(frame))
    return agreement.verdict()


@pytest.mark.parametrize(
    "scenario_name", part_of(["wall_yaw", "wall_range", "net_diamond", "net_hexagon"])
)
def test_a_true_rig_raises_no_alarm(scenario_name: str) -> None:
    verdict = watched(example_rig(), scenario_name)
    assert verdict.n_frames >= 6
    assert verdict.sentence() == ""


@pytest.mark.parametrize(
    ("scenario_name", "laser", "towards"),
    [
        (scenario_name, laser, towards)
        for i, scenario_name in enumerate(["wall_yaw", "wall_range"])
        for laser in (0, 1, 2)
        for k, towards in enumerate([0.0, 1.57])
        # Ways to turn, one on each wall, in turn for the lasers.
        if WHOLE or (i + laser + k) % 2 == 0
    ],
)
def test_a_laser_that_has_turned_is_named(scenario_name: str, laser: int, towards: float) -> None:
    verdict = watched(turned(example_rig(), laser, 0.4, towards), scenario_name)
    assert verdict.state is AgreementState.DRIFTED
    assert verdict.suspects == (laser,)
    assert np.rad2deg(verdict.angle) == pytest.approx(0.4, abs=0.1)


@pytest.mark.parametrize(("laser", "towards"), [(0, 0.0), (1, 0.0), (2, 1.57)])
@pytest.mark.parametrize("degrees", [0.1, 2.0])
def test_small_and_large_turns_are_found(laser: int, towards: float, degrees: float) -> None:
    # Two degrees are a third of the range beyond 0.8 m: the stripe leaves where it is sought.
    verdict = watched(turned(example_rig(), laser, degrees, towards), "wall_yaw")
    assert verdict.suspects == (laser,)
    assert np.rad2deg(verdict.angle) == pytest.approx(degrees, abs=0.1)


def test_a_turn_is_found_on_a_net_too() -> None:
    verdict = watched(turned(example_rig(), 1, 0.4, 0.0), "net_diamond")
    assert verdict.suspects == (1,)
    assert np.rad2deg(verdict.angle) == pytest.approx(0.4, abs=0.1)


@pytest.fixture(scope="module")
def sample_rig(samples: Path) -> Rig:
    return load_truth(samples / "lab-paper" / "truth" / "rig_truth.json")


def watched_sample(samples: Path, name: str, rig: Rig, every: int) -> AgreementVerdict:
    scanner, agreement = Scanner(rig), LaserAgreement(rig)
    with open_source(samples / "lab-paper" / "dives" / f"{name}.mp4") as source:
        for frame in source:
            if frame.index % every == 0:
                scan = scanner.process(frame)
                for _ in range(3):
                    agreement.add(scan)
    return agreement.verdict()


@pytest.mark.samples
@pytest.mark.parametrize("name", part_of(_DIVES))
def test_independent_dives_raise_no_alarm(samples: Path, sample_rig: Rig, name: str) -> None:
    verdict = watched_sample(samples, name, sample_rig, every=3)
    assert verdict.n_frames >= 10
    assert verdict.sentence() == ""


@pytest.mark.samples
@pytest.mark.parametrize("name", ["wall", "net_diamond"])
def test_a_turn_is_found_in_independent_dives(samples: Path, sample_rig: Rig, name: str) -> None:
    verdict = watched_sample(samples, name, turned(sample_rig, 1, 0.4, 0.0), every=3)
    assert verdict.suspects == (1,)
    assert np.rad2deg(verdict.angle) == pytest.approx(0.4, abs=0.1)
