"""Track and log put together: everything seen gets its place on the unrolled net."""

import numpy as np
import pytest

from aqualvs.nets.places import PlacedBy, place_net
from aqualvs.vehicle_logs import VehiclePlaces
from net_app_cases import STRETCH_S, hole, postures, stretch, vehicle_log

SPEED = 0.2
N = 12
DURATION = N * STRETCH_S


def passing(n=N, *, lost=(), gap_at=None, up=0.0):
    """A dive to the right at `SPEED`; the track misses the stretches `lost` altogether.

    At `gap_at` a new piece of track begins, which does not know of the way during that stretch.
    """
    found, place, piece = [], np.zeros(2), 0
    for i in range(n):
        if i == gap_at:
            piece += 1
        elif i not in lost:
            place = place + np.array([SPEED * STRETCH_S, up])
        found.append(stretch(i, place, piece, seen=i not in lost))
    return found


def test_without_a_log_the_track_tells_the_places():
    holes = [hole(6.0, (1.25, 0.1))]
    places = place_net(passing(up=0.05), holes, postures(DURATION))
    along = [one.along for one in places.end]
    assert along == pytest.approx(SPEED * STRETCH_S * np.arange(1, N + 1))
    assert [one.up for one in places.end] == pytest.approx(0.05 * np.arange(1, N + 1))
    assert places.begin[0].along == 0.0
    assert places.middle[3].along == pytest.approx(3.5 * SPEED * STRETCH_S)
    assert {one.placed_by for one in places.end} == {PlacedBy.TRACK}
    assert {one.depth for one in places.end} == {one.bearing for one in places.end} == {None}
    assert (places.holes[0].along, places.holes[0].up) == pytest.approx((1.25, 0.1))


def test_a_dive_without_a_net_has_no_places():
    places = place_net([], [], postures(3.0))
    assert [places.begin, places.middle, places.end, places.holes] == [[]] * 4


@pytest.mark.parametrize("lean", [0.0, 0.3])
def test_depth_is_that_of_the_foot_on_a_leaning_net(lean):
    """Level vehicle 7 m deep: the far normal rises by `lean`, so the foot is above the vehicle."""
    log = vehicle_log(DURATION, depth=lambda t: 7.0 + 0 * t, heading=lambda t: 1.0 + 0 * t)
    dive = postures(DURATION, distance=0.8, pitch=lean)
    places = place_net(passing(), [hole(6.0, (1.2, 0.2))], dive, VehiclePlaces(log))
    foot = 7.0 - 0.8 * np.sin(lean)
    assert places.middle[4].depth == pytest.approx(foot)
    # 0.2 m up in the plane of the net are less upwards where it leans.
    assert places.holes[0].depth == pytest.approx(foot - 0.2 * np.cos(lean))


def test_attitude_of_the_vehicle_counts_where_the_log_has_it():
    """The net hangs plumb and the nose is up by 0.2: the foot is as deep as the vehicle."""
    nose = 0.2
    log = vehicle_log(
        DURATION,
        depth=lambda t: 7.0 + 0 * t,
        heading=lambda t: 1.0 + 0 * t,
        roll=lambda t: 0 * t,
        pitch=lambda t: nose + 0 * t,
    )
    dive = postures(DURATION, distance=0.8, pitch=-nose)
    places = place_net(passing(), [], dive, VehiclePlaces(log))
    assert places.middle[4].depth == pytest.approx(7.0)


def test_depth_without_a_heading_still_counts():
    log = vehicle_log(DURATION, depth=lambda t: 7.0 + 0 * t)
    places = place_net(passing(), [], postures(DURATION), VehiclePlaces(log))
    assert places.middle[4].depth == pytest.approx(7.0)
    assert places.middle[4].bearing is None


def test_bearing_is_heading_plus_yaw_across_north():
    log = vehicle_log(DURATION, heading=lambda t: np.deg2rad(355.0) + 0 * t)
    places = place_net(passing(), [], postures(DURATION, yaw=np.deg2rad(12.0)), VehiclePlaces(log))
    assert np.rad2deg(places.middle[4].bearing) == pytest.approx(7.0)
    assert np.rad2deg(places.end[4].heading) == pytest.approx(355.0)
    assert places.middle[4].depth is None


def test_noise_of_the_log_does_not_shake_the_track():
    """Waves move the depth sensor by 0.2 m; the track knows that the vehicle kept its height."""
    wave = 0.2
    log = vehicle_log(
        DURATION, depth=lambda t: 5.0 + wave * np.sin(2 * np.pi * t / 4.0), heading=lambda t: 0 * t
    )
    places = place_net(passing(), [], postures(DURATION), VehiclePlaces(log))
    depths = np.array([one.depth for one in places.end])
    assert np.ptp(depths) < 0.25 * wave
    assert places.slip == 0.0
    assert depths.mean() == pytest.approx(5.0, abs=0.1 * wave)


