"""Errors that all given distances of a rail share: its zero, and its scale against the board's."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.blocks import Block
from aqualvs.calibration.bundle import BundleState
from aqualvs.calibration.dome_problem import DomeProblem
from aqualvs.calibration.least_squares import Solution
from aqualvs.calibration.pose_terms import DISTANCES
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray

_SURE = 3.5
# Shared errors beyond these (metres, share) make a wrong rig; smaller ones are worth a remark.
_MAX_OFFSET, _MAX_SCALE = 1e-3, 0.005
# Place of the shift along y in a step of a pose.
_SHIFT_Y = 4


@dataclass(frozen=True, slots=True)
class SharedError:
    """An error that all given distances share, as the pictures see it.

    Attributes
    ----------
    value, sigma : float
        In metres for an offset; a share for a scale. Given minus true.
    """

    value: float
    sigma: float

    @property
    def sigmas(self) -> float:
        """How many sigmas it is from none."""
        return abs(self.value) / self.sigma


def check_shared_errors(
    problem: DomeProblem, solution: Solution[BundleState], covariance: FloatArray
) -> list[str]:
    """Compare the distances as a whole with the pictures.

    Parameters
    ----------
    problem : DomeProblem
    solution : Solution
        Of it.
    covariance : array, shape (P, P)
        Of what was solved, with that of numbers that were held passed on.

    Returns
    -------
    list of str
        Doubts, in plain words.

    Raises
    ------
    CalibrationError
        If the distances are off together by more than a good rig can bear.
    """
    blocks = distance_blocks(problem, solution)
    if len(blocks) < 2:
        return []
    given = {i: problem.given_distance(i) for i in blocks}
    offset = _shared_error(covariance, blocks, dict.fromkeys(blocks, 1.0))
    scale = _shared_error(covariance, blocks, given)
    if max(offset.sigmas, scale.sigmas) < _SURE:
        return []
    if offset.sigmas >= scale.sigmas:
        told = (
            f"all given distances are {1e3 * offset.value:+.2f} ± {1e3 * offset.sigma:.2f} mm off "
            "together; they count from the dome's centre along its y axis, not from its front or "
            "from the lens"
        )
        fatal = abs(offset.value) > _MAX_OFFSET
    else:
        told = (
            f"all given distances are {100.0 * scale.value:+.2f} ± {100.0 * scale.sigma:.2f} % off "
            "together, measured in the board's squares; measure the squares, and check the medium"
        )
        fatal = abs(scale.value) > _MAX_SCALE
    if fatal:
        raise CalibrationError(told)
    return [told]


def distance_blocks(problem: DomeProblem, solution: Solution[BundleState]) -> dict[int, Block]:
    """Return the residuals of given distances by view."""
    blocks = [block for block in solution.blocks if block.group == DISTANCES]
    return dict(zip(problem.measured_views, blocks, strict=True))


def solved_by_offset(problem: DomeProblem, solution: Solution[BundleState]) -> FloatArray:
    """Return the derivative (P,) of what was solved by an error that all distances share."""
    blocks = distance_blocks(problem, solution)
    slopes, _, _ = _slopes(len(solution.covariance), blocks, dict.fromkeys(blocks, 1.0))
    by_offset: FloatArray = solution.covariance @ slopes
    return by_offset


def _shared_error(
    covariance: FloatArray, blocks: Mapping[int, Block], shape: Mapping[int, float]
) -> SharedError:
    """Fit an error of a given shape over the distances, from slopes at the solution."""
    slopes, own, gradient = _slopes(len(covariance), blocks, shape)
    left = own - float(slopes @ covariance @ slopes)
    if left <= 1e-9 * own:
        return SharedError(0.0, float("inf"))
    return SharedError(gradient / left, 1.0 / float(np.sqrt(left)))


def _slopes(
    n_parameters: int, blocks: Mapping[int, Block], shape: Mapping[int, float]
) -> tuple[FloatArray, float, float]:
    """Return cross information with what was solved, own information, and minus the gradient."""
    slopes, own, gradient = np.zeros(n_parameters), 0.0, 0.0
    for i, block in blocks.items():
        weight = float(block.loss.weight(block.lengths)[0])
        # A given distance that is too large is mended by what a shift of the board along y does.
        by_error = shape[i] * float(block.jacobian[0, 0, _SHIFT_Y])
        slopes[block.columns] += weight * by_error * block.jacobian[0, 0]
        own += weight * by_error**2
        gradient -= weight * by_error * float(block.residuals[0, 0])
    return slopes, own, gradient
