"""A model of swell inside the loop: what comes back every few seconds is met before it is felt."""

import math


class SwellFilter:
    """Passes what swings with about one period, and little else.

    In parallel to a proportional gain it raises the loop's gain about that period alone (internal
    model principle; Francis and Wonham 1976, doi:10.1016/0005-1098(76)90006-6):

        H(s) = 2 zeta w s / (s² + 2 zeta w s + w²),   w = 2 pi / period.

    At the period H is 1, far from it 0. Its memory is that of a damped pendulum: bounded by its
    input, so that it does not wind up.

    Parameters
    ----------
    period : float
        In seconds.
    damping : float
        zeta; half of the width of the band over its middle.
    """

    def __init__(self, period: float, damping: float) -> None:
        self._omega, self._damping = 2.0 * math.pi / period, damping
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._output = self._sum = 0.0

    @property
    def amplitude(self) -> float:
        """Of what swings now."""
        return math.hypot(self._output, self._sum)

    def update(self, step: float, value: float) -> float:
        """Return what of `value` swings; unchanged if `step` seconds are not positive.

        Backward Euler: any step is stable.
        """
        if not step > 0.0:
            return self._output
        w = self._omega
        # y' = 2 zeta w (value - y) - w q,  q' = w y.
        above = self._output + step * w * (2.0 * self._damping * value - self._sum)
        below = 1.0 + 2.0 * self._damping * w * step + (w * step) ** 2
        self._output = above / below
        self._sum += step * w * self._output
        return self._output
