"""What kernels use instead of LAPACK and NumPy, against them."""

import numpy as np
import pytest

from aqualvs.geometry.linear_algebra import (
    argsort,
    cholesky,
    cholesky_inverse,
    cholesky_solve,
    flatnonzero,
    median_of,
    select_nth,
    take,
)

MIN_PIVOT = 1e-13


def positive(n: int) -> np.ndarray:
    half = np.random.default_rng(n).normal(size=(n, n))
    return half @ half.T + 0.1 * np.eye(n)


@pytest.mark.parametrize("n", [1, 2, 6, 11])
def test_solutions_and_inverse(n: int) -> None:
    matrix = positive(n)
    right = np.arange(1.0, n + 1.0)
    # Only the lower half is read.
    factor = np.tril(matrix)
    apart = np.zeros((n, n))
    assert cholesky(factor.copy(), 0.0, MIN_PIVOT, apart)
    assert cholesky(factor, 0.0, MIN_PIVOT, factor)
    np.testing.assert_array_equal(np.tril(factor), apart)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(matrix), rtol=1e-10)
    np.testing.assert_allclose(
        cholesky_inverse(factor), np.linalg.inv(matrix), rtol=1e-9, atol=1e-9
    )
    solution = right.copy()
    cholesky_solve(factor, solution, solution)
    np.testing.assert_allclose(matrix @ solution, right, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.outer([1.0, 2.0, 3.0], [1.0, 2.0, 3.0]),
        np.diag([1.0, -1.0]),
        np.array([[np.nan]]),
    ],
    ids=["nothing", "one direction", "negative", "nan"],
)
def test_a_matrix_that_is_not_positive_definite_has_no_factor(matrix: np.ndarray) -> None:
    assert not cholesky(matrix, 0.0, MIN_PIVOT, np.zeros_like(matrix))


def test_damping_adds_to_the_diagonal() -> None:
    matrix, factor = positive(4), np.zeros((4, 4))
    assert cholesky(matrix, 0.5, MIN_PIVOT, factor)
    damped = matrix + 0.5 * np.diag(np.diag(matrix))
    np.testing.assert_allclose(factor, np.linalg.cholesky(damped), rtol=1e-10)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 4, 7, 40, 257])
@pytest.mark.parametrize("with_ties", [False, True])
def test_order_and_choice_are_those_of_numpy(n: int, with_ties: bool) -> None:
    random = np.random.default_rng(n)
    values = random.integers(0, 5, n).astype(float) if with_ties else random.normal(size=n)
    np.testing.assert_array_equal(argsort(values), np.argsort(values, kind="stable"))
    for k in {0, n // 3, n // 2, n - 1} if n else ():
        assert select_nth(values.copy(), k) == np.sort(values)[k]
    np.testing.assert_equal(median_of(values.copy()), np.median(values) if n else np.nan)
    rows = flatnonzero(values > 0.5)
    np.testing.assert_array_equal(rows, np.flatnonzero(values > 0.5))
    np.testing.assert_array_equal(take(values, rows), values[values > 0.5])


def test_nan_counts_as_highest() -> None:
    values = np.array([3.0, np.nan, 1.0, np.nan, 2.0])
    assert [select_nth(values.copy(), k) for k in range(3)] == [1.0, 2.0, 3.0]
    assert np.isnan([select_nth(values.copy(), k) for k in (3, 4)]).all()
