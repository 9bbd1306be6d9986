"""Wavelengths: how a camera's colour filters and the water answer to a laser's light.

What a camera records of a green laser is a number for each filter, fitted to real pictures of
laser lines; three Gaussians carry it over to other wavelengths. Real filters are lopsided and
differ between makers: Jiang, Liu, Gu and Süsstrunk, "What is the space of spectral sensitivity
functions for digital color cameras?" (WACV 2013), measured 28 cameras, with peaks near 600, 530
and 460 nm.
"""

from dataclasses import dataclass

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Laser
from aqualvs.simulation.scene import Vector

GREEN_NM = 532.0
"""Wavelength of a laser whose rig file tells none: a frequency-doubled Nd:YAG diode."""

# Middles of the bands red, green and blue, in which scenes and water are described.
_BANDS_NM = np.array([620.0, GREEN_NM, 460.0])

LUMA: FloatArray = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in luma (ITU-R BT.601)."""
LUMA.flags.writeable = False


def laser_wavelength_nm(laser: Laser) -> float:
    """Return the wavelength of a rig's laser in nanometres; `GREEN_NM` if the rig tells none."""
    return GREEN_NM if laser.wavelength_nm is None else laser.wavelength_nm


def band_shares(wavelength_nm: float) -> FloatArray:
    """Return the shares (3,) of red, green and blue that water's numbers have in a wavelength's.

    Linear between the middles of the bands, constant beyond: a laser of 635 nm is dimmed as red.
    """
    upward = np.interp(wavelength_nm, _BANDS_NM[::-1], np.arange(3.0))
    return np.asarray(np.maximum(0.0, 1.0 - np.abs(np.array([2.0, 1.0, 0.0]) - upward)))


@dataclass(frozen=True, slots=True, kw_only=True)
class ColourFilters:
    """Colour filters of a sensor, and the matrix that the camera makes up for their crosstalk with.

    Attributes
    ----------
    at_green : (float, float, float)
        What the pixels under the red, the green and the blue filter record of a laser of
        `GREEN_NM`, white light being recorded alike by all three; the green one has 1.
    saturation : float
        How much of the colour of daylight is lost to crosstalk between the filters, and put back
        by the camera's colour matrix: colour minus luma is divided, then multiplied by 1 plus
        this. Daylight comes out as it was; a laser, whose one wavelength has crosstalk of its own,
        comes out with less red than was recorded, or with less than none: it darkens red.
    peak_nm : (float, float, float)
        Middles of the filters in nanometres. Each falls off as a Gaussian.
    width_nm : float
        Standard deviation of the green filter, and of the others on the side away from green; on
        the side towards green they are as wide as `at_green` asks.
    """

    at_green: Vector = (0.40, 1.0, 0.27)
    saturation: float = 0.0
    peak_nm: Vector = (600.0, GREEN_NM, 460.0)
    width_nm: float = 45.0

    @property
    def correcting(self) -> FloatArray:
        """Matrix (3, 3) from what is recorded, with white balanced, to red, green and blue."""
        return (1.0 + self.saturation) * np.eye(3) - self.saturation * np.tile(LUMA, (3, 1))

    @property
    def crosstalk(self) -> FloatArray:
        """Matrix (3, 3) from red, green and blue of a scene to what is recorded of them."""
        return np.asarray(np.linalg.inv(self.correcting))

    def recorded(self, wavelength_nm: float) -> FloatArray:
        """Return what is recorded of a laser's light under the three filters, shape (3,)."""
        if wavelength_nm == GREEN_NM:
            return np.array(self.at_green)
        off = wavelength_nm - np.array(self.peak_nm)
        seen = np.exp(-0.5 * (off / self.width_nm) ** 2)
        for k in (0, 2):
            to_green = GREEN_NM - self.peak_nm[k]
            if off[k] * to_green > 0.0:
                seen[k] = self.at_green[k] ** ((off[k] / to_green) ** 2)
        return np.asarray(seen)

    def laser_colour(self, wavelength_nm: float) -> FloatArray:
        """Return the red, green and blue (3,) that a scene must hold to be recorded so."""
        return np.asarray(self.correcting @ self.recorded(wavelength_nm))


COLOUR_BALANCED = ColourFilters()
"""Filters of the ideal camera: daylight as it is, and a green laser with a little red and blue."""
