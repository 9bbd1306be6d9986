"""Laying a lattice onto frames, and the way along the net that follows."""

import numpy as np
import pytest

from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.dashes import Dashes
from aqualvs.nets.lattice import LatticeFitter, NetLattice, NetTrack
from aqualvs.nets.spectrum import Crossings, Mesh

LINES = np.deg2rad([-4.0, -97.0, -46.0])
HALF, FPS = 0.2, 25.0


def lattice(mesh: Mesh = Mesh.FOUR_SIDED, bar: float = 0.025, roll: float = 0.3) -> NetLattice:
    if mesh is Mesh.FOUR_SIDED:
        angle, pitch = roll + np.array([0.0, np.pi / 2.0]), bar
    else:
        # a + b, 2b - a and 2a - b of waves a and b that are 60 degrees apart.
        angle = roll + np.deg2rad([30.0, 90.0, -30.0])
        pitch = bar * np.sqrt(0.75)
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=1) / pitch
    return NetLattice(mesh, bar, 1e-4, waves, 5.0)


def on_strand(net: NetLattice, place: FloatArray) -> bool:
    """Whether a place, seen from a knot or the middle of an opening, lies on a strand."""
    turns = net.waves @ place
    off = np.abs(turns - np.rint(turns)) * net.pitch
    if net.mesh is Mesh.FOUR_SIDED:
        return bool(off.min() < 1e-6)
    # Of hexagons' lines a third is there: where two middles are equally near, and no third.
    cell = np.linalg.inv(net.basis).T
    near = np.rint(net.basis @ place)
    around = near + np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    distance = np.sort(np.hypot(*(around @ cell - place).T))
    return bool(distance[1] - distance[0] < 1e-6)


def crossings(net: NetLattice, foot: FloatArray, rng: np.random.Generator) -> Crossings:
    """What a vehicle sees whose foot is at a place on the net, with half a millimetre of noise."""
    t = np.stack([np.cos(LINES), np.sin(LINES)], axis=1)
    origin = 0.05 * np.stack([-t[:, 1], t[:, 0]], axis=1) * [[1.0], [0.0], [-1.0]]
    places, lasers = [], []
    for i in range(3):
        for wave in net.waves:
            rate, start = wave @ t[i], wave @ (origin[i] + foot)
            if abs(rate) < 1e-6:
                continue
            turns = np.arange(np.ceil(start - HALF * abs(rate)), start + HALF * abs(rate))
            for s in (turns - start) / rate:
                if on_strand(net, origin[i] + foot + s * t[i]):
                    places.append(origin[i] + (s + rng.normal(0.0, 5e-4)) * t[i])
                    lasers.append(i)
    return Crossings(
        place=np.array(places),
        laser=np.array(lasers),
        begin=origin - HALF * t,
        end=origin + HALF * t,
        span_laser=np.arange(3),
        direction=t,
        length=np.full(3, 2.0 * HALF),
        lit=0.1,
    )


@pytest.mark.parametrize("mesh", list(Mesh))
def test_the_way_along_the_net_is_kept(mesh: Mesh) -> None:
    net, rng = lattice(mesh), np.random.default_rng(1)
    fitter, track = LatticeFitter(net), NetTrack()
    velocity = np.array([0.15, -0.08])
    for i in range(60):
        assert track.step(fitter, crossings(net, velocity * i / FPS, rng), i / FPS) is not None
    # 0.4 m, that is 16 meshes, and none of them counted wrongly.
    np.testing.assert_allclose(track.place, velocity * 59 / FPS, atol=1e-3)
    np.testing.assert_allclose(track.velocity, velocity, atol=0.02)
    assert track.piece == 0


def test_a_fast_vehicle_is_followed_if_it_says_how_fast() -> None:
    net, rng = lattice(bar=0.02), np.random.default_rng(2)
    velocity = np.array([0.4, 0.1])
    ends = []
    for told in (None, velocity + np.array([0.02, -0.02])):
        fitter, track = LatticeFitter(net), NetTrack()
        for i in range(25):
            track.step(fitter, crossings(net, velocity * i / FPS, rng), i / FPS, told)
        ends.append(track.place - velocity * 24 / FPS)
    # 16 mm a frame are nearer to a mesh back than to where it went.
    assert np.hypot(*ends[0]) > 0.1
    assert np.hypot(*ends[1]) < 2e-3


