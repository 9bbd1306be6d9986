"""Lattices from made-up crossings of lines with ideal nets."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.lattice import NetLattice, find_lattice
from aqualvs.nets.spectrum import Crossings, Mesh, Spectrum
from aqualvs.nets.spectrum_kernels import comb_power

LINES = np.deg2rad([-4.0, -97.0, -46.0])
HALF = 0.22


def families(mesh: str, bar: float, roll: float, half_opening: float) -> FloatArray:
    """Wave vectors of the strands; of hexagons the lines that the bars lie on."""
    if mesh == "hexagon":
        angle, pitch = roll + np.pi / 2.0 + np.arange(3) * np.pi / 3.0, bar * np.sqrt(0.75)
    else:
        angle = roll + np.array([-half_opening, half_opening])
        pitch = bar * np.sin(2.0 * half_opening)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) / pitch


def on_bar(place: FloatArray, bar: float, roll: float) -> bool:
    """Whether a place lies on a bar of a honeycomb: nearly as far from two cells' centres."""
    p = bar * np.sqrt(3.0)
    a = p * np.array([-np.sin(roll), np.cos(roll)])
    b = p * np.array([np.cos(roll + np.pi / 6.0), np.sin(roll + np.pi / 6.0)])
    near = np.round(np.linalg.solve(np.stack([a, b], axis=1), place))
    cells = near + np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    distance = np.sort(np.hypot(*(cells @ np.stack([a, b]) - place).T))
    return bool(distance[1] - distance[0] < 1e-6)


def frame(
    rng: np.random.Generator, mesh: str, bar: float, roll: float, half_opening: float, noise: float
) -> Crossings:
    waves = families(mesh, bar, roll, half_opening)
    shift = rng.uniform(0.0, 0.2, 2)
    places, lasers, ends = [], [], []
    for i, angle in enumerate(LINES):
        t = np.array([np.cos(angle), np.sin(angle)])
        origin = rng.uniform(-0.03, 0.03, 2) + 0.1 * np.array([-t[1], t[0]]) * (i - 1)
        for wave in waves:
            rate, start = wave @ t, wave @ (origin + shift)
            turns = np.arange(np.ceil(start - HALF * abs(rate)), start + HALF * abs(rate))
            for s in (turns - start) / rate:
                if mesh != "hexagon" or on_bar(origin + shift + s * t, bar, roll):
                    places.append(origin + (s + rng.normal(0.0, noise)) * t)
                    lasers.append(i)
        ends.append([origin - HALF * t, origin + HALF * t])
    return Crossings(
        place=np.array(places),
        laser=np.array(lasers),
        begin=np.array(ends)[:, 0],
        end=np.array(ends)[:, 1],
        span_laser=np.arange(3),
        direction=np.stack([np.cos(LINES), np.sin(LINES)], axis=1),
        length=np.full(3, 2.0 * HALF),
        lit=0.15,
    )


def found_in(seed: int, *net: object, n_frames: int = 12, noise: float = 5e-4) -> NetLattice:
    rng = np.random.default_rng(seed)
    lattice = find_lattice([frame(rng, *net, noise) for _ in range(n_frames)])
    assert lattice is not None
    return lattice


