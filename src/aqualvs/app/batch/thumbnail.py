"""The range over a dive as a picture of the size of a word."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

_STEPS = 120
_WIDTH, _HEIGHT = 180, 34
_EDGE = 2.0


def range_steps(ranges: ArrayLike) -> list[float | None]:
    """Return the median range in at most 120 equal parts of a dive, in metres; None without any.

    Parameters
    ----------
    ranges : array, shape (N,)
        Metres, NaN without a posture.
    """
    parts = np.array_split(np.asarray(ranges, np.float64), _STEPS)
    known = [part[np.isfinite(part)] for part in parts if len(part)]
    return [round(float(np.median(part)), 4) if len(part) else None for part in known]


def range_svg(steps: Sequence[float | None], low: float, high: float) -> str:
    """Return the steps as a line in SVG; without a posture there is no line.

    Parameters
    ----------
    steps : sequence of float or None
        From `range_steps`.
    low, high : float
        Ranges at the picture's lower and upper edge, in metres.
    """
    if not steps or not high > low:
        return ""
    across = (_WIDTH - 2 * _EDGE) / len(steps)
    path, pen_is_down = "", False
    for i, step in enumerate(steps):
        if step is None:
            pen_is_down = False
            continue
        share = min(max((step - low) / (high - low), 0.0), 1.0)
        x, y = _EDGE + across * i, _HEIGHT - _EDGE - share * (_HEIGHT - 2 * _EDGE)
        path += f"{'L' if pen_is_down else 'M'}{x:.1f} {y:.1f}H{x + across:.1f}"
        pen_is_down = True
    return (
        f'<svg class="range" viewBox="0 0 {_WIDTH} {_HEIGHT}" width="{_WIDTH}" height="{_HEIGHT}" '
        f'role="img" aria-label="range over the dive"><path d="{path}"/></svg>'
    )
