"""What is known of a medium's refractive index before a camera has looked at it."""

import math
from dataclasses import dataclass

from aqualvs.errors import OptionError
from aqualvs.optics.water import (
    GREEN_NM,
    N_AIR,
    seawater_index_slopes,
    seawater_index_vacuum,
)

# Standard deviation of the fit of Quan & Fry (1995) to its data.
_SIGMA_FORMULA = 1.5e-5
# Air's index less one goes with its density: 3 K or 10 hPa change it by 1 %, 3e-6.
_SIGMA_AIR = 1e-5
_STEP_NM = 1.0


@dataclass(frozen=True, slots=True)
class IndexPrior:
    """An index and how well it is known.

    Attributes
    ----------
    n : float
        Relative to vacuum.
    sigma : float
        Standard deviation, positive.
    source : str
        Where it comes from, for reports.

    Raises
    ------
    OptionError
        If the index cannot be or sigma is not positive.
    """

    n: float
    sigma: float
    source: str = "given"

    def __post_init__(self) -> None:
        if not 1.0 <= self.n <= 2.0:
            raise OptionError(
                f"index prior is {self.n:g}; give the medium's index relative to vacuum, 1 to 2"
            )
        if not (math.isfinite(self.sigma) and self.sigma > 0.0):
            raise OptionError(
                f"index prior has sigma {self.sigma:g}; give a positive standard deviation"
            )

    @classmethod
    def air(cls, n_air: float = N_AIR) -> "IndexPrior":
        """Return what is known of air: a vehicle on deck that looks at its target learns from it.

        The target's place and the lens are then known as well as this index makes them, and keep
        that when the vehicle goes into the water.
        """
        return cls(n_air, _SIGMA_AIR, "air")

    @classmethod
    def seawater(
        cls,
        temperature_c: float,
        salinity_permille: float,
        *,
        sigma_temperature_c: float = 0.5,
        sigma_salinity_permille: float = 0.5,
        wavelength_nm: float = GREEN_NM,
        sigma_wavelength_nm: float = 5.0,
        n_air: float = N_AIR,
    ) -> "IndexPrior":
        """Return what temperature and salinity say, by Quan & Fry (1995).

        Parameters
        ----------
        temperature_c, salinity_permille : float
            0 to 30 degrees Celsius and 0 to 40 per mille.
        sigma_temperature_c, sigma_salinity_permille : float
            Standard deviations of the two.
        wavelength_nm, sigma_wavelength_nm : float
            Of the light that the target is seen in. 5 nm change the index by 2e-4: look at the
            target in the colour of the lasers (the green channel).
        n_air : float
            Index of air relative to vacuum, which the formula is multiplied by.

        Raises
        ------
        OptionError
            If a value lies outside the formula's range.
        """
        n = float(seawater_index_vacuum(temperature_c, salinity_permille, wavelength_nm))
        slopes = seawater_index_slopes(temperature_c, salinity_permille, wavelength_nm)
        side = math.copysign(_STEP_NM, GREEN_NM - wavelength_nm)
        beside = seawater_index_vacuum(temperature_c, salinity_permille, wavelength_nm + side)
        parts = (
            float(slopes.by_temperature) * sigma_temperature_c,
            float(slopes.by_salinity) * sigma_salinity_permille,
            (float(beside) - n) / _STEP_NM * sigma_wavelength_nm,
            _SIGMA_FORMULA,
        )
        source = f"{temperature_c:g} °C, {salinity_permille:g} per mille"
        return cls(n / N_AIR * n_air, math.hypot(*parts), source)
