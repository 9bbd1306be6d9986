"""Robust least squares on problems whose answer is known in closed form."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.calibration.solver.least_squares import Block, RobustLoss, inverse, solve
from aqualvs.errors import CalibrationError, RigError
from aqualvs.geometry.arrays import FloatArray

N = 200


@dataclass(frozen=True)
class Linear:
    """Lines a x + b through pairs of values, in blocks; a barrier forbids slopes beyond it."""

    abscissas: tuple[FloatArray, ...]
    values: tuple[FloatArray, ...]
    barrier: float = np.inf
    loss: RobustLoss = RobustLoss.HUBER
    priors: tuple[Block, ...] = ()

    n_parameters = 2

    def blocks(self, state: FloatArray) -> Sequence[Block]:
        if state[0] > self.barrier:
            raise RigError("no such slope")
        return [
            *(
                Block(
                    "line", np.arange(2), (state[0] * x + state[1])[:, None] - y, _by(x), self.loss
                )
                for x, y in zip(self.abscissas, self.values, strict=True)
            ),
            *(
                Block(
                    b.group,
                    b.columns,
                    b.residuals + b.jacobian @ state[b.columns],
                    b.jacobian,
                    b.loss,
                    b.scaled,
                )
                for b in self.priors
            ),
        ]

    def moved(self, state: FloatArray, step: FloatArray) -> FloatArray:
        return state + step


def _by(x: FloatArray) -> FloatArray:
    one = np.stack([x, np.ones_like(x)], axis=-1)
    return np.repeat(one[:, None, :], 2, axis=1)


def _line(seed: int, noise: float, n: int = N) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.0, 1.0, n)
    return x, (2.0 * x + 3.0)[:, None] + rng.normal(0.0, noise, (n, 2))


def test_agrees_with_the_closed_form_and_its_covariance() -> None:
    x, y = _line(1, 0.5)
    found = solve(Linear((x,), (y,), loss=RobustLoss.SQUARE), np.zeros(2))
    design = _by(x).reshape(-1, 2)
    answer, squares, _, _ = np.linalg.lstsq(design, y.reshape(-1), rcond=None)
    np.testing.assert_allclose(found.state, answer, rtol=1e-9)
    noise = np.sqrt(squares[0] / (2 * N - 2))
    assert found.scales["line"] == pytest.approx(noise, rel=1e-9)
    # The scale of a block is tempered by its group's, of which it is the only one.
    np.testing.assert_allclose(
        found.covariance, noise**2 * np.linalg.inv(design.T @ design), rtol=1e-6
    )


def test_robust_estimate_keeps_the_noise_scale_of_normal_data() -> None:
    scales = []
    for seed in range(20):
        x, y = _line(seed, 0.1)
        scales.append(solve(Linear((x,), (y,)), np.zeros(2)).scales["line"])
    # Huber's weights take 0.6 % off; twenty times 400 values tell the scale to 0.8 %.
    assert np.mean(scales) == pytest.approx(0.1, rel=0.03)


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_outliers_are_left_out(share: float) -> None:
    x, y = _line(3, 0.1)
    bad = np.arange(N) < share * N
    y[bad] += np.random.default_rng(4).uniform(3.0, 30.0, (int(bad.sum()), 2))
    found = solve(Linear((x,), (y,)), np.zeros(2))
    assert not found.inliers[0][bad].any()
    assert found.inliers[0][~bad].all()
    alone = solve(Linear((x[~bad],), (y[~bad],)), np.zeros(2))
    # Steps below a fiftieth of a sigma are not taken.
    sigma = np.sqrt(np.diag(alone.covariance))
    assert np.all(np.abs(found.state - alone.state) < 0.02 * sigma)


def test_noisy_blocks_weigh_less() -> None:
    (x, y), (noisy_x, noisy_y) = _line(5, 0.05), _line(6, 1.0)
    found = solve(Linear((x, noisy_x), (y, noisy_y)), np.zeros(2))
    # 400 values each tell a scale to 3.5 %; tempering by ten values of the other moves it by more.
    assert found.block_scales[1] == pytest.approx(1.0, rel=0.15)
    assert found.block_scales[0] < 0.15
    alone = solve(Linear((x,), (y,)), np.zeros(2))
    assert np.all(np.abs(found.state - alone.state) < np.sqrt(np.diag(alone.covariance)))


def test_priors_are_meant_as_they_are() -> None:
    x, y = _line(7, 0.1, 20)
    # Slope known to be 0 ± 1e-3, whatever the noise of the data.
    prior = Block(
        "prior", np.array([0]), np.zeros((1, 1)), np.full((1, 1, 1), 1e3), RobustLoss.SQUARE, False
    )
    found = solve(Linear((x,), (y,), priors=(prior,)), np.zeros(2))
    assert abs(found.state[0]) < 0.01
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(1e-3, rel=1e-3)


def test_steps_into_the_impossible_are_shortened() -> None:
    x, y = _line(8, 0.1)
    found = solve(Linear((x,), (y,), barrier=1.5), np.zeros(2))
    assert 1.0 < found.state[0] <= 1.5


def test_unseen_observations_play_no_part() -> None:
    x, y = _line(9, 0.1)
    hidden = y.copy()
    hidden[::3] = np.nan
    found = solve(Linear((x,), (hidden,)), np.zeros(2))
    assert not found.inliers[0][::3].any()
    keep = np.arange(N) % 3 != 0
    alone = solve(Linear((x[keep],), (y[keep],)), np.zeros(2))
    np.testing.assert_allclose(found.state, alone.state, rtol=1e-6)


def test_says_when_nothing_is_seen() -> None:
    x, y = _line(10, 0.1)
    with pytest.raises(CalibrationError, match="no point can be seen"):
        solve(Linear((x,), (np.full_like(y, np.nan),)), np.zeros(2))


def test_says_when_a_parameter_is_entirely_free() -> None:
    x, y = np.zeros(10), np.ones((10, 2))
    with pytest.raises(CalibrationError, match="parameter 0 of the solve is entirely free"):
        solve(Linear((x,), (y,)), np.zeros(2))


def test_exact_data_are_solved_exactly() -> None:
    x, y = _line(11, 0.0)
    found = solve(Linear((x,), (y,)), np.zeros(2))
    np.testing.assert_allclose(found.state, [2.0, 3.0], atol=1e-8)


def test_a_minimum_that_rounding_ends_is_one() -> None:
    """Steps that no longer lower the cost are short at any damping, and say nothing of it."""
    for seed in range(40):
        x, y = _line(seed, 0.0)
        found = solve(Linear((x,), (y + 0.1 * x[:, None] ** 2,)), np.array([2.0, 3.0]))
        assert found.converged
        # Some ten steps, and once in a while ten shorter ones that rounding asks for.
        assert found.n_iterations < 40


@settings(max_examples=50)
@given(st.sampled_from(list(RobustLoss)), st.floats(0.0, 100.0))
def test_weights_are_slopes_of_the_losses(loss: RobustLoss, length: float) -> None:
    h = 1e-5 * max(length, 1.0)
    above, below = loss.cost(np.array([length + h, abs(length - h)]))
    slope = (above - below) / (length + h - abs(length - h)) if length > h else length
    weight = float(loss.weight(np.array([length]))[0])
    # The kink of Huber's second derivative costs h; differences lose ten digits.
    assert weight * length == pytest.approx(slope, rel=1e-4, abs=1e-5)


def test_inverse_bears_units_of_any_size() -> None:
    rng = np.random.default_rng(12)
    root = rng.normal(size=(6, 6))
    size = 10.0 ** np.array([-6.0, 0.0, 3.0, 8.0, -2.0, 5.0])
    information = (root @ root.T + np.eye(6)) * np.outer(size, size)
    product = inverse(information) @ information
    np.testing.assert_allclose(product * np.outer(size, 1.0 / size), np.eye(6), atol=1e-9)