@pytest.mark.parametrize(
    ("mesh", "bar", "roll_deg", "half_opening_deg"),
    [
        ("square", 0.025, 3.0, 45.0),
        ("square", 0.040, 33.0, 45.0),
        ("diamond", 0.018, 80.0, 33.0),
        # Its waves lie as a honeycomb's do.
        ("diamond", 0.026, 50.0, 30.0),
        ("hexagon", 0.022, 17.0, 0.0),
    ],
)
def test_the_bar_and_the_directions_are_found(
    mesh: str, bar: float, roll_deg: float, half_opening_deg: float
) -> None:
    roll, half = np.deg2rad(roll_deg), np.deg2rad(half_opening_deg)
    lattice = found_in(1, mesh, bar, roll, half)
    assert lattice.mesh is (Mesh.SIX_SIDED if mesh == "hexagon" else Mesh.FOUR_SIDED)
    # Half a millimetre of scatter over 0.44 m of line and 12 frames.
    assert lattice.bar == pytest.approx(bar, rel=0.005)
    assert abs(lattice.bar - bar) < 4.0 * lattice.sigma_bar
    expected = np.mod(np.arctan2(*families(mesh, bar, roll, half).T[::-1]), np.pi)
    seen = np.mod(np.arctan2(*lattice.waves.T[::-1]), np.pi)
    apart = np.abs((seen[:, None] - expected + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
    assert np.max(apart.min(axis=1)) < np.deg2rad(0.5)


def test_the_pitch_follows_from_the_lattice() -> None:
    lattice = found_in(2, "square", 0.03, 0.2, np.pi / 4.0)
    np.testing.assert_allclose(lattice.pitch, 0.03, rtol=0.01)


def test_crossings_at_random_have_no_lattice() -> None:
    rng = np.random.default_rng(3)
    frames = []
    for _ in range(12):
        one = frame(rng, "square", 0.025, 0.1, np.pi / 4.0, 0.0)
        t = one.direction[one.laser]
        moved = one.place + rng.uniform(-0.05, 0.05, len(one.place))[:, None] * t
        frames.append(replace(one, place=moved))
    assert find_lattice(frames) is None


def test_a_lattice_known_before_is_found_again_though_turned() -> None:
    before = found_in(4, "square", 0.03, 0.2, np.pi / 4.0)
    rng = np.random.default_rng(5)
    turned = [frame(rng, "square", 0.03, 0.25, np.pi / 4.0, 5e-4) for _ in range(6)]
    lattice = find_lattice(turned, before)
    assert lattice is not None
    assert lattice.bar == pytest.approx(0.03, rel=0.01)
    expected = np.mod(np.arctan2(*families("square", 0.03, 0.25, np.pi / 4.0).T[::-1]), np.pi)
    seen = np.mod(np.arctan2(*lattice.waves.T[::-1]), np.pi)
    assert np.sort(seen) == pytest.approx(np.sort(expected), abs=np.deg2rad(0.5))


def test_too_little_gives_nothing() -> None:
    assert find_lattice([]) is None


def power_at(spectrum: Spectrum, wave: FloatArray, n_harmonics: int = 1) -> FloatArray:
    return comb_power(spectrum.crossings, wave[0], wave[1], n_harmonics)


def test_power_is_that_of_a_sum_over_places() -> None:
    rng = np.random.default_rng(7)
    frames = [frame(rng, "square", 0.03, 0.3, np.pi / 4.0, 1e-3) for _ in range(3)]
    wave = np.array([21.0, -13.0])
    expected = 0.0
    for one in frames:
        swing = np.sum(np.exp(2j * np.pi * one.place @ wave))
        for i in range(3):
            # Evenly spread crossings, as many as the laser has seen.
            share = (np.arange(5000)[:, None] + 0.5) / 5000
            even = one.begin[i] + share * (one.end[i] - one.begin[i])
            swing -= np.sum(one.laser == i) * np.mean(np.exp(2j * np.pi * even @ wave))
        expected += abs(swing) ** 2
    n = sum(len(one.place) for one in frames)
    assert power_at(Spectrum.of(frames), wave)[0] == pytest.approx(expected / n, rel=1e-3)


def test_power_of_a_rest_is_that_of_its_pieces_one_by_one() -> None:
    rng = np.random.default_rng(9)
    frames = [frame(rng, "square", 0.02, 0.3, np.pi / 4.0, 1e-3) for _ in range(3)]
    one, other = families("square", 0.02, 0.3, np.pi / 4.0)
    rest = Spectrum.of(frames).without(one)
    seen = rest.crossings
    assert len(seen.begin) > 60
    power = np.zeros(3)
    for h in range(3):
        wave = (h + 1) * other
        for k in range(3):
            swing = np.sum(
                np.exp(2j * np.pi * seen.place[seen.start[k] : seen.start[k + 1]] @ wave)
            )
            mine = slice(seen.span_start[k], seen.span_start[k + 1])
            turns = (seen.end[mine] - seen.begin[mine]) @ wave
            middle = 0.5 * (seen.begin[mine] + seen.end[mine]) @ wave
            swing -= np.sum(seen.expected[mine] * np.sinc(turns) * np.exp(2j * np.pi * middle))
            power[h] += abs(swing) ** 2
    np.testing.assert_allclose(power_at(rest, other, 3), power / rest.n_crossings, rtol=1e-9)


def test_without_a_family_its_crossings_are_gone() -> None:
    rng = np.random.default_rng(8)
    frames = [frame(rng, "square", 0.03, 0.2, np.pi / 4.0, 2e-4) for _ in range(6)]
    one, other = families("square", 0.03, 0.2, np.pi / 4.0)
    spectrum = Spectrum.of(frames)
    rest = spectrum.without(one)
    assert power_at(rest, one)[0] < 0.1 * power_at(spectrum, one)[0]
    assert power_at(rest, other)[0] > 0.8 * power_at(spectrum, other)[0]
    # One family has about half of the crossings; of the other a quarter lies on the crests as well.
    assert 0.25 < rest.n_crossings / spectrum.n_crossings < 0.5
