"""The best angles beat all others: brute force, neighbours; and what must not move stays."""

import math
from dataclasses import replace

import numpy as np
import pytest

from aqualvs.design.changes import best_angles, changes
from aqualvs.design.judge import Judge, predict, score
from aqualvs.design.settings import Design, Goals, ring
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig

DEG = math.pi / 180.0
FAN = 68.0 * DEG
RIGS = [example_rig(), bluerov2_rig()]


def design_of(rig, count=2, **changed) -> Design:
    return replace(Design(rig=rig, mounts=ring(count, 0.15, 0.0, FAN)), **changed)


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_no_pair_of_tilts_on_a_grid_is_better(rig):
    design = design_of(rig)
    best = best_angles(design)
    judge, least = Judge(design), score(best).total
    halfway = math.sqrt(math.prod(rig.working_range))
    tilts = np.arange(-40.0, 60.1, 2.0) * DEG
    lots = [
        judge.trace([replace(mount, tilt=float(tilt)).aimed_at(halfway) for tilt in tilts])
        for mount in design.mounts
    ]
    totals = np.array([judge.judge(lots[1], lots[0].take([i]))[1] for i in range(len(tilts))])
    assert totals.shape == (51, 51)
    assert least <= totals.min() * (1.0 + 1e-9)
    # The grid is fine enough for its best to be near, else the search has not been tested.
    assert totals.min() < 1.2 * least


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
@pytest.mark.parametrize("free", [False, True])
def test_no_neighbour_is_better(rig, free):
    design = design_of(rig, 3)
    design = design.with_mounts([replace(m, free_stripe=free) for m in design.mounts])
    best = best_angles(design)
    least = score(best).total
    halfway = math.sqrt(math.prod(rig.working_range))
    for i, mount in enumerate(best.mounts):
        steps = [(t, 0.0) for t in (-2.0, -0.2, 0.2, 2.0)]
        steps += [(0.0, s) for s in (-8.0, -2.0, 2.0, 8.0)] * free
        for tilt, stripe in steps:
            moved = replace(mount, tilt=mount.tilt + tilt * DEG, stripe=mount.stripe + stripe * DEG)
            mounts = [*best.mounts]
            mounts[i] = moved.aimed_at(halfway)
            # The last grids are 0.1 degrees of tilt by 1 of direction, one laser at a time.
            assert score(best.with_mounts(mounts)).total >= least * (1.0 - 1e-6)


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_all_lasers_stay_in_the_picture(rig):
    for count in (2, 3):
        best = best_angles(design_of(rig, count))
        told = predict(best, np.geomspace(*rig.working_range, 30))
        assert told.visible.all()
        assert told.valid.all()


def test_freedom_helps_and_what_is_fixed_stays():
    rig = example_rig()
    design = design_of(rig)
    best = best_angles(design)
    turned = best_angles(
        design.with_mounts([replace(mount, free_stripe=True) for mount in design.mounts])
    )
    assert score(turned).total < score(best).total
    first, second = design.mounts
    fixed = replace(first, tilt=0.3, free_tilt=False)
    half = best_angles(design.with_mounts([fixed, second]))
    assert half.mounts[0] == fixed
    assert half.mounts[1].tilt != second.tilt
    assert score(half).total >= score(best).total
    all_fixed = design.with_mounts([fixed, replace(second, free_tilt=False)])
    assert best_angles(all_fixed) is all_fixed


def test_a_turned_stripe_keeps_half_of_its_baseline():
    """The best stripes of four lasers, but for that, include one that does not move with range."""
    rig = replace(bluerov2_rig(), working_range=(0.2, 0.9))
    design = design_of(rig, 4)
    free = [replace(mount, stripe=0.5 * math.pi, free_stripe=True) for mount in design.mounts]
    assert min(mount.baseline for mount in free) < 1e-9
    for mount in best_angles(design.with_mounts(free)).mounts:
        assert mount.baseline >= 0.5 * 0.15 - 1e-9


def test_a_quick_search_ends_where_a_long_one_does_when_it_starts_nearby():
    best = best_angles(design_of(bluerov2_rig(), 3))
    again = best_angles(best, quick=True)
    for one, other in zip(best.mounts, again.mounts, strict=True):
        assert one.tilt == pytest.approx(other.tilt, abs=0.3 * DEG)


@pytest.mark.parametrize("goals", [Goals(), Goals(1e-4, 1.0), Goals(1.0, 1e-3)], ids=str)
def test_the_score_is_the_prediction_in_goals(goals):
    """Without crossings and with whole stripes the total is the error, made of what is told."""
    design = design_of(bluerov2_rig(), avoid_crossings=False, goals=goals)
    design = best_angles(design, quick=True)
    told, judged = predict(design), score(design)
    assert judged.total == pytest.approx(judged.error)
    angle = np.full_like(told.ranges, goals.angle)
    wanted = np.stack([goals.range_share * told.ranges, angle, angle], axis=-1)
    # On a wall; the net's tolerances, with slightly other weights, are not told.
    noise = told.wall**2 + told.net**2
    squares = (0.5 * noise + told.systematic_total**2) / wanted**2
    # The score leaves a margin at the picture's border.
    assert math.sqrt(squares.mean()) == pytest.approx(judged.error, rel=0.15)


def test_crossings_and_stripes_out_of_the_picture_cost():
    design = best_angles(design_of(bluerov2_rig(), 3))
    free = replace(design, avoid_crossings=False)
    assert predict(design).crossing.any()
    assert score(free).total < score(design).total
    assert score(free).error == score(design).error
    away = [replace(design.mounts[0], tilt=-40.0 * DEG), *design.mounts[1:]]
    assert score(design.with_mounts(away)).total > 3.0 + score(design).total


def test_changes_do_what_they_must():
    design = best_angles(design_of(bluerov2_rig()))
    found = {one.words: one for one in changes(design)}
    assert [one.score for one in found.values()] == sorted(one.score for one in found.values())
    halved = found["mean of four frames"]
    assert halved.noise_range == pytest.approx(0.5, rel=0.02)
    assert halved.noise_angle == pytest.approx(0.5, rel=0.02)
    known = found["lasers known twice as well"]
    # All but what the water's index makes of it.
    assert known.systematic_range == pytest.approx(0.5, rel=0.1)
    wider = found["baseline 20 % longer"]
    # 1 / 1.2, but that other tilts suit it.
    assert wider.noise_range == pytest.approx(1 / 1.2, rel=0.05)
    assert found["twice the pixels, each way"].noise_range < 0.55
