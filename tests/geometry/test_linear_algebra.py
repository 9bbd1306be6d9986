"""Cholesky's factor inside kernels, against LAPACK."""

import numpy as np
import pytest

from aqualvs.geometry.linear_algebra import factorise, inverse_of, solve_factorised

LEAST = 1e-13


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
    assert factorise(factor.copy(), 0.0, LEAST, apart)
    assert factorise(factor, 0.0, LEAST, factor)
    np.testing.assert_array_equal(np.tril(factor), apart)
    np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(matrix), rtol=1e-10)
    np.testing.assert_allclose(inverse_of(factor), np.linalg.inv(matrix), rtol=1e-9, atol=1e-9)
    solution = right.copy()
    solve_factorised(factor, solution, solution)
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
def test_no_factor_where_nothing_is_determined(matrix: np.ndarray) -> None:
    assert not factorise(matrix, 0.0, LEAST, np.zeros_like(matrix))


def test_damping_adds_to_the_diagonal() -> None:
    matrix, factor = positive(4), np.zeros((4, 4))
    assert factorise(matrix, 0.5, LEAST, factor)
    damped = matrix + 0.5 * np.diag(np.diag(matrix))
    np.testing.assert_allclose(factor, np.linalg.cholesky(damped), rtol=1e-10)
