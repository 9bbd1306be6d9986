"""From the radiance before the lens to the grey levels of the file."""

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.simulation.scene import Sensor, WaterOptics

# The wide halo has no detail: it is computed on a picture so many times smaller.
_SHRINK = 4


def spread(
    radiance: NDArray[np.float32], water: WaterOptics, sensor: Sensor
) -> NDArray[np.float32]:
    """Blur by the lens, and send the forward-scattered fraction into a wide halo.

    Before saturation, as light does: a stripe far above full scale keeps its broad halo.
    """
    sharp = radiance
    if sensor.defocus_px > 0.0:
        sharp = cv2.GaussianBlur(radiance, (0, 0), sensor.defocus_px)
    if water.forward_scatter <= 0.0:
        return sharp
    height, width = radiance.shape[:2]
    small = cv2.resize(
        radiance, (-(-width // _SHRINK), -(-height // _SHRINK)), interpolation=cv2.INTER_AREA
    )
    small = cv2.GaussianBlur(small, (0, 0), water.halo_px / _SHRINK)
    halo = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(
        cv2.addWeighted(sharp, 1.0 - water.forward_scatter, halo, water.forward_scatter, 0.0)
    )


def expose(
    radiance: NDArray[np.float32], sensor: Sensor, rng: np.random.Generator | None
) -> NDArray[np.uint8]:
    """Apply gain, noise, full scale, gamma and 8 bits; without `rng` there is no noise."""
    signal = radiance * np.float32(sensor.gain)
    if rng is not None:
        variance = np.float32(sensor.shot_noise) * np.maximum(signal, 0.0)
        variance += np.float32(sensor.read_noise**2)
        signal = signal + np.sqrt(variance) * rng.standard_normal(signal.shape, dtype=np.float32)
    levels = np.clip(signal, 0.0, 1.0) * np.float32(_CURVE_STEPS)
    return np.asarray(_tone_curve(sensor.gamma)[(levels + 0.5).astype(np.uint16)])


_CURVE_STEPS = 16383


def _tone_curve(gamma: float) -> NDArray[np.uint8]:
    """Grey level for every one of 2^14 equal steps of radiance."""
    linear = np.arange(_CURVE_STEPS + 1) / _CURVE_STEPS
    return np.asarray(np.rint(255.0 * linear ** (1.0 / gamma)), dtype=np.uint8)
