"""Growth between dates is what it is, and as uncertain as it is said to be."""

from datetime import date

import numpy as np
import pytest

from aqualvs.net_survey.comparison import HoleState, compare
from aqualvs.net_survey.frames import SurveyShift, WallFrame, place_survey
from aqualvs.net_survey.growth import Growth, history
from aqualvs.net_survey.tables import summary_lines
from net_change_cases import RADIUS, Cage, dive

ARC, LANES = (0.0, 70.0), (3.0, 3.4, 3.8)
DAYS = 21
N_PAIRS = 12


def some_holes(rng, n, first=0, last=99):
    where = zip(
        rng.uniform(5, 65, n), rng.uniform(2.9, 3.9, n), rng.uniform(0.08, 0.2, n), strict=True
    )
    return [(*one, first, last) for one in where]


@pytest.fixture(scope="module")
def pairs():
    """Many nets, each on two dates, with instruments that are off; nothing is missed."""
    found = []
    for seed in range(N_PAIRS):
        rng = np.random.default_rng(seed)
        cage = Cage(rng, holes=some_holes(rng, 5))
        off = rng.normal(0.0, [4.0, 0.3])
        before = dive(cage, 0, bearings=ARC, depths=LANES)
        after = dive(cage, DAYS, bearings=ARC, depths=LANES, shift=off)
        found.append((cage, off, compare([after, before], 1.0)))
    return found


def middles(wall):
    return wall.history.raster.middle(np.array([one.cell for one in wall.cells]))


def test_growth_of_the_wall_is_recovered_within_its_sigma(pairs):
    z = [
        (result.wall.growth.value - cage.growth(*middles(result.wall).T).mean())
        / result.wall.growth.sigma
        for cage, _, result in pairs
    ]
    # The root of a mean of 12 squares of normal numbers: 0.1 % quantiles.
    assert 0.42 < np.sqrt(np.mean(np.square(z))) < 1.66
    assert np.abs(z).max() < 4.0


def test_growth_of_the_cells_is_recovered_within_its_sigma(pairs):
    z = np.concatenate(
        [
            [
                (one.difference.value - DAYS * true) / one.difference.sigma
                for one, true in zip(
                    result.wall.cells, cage.growth(*middles(result.wall).T), strict=True
                )
            ]
            for cage, _, result in pairs
        ]
    )
    assert len(z) > 100
    # The error common to a dive is drawn 12 times only.
    assert 0.5 < np.sqrt(np.mean(z**2)) < 1.5
    assert np.abs(z).max() < 4.5


def test_what_grows_faster_than_the_rest_is_told_better_than_growth_itself(pairs):
    z, narrower = [], []
    for cage, _, result in pairs:
        true = cage.growth(*middles(result.wall).T)
        for one, rate in zip(result.wall.cells, true - true.mean(), strict=True):
            z.append((one.excess.value - rate) / one.excess.sigma)
            narrower.append(one.excess.sigma < 0.8 * one.per_day.sigma)
    # 124 numbers, not quite independent.
    assert 0.75 < np.sqrt(np.mean(np.square(z))) < 1.3
    assert np.abs(z).max() < 4.5
    # Cells in the middle of what was seen; at its edge places weigh more.
    assert np.mean(narrower) > 0.5


def test_a_place_that_grows_faster_is_named():
    cage = Cage(np.random.default_rng(12), spread=0.0)
    even = Cage.growth

    def patchy(self, u, d):
        return even(self, u, d) + 0.012 * (np.abs(u - 5.0) < 1.0)

    cage.growth = patchy.__get__(cage)
    dives = [dive(cage, day, bearings=ARC, depths=LANES) for day in (0, DAYS)]
    result = compare(dives, 1.0)
    faster = [one for one in result.wall.cells if one.apart and one.excess.value > 0.0]
    assert faster
    places = result.wall.history.raster.middle(np.array([one.cell for one in faster]))
    assert np.all(np.abs(places[:, 0] - 5.0) < 1.6)
    lines = "\n".join(summary_lines(result))
    assert "differ from the rest of the wall; surest at" in lines
    assert "faster by" in lines


def test_the_instruments_shift_is_found_within_its_sigma(pairs):
    z = []
    for _, off, result in pairs:
        wall, shift = result.wall, result.wall.shifts[1]
        assert shift.determined.all()
        assert np.all(shift.sigma < [0.25, 0.15])
        true = -np.array([wall.frame.radius * np.deg2rad(off[0]), off[1]])
        z.append((shift.value - true) / shift.sigma)
    # Sigma allows for the raster of shifts: on the safe side.
    assert np.all(np.sqrt(np.mean(np.square(z), axis=0)) < 1.5)
    assert np.all(np.sqrt(np.mean(np.square(z), axis=0)) > 0.2)
    assert np.abs(z).max() < 4.0


def test_no_hole_is_new_or_gone_where_all_stay(pairs):
    states = [one.state for _, _, result in pairs for one in result.wall.sites]
    assert len(states) > 4 * N_PAIRS
    assert HoleState.NEW not in states
    assert HoleState.GONE not in states
    assert states.count(HoleState.SAME) > 0.9 * len(states)


