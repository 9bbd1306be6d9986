"""What looks at cells of a net say together: a hole, or something that hid it for a while."""

import numpy as np
import pytest

from aqualvs.nets.hole_candidates import LASERS, Looks, looks_say

MIDDLE = np.zeros(2)


def looks(laser: int, dark: int, lit: int, frames: int) -> Looks:
    """Looks of one laser at as many cells within 1 m, one a cell, spread over some frames."""
    n = dark + lit
    cell = np.arange(n)
    missed = (cell < dark).astype(np.int64)
    place = 0.5 * np.stack([np.cos(cell), np.sin(cell)], axis=1)
    rows = np.c_[np.ones(n), place, np.where(missed, 3.0, -3.0)]
    frame = np.linspace(0, frames - 1, n).round().astype(np.int64)
    return Looks().added((cell * LASERS + laser) * 2 + missed, rows, frame)


def both(one: Looks, other: Looks) -> Looks:
    """Looks of two lasers."""
    return one.added(other.keys, other.sums, other.frames[:, 0])


def test_a_hole_is_dark_for_two_lasers_at_once() -> None:
    assert both(looks(0, 10, 0, 3), looks(1, 10, 0, 3)).stays_dark(MIDDLE, 1.0)


def test_what_one_laser_alone_saw_dark_must_stay_so() -> None:
    assert not looks(0, 20, 0, 5).stays_dark(MIDDLE, 1.0)
    assert looks(0, 20, 0, 12).stays_dark(MIDDLE, 1.0)
    # The other one saw strands there.
    assert not both(looks(0, 20, 0, 5), looks(1, 1, 2, 5)).stays_dark(MIDDLE, 1.0)


def test_strands_seen_in_a_hole_now_and_then_do_not_fill_it() -> None:
    assert both(looks(0, 40, 2, 20), looks(1, 40, 3, 20)).stays_dark(MIDDLE, 1.0)


def test_what_drifts_by_hides_strands_that_are_seen_as_well() -> None:
    assert not both(looks(0, 40, 12, 20), looks(1, 40, 12, 20)).stays_dark(MIDDLE, 1.0)


def test_strands_beyond_a_patch_do_not_count() -> None:
    one = both(looks(0, 40, 0, 20), looks(1, 40, 0, 20))
    far = looks(2, 0, 40, 20)
    far.sums[:, 1:3] += 5.0
    assert both(one, far).stays_dark(MIDDLE, 1.0)
    near = looks(2, 0, 40, 20)
    assert not both(one, near).stays_dark(MIDDLE, 1.0)


def test_frames_are_the_first_and_the_last() -> None:
    row = np.array([[1.0, 0.0, 0.0, 3.0]])
    key = np.array([1])
    many = Looks()
    for frame in (7, 3, 9):
        many = many.added(key, row, np.array([frame]))
    np.testing.assert_array_equal(many.frames, [[3, 9]])
    assert many.sums[0, 0] == 3.0


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_a_miss_says_the_less_the_more_are_missed(share: float) -> None:
    rng = np.random.default_rng(1)
    n = 4000
    missed = rng.random(n) < share
    says = looks_say(
        np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n), missed, missed.astype(np.int64)
    )
    # A share of 0.03 is always allowed for; chance, and what single ones do not tell, a fifth.
    assert np.exp(-says[missed][0]) == pytest.approx(0.03 + share, rel=0.2)
    assert np.all(says[~missed] < -3.0)
