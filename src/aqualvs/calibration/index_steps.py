"""Has the index jumped? A two-sided cumulative sum over the frames' normalised surprises.

Page (1954), Continuous inspection schemes, Biometrika 41, 100, doi:10.1093/biomet/41.1-2.100.
"""

from dataclasses import dataclass, field

import numpy as np

# A change of one standard deviation of a frame is what is looked for.
_ALLOWANCE = 0.5
# False alarms of independent normal surprises are exp(2 * 0.5 * 21) frames apart: years at 25 fps.
_LIMIT = 20.0
# No single frame counts more, so that one wrong picture never rings; four in a row do.
_LARGEST = 7.0
# Compression repeats its errors over a group of pictures: what frames say is correlated that long.
_BLOCK = 12
_MEMORY = 100


@dataclass(slots=True)
class StepTest:
    """Sums up surprises until they cannot be chance.

    Attributes
    ----------
    inflation : float
        By how much the spread of the surprises exceeds 1 over blocks of frames, 1 at least: what
        the noise of corners has to be multiplied by, because neighbouring corners and frames err
        together.
    """

    inflation: float = 1.0
    _sums: list[float] = field(default_factory=lambda: [0.0, 0.0])
    _lengths: list[int] = field(default_factory=lambda: [0, 0])
    _block: list[float] = field(default_factory=list)
    _n_blocks: int = 0

    def add(self, surprise: float) -> int:
        """Take the surprise of a frame in standard deviations.

        Returns
        -------
        int
            How many frames ago, this one included, the change that rings the alarm began; 0 while
            there is none.
        """
        for side, sign in enumerate((1.0, -1.0)):
            bounded = min(max(sign * surprise, -_LARGEST), _LARGEST)
            total = max(self._sums[side] + bounded - _ALLOWANCE, 0.0)
            self._sums[side] = total
            self._lengths[side] = self._lengths[side] + 1 if total > 0.0 else 0
            if total > _LIMIT:
                began = self._lengths[side]
                self.forget()
                return began
        self._spread(surprise)
        return 0

    @property
    def quiet(self) -> bool:
        """Whether nothing has been summed up."""
        return not any(self._lengths)

    def forget(self) -> None:
        """Begin anew, as after a jump; the inflation stays."""
        self._sums, self._lengths, self._block = [0.0, 0.0], [0, 0], []

    def _spread(self, surprise: float) -> None:
        self._block.append(surprise)
        if len(self._block) < _BLOCK:
            return
        self._n_blocks += 1
        square = min(float(np.sum(self._block)) ** 2 / _BLOCK, 9.0)
        share = 1.0 / min(self._n_blocks + 8, _MEMORY)
        # Surprises are over the inflated noise already: what they still exceed 1 by comes on top.
        squared = self.inflation**2 * (1.0 + share * (square - 1.0))
        self.inflation = float(np.sqrt(min(max(squared, 1.0), 100.0)))
        self._block = []
