"""Two rigs compared number by number: the change itself, and how many sigmas it is."""

from dataclasses import replace

import numpy as np
import pytest

from aqualvs.check.comparison import rig_difference
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig, RigUncertainty, rig_moved_by, rig_parameter_names
from aqualvs.simulation.scenarios import example_rig, flat_port_rig

NONE = RigUncertainty.none()
RIG = example_rig()
NAMES = rig_parameter_names(RIG)


def known(seed: int, size: float = 1e-4) -> RigUncertainty:
    root = np.random.default_rng(seed).normal(size=(len(NAMES), 2 * len(NAMES)))
    return RigUncertainty(NAMES, size**2 * root @ root.T / (2 * len(NAMES)))


def drawn(uncertainty: RigUncertainty, rng: np.random.Generator) -> Rig:
    root: FloatArray = np.linalg.cholesky(uncertainty.covariance)
    return rig_moved_by(RIG, uncertainty.names, root @ rng.normal(size=len(root)))


def test_the_change_is_the_step_that_was_made() -> None:
    step = np.linspace(-1.0, 1.0, len(NAMES)) * 1e-3
    found = rig_difference(rig_moved_by(RIG, NAMES, step), RIG, NONE, NONE)
    order = [found.names.index(name) for name in NAMES]
    # Differences of focal lengths near 900 px keep 1e-13.
    np.testing.assert_allclose(found.change[order], step, rtol=1e-9, atol=3e-13)
    np.testing.assert_array_equal(found.covariance, 0.0)
    assert found.sigmas(NAMES) is None
    assert found.has_moved(NAMES) is None


def test_the_change_of_a_flat_port_is_the_step_that_was_made() -> None:
    rig = flat_port_rig()
    names = rig_parameter_names(rig)
    step = np.linspace(-1.0, 1.0, len(names)) * 1e-3
    found = rig_difference(rig_moved_by(rig, names, step), rig, NONE, NONE)
    order = [found.names.index(name) for name in names]
    np.testing.assert_allclose(found.change[order], step, rtol=1e-9, atol=3e-13)


def test_the_same_rig_has_not_changed() -> None:
    found = rig_difference(RIG, RIG, known(0), known(0))
    assert found.sigmas(NAMES) == 0.0
    assert not found.has_moved(NAMES)


def test_a_plane_written_the_other_way_round_is_the_same() -> None:
    flipped = tuple(
        replace(laser, plane=Plane(-laser.plane.normal, -laser.plane.offset))
        for laser in RIG.lasers
    )
    found = rig_difference(replace(RIG, lasers=flipped), RIG, NONE, NONE)
    np.testing.assert_array_equal(found.change, 0.0)


@pytest.mark.parametrize(
    "group", [("lens_x", "lens_y", "lens_z"), ("left:tilt_1", "left:tilt_2", "left:offset"), NAMES]
)
def test_sigmas_of_two_good_calibrations_are_those_of_chance(group: tuple[str, ...]) -> None:
    """Squared, they follow chi square: its mean is the number of numbers."""
    one, other = known(1), known(2, 2e-4)
    rng = np.random.default_rng(3)
    squares = []
    for _ in range(150):
        found = rig_difference(drawn(one, rng), drawn(other, rng), one, other)
        distance = found.sigmas(group)
        assert distance is not None
        squares.append(distance**2)
        assert not found.has_moved(group)
    # The mean of 150 values of variance 2 k is known to 0.12 sqrt(k); four times that.
    assert np.mean(squares) == pytest.approx(len(group), abs=0.47 * np.sqrt(len(group)))


def test_a_laser_that_has_turned_is_found_by_its_sigmas() -> None:
    one = known(1, 1e-5)
    rng = np.random.default_rng(3)
    turned = rig_moved_by(drawn(one, rng), ("left:tilt_2",), np.array([5e-4]))
    found = rig_difference(turned, drawn(one, rng), one, one)
    left = ("left:tilt_1", "left:tilt_2", "left:offset")
    assert found.has_moved(left)
    assert not found.has_moved(tuple(name.replace("left", "right") for name in left))
    # 5e-4 against sqrt(2) times 1e-5, in the direction that shows it best.
    assert found.of("left:tilt_2") / found.sigma("left:tilt_2") == pytest.approx(35.0, rel=0.3)


def test_errors_of_common_numbers_take_no_part() -> None:
    """Lasers calibrated twice on one dome: the dome's error moves both planes alike."""
    names = ("lens_y", "left:offset")
    common, own = 1e-3, 1e-5
    covariance = np.array([[common**2, common**2], [common**2, common**2 + own**2]])
    both = RigUncertainty(names, covariance)
    moved = rig_moved_by(RIG, ("left:offset",), np.array([1e-4]))
    found = rig_difference(moved, RIG, both, both)
    # What is left after subtracting 1e-6 from 1e-6 + 1e-10.
    assert found.sigma("left:offset") == pytest.approx(np.sqrt(2.0) * own, rel=1e-4)
    assert found.sigmas(("left:offset",)) == pytest.approx(10.0 / np.sqrt(2.0), rel=1e-4)


def test_sigmas_turn_with_the_basis_of_the_new_plane() -> None:
    """The tangent basis jumps where another component of the normal becomes the smallest."""
    old = replace(RIG.lasers[0], plane=Plane.from_normal([0.301, 0.3, 0.9], 0.1))
    new = replace(RIG.lasers[0], plane=Plane.from_normal([0.3, 0.301, 0.9], 0.1))
    sigmas = {"lower:tilt_1": 1e-3, "lower:tilt_2": 1e-6, "lower:offset": 1e-6}
    found = rig_difference(
        replace(RIG, lasers=(new,)),
        replace(RIG, lasers=(old,)),
        RigUncertainty.independent(sigmas),
        NONE,
    )
    # Both bases are right-angled crosses of the normal with x and with y, so neither axis stays.
    assert 1e-5 < found.sigma("lower:tilt_1") < 0.999e-3
    assert 1e-5 < found.sigma("lower:tilt_2") < 0.999e-3
    total = np.hypot(found.sigma("lower:tilt_1"), found.sigma("lower:tilt_2"))
    assert total == pytest.approx(1e-3, rel=1e-2)


def test_what_the_rigs_do_not_share_is_left_out() -> None:
    other = replace(RIG, housing=None, size_px=(640, 480), lasers=RIG.lasers[1:])
    found = rig_difference(other, RIG, NONE, NONE)
    assert "fx" not in found.names
    assert "inner_radius" not in found.names
    assert "lower:offset" not in found.names
    assert found.of("fx") == found.sigma("fx") == 0.0
    assert found.sigmas(("left:offset",)) == 0.0
