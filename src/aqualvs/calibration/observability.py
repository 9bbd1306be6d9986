"""What the data of a solve determined, and what rests on prior knowledge."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.calibration.bundle import Bundle, BundleState
from aqualvs.calibration.least_squares import Solution, inverse
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.optics.uncertainty import RigUncertainty


@dataclass(frozen=True, slots=True)
class Direction:
    """A combination of numbers, each counted in sigmas of its prior.

    Attributes
    ----------
    weights : dict
        Share of every number, squares adding up to 1.
    gain : float
        How many times more the data say about it than the prior does.
    """

    weights: dict[str, float]
    gain: float

    @property
    def main(self) -> dict[str, float]:
        """The numbers that make up nearly all of it, largest first."""
        order = sorted(self.weights, key=lambda name: -abs(self.weights[name]))
        return {name: self.weights[name] for name in order if abs(self.weights[name]) > 0.3}


@dataclass(frozen=True, slots=True)
class Observability:
    """What the data determined of the numbers of which something was known beforehand.

    Attributes
    ----------
    shrinkage : dict
        For every such number its sigma after the solve over that before: 1 says that the data
        added nothing.
    directions : tuple of Direction
        Independent combinations, best determined first.
    """

    shrinkage: dict[str, float]
    directions: tuple[Direction, ...]

    def untold(self, limit: float = 0.1) -> list[Direction]:
        """Return the combinations about which the data say far less than the priors do."""
        return [direction for direction in self.directions if direction.gain < limit]

    def undetermined(self, names: Sequence[str], limit: float = 0.9) -> list[str]:
        """Return which of the names the data hardly say anything about."""
        return [name for name in names if self.shrinkage.get(name, 0.0) > limit]


def observability(
    bundle: Bundle,
    solution: Solution[BundleState],
    uncertainty: RigUncertainty,
    names: Sequence[str],
) -> Observability:
    """Weigh what a solve learnt about some numbers against what was known of them.

    All else is marginalised, with what was known of it: poses, the lens, the intrinsics.

    Parameters
    ----------
    bundle : Bundle
    solution : Solution
        Of it.
    uncertainty : RigUncertainty
        After the solve, with that of numbers that were held passed on.
    names : sequence of str
        Numbers to judge, whose priors do not hang on those of others; those without a prior are
        passed over.
    """
    names = [name for name in names if name in bundle.free and name in bundle.priors.names]
    if not names:
        return Observability({}, ())
    columns = np.array([bundle.free.index(name) for name in names])
    prior = bundle.priors.of(names)
    learnt = solution.information.copy()
    learnt[np.ix_(columns, columns)] -= np.linalg.inv(prior)
    root = np.linalg.cholesky(prior)
    gains, vectors = np.linalg.eigh(root.T @ _marginal(learnt, columns) @ root)
    # In the numbers themselves a direction is root @ vector; told in sigmas of each one's prior.
    shares = root @ vectors / np.sqrt(np.diag(prior))[:, None]
    shares /= np.linalg.norm(shares, axis=0)
    directions = tuple(
        Direction(dict(zip(names, shares[:, k].tolist(), strict=True)), max(float(gains[k]), 0.0))
        for k in np.argsort(-gains)
    )
    before, after = bundle.priors.sigmas, uncertainty.sigmas
    return Observability({name: after[name] / before[name] for name in names}, directions)


def _marginal(information: FloatArray, columns: IntArray) -> FloatArray:
    """Return the information on some parameters once all others are marginalised."""
    others = np.setdiff1d(np.arange(len(information)), columns)
    cross = information[np.ix_(columns, others)]
    own = information[np.ix_(columns, columns)]
    marginal: FloatArray = own - cross @ inverse(information[np.ix_(others, others)]) @ cross.T
    return marginal