def test_drift_of_the_track_is_taken_back_by_the_log():
    """The track climbs by 1 cm a second, which never was: depth stays within 15 s of that."""
    n = 60
    log = vehicle_log(n * STRETCH_S, depth=lambda t: 5.0 + 0 * t, heading=lambda t: 0 * t)
    drifting = passing(n, up=0.01 * STRETCH_S)
    places = place_net(drifting, [], postures(n * STRETCH_S), VehiclePlaces(log))
    assert max(abs(one.depth - 5.0) for one in places.end) < 0.15 + 1e-9
    assert drifting[-1].place[1] == pytest.approx(1.5)
    # And that is too far to be believed.
    assert places.slip == pytest.approx(1.5, abs=0.05)


def test_a_gap_in_the_track_is_bridged_at_the_speed_beside_it():
    places = place_net(passing(gap_at=5), [hole(21.0, (3.6, 0.0), piece=1)], postures(DURATION))
    along = np.array([one.along for one in places.end])
    assert along == pytest.approx(SPEED * STRETCH_S * np.arange(1, N + 1))
    by = [one.placed_by for one in places.end]
    assert by[:5] == [PlacedBy.TRACK] * 5
    assert set(by[5:]) == {PlacedBy.SPEED}
    # The piece of the hole begins a stretch's way behind where its own track thinks it does.
    assert places.holes[0].along == pytest.approx(3.6 + SPEED * STRETCH_S)
    assert places.holes[0].placed_by is PlacedBy.SPEED


def test_a_stretch_that_showed_nothing_does_not_stand_still():
    places = place_net(passing(lost=(6,), gap_at=7), [], postures(DURATION))
    along = np.array([one.along for one in places.end])
    assert along == pytest.approx(SPEED * STRETCH_S * np.arange(1, N + 1))


def test_depth_of_every_piece_comes_from_the_log():
    log = vehicle_log(
        DURATION, depth=lambda t: np.where(t < 13.0, 5.0, 9.0), heading=lambda t: 0 * t
    )
    places = place_net(passing(gap_at=5), [], postures(DURATION), VehiclePlaces(log))
    assert places.end[4].depth == pytest.approx(5.0, abs=0.05)
    assert places.end[-1].depth == pytest.approx(9.0, abs=0.05)


RADIUS = 4.0


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_bearing_joins_the_pieces_around_a_round_cage(side):
    """In the gap the vehicle went on fast; bearing knows, from inside and from outside the cage."""
    n, gap, jump = 40, 20, 3.0

    def true_way(t):
        return SPEED * t + np.where(t >= STRETCH_S * (gap + 0.5), jump, 0.0)

    rng = np.random.default_rng(4)

    def heading(t):
        return side * true_way(t) / RADIUS + np.deg2rad(350.0) + rng.normal(0, 0.02, len(t))

    log = vehicle_log(n * STRETCH_S, heading=heading)
    places = place_net(passing(n, gap_at=gap), [], postures(n * STRETCH_S), VehiclePlaces(log))
    along = np.array([one.along for one in places.end])
    true = true_way(STRETCH_S * np.arange(1, n + 1))
    # Bearings are good to 0.02 rad, that is 8 cm on this cage, and are averaged.
    assert along == pytest.approx(true, abs=0.08)
    assert places.end[0].along == pytest.approx(true[0])
    assert {one.placed_by for one in places.end[gap:]} == {PlacedBy.BEARING}


def test_a_flat_net_is_not_taken_for_a_cage():
    """Bearing wanders by a degree or two, as compasses do, and means nothing."""
    log = vehicle_log(DURATION, heading=lambda t: 1.0 + 0.03 * np.sin(t / 5.0))
    places = place_net(passing(gap_at=5), [], postures(DURATION), VehiclePlaces(log))
    along = np.array([one.along for one in places.end])
    assert along == pytest.approx(SPEED * STRETCH_S * np.arange(1, N + 1))


def test_without_any_track_only_the_log_places():
    found = [stretch(i, (0.0, 0.0), 0, seen=False) for i in range(N)]
    log = vehicle_log(DURATION, depth=lambda t: 4.0 + 0 * t, heading=lambda t: 0.02 * t)
    places = place_net(found, [], postures(DURATION), VehiclePlaces(log))
    assert {one.placed_by for one in places.end} == {PlacedBy.NOTHING}
    assert places.middle[3].depth == pytest.approx(4.0)
    assert places.middle[3].bearing == pytest.approx(0.02 * 3.5 * STRETCH_S, abs=2e-3)


def test_a_hole_in_a_piece_that_was_lost_again_is_where_the_vehicle_saw_it():
    log = vehicle_log(DURATION, depth=lambda t: 4.0 + 0 * t, heading=lambda t: 0 * t)
    places = place_net(
        passing(),
        [hole(10.0, (7.0, 3.0), piece=5, from_foot=(0.1, 0.05))],
        postures(DURATION),
        VehiclePlaces(log),
    )
    assert places.holes[0].along == pytest.approx(2.1)
    assert places.holes[0].depth == pytest.approx(4.0 - 0.05)
    assert places.holes[0].placed_by is PlacedBy.SPEED


def test_a_log_that_ends_early_leaves_the_rest_without_depth():
    log = vehicle_log(5.0, depth=lambda t: 4.0 + 0 * t, heading=lambda t: 0 * t)
    n = 30
    places = place_net(passing(n), [], postures(n * STRETCH_S), VehiclePlaces(log))
    assert places.end[0].depth == pytest.approx(4.0)
    assert places.end[-1].depth is None
    assert places.end[-1].bearing is None
