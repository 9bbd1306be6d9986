"""What became of holes: new only where an earlier dive looked, gone only where the last one did."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.net_survey.comparison import HoleState, find_sites
from aqualvs.net_survey.frames import SurveyShift, WallFrame, place_survey
from aqualvs.net_survey.surveys import Holes
from net_change_cases import RADIUS, Cage, dive

FRAME = WallFrame(True, RADIUS)
LANES = (3.0, 3.4, 3.8)


def seen(day, holes, *, bearings=(0.0, 40.0), sigma=(0.0, 0.0)):
    """A dive that saw these holes: (bearing in degrees, depth, diameter)."""
    survey = dive(Cage(np.random.default_rng(day)), day, bearings=bearings, depths=LANES)
    columns = np.array(holes, float).reshape(-1, 3).T
    n = len(columns[0])
    found = Holes(
        [str(i + 1) for i in range(n)],
        np.full(n, np.nan),
        np.full(n, np.nan),
        columns[1],
        np.deg2rad(columns[0]),
        columns[2],
        np.full(n, 0.012),
    )
    placed = place_survey(replace(survey, holes=replace(found, time_s=np.zeros(n))), FRAME)
    u = RADIUS * np.deg2rad(columns[0])
    placed = replace(placed, holes=np.stack([u, columns[1]], axis=-1))
    return placed, SurveyShift(np.zeros(2), np.array(sigma), np.ones(2, bool))


def sites(*dives):
    return find_sites([one for one, _ in dives], [shift for _, shift in dives], FRAME)


def states(*dives):
    return [one.state for one in sites(*dives)]


@pytest.mark.parametrize(
    ("before", "after", "state"),
    [
        (0.12, 0.12, HoleState.SAME),
        (0.12, 0.15, HoleState.SAME),
        (0.12, 0.25, HoleState.GROWN),
        (0.25, 0.12, HoleState.SMALLER),
        (None, 0.12, HoleState.NEW),
        (0.12, None, HoleState.GONE),
    ],
)
def test_what_became_of_a_hole(before, after, state):
    dives = [
        seen(day, [] if size is None else [(20.0, 3.4, size)])
        for day, size in ((0, before), (21, after))
    ]
    assert states(*dives) == [state]


def test_a_place_not_looked_at_proves_nothing():
    west, east = {"bearings": (0.0, 20.0)}, {"bearings": (30.0, 50.0)}
    hole = (40.0, 3.4, 0.12)
    assert states(seen(0, [], **west), seen(21, [hole], **east)) == [HoleState.FIRST_LOOK]
    assert states(seen(0, [hole], **east), seen(21, [], **west)) == [HoleState.NOT_PASSED]
    # Where one of the earlier dives looked, it is new all the same.
    several = seen(0, [], **west), seen(9, [], **east), seen(21, [hole], **east)
    assert states(*several) == [HoleState.NEW]


def test_at_the_edge_of_what_was_seen_unsure_places_prove_nothing():
    """Lanes end at 3.8 m plus half a picture; a hole there is new only if its place is sure."""
    edge = [(20.0, 3.85, 0.12)]
    assert states(seen(0, []), seen(21, edge)) == [HoleState.NEW]
    unsure = seen(21, edge, sigma=(0.2, 0.4))
    (site,) = sites(seen(0, []), unsure)
    assert site.state is HoleState.FIRST_LOOK
    assert 0.2 < site.looked[0] < 0.8


def test_every_look_that_found_nothing_makes_it_surer():
    hole = [(20.0, 3.4, 0.12)]
    (once,) = sites(seen(0, []), seen(21, hole))
    (twice,) = sites(seen(0, []), seen(9, []), seen(21, hole))
    assert once.missed == pytest.approx(0.2)
    assert twice.missed == pytest.approx(0.04)
    (gone,) = sites(seen(0, []), seen(9, hole), seen(21, []))
    assert gone.state is HoleState.GONE
    assert gone.missed == pytest.approx(0.2)


def test_a_new_hole_beside_an_old_one_is_new():
    """Half a metre apart: each hole has one counterpart, even where places are unsure."""
    beside = (20.0 + np.rad2deg(0.5 / RADIUS), 3.4, 0.12)
    unsure = seen(21, [(20.5, 3.4, 0.12), beside], sigma=(0.2, 0.05))
    assert sorted(states(seen(0, [(20.0, 3.4, 0.12)]), unsure)) == ["new", "same"]


def test_parts_of_one_hole_are_one():
    """What growth parts in two has the area of both; what an earlier dive saw whole stays one."""
    apart = np.rad2deg(0.1 / RADIUS)
    touching = seen(21, [(20.0, 3.4, 0.09), (20.0 + apart, 3.4, 0.09)])
    (site,) = sites(seen(0, [(20.0 + apart / 2, 3.4, 0.13)]), touching)
    assert site.state is HoleState.SAME
    assert site.sizes[1] == pytest.approx(0.09 * np.sqrt(2.0))
    assert len(site.numbers) == 3
    pieces = seen(21, [(20.0 - apart, 3.4, 0.07), (20.0 + apart, 3.4, 0.07)])
    assert len(sites(seen(0, [(20.0, 3.4, 0.4)]), pieces)) == 1


def test_of_two_dives_of_a_day_the_larger_look_counts():
    whole, part = seen(0, [(20.0, 3.4, 0.2)]), seen(0, [(20.0, 3.4, 0.1)])
    (site,) = sites(whole, part, seen(21, [(20.0, 3.4, 0.2)]))
    assert site.state is HoleState.SAME
    assert site.sizes == pytest.approx([0.2, 0.2])


def test_a_hole_due_north_is_one_hole():
    north = {"bearings": (-20.0, 20.0)}
    before, after = seen(0, [(359.8, 3.4, 0.12)], **north), seen(21, [(0.2, 3.4, 0.12)], **north)
    assert states(before, after) == [HoleState.SAME]
