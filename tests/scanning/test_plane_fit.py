"""Plane fits: exact where points are, robust where some are not, honest about the rest."""

import numpy as np
import pytest

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.scanning.plane_fit import (
    SHARED_ERROR_PX,
    PlaneFit,
    SharedError,
    fit_pseudo_inverse,
    fit_robust,
    shared_error,
)

SQUARE = np.array([0.0, 1.0, 0.0]) / 0.5
TILTED = np.array([0.2, 1.0, -0.3]) / np.linalg.norm([0.2, 1.0, -0.3]) / 0.7
FORWARD = np.array([0.0, 1.0, 0.0])
N_LINES = 60
ALONG = np.linspace(-1.0, 1.0, N_LINES)


def stripes(m: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
    """Points on three lines across a plane, what a pixel moves them by, and their lasers.

    The lines are level, upright and diagonal; a pixel moves a point along the line of sight's
    crossing with its sheet, here by 0.6 to 1 mm forwards and a little across.
    """
    t = np.linspace(-0.15, 0.15, N_LINES)
    zero = np.zeros_like(t)
    across = np.concatenate(
        [
            np.stack([t, zero - 0.08], axis=-1),
            np.stack([zero - 0.1, t], axis=-1),
            np.stack([t, 0.1 - t], axis=-1),
        ]
    )
    y = (1.0 - m[0] * across[:, 0] - m[2] * across[:, 1]) / m[1]
    points = np.stack([across[:, 0], y, across[:, 1]], axis=-1)
    laser = np.repeat(np.arange(3), N_LINES)
    per_px = np.array([[0.0, 1e-3, 3e-4], [3e-4, 8e-4, 0.0], [-2e-4, 6e-4, -2e-4]])[laser]
    return points, per_px, laser


def own(sigma_px: float, n: int) -> SharedError:
    """Return errors that the stripe of each laser shares, and none that all share."""
    return SharedError(np.full(n, sigma_px), np.empty((0, n)))


def fit(
    points: FloatArray,
    sigma_px: float | FloatArray = 0.3,
    m: FloatArray = TILTED,
    shared_px: float = SHARED_ERROR_PX,
    rows: IntArray | slice = slice(None),
) -> PlaneFit | None:
    """Fit to some of the stripes' points, started at `m`."""
    _, per_px, laser = stripes(m)
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (len(laser),))
    return fit_robust(
        points[rows].copy(),
        per_px[rows].copy(),
        sigma[rows].copy(),
        laser[rows].copy(),
        np.tile(ALONG, 3)[rows].copy(),
        start=m,
        shared=own(shared_px, len(laser[rows])),
    )


@pytest.mark.parametrize("m", [SQUARE, TILTED])
def test_an_exact_plane_is_found_from_a_rough_start(m: FloatArray) -> None:
    points, per_px, laser = stripes(m)
    start = FORWARD / 0.6
    along = np.tile(ALONG, 3)
    shared = shared_error(np.zeros(len(points)))
    found = fit_robust(
        points, per_px, np.full(len(points), 0.2), laser, along, start=start, shared=shared
    )
    assert found is not None
    np.testing.assert_allclose(found.m, m, rtol=0.0, atol=1e-11)
    assert found.rms < 1e-12
    # Rounding is weighed like noise, but nothing is thrown away for it.
    assert np.all(found.weights > 0.0)
    assert np.linalg.eigvalsh(found.covariance).min() > 0.0
    np.testing.assert_array_equal(start, FORWARD / 0.6)


@pytest.mark.parametrize("m", [SQUARE, TILTED])
def test_the_pseudo_inverse_finds_an_exact_plane(m: FloatArray) -> None:
    points, *_ = stripes(m)
    covariance = np.diag([1.0, 2.0, 3.0])
    fit = fit_pseudo_inverse(points, n_groups=len(points), covariance=covariance)
    np.testing.assert_allclose(fit.m, m, rtol=0.0, atol=1e-12)
    assert fit.rms < 1e-13
    np.testing.assert_array_equal(fit.weights, np.ones(len(points)))
    np.testing.assert_array_equal(fit.covariance, covariance)


