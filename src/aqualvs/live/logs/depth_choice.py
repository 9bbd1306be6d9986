"""Which of several depths in a log to believe."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from aqualvs.live.logs.signals import Signal

_STUCK_SHARE = 0.1
_DIVED_M = 0.5


@dataclass(frozen=True, slots=True)
class Candidate:
    """A depth that a log holds.

    Attributes
    ----------
    label : str
        Where it stands in the log.
    depth : Signal or None
        Metres, positive down; None where the log does not have it.
    """

    label: str
    depth: Signal | None


def choose_depth(
    candidates: Sequence[Candidate], pressure_depth: Signal | None
) -> tuple[Candidate | None, str | None]:
    """Return the first candidate that is there and moves, and a note where one does not.

    Parameters
    ----------
    candidates : sequence of Candidate
        The best first.
    pressure_depth : Signal or None
        Depth that the outer pressure alone tells, up to a constant. An estimate that stands still
        while the pressure changes is the estimate of a filter without origin, not a depth.
    """
    dived = 0.0 if pressure_depth is None else _span(pressure_depth)
    note = None
    for candidate in candidates:
        if candidate.depth is None:
            continue
        if dived > _DIVED_M and _span(candidate.depth) < _STUCK_SHARE * dived:
            note = note or (
                f"{candidate.label} stands still while the pressure changes by {dived:.1f} m of "
                "water; not used"
            )
            continue
        return candidate, note
    return None, note


def _span(depth: Signal) -> float:
    low, high = np.percentile(depth.values, (1.0, 99.0))
    return float(high - low)
