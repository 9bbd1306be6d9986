"""What the processes of a crew send: blocks of measured frames, and how their parts ended."""

import math
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import fields
from enum import Enum, auto
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.app.measuring import Measured
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints


class Ended(Enum):
    """How the measuring of a part ended."""

    WHOLE = auto()
    UNLIKE_SURVEY = auto()
    """It does not hold what it should; what was sent before is sound."""


Message: TypeAlias = list[Measured] | Ended

_COLUMNS = {field.name: getattr(ScanPoints.none(), field.name) for field in fields(ScanPoints)}
_BYTES = [column.itemsize * math.prod(column.shape[1:]) for column in _COLUMNS.values()]
_ARRAYS = ("covariance", "normal_in_dome", "rig_covariance")
_NUMBERS = tuple(field.name for field in fields(Posture) if field.name not in _ARRAYS)
# A line of the cache: no two columns share one.
_ALIGNED = 64


def room_for(message: Message) -> int:
    """Return how many bytes of memory `packed` needs."""
    if isinstance(message, Ended):
        return 0
    return _places(sum(len(measured.scan.points) for measured in message))[-1][1]


def packed(message: Message, memory: NDArray[np.uint8]) -> bytes:
    """Return a message as bytes, but for the points of frames, which are written to memory.

    Pictures stay behind. The points of all frames travel together: a dozen arrays for each frame,
    and objects put together one by one, would cost many times as much.
    """
    if isinstance(message, Ended):
        return pickle.dumps(message)
    points = [measured.scan.points for measured in message]
    stops = np.cumsum([len(one) for one in points]).tolist()
    for name, column in zip(_COLUMNS, _columns(memory, stops[-1]), strict=True):
        np.concatenate([getattr(one, name) for one in points], out=column, casting="no")
    return pickle.dumps((_heads(message), stops), pickle.HIGHEST_PROTOCOL)


def unpacked(parcel: bytes, memory: NDArray[np.uint8]) -> Message:
    """Return the message of `packed`, which a process of this program has sent.

    The points stay in `memory`.
    """
    whole = pickle.loads(parcel)
    if isinstance(whole, Ended):
        return whole
    heads, stops = whole
    columns = list(_columns(memory, stops[-1]))
    found, first = [], 0
    for (index, time_s, posture, n_water, bare), stop in zip(heads, stops, strict=True):
        points = ScanPoints(*[column[first:stop] for column in columns])
        scan = Scan(index, time_s, _answer(posture), points, n_water)
        found.append(Measured(scan, _answer(bare)))
        first = stop
    return found


def _heads(block: Sequence[Measured]) -> list[tuple[Any, ...]]:
    return [
        (m.scan.index, m.scan.time_s, _plain(m.scan.posture), m.scan.n_water, _plain(m.bare))
        for m in block
    ]


def _plain(answer: Posture | Refusal | None) -> Any:
    """Return a posture as plain numbers, which are packed several times as fast."""
    if not isinstance(answer, Posture):
        return answer
    numbers = [getattr(answer, name) for name in _NUMBERS]
    return numbers, [getattr(answer, name).tolist() for name in _ARRAYS]


def _answer(plain: Any) -> Any:
    if not isinstance(plain, tuple):
        return plain
    numbers, arrays = plain
    values: dict[str, Any] = dict(zip(_NUMBERS, numbers, strict=True))
    values |= zip(_ARRAYS, map(np.array, arrays), strict=True)
    return Posture(**values)


def _columns(memory: NDArray[np.uint8], n_points: int) -> Iterator[NDArray[Any]]:
    """Yield where the columns of points lie in memory."""
    for like, (first, stop) in zip(_COLUMNS.values(), _places(n_points), strict=True):
        yield memory[first:stop].view(like.dtype).reshape(n_points, *like.shape[1:])


def _places(n_points: int) -> list[tuple[int, int]]:
    """Return where the bytes of each column begin and end."""
    places, first = [], 0
    for n_bytes in _BYTES:
        stop = first + n_points * n_bytes
        places.append((first, stop))
        first = -(-stop // _ALIGNED) * _ALIGNED
    return places