def noisy(
    m: FloatArray,
    rng: np.random.Generator,
    sigma_px: float | FloatArray = 0.3,
    shared_px: float = 0.0,
) -> FloatArray:
    """Independent errors, and a shift and a tilt that each laser's points share."""
    points, per_px, laser = stripes(m)
    error = rng.normal(size=len(points)) * sigma_px
    error += rng.normal(0.0, shared_px, 3)[laser]
    error += rng.normal(0.0, shared_px, 3)[laser] * np.tile(ALONG, 3)
    moved: FloatArray = points + error[:, None] * per_px
    return moved


def test_outliers_of_any_size_do_not_pull_but_the_pseudo_inverse_follows_them() -> None:
    points = noisy(TILTED, np.random.default_rng(1))
    wild = np.arange(len(points)) % 5 == 0
    # 2 % of 0.7 m are 14 pixels.
    points[wild] *= np.linspace(1.02, 1.5, np.count_nonzero(wild))[:, None]
    found = fit(points)
    assert found is not None
    error = np.linalg.norm(found.m - TILTED) / np.linalg.norm(TILTED)
    assert error < 0.005
    assert np.all(found.weights[wild] == 0.0)
    assert np.all(found.weights[~wild] > 0.0)
    plain = fit_pseudo_inverse(points, n_groups=len(points), covariance=found.covariance)
    assert np.linalg.norm(plain.m - TILTED) / np.linalg.norm(TILTED) > 5.0 * error
    assert plain.rms > 10.0 * found.rms


def test_an_error_that_all_stripes_share_counts_as_what_it_moves_the_plane_by() -> None:
    points, per_px, laser = stripes(TILTED)
    common = np.where(laser == 1, -0.1, 0.2) + 0.05 * np.tile(ALONG, 3)

    def fitted(at: FloatArray, common: FloatArray) -> PlaneFit:
        found = fit_robust(
            at,
            per_px,
            np.full(len(at), 0.2),
            laser,
            np.tile(ALONG, 3),
            start=TILTED,
            shared=SharedError(np.zeros(len(at)), common),
        )
        assert found is not None
        return found

    none = np.empty((0, len(points)))
    plain, widened = fitted(points, none), fitted(points, common[None])
    moved = fitted(points + 1e-3 * common[:, None] * per_px, none).m - plain.m
    added = widened.covariance - plain.covariance
    # A thousandth of the error, so that no point is an outlier; it scales.
    np.testing.assert_allclose(added, 1e6 * np.outer(moved, moved), rtol=0.01, atol=1e-9)
    np.testing.assert_array_equal(widened.m, plain.m)


@pytest.mark.parametrize("m", [SQUARE, TILTED])
@pytest.mark.parametrize("shared_px", [0.0, 0.015, 0.04])
@pytest.mark.parametrize("sigma_px", [0.1, 0.4])
def test_predicted_covariance_against_the_scatter_of_many_fits(
    m: FloatArray, shared_px: float, sigma_px: float
) -> None:
    rng = np.random.default_rng(2)
    n = 600
    # The fit is not told how large the shared errors are.
    known = SHARED_ERROR_PX if shared_px > 0.0 else 0.0
    fits = [fit(noisy(m, rng, sigma_px, shared_px), sigma_px, m, known) for _ in range(n)]
    found = np.array([one.m for one in fits if one is not None])
    predicted = np.array([one.covariance for one in fits if one is not None]).mean(axis=0)
    assert len(found) == n
    # 600 fits know a standard deviation to 3 %; stated errors are a floor, which costs 3 % more. Of
    # errors that stripes share a fit sees three numbers; it expects fewer large ones.
    ratio = found.std(axis=0) / np.sqrt(np.diag(predicted))
    assert np.all((ratio > 0.7) & (ratio < 1.25)), ratio
    # Along every direction, not only the axes: eigenvalues of the whitened scatter.
    inverse = np.linalg.inv(np.linalg.cholesky(predicted))
    spread = np.sqrt(np.linalg.eigvalsh(inverse @ np.cov(found.T) @ inverse.T))
    assert np.all((spread > 0.6) & (spread < 1.35)), spread
    # Four standard errors of the mean.
    bias = np.abs(found.mean(axis=0) - m) / found.std(axis=0) * np.sqrt(n)
    assert np.all(bias < 4.0), bias