def test_what_instruments_are_off_by_would_else_make_holes_new(pairs, monkeypatch):
    """Guard of the test above: without the shift most holes would be new, and as many gone."""
    from aqualvs.net_survey import comparison as body

    monkeypatch.setattr(body, "align", lambda *_: SurveyShift.first())
    survey = pairs[0][2].surveys
    one = survey[1]
    moved = dive(pairs[0][0], DAYS, bearings=ARC, depths=LANES, shift=(6.0, 0.0))
    states = [site.state for site in compare([survey[0], moved], 1.0).wall.sites]
    assert one.date == moved.date
    assert states.count(HoleState.NEW) >= 2


def test_without_noise_growth_is_exact():
    cage = Cage(np.random.default_rng(3), spread=0.0, pattern=0.0, rate=0.003)
    dives = [dive(cage, day, bearings=ARC, depths=LANES, noise=0.0) for day in (0, 10, 30)]
    result = compare(dives, 1.0)
    wall = result.wall
    assert wall.growth.value == pytest.approx(0.003, rel=1e-6)
    for one in wall.cells:
        assert one.per_day.value == pytest.approx(0.003, rel=1e-6)
        assert one.n_dates in (2, 3)
        span = wall.history.days[one.last] - wall.history.days[one.first]
        assert one.difference.value == pytest.approx(0.003 * span, rel=1e-6)
    assert [one.value for one in wall.means] == pytest.approx([0.3, 0.33, 0.39], rel=1e-6)
    assert [one.value for one in result.whole] == pytest.approx([0.3, 0.33, 0.39], rel=1e-6)
    assert result.rate.value == pytest.approx(0.003, rel=1e-6)
    assert wall.history.known.all(axis=1).sum() >= 10


def test_dives_that_see_other_parts_do_not_pass_for_growth():
    """The pattern of an even net that never changes is no growth, whoever sees which part."""
    cage = Cage(np.random.default_rng(6), rate=0.0, spread=0.0)
    first = dive(cage, 0, bearings=(0.0, 60.0), depths=LANES, noise=0.0)
    second = dive(cage, DAYS, bearings=(20.0, 90.0), depths=LANES, noise=0.0)
    wall = compare([first, second], 1.0).wall
    assert abs(wall.growth.value) < 0.2 * wall.growth.sigma
    assert not any(one.changed for one in wall.cells)


def test_places_weigh_where_solidity_changes_from_place_to_place():
    frame = WallFrame(True, RADIUS)
    variance = {}
    for pattern in (0.0, 0.05):
        cage = Cage(np.random.default_rng(5), pattern=pattern, rate=0.0, spread=0.0)
        placed = [
            place_survey(dive(cage, day, bearings=ARC, depths=depths, noise=0.0), frame)
            for day, depths in ((0, (3.1, 3.4)), (DAYS, (3.3, 3.6)))
        ]
        for open_sigma in (0.0, 0.5):
            shifts = [
                SurveyShift.first(),
                SurveyShift(np.zeros(2), np.full(2, open_sigma), np.ones(2, bool)),
            ]
            wall = history(placed, shifts, frame, 1.0)
            variance[pattern, open_sigma] = wall.place_variance[wall.known.all(axis=1)].mean(axis=0)
    assert variance[0.0, 0.5] == pytest.approx([0.0, 0.0], abs=1e-12)
    # The pattern has a slope of 0.06 a metre; lanes that are 0.2 m apart differ by its share.
    assert np.all(variance[0.05, 0.0] > 1e-6)
    assert variance[0.05, 0.5][1] > variance[0.05, 0.0][1] + 0.25 * 0.02**2
    assert variance[0.05, 0.5][0] == pytest.approx(variance[0.05, 0.0][0])


def test_two_dives_of_one_day_are_one_date():
    cage = Cage(np.random.default_rng(8), spread=0.0)
    near = dive(cage, 0, name="near", bearings=(0.0, 45.0), depths=LANES)
    far = dive(cage, 0, name="far", bearings=(40.0, 90.0), depths=LANES)
    later = dive(cage, DAYS, bearings=(0.0, 90.0), depths=LANES)
    result = compare([far, later, near], 1.0)
    assert result.dates == [date(2026, 5, 1), date(2026, 5, 22)]
    assert len(result.wall.placed) == 3
    assert abs(result.wall.growth.z) > 0.0
    one_side = compare([near, later], 1.0)
    assert len(result.wall.cells) > 1.5 * len(one_side.wall.cells)
    # Errors common to a dive are independent between two.
    assert result.wall.growth.sigma < one_side.wall.growth.sigma


def test_the_summary_says_what_is_not_told():
    cage = Cage(np.random.default_rng(9), rate=0.0, spread=0.0)
    dives = [dive(cage, day, bearings=ARC, depths=LANES) for day in (0, DAYS)]
    lines = "\n".join(summary_lines(compare(dives, 1.0)))
    assert "no change beyond the uncertainty" in lines
    assert "beyond chance" in lines
    assert Growth(0.01, 0.005).z == pytest.approx(2.0)