@pytest.mark.parametrize("mesh", list(Mesh))
@pytest.mark.parametrize("heading", [0.2, 2.0, 4.5])
def test_a_dive_that_begins_at_full_speed_is_followed(mesh: Mesh, heading: float) -> None:
    net, rng = lattice(mesh), np.random.default_rng(7)
    # 0.4 bars a frame; and the posture of the first frame is askew.
    velocity = 0.4 * net.bar * FPS * np.array([np.cos(heading), np.sin(heading)])
    askew = 0.25 * net.bar * np.array([np.sin(heading), -np.cos(heading)])
    seen = [crossings(net, velocity * i / FPS + askew * (i == 0), rng) for i in range(40)]
    times = np.arange(40) / FPS
    fitter, track = LatticeFitter(net), NetTrack()
    assert track.begins(0.0)
    start = fitter.start(seen[:8], times[:8])
    assert start is not None
    np.testing.assert_allclose(start.velocity, velocity, atol=0.02)
    for i in range(40):
        track.step(fitter, seen[i], times[i], start=start)
    assert not track.begins(times[-1])
    off = track.place - velocity * times[-1]
    # Of the first frame's posture nothing is left but what the place began with.
    assert np.hypot(*off) < 0.3 * net.bar


def test_the_slowest_of_the_velocities_that_look_alike_is_taken() -> None:
    net, rng = lattice(bar=0.015), np.random.default_rng(8)
    seen = [crossings(net, np.zeros(2), rng) for _ in range(8)]
    # A whole mesh a frame would be 0.375 m/s.
    start = LatticeFitter(net).start(seen, np.arange(8) / FPS)
    assert start is not None
    assert np.hypot(*start.velocity) < 0.02


def test_too_few_frames_tell_no_velocity() -> None:
    net, rng = lattice(), np.random.default_rng(9)
    seen = [crossings(net, np.zeros(2), rng) for _ in range(3)]
    assert LatticeFitter(net).start(seen, np.arange(3) / FPS) is None


def test_a_net_measured_anew_goes_on_where_it_was() -> None:
    rng = np.random.default_rng(3)
    net = lattice()
    anew = NetLattice(net.mesh, net.bar, 1e-4, -net.waves[::-1], 4.0)
    track, velocity = NetTrack(), np.array([0.1, 0.1])
    for i in range(40):
        fitter = LatticeFitter(net if i < 20 else anew)
        track.step(fitter, crossings(net, velocity * i / FPS, rng), i / FPS)
    np.testing.assert_allclose(track.place, velocity * 39 / FPS, atol=2e-3)
    assert track.piece == 0


def test_a_long_gap_begins_a_new_piece_a_short_one_does_not() -> None:
    net, rng = lattice(), np.random.default_rng(4)
    fitter, track = LatticeFitter(net), NetTrack()
    velocity = np.array([0.1, 0.0])
    for i in [*range(30), *range(36, 60)]:
        track.step(fitter, crossings(net, velocity * i / FPS, rng), i / FPS)
    assert track.piece == 0
    np.testing.assert_allclose(track.place, velocity * 59 / FPS, atol=2e-3)
    track.step(fitter, crossings(net, velocity * 4.0, rng), 4.0)
    assert track.piece == 1


def test_crossings_at_random_show_no_lattice() -> None:
    net, rng = lattice(), np.random.default_rng(5)
    fitter = LatticeFitter(net)
    found = 0
    for _ in range(20):
        seen = crossings(net, np.zeros(2), rng)
        along = rng.uniform(-HALF, HALF, len(seen.place))
        middle = 0.5 * (seen.begin + seen.end)[seen.laser]
        shift = fitter.shift(
            Crossings(
                middle + along[:, None] * seen.direction[seen.laser],
                seen.laser,
                seen.begin,
                seen.end,
                seen.span_laser,
                seen.direction,
                seen.length,
                seen.lit,
            )
        )
        found += shift is not None
    assert fitter.shift(crossings(net, np.zeros(2), rng)) is not None
    assert found == 0


def test_dashes_are_given_to_the_nearest_strand() -> None:
    net = lattice(roll=0.0)
    place = np.array([[0.051, 0.012], [0.013, -0.0755], [0.0, 0.0125]])
    nothing = np.zeros(3)
    dashes = Dashes(
        nothing.astype(int), nothing, place, nothing, nothing, nothing, np.ones(3, np.bool_)
    )
    fit = LatticeFitter(net).assign(dashes, np.zeros(2))
    np.testing.assert_array_equal(fit.family, [0, 1, 0])
    np.testing.assert_array_equal(fit.strand, [2, -3, 0])
    np.testing.assert_allclose(fit.off, [1e-3, 5e-4, 0.0], atol=1e-12)
    np.testing.assert_allclose(fit.clear, [0.012, 0.012, 0.0125], atol=1e-12)
    assert fit.n_strands == 3
