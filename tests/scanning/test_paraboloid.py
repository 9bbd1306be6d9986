"""Patches: curved nets from exact and noisy observations."""

import numpy as np
import pytest

from aqualvs.geometry.planes import Plane
from aqualvs.scanning.observations import Observations
from aqualvs.scanning.paraboloid import fit_patch, shows_curvature
from aqualvs.scanning.patch import (
    COEFFICIENTS,
    OFFSET,
    RIGHT,
    UP,
    heights_over,
    nearest_tangent,
    packed_plane,
    tangent_covariance,
)
from aqualvs.scanning.plane_fit import SharedError

BASE = Plane.from_normal([0.1, 1.0, -0.05], 0.6)
_PX = 1.0e-3


def observed(patch: np.ndarray, noise_px: float = 0.1, n: int = 40, wrong: int = 0) -> Observations:
    """Strands along three lines on a patch, as three lasers see them, and wrong readings."""
    rng = np.random.default_rng(5)
    s = np.linspace(-0.22, 0.22, n)
    uv = np.concatenate(
        [
            np.stack([s, np.full(n, -0.10)], axis=-1),
            np.stack([np.full(n, -0.08), s], axis=-1),
            np.stack([s, 0.05 - 0.7 * s], axis=-1),
        ]
    )
    laser = np.repeat([0, 1, 2], n)
    line = np.tile(np.linspace(0.0, 700.0, n), 3)
    u, v = uv.T
    a, b, c, p, q, r = patch[COEFFICIENTS:]
    h = a + b * u + c * v + 0.5 * (p * u * u + r * v * v) + q * u * v
    h += rng.normal(0.0, noise_px * _PX, len(h))
    h[rng.permutation(len(h))[:wrong]] += rng.uniform(0.02, 0.06, wrong)
    normal = patch[:OFFSET]
    points = (patch[OFFSET] + h)[:, None] * normal + u[:, None] * patch[RIGHT:UP]
    points += v[:, None] * patch[UP:COEFFICIENTS]
    m = len(points)
    return Observations(
        points=points,
        sensitivity=np.tile(_PX * normal, (m, 1)),
        sigma_px=np.full(m, 0.1),
        glow=np.zeros(m),
        width=np.full(m, 5.0),
        height=np.full(m, 80.0),
        line=line,
        laser=laser,
    )


def shared(seen: Observations) -> SharedError:
    return SharedError(np.full(len(seen.laser), 0.02), np.empty((0, len(seen.laser))))


def patch_of(*coefficients: float) -> np.ndarray:
    patch = packed_plane(BASE)
    patch[COEFFICIENTS:] = coefficients
    return patch


def test_a_flat_patch_measures_heights_as_its_plane_does() -> None:
    points = np.random.default_rng(0).normal(0.0, 0.3, (50, 3))
    patch, height = packed_plane(BASE), np.empty(50)
    heights_over(points, patch, height)
    np.testing.assert_allclose(height, BASE.signed_distance(points), atol=1e-15)
    right, up = patch[RIGHT:UP], patch[UP:COEFFICIENTS]
    assert abs(right @ BASE.normal) < 1e-15
    # u to the right, v upward.
    assert right[0] > 0.9
    assert up[2] > 0.9
    assert patch.shape == (16,)


@pytest.mark.parametrize("bend", [(1.0, 0.0, 0.0), (-0.8, 0.0, 0.4), (0.0, 0.1, -0.6)])
def test_curvature_is_found_with_its_sigma(bend: tuple[float, float, float]) -> None:
    true = patch_of(0.002, 0.01, -0.02, *bend)
    seen = observed(true, wrong=12)
    fit = fit_patch(seen, BASE, shared(seen))
    assert fit is not None
    assert fit.is_clear
    sigma = np.sqrt(np.diag(fit.covariance))
    # Five standard deviations: 18 comparisons in all must hold.
    assert np.all(np.abs(fit.patch - true)[COEFFICIENTS:] < 5.0 * sigma)
    assert sigma[3:].max() < 0.1
    assert np.count_nonzero(fit.weights == 0.0) >= 12


def test_a_plane_is_left_a_plane() -> None:
    seen = observed(patch_of(*np.zeros(6)))
    found = fit_patch(seen, BASE, shared(seen))
    assert found is not None
    assert not found.is_clear


def test_a_strand_along_a_stripe_is_no_twist() -> None:
    flat = observed(patch_of(*np.zeros(6)), n=12)
    # The diagonal laser lights pieces of one strand, more and more off the middle of its sheet.
    seen = Observations(*(one[(flat.laser != 2) | (flat.line > 300.0)] for one in flat))
    off_px = np.linspace(0.4, 2.0, 7)
    seen.points[-7:] += off_px[:, None] * seen.sensitivity[-7:]
    found = fit_patch(seen, BASE, shared(seen))
    assert found is not None
    assert not found.is_clear


@pytest.mark.parametrize("bend", [0.0, 0.2])
def test_a_bend_is_hinted_at(bend: float) -> None:
    seen = observed(patch_of(0.0, 0.0, 0.0, bend, 0.0, 0.0), noise_px=0.02)
    assert shows_curvature(seen, np.ones(len(seen.laser)), packed_plane(BASE)) == (bend > 0.0)


@pytest.mark.parametrize("bend", [(1.0, 0.0, 0.0), (-0.8, 0.1, 0.4), (0.0, 0.0, 0.0)])
def test_the_nearest_tangent_touches_at_the_nearest_point(bend: tuple[float, float, float]) -> None:
    patch = patch_of(0.003, 0.05, -0.04, *bend)
    m = nearest_tangent(patch)
    assert m is not None
    distance = 1.0 / np.linalg.norm(m)
    # Every point of a fine grid on the patch is as far away or farther.
    u, v = (one.ravel() for one in np.meshgrid(*[np.linspace(-0.3, 0.3, 601)] * 2))
    a, b, c, p, q, r = patch[COEFFICIENTS:]
    h = a + b * u + c * v + 0.5 * (p * u * u + r * v * v) + q * u * v
    away = np.sqrt(u**2 + v**2 + (BASE.offset + h) ** 2)
    assert distance == pytest.approx(away.min(), abs=1e-6)
    assert np.all(away > distance - 1e-12)


def test_a_net_that_curls_around_the_vehicle_has_no_nearest_point() -> None:
    assert nearest_tangent(patch_of(0.0, 0.0, 0.0, -1.9, 0.0, 0.0)) is None


def test_the_covariance_of_the_tangent_follows_the_scatter() -> None:
    true = patch_of(0.0, 0.01, 0.0, 0.8, 0.0, 0.2)
    fit = fit_patch(observed(true), BASE, shared(observed(true)))
    assert fit is not None
    m = nearest_tangent(fit.patch)
    expected = nearest_tangent(true)
    assert m is not None
    assert expected is not None
    sigma = np.sqrt(np.diag(tangent_covariance(fit.patch, fit.covariance, m)))
    assert np.all(sigma > 0.0)
    assert np.all(np.abs(m - expected) < 5.0 * sigma)
