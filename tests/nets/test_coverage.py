"""Kinds of dashes and solidity, from made-up dashes."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.nets.coverage import RegisteredView, Twine, dash_kinds, measure_solidity, sound_length
from aqualvs.nets.dashes import NetView, find_dashes
from aqualvs.nets.lattice import LatticeFitter, NetLattice
from aqualvs.nets.lit_intervals import NetSignal
from aqualvs.nets.spectrum import Mesh

BAR, STEP, HALF, HEIGHT, PIXEL = 0.05, 5e-4, 0.4, 100.0, 6e-4
NET = NetLattice(Mesh.FOUR_SIDED, BAR, 1e-4, np.eye(2) / BAR, 5.0)
TURN = np.deg2rad(40.0)
# Body 2.4 mm, halo 0.6 mm and a share of a step of the search lines.
TWINE = Twine(2.5e-3, 2e-4, 2.4e-3, 3e-3, 0.6e-3, 2e-4)


def view_of(
    shift: float, grown: float = 0.0, turn: float = TURN, height: float = HEIGHT
) -> NetView:
    """What two lasers, turned from level and upright, show of a square net.

    Dashes are as long as the twine says, and a share `grown` of them 4 mm longer.
    """
    direction = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    search = np.array([[0.0, 1.0], [1.0, 0.0]])
    along = np.arange(-HALF, HALF, STEP)
    state = np.ones((2, len(along)), np.uint8)
    n = 0
    for i, t in enumerate(direction):
        square = abs(search[i] @ [-t[1], t[0]])
        for k in range(2):
            across = abs(t[k])
            slant = abs(search[i, k]) / (across * square)
            usual = TWINE.dash_length(*(np.array(v) for v in (across, slant, STEP, HEIGHT)))
            for s in (np.arange(-15, 16) - shift) * BAR / t[k]:
                n += 2
                length = float(usual) + (4e-3 if n % 5 < 5.0 * grown else 0.0)
                state[i, np.abs(along - s) < 0.5 * length] = 2
    signal = NetSignal(
        index=0,
        time_s=0.0,
        range=0.5,
        origin=np.zeros((2, 2)),
        direction=direction,
        search=search,
        pixel=PIXEL,
        along=np.tile(along, (2, 1)),
        step=np.full(state.shape, STEP),
        state=state,
        height=np.where(state == 2, height, 0.0),
        width=np.where(state == 2, 4e-3, 0.0),
        beyond=np.zeros(state.shape, np.bool_),
    )
    return find_dashes(signal)


def laid(grown: float = 0.0, turn: float = TURN, height: float = HEIGHT) -> list[RegisteredView]:
    fitter, found = LatticeFitter(NET), []
    for shift in np.linspace(0.0, 0.9, 10):
        view = view_of(shift, grown, turn, height)
        fit = fitter.assign(view.dashes, np.full(2, -shift * BAR))
        found.append(RegisteredView(view, fit, np.full(2, shift * BAR)))
    return found


def test_dashes_are_sorted_by_laser_and_family() -> None:
    kinds = {(kind.laser, kind.family): kind for kind in dash_kinds(NET, laid())}
    assert set(kinds) == {(0, 0), (0, 1), (1, 0), (1, 1)}
    level, slanted = kinds[0, 0], kinds[0, 1]
    assert level.across == pytest.approx(np.cos(TURN))
    assert level.slant == pytest.approx(0.0, abs=1e-9)
    assert slanted.across == pytest.approx(np.sin(TURN))
    assert slanted.slant == pytest.approx(1.0 / (np.sin(TURN) * np.cos(TURN)))
    for kind in (level, slanted):
        usual = TWINE.dash_length(*(np.array(v) for v in (kind.across, kind.slant, STEP, HEIGHT)))
        assert kind.length == pytest.approx(float(usual), abs=STEP)
        # Pixels are as large as search lines are apart; width square to the line: that leans.
        assert kind.pixel == pytest.approx(STEP * np.cos(TURN))
        assert kind.width == pytest.approx(4e-3 * np.cos(TURN) * kind.pixel / PIXEL)
        assert kind.step == pytest.approx(STEP)


def test_strands_nearly_along_the_line_make_no_kind() -> None:
    kinds = {(kind.laser, kind.family) for kind in dash_kinds(NET, laid(turn=np.deg2rad(20.0)))}
    assert kinds == {(0, 0), (1, 1)}


def test_growth_is_not_taken_for_twine() -> None:
    bare = {(kind.laser, kind.family): kind for kind in dash_kinds(NET, laid())}
    kinds = {(k.laser, k.family): k for k in dash_kinds(NET, laid(grown=0.4))}
    assert kinds[0, 0].spread > 0.3 > bare[0, 0].spread
    assert kinds[0, 0].length == pytest.approx(bare[0, 0].length, rel=0.1)


def test_noise_is_not_taken_for_growth() -> None:
    bright = {(k.laser, k.family): k for k in dash_kinds(NET, laid(grown=0.4))}
    # So faint that noise alone explains how dashes differ: the usual ones count, which are long.
    faint = {(k.laser, k.family): k for k in dash_kinds(NET, laid(grown=0.4, height=7.0))}
    assert faint[0, 0].spread == pytest.approx(bright[0, 0].spread)
    assert faint[0, 0].length > bright[0, 0].length + 2e-3


def test_solidity_is_that_of_the_bodies() -> None:
    found = measure_solidity(NET, TWINE, laid())
    assert found is not None
    solidity, sigma = found
    share = 2.4e-3 / BAR
    assert solidity == pytest.approx(2.0 * share - share**2, abs=0.01)
    # The halo's 0.2 mm on 20 dashes a metre of either family, and what slant adds.
    assert 0.005 < sigma < 0.025


def test_openings_of_few_pixels_are_told_less_well() -> None:
    near = laid()
    far = [replace(one, view=replace(one.view, pixel=10.0 * one.view.pixel)) for one in near]
    found = [measure_solidity(NET, TWINE, frames) for frames in (near, far)]
    assert found[0] is not None
    assert found[1] is not None
    assert found[1][0] == found[0][0]
    assert found[1][1] > 1.3 * found[0][1]


def test_growth_is_solid() -> None:
    bare, grown = measure_solidity(NET, TWINE, laid()), measure_solidity(NET, TWINE, laid(0.4))
    assert bare is not None
    assert grown is not None
    # On the lines 0.4 of 20 (cos + sin) dashes a metre are 4 mm longer; some run together.
    more = 0.4 * 4e-3 * (np.cos(TURN) + np.sin(TURN)) / BAR
    assert 0.7 * more < grown[0] - bare[0] < 1.05 * more
    # A quarter of what growth adds is open.
    assert grown[1] > np.hypot(bare[1], 0.2 * more)


def test_holes_are_no_part_of_the_sound_net() -> None:
    view = view_of(0.0)
    signal_length = sound_length(NET, view)
    np.testing.assert_allclose(signal_length, 2.0 * HALF, rtol=0.01)
    # Without strands everything is one long gap.
    empty = find_dashes(
        NetSignal(
            0,
            0.0,
            0.5,
            view.origin,
            view.direction,
            view.search,
            view.pixel,
            np.tile(np.arange(-HALF, HALF, STEP), (2, 1)),
            np.full((2, 1600), STEP),
            np.ones((2, 1600), np.uint8),
            np.zeros((2, 1600)),
            np.zeros((2, 1600)),
            np.zeros((2, 1600), np.bool_),
        )
    )
    np.testing.assert_allclose(sound_length(NET, empty), 0.0, atol=1e-12)
