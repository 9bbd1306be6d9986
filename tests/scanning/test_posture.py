"""Posture: signs, uncertainty, and every reason to refuse that a fit can give."""

import numpy as np
import pytest

from agreement_cases import posture_from_fit
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.plane_fit import PlaneFit
from aqualvs.scanning.posture import Posture, Reason, Refusal, range_pitch_yaw, validate
from aqualvs.simulation.scenario import dome_from_target

POINTS = np.array([[0.0, 0.55, 0.0], [0.1, 0.5, -0.1], [-0.2, 0.5, 0.1]])
SURE = np.diag([1e-4, 1e-4, 1e-4])
AXIS = np.array([0.0, 1.0, 0.0])


def m_of(distance: float, pitch_deg: float, yaw_deg: float) -> FloatArray:
    """Normal over distance, from the definition in docs/conventions.md."""
    normal = np.array([np.tan(np.deg2rad(yaw_deg)), 1.0, np.tan(np.deg2rad(pitch_deg))])
    m: FloatArray = normal / np.linalg.norm(normal) / distance
    return m


def answer(
    m: FloatArray,
    covariance: FloatArray = SURE,
    rms: float = 1e-3,
    axis: FloatArray = AXIS,
    working_range: tuple[float, float] = (0.3, 1.0),
) -> Posture | Refusal:
    fit = PlaneFit(m, covariance, np.ones(3), rms)
    return validate(posture_from_fit(fit, POINTS, axis), working_range)


@pytest.mark.parametrize(("pitch", "yaw"), [(0.0, 0.0), (12.0, -25.0), (-30.0, 7.0), (1e-6, 40.0)])
def test_definition_both_ways(pitch: float, yaw: float) -> None:
    found = range_pitch_yaw(m_of(0.62, pitch, yaw))
    np.testing.assert_allclose(found, [0.62, np.deg2rad(pitch), np.deg2rad(yaw)], atol=1e-14)
    # The paper's own form, Eq. 25 and 26.
    n = m_of(0.62, pitch, yaw) * 0.62
    assert found[1] == pytest.approx(np.pi / 2 - np.arccos(n[2] / np.hypot(n[1], n[2])), abs=1e-12)
    assert found[2] == pytest.approx(np.pi / 2 - np.arccos(n[0] / np.hypot(n[0], n[1])), abs=1e-12)


def test_signs() -> None:
    # A target whose top is nearer has a far normal that points up, one whose right side is nearer
    # one that points to the right.
    top_nearer = np.array([[0.0, 0.5, -0.1], [0.1, 0.5, -0.1], [0.0, 0.4, 0.1]])
    m = np.linalg.solve(top_nearer, np.ones(3))
    assert m[2] > 0.0
    assert range_pitch_yaw(m)[1] == pytest.approx(np.arctan(0.5), abs=1e-12)
    right_side_nearer = np.array([[-0.1, 0.5, 0.0], [-0.1, 0.5, 0.1], [0.1, 0.4, 0.0]])
    m = np.linalg.solve(right_side_nearer, np.ones(3))
    assert m[0] > 0.0
    assert range_pitch_yaw(m)[2] == pytest.approx(np.arctan(0.5), abs=1e-12)


@pytest.mark.parametrize(("pitch", "yaw"), [(0.2, -0.3), (-0.1, 0.4)])
def test_signs_are_the_simulators(pitch: float, yaw: float) -> None:
    pose = dome_from_target(0.7, pitch, yaw)
    corners = pose.apply(np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.0, 0.2]]))
    found = range_pitch_yaw(np.linalg.solve(corners, np.ones(3)))
    np.testing.assert_allclose(found, [0.7, pitch, yaw], atol=1e-12)


