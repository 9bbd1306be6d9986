"""Scheduler of a batch: hands the next task to the processes, and takes care of its outcome.

A dive is surveyed, measured piece by piece, and merged; failed tasks are tried again or given up.
Where the condition of the net is wanted, it is evaluated from the finished run and kept until
something that it depends on changes.
"""

import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

from aqualvs.batch.cluster import FinishedTask, Workers, WorkersLostError
from aqualvs.batch.dataset import (
    drop_dive,
    holds_net,
    put_net,
    read_manifest,
    read_valid_manifest,
    scratch,
    write_manifest,
)
from aqualvs.batch.dives import DiveRecord, DiveState
from aqualvs.batch.merge import PieceLostError, finished_dive, join_dive
from aqualvs.batch.parts import PieceResult, measure_piece
from aqualvs.batch.work import DiveProbe, DiveWork, content_digest, digest, probe
from aqualvs.errors import AqualvsError
from aqualvs.net_survey.command import StoredDive
from aqualvs.nets.target_file import NetRequest
from aqualvs.report.run_page import write_report
from aqualvs.results.files import writing
from aqualvs.results.folder import NET_FILES
from aqualvs.results.net_survey import read_run
from aqualvs.sources.spans import UnlikeProbeError

NET = "net"
"""Folder, below a dive's home, with the seal of its net's state."""


