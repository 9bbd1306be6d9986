"""The refractive index of water from temperature, salinity and wavelength.

Quan and Fry, Empirical equation for the index of refraction of seawater, Applied Optics 34 (1995)
3477, doi:10.1364/AO.34.003477, fitted to the data of Austin and Halikas (1976): standard deviation
about 1.5e-5. The index it gives is relative to air.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray

N_AIR = 1.0003
"""Index of air relative to vacuum, as rig files have it by default."""
GREEN_NM = 532.0
"""Wavelength of a frequency-doubled Nd:YAG laser in vacuum, nanometres."""
GREEN_SIGMA_NM = 5.0
"""Standard deviation of the wavelength in which a target is seen; it changes the index by 2e-4."""


# Coefficients n0 to n9 of the formula.
_N = (1.31405, 1.779e-4, -1.05e-6, 1.6e-8, -2.02e-6, 15.868, 0.01155, -0.00423, -4382.0, 1.1455e6)
# The warmest (degrees Celsius) and saltiest (per mille) water for which it holds.
_WARMEST_C, _SALTIEST = 30.0, 40.0


class IndexSlopes(NamedTuple):
    """Derivatives of the index of seawater relative to air."""

    by_temperature: FloatArray  # Per degree Celsius.
    by_salinity: FloatArray  # Per per mille.


def seawater_index(
    temperature_c: ArrayLike, salinity_permille: ArrayLike, wavelength_nm: ArrayLike = GREEN_NM
) -> FloatArray:
    """Return the refractive index of seawater relative to air at atmospheric pressure.

    Parameters
    ----------
    temperature_c : array
        0 to 30 degrees Celsius.
    salinity_permille : array
        0 to 40 per mille. The equation was fitted from 0 to 35; above that it is extrapolated,
        linearly, as the formula is in salinity.
    wavelength_nm : array
        400 to 700 nanometres.

    Returns
    -------
    array
        Of the broadcast shape of the three.

    Raises
    ------
    OptionError
        If a value lies outside its range or is not a number.
    """
    t, s, w = _checked(temperature_c, salinity_permille, wavelength_nm)
    n0, n1, n2, n3, n4, n5, n6, n7, n8, n9 = _N
    by_light = (n5 + n6 * s + n7 * t + (n8 + n9 / w) / w) / w
    index: FloatArray = np.asarray(n0 + (n1 + (n2 + n3 * t) * t) * s + n4 * t * t + by_light)
    return index


def seawater_index_vacuum(
    temperature_c: ArrayLike,
    salinity_permille: ArrayLike,
    wavelength_nm: ArrayLike = GREEN_NM,
    *,
    n_air: float = N_AIR,
) -> FloatArray:
    """Return the refractive index of seawater relative to vacuum, as rigs and cameras take it.

    `seawater_index` times `n_air`; parameters and errors as there.
    """
    return seawater_index(temperature_c, salinity_permille, wavelength_nm) * n_air


def seawater_index_slopes(
    temperature_c: ArrayLike, salinity_permille: ArrayLike, wavelength_nm: ArrayLike = GREEN_NM
) -> IndexSlopes:
    """Return how `seawater_index` changes with temperature and salinity; parameters as there."""
    t, s, w = _checked(temperature_c, salinity_permille, wavelength_nm)
    _, n1, n2, n3, n4, _, n6, n7, _, _ = _N
    return IndexSlopes(
        np.asarray((n2 + 2.0 * n3 * t) * s + 2.0 * n4 * t + n7 / w),
        np.asarray(n1 + (n2 + n3 * t) * t + n6 / w),
    )


def _checked(*values: ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
    ranges = (
        ("water temperature", "°C", 0.0, _WARMEST_C),
        ("salinity", "per mille", 0.0, _SALTIEST),
        ("wavelength", "nm", 400.0, 700.0),
    )
    arrays = []
    for value, (name, unit, low, high) in zip(values, ranges, strict=True):
        array = np.asarray(value, dtype=np.float64)
        outside = ~((array >= low) & (array <= high))
        if np.any(outside):
            first = float(array[outside].flat[0])
            raise OptionError(
                f"{name} {first:g} {unit} is outside {low:g} to {high:g} {unit}, where the "
                "equation of Quan and Fry holds; give the measured value or the index itself"
            )
        arrays.append(array)
    t, s, w = np.broadcast_arrays(*arrays)
    return t, s, w


def water_fault(temperature_c: float | None, salinity_permille: float | None) -> tuple[str, str]:
    """Return which of these the user gave in another unit, or for no water, and the remedy.

    None was not given. Returns "temperature_c" or "salinity" and the remedy, or two empty texts.
    """
    least_salt, fahrenheit_from, kelvin_from = 0.1, 40.0, 200.0
    if temperature_c is not None and not 0.0 <= temperature_c <= _WARMEST_C:
        celsius, unit = temperature_c - 273.15, "kelvin"
        if temperature_c < kelvin_from:
            celsius, unit = (temperature_c - 32.0) / 1.8, "degrees Fahrenheit"
        hint = ""
        if temperature_c >= fahrenheit_from and 0.0 <= celsius <= _WARMEST_C:
            hint = f"; {celsius:.4g} if {unit} are meant"
        elif _WARMEST_C < temperature_c < fahrenheit_from:
            hint = "; for warmer water give its refractive index instead"
        return "temperature_c", f"give degrees Celsius, from 0 to {_WARMEST_C:g}{hint}"
    if salinity_permille is None or salinity_permille == 0.0:
        return "", ""
    remedy = f"give per mille, from 0 to {_SALTIEST:g}"
    if 0.0 < salinity_permille < least_salt:
        # Fresh water has 0.05 to 0.5; less than 0.1 changes the index by 2e-5.
        share = 1e3 * salinity_permille
        hint = f", {share:g} if a share is meant" if share <= _SALTIEST else ""
        return "salinity", f"{remedy}: 0 for fresh water{hint}"
    return ("", "") if 0.0 < salinity_permille <= _SALTIEST else ("salinity", remedy)


def may_be_water(n: float) -> bool:
    """Return whether an index may be that of water: 1.330 to 1.345 for green light, with margin."""
    return 1.32 <= n <= 1.36


class Dispersion(NamedTuple):
    """Index of water for light of one wavelength, by that for green or white light.

    The ratio of n - n_air at both wavelengths is nearly the same in all water, and in air the
    indices are equal.
    """

    ratio: float
    # Of the ratio, one standard deviation.
    sigma_ratio: float
    n_air: float

    @classmethod
    def of(cls, light_nm: float | None, n_air: float = N_AIR) -> "Dispersion":
        """Return that of a wavelength, by Quan & Fry (1995); none for green or unknown light.

        Of light beyond the formula's 400 to 700 nm it is that of its end.
        """
        light_nm = _within_formula(light_nm)
        if light_nm == GREEN_NM:
            return cls(1.0, 0.0, n_air)
        # All water: its middle, and the corners of temperature and salinity.
        t = np.array([0.5, 0.0, 0.0, 1.0, 1.0]) * _WARMEST_C
        s = np.array([0.5, 0.0, 1.0, 0.0, 1.0]) * _SALTIEST
        there, green = seawater_index(t, s, light_nm), seawater_index(t, s)
        ratios = (there - 1.0) / (green - 1.0)
        beside = seawater_index(t[0], s[0], GREEN_NM + GREEN_SIGMA_NM)
        by_water = float(np.abs(ratios - ratios[0]).max())
        by_light = float((beside - green[0]) / (green[0] - 1.0))
        return cls(float(ratios[0]), float(np.hypot(by_water, by_light)), n_air)

    def from_green(self, n_green: float) -> float:
        """Return the index at the wavelength."""
        return n_green + (self.ratio - 1.0) * (n_green - self.n_air)

    def to_green(self, n: float) -> float:
        """Return the index for green light in water that has the index `n` at the wavelength."""
        return n + (1.0 / self.ratio - 1.0) * (n - self.n_air)

    def sigma(self, n_green: float, sigma_green: float) -> float:
        """Return the standard deviation of `from_green`, where `n_green` has `sigma_green`."""
        own = self.sigma_ratio * (n_green - self.n_air)
        return float(np.hypot(self.ratio * sigma_green, own))


def _within_formula(light_nm: float | None) -> float:
    return GREEN_NM if light_nm is None else min(max(light_nm, 400.0), 700.0)


def index_in_seawater(
    temperature_c: float, salinity_permille: float, light_nm: float | None, n_air: float
) -> float:
    """Return the index of water for lasers of a wavelength, relative to vacuum.

    Light of no stated wavelength counts as green. Of light beyond the formula's 400 to 700 nm the
    index is that of its end.

    Raises `OptionError` if temperature or salinity lies outside the formula's range.
    """
    light_nm = _within_formula(light_nm)
    return float(seawater_index_vacuum(temperature_c, salinity_permille, light_nm, n_air=n_air))