@pytest.mark.parametrize(("pitch", "yaw"), [(0.0, 0.0), (25.0, -10.0), (-8.0, 35.0)])
def test_covariance_is_carried_over_by_the_true_derivatives(pitch: float, yaw: float) -> None:
    m = m_of(0.6, pitch, yaw)
    step = 1e-6
    jacobian = np.stack(
        [
            (np.array(range_pitch_yaw(m + e)) - np.array(range_pitch_yaw(m - e))) / (2 * step)
            for e in step * np.eye(3)
        ],
        axis=-1,
    )
    root = np.random.default_rng(1).normal(size=(3, 3)) * 1e-2
    covariance = root @ root.T
    found = answer(m, covariance)
    assert found
    expected = jacobian @ covariance @ jacobian.T
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-7, atol=1e-14)


def test_what_a_posture_tells() -> None:
    m = m_of(0.5, 10.0, -20.0)
    axis = np.array([0.1, 0.97, -0.2]) / np.linalg.norm([0.1, 0.97, -0.2])
    found = answer(m, axis=axis)
    assert found
    assert bool(found) is True
    np.testing.assert_allclose(np.linalg.norm(found.normal_in_dome), 1.0, atol=1e-14)
    # Along the camera's axis from the dome's centre one meets the plane.
    assert m @ (found.slant_range * axis) == pytest.approx(1.0, abs=1e-12)
    assert found.slant_range > found.range
    assert found.nearest == pytest.approx(np.linalg.norm(POINTS, axis=1).min(), abs=1e-15)
    assert found.n_points == 3
    assert found.rms == 1e-3


def test_a_camera_that_looks_away_never_meets_the_plane() -> None:
    found = answer(m_of(0.5, 0.0, 0.0), axis=np.array([0.0, -1.0, 0.0]))
    assert found
    assert found.slant_range == np.inf


@pytest.mark.parametrize("distance", [0.2, 0.29, 1.02, 3.0])
def test_beyond_the_working_range(distance: float) -> None:
    found = answer(m_of(distance, 0.0, 0.0))
    assert not found
    assert found.reason is Reason.OUT_OF_RANGE
    assert f"{distance:.3f} m" in found.detail


@pytest.mark.parametrize("distance", [0.299, 0.3, 0.65, 1.0, 1.005])
def test_noise_at_the_edge_of_the_working_range_is_let_pass(distance: float) -> None:
    assert answer(m_of(distance, 0.0, 0.0))


def test_points_off_the_plane() -> None:
    assert answer(m_of(0.5, 0.0, 0.0), rms=0.009)
    found = answer(m_of(0.5, 0.0, 0.0), rms=0.011)
    assert not found
    assert found.reason is Reason.NOT_A_PLANE
    assert "11.0 mm" in found.detail


@pytest.mark.parametrize("which", [0, 1, 2])
def test_a_plane_that_may_turn_or_shift(which: int) -> None:
    # For a square plane at 0.5 m: sigma of range is d² times that of m_y, of an angle d times
    # that of m_x or m_z. Allowed are 5 % and 5 degrees.
    limit = {0: np.deg2rad(5.0) / 0.5, 1: 0.05 * 0.5 / 0.25, 2: np.deg2rad(5.0) / 0.5}[which]
    for share, reason in ((0.95, None), (1.05, Reason.COLLINEAR)):
        covariance = 1e-8 * np.eye(3)
        covariance[which, which] = (share * limit) ** 2
        found = answer(m_of(0.5, 0.0, 0.0), covariance)
        assert (None if found else found.reason) is reason


@pytest.mark.parametrize("bad", [np.inf, np.nan])
def test_an_unknown_uncertainty_is_refused(bad: float) -> None:
    with np.errstate(invalid="ignore"):
        found = answer(m_of(0.5, 0.0, 0.0), np.full((3, 3), bad))
    assert not found
    assert found.reason is Reason.COLLINEAR


def test_a_refusal_is_false_and_names_its_reason() -> None:
    refusal = Refusal(Reason.CORRUPT_FRAME)
    assert bool(refusal) is False
    assert refusal.reason.value == "corrupt_frame"