def with_net(work: DiveWork, key: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return a finished dive's facts with the condition of its net, evaluated now if it is wanted.

    Parameters
    ----------
    work : DiveWork
    key : str
        Of the dive's result, `DiveProbe.key`.
    facts : mapping
        From `join_dive`.

    Returns
    -------
    facts : dict
        With `net`, as `net_dict` has it, where it is known, or with `net_fault`, which says why
        not. The dive's own result stands in any case.
    """
    request = work.request.net
    if request is None:
        return dict(facts) | known_net(work.home, key)
    try:
        return dict(facts) | {"net": _state(work, f"{key}-{_digest(request)}", request)}
    except AqualvsError as fault:
        return dict(facts) | {"net_fault": str(fault)}


def known_net(home: Path, key: str) -> dict[str, Any]:
    """Return the stored condition of a dive's net, as from `with_net`; empty if there is none.

    Parameters
    ----------
    home : Path
        Of the dive.
    key : str
        Of its result; what was told of another does not count.
    """
    found = read_manifest(home / NET)
    if found is None or not str(found["key"]).startswith(f"{key}-"):
        return {}
    return {"net": found["facts"]}


def _state(work: DiveWork, key: str, request: NetRequest) -> dict[str, Any]:
    """Return the summary of a net's state: the one that is there, or a new one."""
    out, home = work.request.out, work.home / NET
    found = read_valid_manifest(home, key, out)
    if found is not None and holds_net(work.dataset, work.name):
        return found
    dive = StoredDive(out)
    net = dive.net_pass(request)
    for scan in read_run(out):
        net.add(scan)
    with writing(out), scratch(work.home, NET) as draft:
        result = net.write(draft, dive.video)
        for name in NET_FILES:
            os.replace(draft / name, out / name)
        put_net(work.dataset, work.name, out)
        if work.request.report:
            write_report(out)
        home.mkdir(parents=True, exist_ok=True)
        write_manifest(home, key, result.summary, NET_FILES, out)
    return result.summary


def _digest(request: NetRequest) -> str:
    """Return a short text of all that a net's state depends on besides the dive's result."""
    return digest(asdict(request) | {"log": content_digest(request.log)})


# Tasks handed over for each that can be under way, so that no process waits for the next.
_AHEAD = 3
_WAIT_S = 0.2
# Beginnings of a dive; each costs only what is not finished.
_MAX_BEGINNINGS = 3


class BatchObserver(Protocol):
    """Observer of a batch's progress."""

    def expect(self, n_bytes: int) -> None:
        """Note that there is so much more, or less, to be worked through than was said."""

    def measured(self, n_bytes: int, n_frames: int) -> None:
        """Note that a piece is done."""

    def ended(self, record: DiveRecord) -> None:
        """Note that a dive is done, or given up."""


@dataclass(slots=True, eq=False)
class _Dive:
    """A dive under way."""

    work: DiveWork
    # What the watcher was told to expect of it, and not yet that it is done.
    n_bytes: int
    probe: DiveProbe | None = None
    results: dict[int, PieceResult] = field(default_factory=dict)
    n_beginnings: int = 0
    is_done: bool = False


@dataclass(frozen=True, slots=True)
class _Task:
    """A task under way; those of a beginning that was given up count no more."""

    dive: _Dive
    beginning: int
    piece: int | None = None


def look(work: DiveWork) -> tuple[DiveProbe, dict[str, Any] | None]:
    """Look at a dive; returns its survey, and its facts if an earlier batch has finished it.

    Then the state of its net is told, if it is wanted and has not been.

    Raises
    ------
    AqualvsError
        If the dive or its rig cannot be used.
    """
    found = probe(work)
    facts = finished_dive(work, found)
    return found, None if facts is None else with_net(work, found.key, facts)


def join(work: DiveWork, found: DiveProbe, results: Sequence[PieceResult]) -> dict[str, Any]:
    """Merge as `join_dive` does, and evaluate the dive's net if it is wanted."""
    return with_net(work, found.key, join_dive(work, found, results))


@dataclass(frozen=True, slots=True)
class Steps:
    """Tasks of a dive, in the order in which the processes do them.

    Attributes
    ----------
    look, measure, join : callable
        As `look`, `measure_piece` and `join`.
    """

    look: Callable[[DiveWork], tuple[DiveProbe, dict[str, Any] | None]] = look
    measure: Callable[[DiveWork, DiveProbe, int], PieceResult] = measure_piece
    join: Callable[[DiveWork, DiveProbe, Sequence[PieceResult]], dict[str, Any]] = join


class Scheduler:
    """Scheduler that measures many dives with many processes.

    Parameters
    ----------
    works : sequence of (DiveWork, int)
        The dives with the sizes of their sources in bytes, in the order in which they are begun.
    workers : Workers
    observer : BatchObserver
    steps : Steps, optional
        In place of the real ones.
    """

    def __init__(
        self,
        works: Sequence[tuple[DiveWork, int]],
        workers: Workers,
        observer: BatchObserver,
        steps: Steps | None = None,
    ) -> None:
        self._workers, self._observer, self._steps = workers, observer, steps or Steps()
        self._dives = [_Dive(work, n_bytes) for work, n_bytes in works]
        self._new = deque(self._dives)
        self._ready: deque[tuple[_Task, Callable[..., Any], tuple[object, ...]]] = deque()
        self._n_under_way = 0
        self.records: dict[str, DiveRecord] = {}

    def run(self, is_stopped: Callable[[], bool]) -> dict[str, DiveRecord]:
        """Work until all is done, or it is stopped.

        Parameters
        ----------
        is_stopped : callable
            Asked several times a second.

        Returns
        -------
        records : dict
            Name to how the dive stands, of all dives.
        """
        for dive in self._dives:
            self._observer.expect(dive.n_bytes)
        while len(self.records) < len(self._dives) and not is_stopped():
            self._hand_over()
            outcome = self._workers.next_done(_WAIT_S)
            if outcome is not None:
                self._n_under_way -= 1
                self._take(outcome)
        for dive in self._dives:
            if not dive.is_done:
                name = dive.work.name
                self.records[name] = _record(dive, DiveState.UNFINISHED, "")
        return self.records

    def _hand_over(self) -> None:
        """Keep the processes busy: dives that were begun come before new ones."""
        most = _AHEAD * self._workers.n_slots
        while self._n_under_way < most and (self._ready or self._new):
            if not self._ready:
                self._begin(self._new.popleft())
            task, function, arguments = self._ready.popleft()
            if not self._is_stale(task):
                self._workers.submit(task, function, *arguments)
                self._n_under_way += 1

    def _begin(self, dive: _Dive) -> None:
        dive.n_beginnings += 1
        dive.results.clear()
        self._ready.append((_Task(dive, dive.n_beginnings), self._steps.look, (dive.work,)))

    def _measure(self, dive: _Dive, found: DiveProbe) -> None:
        dive.probe = found
        for piece in range(len(found.spans)):
            task = _Task(dive, dive.n_beginnings, piece)
            self._ready.append((task, self._steps.measure, (dive.work, found.only(piece), 0)))

    def _take(self, outcome: FinishedTask) -> None:
        task: _Task = outcome.token
        if self._is_stale(task):
            return
        if outcome.error is not None:
            self._mend(task.dive, outcome.error)
        elif task.dive.probe is None:
            self._probed(task.dive, *outcome.value)
        elif task.piece is not None:
            self._measured(task.dive, task.piece, outcome.value)
        else:
            self._end(
                task.dive,
                DiveRecord.of(
                    task.dive.work.name, task.dive.work.request.source, outcome.value, reused=False
                ),
            )

    def _probed(self, dive: _Dive, found: DiveProbe, facts: dict[str, Any] | None) -> None:
        self._expect(dive, found.n_bytes)
        if facts is None:
            self._measure(dive, found)
            return
        work = dive.work
        self._end(dive, DiveRecord.of(work.name, work.request.source, facts, reused=True))

    def _measured(self, dive: _Dive, piece: int, result: PieceResult) -> None:
        found = dive.probe
        if found is None:
            return
        dive.results[piece] = replace(result, number=piece)
        n_bytes = found.spans[piece].n_bytes
        if result.reused:
            self._expect(dive, dive.n_bytes - n_bytes)
        else:
            dive.n_bytes -= n_bytes
            self._observer.measured(n_bytes, result.n_frames)
        if len(dive.results) == len(found.spans):
            results = [dive.results[i] for i in range(len(found.spans))]
            # A dive that is nearly done comes first: its pieces can go.
            task = _Task(dive, dive.n_beginnings)
            self._ready.appendleft((task, self._steps.join, (dive.work, found, results)))

    def _mend(self, dive: _Dive, error: BaseException) -> None:
        """Retry the tasks that may succeed, and give up the others."""
        again = dive.n_beginnings < _MAX_BEGINNINGS
        if isinstance(error, UnlikeProbeError) and dive.probe is not None:
            if not dive.probe.is_whole:
                return self._as_whole(dive, str(error))
        elif isinstance(error, PieceLostError | WorkersLostError) and again:
            dive.probe = None
            return self._begin(dive)
        foreseen = isinstance(error, AqualvsError | WorkersLostError)
        words = str(error) if foreseen else f"{type(error).__name__}: {error}"
        drop_dive(dive.work.dataset, dive.work.name)
        return self._end(dive, _record(dive, DiveState.FAILED, words))

    def _as_whole(self, dive: _Dive, why: str) -> None:
        """Measure a dive in one piece after its pieces turned out to be unusable."""
        if dive.probe is None:
            return
        dive.n_beginnings += 1
        dive.results.clear()
        self._expect(dive, dive.probe.n_bytes)
        self._measure(dive, dive.probe.in_one_piece(why))

    def _end(self, dive: _Dive, record: DiveRecord) -> None:
        dive.is_done = True
        self.records[record.name] = record
        self._expect(dive, 0)
        self._observer.ended(record)

    def _expect(self, dive: _Dive, n_bytes: int) -> None:
        self._observer.expect(n_bytes - dive.n_bytes)
        dive.n_bytes = n_bytes

    @staticmethod
    def _is_stale(task: _Task) -> bool:
        return task.dive.is_done or task.beginning != task.dive.n_beginnings


def _record(dive: _Dive, state: DiveState, words: str) -> DiveRecord:
    work = dive.work
    return DiveRecord(name=work.name, source=work.request.source, state=state, words=words)
