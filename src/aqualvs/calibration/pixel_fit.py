"""What small fits to pixels inside compiled kernels share: an edge, and what is no information."""

import math

from aqualvs.geometry.compiled import inline_borrowing_kernel

LEAST_PIVOT = 1e-12
"""A pivot of the normal matrix below this share of its diagonal is no information."""

_SQRT_HALF = math.sqrt(0.5)
_DENSITY_AT_ZERO = 1.0 / math.sqrt(2.0 * math.pi)
# Farther than this many blurs from where it lies, an edge is over.
_REACH = 4.0


@inline_borrowing_kernel
def blurred_edge(distance: float, blur: float) -> tuple[float, float]:
    """Return a Gaussian edge's height, 0 to 1, and its slope by `distance`."""
    t = distance / blur
    if t > _REACH:
        return 1.0, 0.0
    if t < -_REACH:
        return 0.0, 0.0
    return 0.5 + 0.5 * math.erf(_SQRT_HALF * t), _DENSITY_AT_ZERO * math.exp(-0.5 * t * t) / blur
