"""What is uncertain of the camera that lasers are calibrated with."""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.camera import parameter_names
from aqualvs.optics.rig import Rig
from aqualvs.optics.uncertainty import RigUncertainty


@dataclass(frozen=True, slots=True)
class CameraDoubt:
    """Which of the camera's numbers are uncertain, and the medium's index.

    Attributes
    ----------
    names : tuple of str
        Of the rig, the medium's index not among them.
    sigma_medium : float
        Standard deviation of the index of the medium in the pictures; 0 if exact.
    medium_is_water : bool
        Whether that medium is the rig's own water, so that both are the same number.
    given : RigUncertainty
        What was known beforehand.
    """

    names: tuple[str, ...]
    sigma_medium: float
    medium_is_water: bool
    given: RigUncertainty

    @classmethod
    def of(
        cls, rig: Rig, given: RigUncertainty, n_medium: float | None, sigma_medium: float
    ) -> "CameraDoubt":
        """Sort out what is uncertain.

        Parameters
        ----------
        rig : Rig
            As the calibration starts.
        given : RigUncertainty
            Of the rig.
        n_medium : float or None
            Index of the medium in the pictures; None for the rig's own water.
        sigma_medium : float
            Its standard deviation, where it is not the rig's water.
        """
        # What was known of the lasers before is replaced.
        given = given.only([name for name in given.names if ":" not in name])
        sigmas = given.sigmas
        known = set(parameter_names(rig.camera())) - {"n_water"}
        names = tuple(n for n in given.names if n in known and sigmas[n] > 0.0)
        is_water = n_medium is None and rig.dome is not None
        if is_water:
            sigma_medium = sigmas.get("n_water", 0.0)
        return cls(names, sigma_medium if rig.dome is not None else 0.0, is_water, given)

    @property
    def n_columns(self) -> int:
        """How many numbers are uncertain."""
        return len(self.names) + (self.sigma_medium > 0.0)

    @property
    def covariance(self) -> FloatArray:
        """Of the uncertain numbers as the problem's first columns have them."""
        covariance = np.zeros((self.n_columns, self.n_columns))
        n = len(self.names)
        covariance[:n, :n] = self.given.of(self.names)
        if self.sigma_medium > 0.0 and self.medium_is_water:
            covariance[:] = self.given.of((*self.names, "n_water"))
        elif self.sigma_medium > 0.0:
            covariance[n, n] = self.sigma_medium**2
        return covariance

    def with_given(self) -> FloatArray:
        """Return the covariance (C, U) of the uncertain numbers with all that are given."""
        names = (*self.names, "n_water") if self.medium_is_water else self.names
        rows = [self.given.names.index(n) for n in names[: self.n_columns]]
        crossed = np.zeros((self.n_columns, len(self.given.names)))
        crossed[: len(rows)] = self.given.covariance[rows]
        return crossed
