"""What the processes of a crew send: blocks of measured frames, and how their parts ended."""

import pickle
from collections.abc import Sequence
from dataclasses import fields
from enum import Enum, auto
from typing import Any, TypeAlias

import numpy as np

from aqualvs.app.measuring import Measured
from aqualvs.scanning.scan import Scan, ScanPoints


class Ended(Enum):
    """How the measuring of a part ended."""

    WHOLE = auto()
    UNLIKE_SURVEY = auto()
    """It does not hold what it should; what was sent before is sound."""


Message: TypeAlias = list[Measured] | Ended

_COLUMNS = tuple(field.name for field in fields(ScanPoints))


def packed(message: Message) -> bytes:
    """Return a message as bytes; of measured frames without their pictures.

    The points of all frames travel together: a dozen arrays for each frame, and objects put
    together one by one, would cost four times as much.
    """
    whole = message if isinstance(message, Ended) else (_heads(message), *_points(message))
    return pickle.dumps(whole, pickle.HIGHEST_PROTOCOL)


def unpacked(parcel: bytes) -> Message:
    """Return the message of `packed`, which a process of this program has sent."""
    whole = pickle.loads(parcel)
    if isinstance(whole, Ended):
        return whole
    heads, stops, columns = whole
    found, first = [], 0
    for (index, time_s, posture, n_water, bare), stop in zip(heads, stops, strict=True):
        points = ScanPoints(*(column[first:stop] for column in columns))
        found.append(Measured(Scan(index, time_s, posture, points, n_water), bare))
        first = stop
    return found


def _heads(block: Sequence[Measured]) -> list[tuple[Any, ...]]:
    return [(m.scan.index, m.scan.time_s, m.scan.posture, m.scan.n_water, m.bare) for m in block]


def _points(block: Sequence[Measured]) -> tuple[list[int], list[Any]]:
    """Return where each frame's points end, and the columns of all."""
    points = [measured.scan.points for measured in block]
    stops = np.cumsum([len(one) for one in points]).tolist()
    return stops, [np.concatenate([getattr(one, name) for one in points]) for name in _COLUMNS]
