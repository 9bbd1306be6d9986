"""Dashes, gaps and spans, from made-up signals."""

import numpy as np
import pytest

from aqualvs.nets.dashes import crossings_of, find_dashes
from aqualvs.nets.lit_intervals import NetSignal

STEP = 1e-3


def signal_of(*states: str, beyond: str = "", back: bool = False) -> NetSignal:
    """A signal from one string for each laser: space hidden, dot dark, # lit.

    `beyond` marks by # where light is seen behind the net; `back` lets `along` descend.
    """
    state = np.array([[" .#".index(c) for c in text] for text in states], np.uint8)
    n_lasers, n_lines = state.shape
    angle = np.linspace(0.0, 2.0, n_lasers)
    along = np.tile(np.arange(n_lines) * STEP, (n_lasers, 1))
    behind = np.array([c == "#" for c in beyond.ljust(n_lines)])
    return NetSignal(
        index=0,
        time_s=0.0,
        range=0.5,
        origin=np.zeros((n_lasers, 2)),
        direction=np.stack([np.cos(angle), np.sin(angle)], axis=1),
        search=np.stack([-np.sin(angle), np.cos(angle)], axis=1),
        pixel=6e-4,
        along=along[:, ::-1].copy() if back else along,
        step=np.full(state.shape, STEP),
        state=state,
        height=np.where(state == 2, 100.0, 0.0),
        width=np.where(state == 2, 4e-3, 0.0),
        beyond=np.tile(behind, (n_lasers, 1)),
    )


def test_dashes_have_place_and_length() -> None:
    view = find_dashes(signal_of("..###....#####.."))
    np.testing.assert_allclose(view.dashes.along, [3 * STEP, 11 * STEP])
    # Towards the dark the light falls to 0.4 of its peak a tenth of a step beyond each end.
    np.testing.assert_allclose(view.dashes.length, [3.2 * STEP, 5.2 * STEP])
    assert view.dashes.whole.all()
    assert view.seen_length == pytest.approx(16 * STEP)
    np.testing.assert_allclose(view.step, STEP)


def test_one_dark_search_line_does_not_end_a_dash_two_do() -> None:
    assert len(find_dashes(signal_of("..##.##..")).dashes) == 1
    assert len(find_dashes(signal_of("..##..##..")).dashes) == 2


def test_a_dash_cut_off_is_not_whole() -> None:
    view = find_dashes(signal_of("##...##.  ..##", "..##  ..##...."))
    np.testing.assert_array_equal(view.dashes.whole, [False, True, False, False, True])
    np.testing.assert_array_equal(view.dashes.laser, [0, 0, 0, 1, 1])
    np.testing.assert_array_equal(view.span_laser, [0, 0, 1, 1])


def measured(heights: list[float], widths: list[float] | None = None) -> tuple[float, float]:
    """Length in steps, and width, of the one dash that has these heights."""
    signal = signal_of(".." + "#" * len(heights) + "..")
    signal.height[0, 2:-2] = heights
    if widths is not None:
        signal.width[0, 2:-2] = widths
    dashes = find_dashes(signal).dashes
    assert len(dashes) == 1
    return float(dashes.length[0]) / STEP, float(dashes.width[0])


def test_an_overexposed_core_does_not_end_a_dash() -> None:
    def dashes_of(left: list[float], dark: int, right: list[float]) -> np.ndarray:
        signal = signal_of(".." + "#" * len(left) + "." * dark + "#" * len(right) + "..")
        signal.height[signal.state == 2] = left + right
        return find_dashes(signal).dashes.length / STEP

    white = dashes_of([40.0, 150.0], 3, [155.0, 90.0])
    # As a core that is seen: 62 lies between 0 and 90, and a sixth of a step up from 40.
    whole = dashes_of([40.0, 150.0, 150.0, 150.0], 0, [150.0, 155.0, 90.0])
    np.testing.assert_allclose(white, whole)
    # Two strands: the light fades between them, or the dark is too wide.
    assert len(dashes_of([40.0, 150.0, 90.0], 3, [90.0, 155.0, 90.0])) == 2
    assert len(dashes_of([40.0, 150.0], 4, [155.0, 90.0])) == 2


def test_a_dash_ends_where_its_light_falls_below_a_share_of_its_peak() -> None:
    # 40 of 100 lies a quarter of a step from 30 towards 70, at both ends.
    assert measured([30.0, 70.0, 100.0, 70.0, 30.0])[0] == pytest.approx(3.5)
    # Exposure does not count.
    assert measured([15.0, 35.0, 50.0, 35.0, 15.0])[0] == pytest.approx(3.5)
    # A faint tail does not lengthen it, a dark middle does not count.
    assert measured([30.0, 70.0, 100.0, 70.0, 30.0, 20.0, 12.0])[0] == pytest.approx(3.5)
    assert measured([100.0, 20.0, 20.0, 100.0])[0] == pytest.approx(2.0 + 2.0 * 0.25 + 2.0 * 0.1)


def test_a_dash_is_as_wide_as_where_it_is_bright() -> None:
    heights, widths = [50.0, 90.0, 100.0, 40.0], [9e-3, 3e-3, 5e-3, 9e-3]
    assert measured(heights, widths)[1] == pytest.approx(4e-3)


def test_gaps_lie_between_dashes() -> None:
    gaps = find_dashes(signal_of("..##...####.")).gaps
    np.testing.assert_allclose(gaps.length, np.array([2, 3, 1]) * STEP)
    np.testing.assert_array_equal(gaps.closed, [[False, True], [True, True], [True, False]])


def test_a_line_that_runs_back_shows_the_same() -> None:
    forth = find_dashes(signal_of("..###......#."))
    back = find_dashes(signal_of(".#......###..", back=True))
    for a, b in (
        (forth.dashes.along, back.dashes.along),
        (forth.gaps.ends, back.gaps.ends),
        (forth.gaps.closed, back.gaps.closed),
        (forth.span, back.span),
    ):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_light_beyond_is_counted_where_it_is_dark() -> None:
    view = find_dashes(signal_of("....##....", beyond="##..####.."))
    np.testing.assert_allclose(view.gaps.beyond, [0.5, 0.5])
    np.testing.assert_allclose(view.beyond, 0.5)


def test_what_is_not_usable_counts_as_hidden() -> None:
    signal = signal_of("..###....###..")
    usable = np.ones(signal.state.shape, np.bool_)
    usable[0, :7] = False
    view = find_dashes(signal, usable)
    assert len(view.dashes) == 1
    assert view.seen_length == pytest.approx(7 * STEP)


def test_nothing_seen_nothing_found() -> None:
    view = find_dashes(signal_of("      ", "......"))
    assert len(view.dashes) == 0
    assert view.seen_length == pytest.approx(6 * STEP)
    assert len(crossings_of(view).place) == 0


def test_crossings_stand_for_all_that_was_seen() -> None:
    view = find_dashes(signal_of("..###....###......#" * 4, " ..##..  ..##.." * 4 + " " * 16))
    crossings = crossings_of(view)
    length = np.hypot(*(crossings.end - crossings.begin).T)
    assert length.sum() == pytest.approx(view.seen_length)
    np.testing.assert_allclose(np.bincount(crossings.span_laser, length), crossings.length)
    assert len(crossings.place) == np.count_nonzero(view.dashes.whole)


def test_a_hole_is_no_place_to_look_for_the_lattice() -> None:
    net, hole = "..##......" * 6, "." * 60
    crossings = crossings_of(find_dashes(signal_of(net + hole + net)))
    assert crossings.length[0] == pytest.approx(120 * STEP, abs=10 * STEP)
    assert len(crossings.begin) == 2