def test_errors_larger_than_stated_are_seen_in_the_residuals() -> None:
    points = noisy(TILTED, np.random.default_rng(3))
    told, bold = fit(points, 0.3, shared_px=0.0), fit(points, 0.03, shared_px=0.0)
    assert told is not None
    assert bold is not None
    np.testing.assert_allclose(told.m, bold.m, rtol=1e-9)
    # 180 residuals know their scale to 5 %; stated and real agree so far.
    np.testing.assert_allclose(told.covariance, bold.covariance, rtol=0.25, atol=1e-5)


def test_errors_smaller_than_stated_are_seen_in_many_residuals_only() -> None:
    points = noisy(TILTED, np.random.default_rng(3))
    sigma = []
    for rows in (slice(None), slice(None, None, 12)):
        told, shy = (fit(points, px, shared_px=0.0, rows=rows) for px in (0.3, 1.5))
        assert told is not None
        assert shy is not None
        sigma.append(np.sqrt(np.trace(shy.covariance) / np.trace(told.covariance)))
    # 5 by what is stated, 1 by the residuals: of 180 observations and of 15.
    assert sigma[0] < 2.5
    assert 3.5 < sigma[1] < 5.5


def test_shared_errors_widen_and_do_not_move() -> None:
    points = noisy(TILTED, np.random.default_rng(5))
    alone, common = fit(points, shared_px=0.0), fit(points, shared_px=0.08)
    assert alone is not None
    assert common is not None
    np.testing.assert_array_equal(alone.m, common.m)
    more = np.linalg.eigvalsh(common.covariance - alone.covariance)
    assert np.all(more > 0.0)


def test_uncertain_points_weigh_less() -> None:
    rng = np.random.default_rng(4)
    sigma = np.where(np.arange(3 * N_LINES) % 2 == 0, 0.1, 1.0)
    told, untold = [], []
    for _ in range(100):
        moved = noisy(SQUARE, rng, sigma)
        for known, stated in ((told, sigma), (untold, 0.5)):
            found = fit(moved, stated, SQUARE)
            assert found is not None
            known.append(found.m)
    assert np.all(np.std(told, axis=0) < 0.8 * np.std(untold, axis=0))


def test_rms_is_the_distance_from_the_plane() -> None:
    points, *_ = stripes(SQUARE)
    points[:, 1] += np.where(np.arange(len(points)) % 2 == 0, 1e-3, -1e-3)
    found = fit(points, 1.0, SQUARE)
    assert found is not None
    # Alternate millimetres on either side; residuals are weighed, so not to the last digit.
    assert abs(found.rms - 1e-3) < 5e-5
    plain = fit_pseudo_inverse(points, n_groups=1, covariance=found.covariance)
    assert abs(plain.rms - 1e-3) < 5e-5


def test_one_line_is_no_plane() -> None:
    points, *_ = stripes(SQUARE)
    found = fit(points, m=SQUARE, rows=slice(N_LINES))
    # Rounding may let it through; then it must say that the plane may be anywhere.
    assert found is None or np.sqrt(np.linalg.eigvalsh(found.covariance).max()) > 10.0


def test_three_points_say_nothing_about_their_own_error() -> None:
    points, *_ = stripes(SQUARE)
    found = fit(points, m=SQUARE, rows=np.array([0, N_LINES + 5, 2 * N_LINES + 40]))
    assert found is None or not np.all(np.isfinite(found.covariance))
