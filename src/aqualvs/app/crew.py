"""Processes that measure a dive together, each some parts of it; what they find comes in order."""

import contextlib
from collections import defaultdict, deque
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Self, cast

from aqualvs.app.crew_messages import Ended, Message
from aqualvs.app.crew_post import Receiver, SharedMemory
from aqualvs.app.crew_start import context, deaf_to_interrupts, interrupts_blocked
from aqualvs.app.crew_work import CrewWork, serve
from aqualvs.app.measuring import Measured
from aqualvs.closing import Closing

_MOST_WAITING = 100
"""Blocks for each process that wait for those of parts before; then only these are taken in."""

_PATIENCE_S = 2.0


@dataclass(slots=True)
class _Hand:
    """A process, and the number of the part that it works on; -1 if there is none left for it."""

    process: BaseProcess
    pipe: Connection
    receiver: Receiver
    number: int = -1


class Crew(Closing):
    """Processes that measure the parts of a dive; a context manager that ends them.

    Parameters
    ----------
    work : CrewWork
    n_processes : int
        There are no more than parts.

    Attributes
    ----------
    next_frame : int
        The first frame of which nothing has come yet.
    is_done : bool
        Whether all has come.
    """

    def __init__(self, work: CrewWork, n_processes: int) -> None:
        self._work = work
        self.next_frame = work.parts[0].first
        self.is_done = False
        self._n_given = 0
        self._hands: list[_Hand] = []
        self._found: defaultdict[int, deque[Message]] = defaultdict(deque)
        self._n_processes = min(n_processes, len(work.parts))

    def blocks(self) -> Iterator[list[Measured]]:
        """Yield what is found, in the order of the dive.

        It ends before its time where a part is not what it was taken for, or a process has died:
        `is_done` is False then, and the rest is to be measured by other means, from `next_frame`.
        """
        try:
            for number in range(len(self._work.parts)):
                for block in self._of_part(number):
                    yield block
                    self.next_frame += len(block)
        except (_UnlikeSurveyError, EOFError, OSError):
            return
        self.is_done = self.next_frame == self._work.parts[-1].stop

    def _of_part(self, number: int) -> Iterator[list[Measured]]:
        found = self._found[number]
        while True:
            while not found:
                self._take_in(number)
            message = found.popleft()
            if message is Ended.UNLIKE_SURVEY:
                raise _UnlikeSurveyError
            if message is Ended.WHOLE:
                break
            yield message
        del self._found[number]

    def _take_in(self, number: int) -> None:
        """Wait for messages about a part, and take in others unless too many wait."""
        crowded = sum(map(len, self._found.values())) > _MOST_WAITING * len(self._hands)
        hands = {
            hand.pipe: hand
            for hand in self._hands
            if hand.number == number or (hand.number >= 0 and not crowded)
        }
        for pipe in wait(list(hands)):
            hand = hands[cast("Connection", pipe)]
            message = hand.receiver.receive()
            self._found[hand.number].append(message)
            if isinstance(message, Ended):
                self._give(hand)

    def _give(self, hand: _Hand) -> None:
        """Give a process its next part, if there is one."""
        hand.number = self._n_given if self._n_given < len(self._work.parts) else -1
        if hand.number >= 0:
            self._n_given += 1
            hand.receiver.give_part(hand.number)

    def __enter__(self) -> Self:
        """Start the processes."""
        for _ in range(self._n_processes):
            hand = self._start()
            self._hands.append(hand)
            self._give(hand)
        return self

    def _start(self) -> _Hand:
        how, memory = context(), SharedMemory.new()
        mine, theirs = how.Pipe()
        is_copy = how.get_start_method() == "fork"
        # A copy has these too; they count as closed when no process has them any more.
        mines = [*(hand.pipe for hand in self._hands), mine] if is_copy else []
        process = how.Process(target=serve, args=(self._work, theirs, memory, mines), daemon=True)
        with interrupts_blocked() if is_copy else deaf_to_interrupts():
            process.start()
        theirs.close()
        if memory is not None:
            memory.seal()
        return _Hand(process, mine, Receiver(mine, memory))

    def close(self) -> None:
        """End the processes."""
        for hand in self._hands:
            with contextlib.suppress(OSError):
                hand.pipe.close()
            hand.process.terminate()
        for hand in self._hands:
            hand.process.join(_PATIENCE_S)
            if hand.process.is_alive():
                hand.process.kill()
                hand.process.join()
            hand.process.close()


class _UnlikeSurveyError(Exception):
    pass
