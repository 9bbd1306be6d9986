"""Messages between the writing process and the measuring processes: pipe and shared memory.

Messages are blocks of measured frames, and the `Ended` of each part. The points go into shared
memory and the pipe only announces them: a pipe holds less than the points of a few frames, so that
both processes would be woken a dozen times for each block.
"""

import math
import mmap
import os
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import fields
from enum import Enum, auto
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.workers.frame_results import FrameResult


class Ended(Enum):
    """Message that a part has ended, and its outcome."""

    WHOLE = auto()
    UNLIKE_PROBE = auto()
    """It does not hold what it should; what was sent before is sound."""


Message: TypeAlias = list[FrameResult] | Ended

_COLUMNS = {field.name: getattr(ScanPoints.none(), field.name) for field in fields(ScanPoints)}
_BYTES = [column.itemsize * math.prod(column.shape[1:]) for column in _COLUMNS.values()]
_ARRAYS = ("covariance", "normal_in_dome", "rig_covariance")
_NUMBERS = tuple(field.name for field in fields(Posture) if field.name not in _ARRAYS)
# Size of a cache line: no two columns share one.
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
        found.append(FrameResult(scan, _answer(bare)))
        first = stop
    return found


def _heads(block: Sequence[FrameResult]) -> list[tuple[Any, ...]]:
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


_N_SLOTS = 3
_SLOT_BYTES = 4 << 20
_TAKEN = -1
"""Sent instead of a part's number: the data of a slot have been read."""


class SharedMemory:
    """Memory that this process shares with one that it begins, to which it is given.

    It lies in no folder: none has to have room for it, and nothing is left behind.

    Parameters
    ----------
    file : int
        Descriptor of a file in memory; stays open until `seal`.

    Attributes
    ----------
    slots : uint8 array, shape (n_slots, n_bytes)

    Raises
    ------
    OSError
        If the memory is not available.
    """

    def __init__(self, file: int) -> None:
        self._file = file
        os.ftruncate(file, _N_SLOTS * _SLOT_BYTES)
        memory = mmap.mmap(file, _N_SLOTS * _SLOT_BYTES)
        self.slots = np.frombuffer(memory, np.uint8).reshape(_N_SLOTS, _SLOT_BYTES)

    @classmethod
    def new(cls) -> Self | None:
        """Return new memory; None where the system has none to share."""
        if not hasattr(os, "memfd_create"):
            return None
        try:
            file = os.memfd_create("aqualvs")
        except OSError:
            return None
        try:
            return cls(file)
        except OSError:
            os.close(file)
            return None

    def seal(self) -> None:
        """Give it to no further process."""
        os.close(self._file)

    def __reduce__(self) -> tuple[Any, ...]:
        """Give it to a process that is about to begin."""
        return _received, (reduction.DupFd(self._file),)


def _received(file: Any) -> SharedMemory:
    memory = SharedMemory(file.detach())
    memory.seal()
    return memory


class Sender:
    """The end of a process that measures.

    Parameters
    ----------
    pipe : Connection
    memory : SharedMemory or None
        Without it all goes through the pipe.

    Raises
    ------
    EOFError, OSError
        From both methods, once the other end has gone.
    """

    def __init__(self, pipe: Connection, memory: SharedMemory | None) -> None:
        self._pipe, self._memory = pipe, memory
        self._next, self._n_free = 0, _N_SLOTS

    def next_part(self) -> int:
        """Wait for the number of a part."""
        while (number := int(self._pipe.recv())) == _TAKEN:
            self._n_free += 1
        return number

    def send(self, message: Message) -> None:
        """Send a message; waits while all slots are full."""
        n_bytes = room_for(message)
        if self._memory is None or n_bytes == 0 or n_bytes > _SLOT_BYTES:
            own = np.empty(n_bytes, np.uint8)
            self._pipe.send((packed(message, own), own, n_bytes))
            return
        while self._n_free == 0:
            # A part is given only to a process without one, so this is always `_TAKEN`.
            self._pipe.recv()
            self._n_free += 1
        parcel = packed(message, self._memory.slots[self._next])
        self._pipe.send((parcel, self._next, n_bytes))
        self._next, self._n_free = (self._next + 1) % _N_SLOTS, self._n_free - 1


class Receiver:
    """The other end, of the process that writes; see `Sender`."""

    def __init__(self, pipe: Connection, memory: SharedMemory | None) -> None:
        self._pipe, self._memory = pipe, memory

    def give_part(self, number: int) -> None:
        """Have a part measured; the one before must have ended."""
        self._pipe.send(number)

    def receive(self) -> Message:
        """Wait for a message."""
        parcel, place, n_bytes = self._pipe.recv()
        if self._memory is None or not isinstance(place, int):
            return unpacked(parcel, place)
        points = self._memory.slots[place, :n_bytes].copy()
        self._pipe.send(_TAKEN)
        return unpacked(parcel, points)
