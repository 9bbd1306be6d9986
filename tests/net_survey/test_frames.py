"""Dives of several dates in one frame of places, or the reason why not."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.net_survey.comparison import HoleState, compare
from aqualvs.net_survey.frames import Raster, WallFrame, common_frame, spread_over
from aqualvs.net_survey.surveys import named_date
from net_change_cases import RADIUS, Cage, dive

LANES = (3.0, 3.4, 3.8)


@pytest.fixture
def cage():
    rng = np.random.default_rng(21)
    holes = [(12.0, 3.1, 0.1, 0, 99), (30.0, 3.5, 0.15, 0, 99), (48.0, 3.2, 0.08, 0, 99)]
    return Cage(rng, holes=[*holes, (55.0, 3.7, 0.12, 10, 99)])


def flat(survey, facing_deg=40.0):
    """The same dive along a net that faces one way."""
    bearing = np.full(len(survey.stretches.along), np.deg2rad(facing_deg))
    holes = np.full(len(survey.holes.number), np.deg2rad(facing_deg))
    return replace(
        survey,
        stretches=replace(survey.stretches, bearing=bearing),
        holes=replace(survey.holes, bearing=holes),
    )


def test_the_radius_of_a_round_net_is_found(cage):
    frame, why = common_frame([dive(cage, day, depths=LANES) for day in (0, 21)])
    assert (frame.round, frame.sign, why) == (True, 1.0, "")
    assert frame.radius == pytest.approx(RADIUS, rel=0.01)


def test_dives_across_north_are_one_piece(cage):
    cage.holes = [(bearing - 30.0, *rest) for bearing, *rest in cage.holes]
    cage.holes = [(bearing % 360.0, *rest) for bearing, *rest in cage.holes]
    dives = [dive(cage, day, bearings=(-30.0, 40.0), depths=LANES) for day in (0, 21)]
    wall = compare(dives, 1.0).wall
    assert sorted(one.state for one in wall.sites) == ["new", "same", "same", "same"]
    # Nothing but the cells of the arc, of 70 degrees times 8 m by three of depth at most.
    assert len(wall.cells) <= 3 * (70.0 / 360.0 * wall.history.raster.shape[0] + 2)


def test_along_a_flat_net_the_pattern_tells_where_a_dive_began(cage):
    first = flat(dive(cage, 0, bearings=(0.0, 60.0), depths=LANES))
    second = flat(dive(cage, 21, bearings=(8.0, 66.0), depths=LANES, shift=(0.0, -0.2)))
    wall = compare([first, second], 1.0).wall
    assert not wall.frame.round
    shift = wall.shifts[1]
    true = np.array([RADIUS * np.deg2rad(8.0), 0.2])
    assert shift.determined.all()
    assert np.all(np.abs(shift.value - true) < 4.0 * shift.sigma)
    states = sorted(one.state for one in wall.sites)
    assert states.count(HoleState.NEW) == 1
    assert states.count(HoleState.SAME) == 3


def test_a_flat_net_without_a_common_pattern_is_not_laid_at_random(cage):
    first = flat(dive(cage, 0, bearings=(0.0, 60.0), depths=LANES))
    other = Cage(np.random.default_rng(22))
    second = flat(dive(other, 21, bearings=(0.0, 60.0), depths=LANES))
    result = compare([first, second], 1.0)
    assert result.wall is None
    assert any("do not determine its position along the net" in one for one in result.warnings)


def test_a_round_net_without_a_common_pattern_keeps_its_places_and_their_doubt(cage):
    other = Cage(np.random.default_rng(23))
    dives = [
        dive(cage, 0, bearings=(0.0, 60.0), depths=LANES),
        dive(other, 21, bearings=(0.0, 60.0), depths=LANES, shift=(3.0, 0.2)),
    ]
    result = compare(dives, 1.0)
    shift = result.wall.shifts[1]
    assert not shift.determined.any()
    assert not shift.by_pattern
    assert not shift.value.any()
    assert shift.sigma == pytest.approx([result.wall.frame.radius * np.deg2rad(5.0), 0.5])
    assert any("taken as logged" in one for one in result.warnings)
    # Lanes of 1.3 m in height, places unsure by half a metre: nothing can be called gone.
    assert HoleState.GONE not in {one.state for one in result.wall.sites}


def test_dives_that_cannot_share_a_frame_say_why(cage):
    arc = {"bearings": (0.0, 60.0), "depths": LANES}
    one, other = dive(cage, 0, **arc), dive(cage, 21, **arc)
    mirrored = replace(other, stretches=replace(other.stretches, bearing=-other.stretches.bearing))
    frame, why = common_frame([one, mirrored])
    assert frame is None
    assert "from inside, others from outside" in why
    frame, why = common_frame([flat(one, 40.0), flat(other, 130.0)])
    assert frame is None
    assert "one flat side" in why
    frame, why = common_frame([one, dive(cage, 21, **arc, log=False)])
    assert frame is None
    assert "fewer than two dates" in why


def test_another_net_and_other_options_are_warned_of(cage):
    one, other = (dive(cage, day, bearings=(0.0, 40.0), depths=LANES) for day in (0, 21))
    facts = {**other.facts, "options": {"twine_mm": 2.5}}
    facts["summary"] = {**other.facts["summary"], "bar_mm": 30.0, "track_slip_m": 1.2}
    warnings = "\n".join(compare([one, replace(other, facts=facts)], 1.0).warnings)
    assert "is this the same net?" in warnings
    assert "--twine-mm" in warnings
    assert "differ by 1.2 m" in warnings


def test_a_raster_goes_round():
    raster = Raster.over(np.array([0.0, 2.3]), np.array([9.0, 4.1]), 1.0, WallFrame(True, 8.0))
    assert raster.shape == (50, 3)
    round_once = np.array([2.0 * np.pi * 8.0, 0.0])
    place = np.array([0.3, 2.5])
    assert (
        raster.index(place) == raster.index(place + round_once) == raster.index(place - round_once)
    )
    assert raster.index(np.array([0.3, 7.0])) == -1
    assert raster.index(np.array([np.nan, 3.0])) == -1
    assert raster.middle(raster.index(place)) == pytest.approx([0.5 * raster.size[0], 2.5])


def test_places_fill_an_outline_and_a_share_of_its_height():
    square = np.array([[[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [0.0, 2.0]]])
    places = spread_over(square, 0.1)[0]
    assert np.ptp(places, axis=0) == pytest.approx([1.0, 2.0], abs=0.1)
    inner = spread_over(square, 0.1, 0.5)[0]
    assert np.ptp(inner, axis=0) == pytest.approx([1.0, 1.0], abs=0.1)
    assert inner.mean(axis=0) == pytest.approx([0.5, 1.0])


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("cage3_2026-05-01", "2026-05-01"),
        ("20260501_1030.mp4", "2026-05-01"),
        ("dive_2026.05.01", "2026-05-01"),
        ("2026-13-01", None),
        ("dive_120260501", None),
        ("net", None),
    ],
)
def test_dates_in_names(name, found):
    day = named_date(name)
    assert (None if day is None else day.isoformat()) == found
