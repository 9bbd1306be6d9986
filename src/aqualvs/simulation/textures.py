"""Periodic noise tiles that kernels look up instead of computing noise for every ray."""

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.compiled import inline_borrowing_kernel

TILE_SIZE = 512
_MASK = TILE_SIZE - 1
_WHITE_MASK = 255


class Tiles(NamedTuple):
    """Noise that repeats seamlessly.

    Attributes
    ----------
    smooth : float32 array, shape (512, 512)
        Fractal noise whose values are uniform in [0, 1): a threshold of f covers a fraction f.
    ridges : float32 array, shape (512, 512)
        Bright network on dark ground, mean 1: light focused by waves.
    white : float32 array, shape (256, 256)
        Independent uniform values.
    """

    smooth: NDArray[np.float32]
    ridges: NDArray[np.float32]
    white: NDArray[np.float32]


@cache
def noise_tiles() -> Tiles:
    """Return the tiles; the same in every process, because their seed is fixed."""
    rng = np.random.default_rng(532)
    smooth = _uniform(_fractal(rng, exponent=1.25, low=2.0))
    waves = _uniform(_fractal(rng, exponent=3.0, low=6.0))
    ridges = 1.0 / (0.07 + np.abs(waves - 0.5))
    white = rng.random((_WHITE_MASK + 1, _WHITE_MASK + 1))
    return Tiles(
        smooth.astype(np.float32),
        (ridges / ridges.mean()).astype(np.float32),
        white.astype(np.float32),
    )


def _fractal(rng: np.random.Generator, exponent: float, low: float) -> NDArray[np.float64]:
    """Gaussian noise with amplitude 1/f^exponent above `low` cycles a tile."""
    f = np.fft.fftfreq(TILE_SIZE) * TILE_SIZE
    radius = np.hypot(f[:, None], f[None, :])
    spectrum = np.fft.fft2(rng.standard_normal((TILE_SIZE, TILE_SIZE)))
    shaped = np.fft.ifft2(spectrum / np.maximum(radius, low) ** exponent).real
    return np.asarray(shaped, dtype=np.float64)


def _uniform(field: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace values by their rank, which makes them uniform in [0, 1)."""
    ranks = np.empty(field.size)
    ranks[np.argsort(field, axis=None)] = np.arange(field.size)
    return ranks.reshape(field.shape) / field.size


@inline_borrowing_kernel
def sample(tile: NDArray[np.float32], x: float, y: float) -> float:
    """Bilinear value of a 512-square tile at (x, y) in texels, repeated without end."""
    fx, fy = np.floor(x), np.floor(y)
    i, j = int(fx) & _MASK, int(fy) & _MASK
    i1, j1 = (i + 1) & _MASK, (j + 1) & _MASK
    ax, ay = x - fx, y - fy
    top = tile[j, i] * (1.0 - ax) + tile[j, i1] * ax
    bottom = tile[j1, i] * (1.0 - ax) + tile[j1, i1] * ax
    return float(top * (1.0 - ay) + bottom * ay)


@inline_borrowing_kernel
def white_at(white: NDArray[np.float32], i: int, j: int) -> float:
    """Return the uniform value that belongs to a pair of whole numbers."""
    return float(white[i & _WHITE_MASK, j & _WHITE_MASK])
