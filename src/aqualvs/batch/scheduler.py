"""Scheduler of a batch: worker processes, their next tasks, and the outcome of each.

Processes are on this machine, or those of a Dask scheduler (dask.distributed). Dask sends tasks to
processes, restarts a process that died, and gives its task to another. It is imported here and
nowhere else.

A dive is surveyed, measured piece by piece, and merged; failed tasks are tried again or given up.
Where the condition of the net is wanted, it is evaluated from the finished run and kept until
something that it depends on changes.
"""

import importlib
import logging
import os
import queue
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from aqualvs.batch.dataset import (
    OF_DIVE,
    OF_NET,
    drop,
    holds,
    put_net,
    read_manifest,
    read_valid_manifest,
    scratch,
    write_manifest,
)
from aqualvs.batch.dives import DiveRecord, DiveState
from aqualvs.batch.parts import PieceLostError, PieceResult, finished_dive, join_dive, measure_piece
from aqualvs.batch.work import DiveProbe, DiveWork, content_digest, digest, probe
from aqualvs.closing import Closing
from aqualvs.errors import AqualvsError, OptionError
from aqualvs.net_survey.command import StoredDive
from aqualvs.nets.target_file import NetRequest
from aqualvs.report.run_page import write_report
from aqualvs.results.files import writing
from aqualvs.results.folder import NET_FILES
from aqualvs.results.net_survey import read_run
from aqualvs.results.run_request import versions
from aqualvs.sources.spans import SpanMismatchError
from aqualvs.workers import start_method

_MAX_DEATHS = 20
"""A task that was under way in so many dying processes is given up by the scheduler."""

# Tasks take seconds: what Dask does many times a second for shorter ones only costs time.
_SETTINGS = {
    "distributed.scheduler.allowed-failures": _MAX_DEATHS,
    "distributed.scheduler.active-memory-manager.start": False,
    "distributed.scheduler.work-stealing-interval": "1s",
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.tick.cycle": "2s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.admin.system-monitor.gil.enabled": False,
}
_TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class FinishedTask:
    """A task that has ended."""

    token: Any  # As it was submitted.
    value: Any = None  # What it returned; None after an error.
    error: BaseException | None = None  # What it raised.


class WorkersLostError(Exception):
    """The processes that worked on a task died, again and again."""


class WorkersGoneError(AqualvsError):
    """There is no worker left, and none has come for minutes."""


class DaskWorkers(Closing):
    """Workers of a Dask scheduler; a context manager.

    `n_workers`: processes on this machine, each with one thread; None for one per core.
    `scheduler`: address of a scheduler whose workers are used instead. Raises `OptionError` if
    `distributed` is missing, or the scheduler does not answer.
    """

    def __init__(self, n_workers: int | None = None, scheduler: str | None = None) -> None:
        try:
            distributed: Any = importlib.import_module("distributed")
        except ImportError as fault:
            raise OptionError(
                "aqualvs batch needs distributed; install it with pip install 'aqualvs[batch]'"
            ) from fault
        self._killed: type[BaseException] = distributed.KilledWorker
        self._n_slots, self._count_again_s, self._seen_s = 1, 0.0, time.monotonic()
        self._ended: queue.SimpleQueue[tuple[object, Any]] = queue.SimpleQueue()
        self._cluster = None if scheduler else _local_cluster(distributed, n_workers)
        where = scheduler or self._cluster
        try:
            # Results come through this object, not through a file of the user's.
            self._client = distributed.Client(where, timeout=_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as fault:
            raise OptionError(
                f"--scheduler {scheduler}: does not answer ({fault}); check the address, such as "
                "tcp://192.168.1.10:8786"
            ) from fault

    @property
    def n_slots(self) -> int:
        """Tasks that can be under way at a time, at least one.

        Raises `WorkersGoneError` if there has been no worker for minutes.
        """
        now_s = time.monotonic()
        count_every_s = 5.0
        no_worker_s = 300.0
        if now_s >= self._count_again_s:
            # Machines may join a scheduler while a batch goes on; asking takes its time.
            n_slots = sum(self._client.nthreads().values())
            if n_slots:
                self._seen_s = now_s
            elif now_s > self._seen_s + no_worker_s:
                raise WorkersGoneError(
                    f"no worker for {no_worker_s:.0f} s; finished work is kept: check the workers "
                    "and run the same command again"
                )
            self._n_slots = max(1, n_slots)
            self._count_again_s = now_s + count_every_s
        return self._n_slots

    def submit(self, token: object, function: Callable[..., Any], *arguments: object) -> None:
        """Have a task done; the same task twice is done twice."""
        future = self._client.submit(function, *arguments, pure=False)
        future.add_done_callback(lambda ended: self._ended.put((token, ended)))

    def next_done(self, timeout_s: float) -> FinishedTask | None:
        """Return a task that has ended; None if none does within the time."""
        try:
            token, future = self._ended.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if future.status == "finished":
            return FinishedTask(token, value=future.result())
        error = future.exception() if future.status == "error" else None
        if error is None or isinstance(error, self._killed):
            error = WorkersLostError("its worker processes died repeatedly")
        return FinishedTask(token, error=error)

    def check_access(self, path: Path) -> None:
        """Raise unless every worker sees a file and has the same versions as this process.

        Raises `OptionError` if one does not.
        """
        mine, option = versions(), f"--scheduler {self._client.scheduler.address}"
        try:
            found: Mapping[str, Any] = self._client.run(_access, str(path))
        except Exception as fault:  # Dask words what workers raise in an exception of its own
            raise OptionError(
                f"{option}: a worker cannot take part ({fault}); install aqualvs[batch] of this "
                "version on its machine"
            ) from fault
        if not found:
            raise OptionError(f"{option}: has no workers yet; start some with 'dask worker'")
        for worker, (sees, theirs) in found.items():
            if not sees:
                raise OptionError(
                    f"{option}: worker {worker} does not see {path.parent}; "
                    "dives and results must lie where all machines find them under one path"
                )
            other = [name for name in mine if theirs.get(name) != mine[name]]
            if other:
                name = other[0]
                raise OptionError(
                    f"{option}: worker {worker} has {name} {theirs.get(name)}, this process has "
                    f"{mine[name]}; install the same versions"
                )

    def close(self) -> None:
        """Drop what is under way, and end the processes of this machine."""
        self._client.close()
        if self._cluster is not None:
            self._cluster.close(timeout=_TIMEOUT_S)


def _local_cluster(distributed: Any, n_workers: int | None) -> Any:
    import dask
    from dask.system import CPU_COUNT
    from distributed.system import MEMORY_LIMIT

    n_workers = n_workers or CPU_COUNT
    settings = dict(_SETTINGS)
    if start_method.can_fork():
        start_method.prepare(start_method.FOR_BATCHES)
        settings["distributed.worker.multiprocessing-method"] = "forkserver"
        # It would import whatever it can find, to have it in the server, which is there already.
        distributed.utils._forkserver_preload_set = True
    # A process that takes more is started again; one needs less than a third of it.
    memory_bytes = 2_000_000_000
    starts = 3
    # What Dask says of dying processes helps nobody: the task is done by another.
    with dask.config.set(settings), start_method.ignored_interrupts():
        for _ in range(starts):
            try:
                return distributed.LocalCluster(
                    n_workers=n_workers,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=min(memory_bytes, MEMORY_LIMIT // n_workers),
                    # Any free port, for this machine alone; Dask's own may be taken.
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                )
            except RuntimeError as fault:
                # A process died before it was there; on a busy machine that may happen once.
                cause = fault
        raise OptionError(
            f"--workers {n_workers}: the processes do not start ({cause}); "
            "take fewer, and see whether there is memory left"
        ) from cause


def _access(path: str) -> tuple[bool, dict[str, str]]:
    return Path(path).exists(), versions()


NET = "net"
"""Folder, below a dive's home, with the seal of its net's state."""


def with_net(work: DiveWork, key: str, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return a finished dive's facts with the condition of its net, evaluated now if it is wanted.

    `key` is that of the dive's result, `DiveProbe.key`, and `facts` are from `join_dive`. Added is
    `net`, as `net_dict` has it, where it is known, or `net_fault`, which says why not. The dive's
    own result stands in any case.
    """
    request = work.request.net
    if request is None:
        return dict(facts) | known_net(work.home, key)
    try:
        # All that a net's state depends on besides the dive's result.
        others = digest(asdict(request) | {"log": content_digest(request.log)})
        return dict(facts) | {"net": _state(work, f"{key}-{others}", request)}
    except AqualvsError as fault:
        return dict(facts) | {"net_fault": str(fault)}


def known_net(home: Path, key: str) -> dict[str, Any]:
    """Return the stored condition of a dive's net, as from `with_net`; empty if there is none.

    `home` is the dive's, `key` its result's; what was told of another result does not count.
    """
    found = read_manifest(home / NET)
    if found is None or not str(found["key"]).startswith(f"{key}-"):
        return {}
    return {"net": found["facts"]}


def _state(work: DiveWork, key: str, request: NetRequest) -> dict[str, Any]:
    """Return the summary of a net's state: the one that is there, or a new one."""
    out, home = work.request.out, work.home / NET
    found = read_valid_manifest(home, key, out)
    if found is not None and holds(work.dataset, work.name, OF_NET):
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


# Tasks handed over for each that can be under way, so that no process waits for the next.
_AHEAD = 3
_WAIT_S = 0.2


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
    # What the observer expects of it, and has not yet been reported as done.
    n_bytes: int
    probe: DiveProbe | None = None
    results: dict[int, PieceResult] = field(default_factory=dict)
    n_attempts: int = 0
    is_done: bool = False


@dataclass(frozen=True, slots=True)
class _Task:
    """A task under way; those of an attempt that was given up count no more."""

    dive: _Dive
    attempt: int
    piece: int | None = None


def look(work: DiveWork) -> tuple[DiveProbe, dict[str, Any] | None]:
    """Look at a dive; returns its survey, and its facts if an earlier batch has finished it.

    Then the state of its net is told, if it is wanted and has not been.

    Raises `AqualvsError` if the dive or its rig cannot be used.
    """
    found = probe(work)
    facts = finished_dive(work, found)
    return found, None if facts is None else with_net(work, found.key, facts)


def join(work: DiveWork, found: DiveProbe, results: Sequence[PieceResult]) -> dict[str, Any]:
    """Merge as `join_dive` does, and evaluate the dive's net if it is wanted."""
    return with_net(work, found.key, join_dive(work, found, results))


@dataclass(frozen=True, slots=True)
class Steps:
    """Tasks of a dive, in the order in which the processes do them."""

    # As `look`, `measure_piece` and `join`.
    look: Callable[[DiveWork], tuple[DiveProbe, dict[str, Any] | None]] = look
    measure: Callable[[DiveWork, DiveProbe], PieceResult] = measure_piece
    join: Callable[[DiveWork, DiveProbe, Sequence[PieceResult]], dict[str, Any]] = join


class Scheduler:
    """Scheduler that measures many dives with many processes.

    `works` are the dives with the sizes of their sources in bytes, in the order in which they are
    begun, and `steps` stand in place of the real ones.
    """

    def __init__(
        self,
        works: Sequence[tuple[DiveWork, int]],
        workers: DaskWorkers,
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
        """Work until all is done, or `is_stopped`, which is asked several times a second.

        Returns how all dives stand, by name.
        """
        for dive in self._dives:
            self._observer.expect(dive.n_bytes)
        while len(self.records) < len(self._dives) and not is_stopped():
            self._submit_ready()
            outcome = self._workers.next_done(_WAIT_S)
            if outcome is not None:
                self._n_under_way -= 1
                self._receive(outcome)
        for dive in self._dives:
            if not dive.is_done:
                name = dive.work.name
                self.records[name] = _record(dive, DiveState.UNFINISHED, "")
        return self.records

    def _submit_ready(self) -> None:
        """Keep the processes busy: dives that were begun come before new ones."""
        most = _AHEAD * self._workers.n_slots
        while self._n_under_way < most and (self._ready or self._new):
            if not self._ready:
                self._start(self._new.popleft())
            task, function, arguments = self._ready.popleft()
            if not self._is_stale(task):
                self._workers.submit(task, function, *arguments)
                self._n_under_way += 1

    def _start(self, dive: _Dive) -> None:
        dive.n_attempts += 1
        dive.results.clear()
        self._ready.append((_Task(dive, dive.n_attempts), self._steps.look, (dive.work,)))

    def _measure(self, dive: _Dive, found: DiveProbe) -> None:
        dive.probe = found
        for piece in range(len(found.spans)):
            task = _Task(dive, dive.n_attempts, piece)
            self._ready.append((task, self._steps.measure, (dive.work, found.only(piece))))

    def _receive(self, outcome: FinishedTask) -> None:
        task: _Task = outcome.token
        if self._is_stale(task):
            return
        if outcome.error is not None:
            self._handle_error(task.dive, outcome.error)
        elif (found := task.dive.probe) is None:
            found, facts = outcome.value
            self._expect(task.dive, found.n_bytes)
            if facts is None:
                self._measure(task.dive, found)
            else:
                self._finish(task.dive, facts, reused=True)
        elif task.piece is not None:
            self._measured(task.dive, found, task.piece, outcome.value)
        else:
            self._finish(task.dive, outcome.value, reused=False)

    def _measured(self, dive: _Dive, found: DiveProbe, piece: int, result: PieceResult) -> None:
        dive.results[piece] = result
        n_bytes = found.spans[piece].n_bytes
        if result.reused:
            self._expect(dive, dive.n_bytes - n_bytes)
        else:
            dive.n_bytes -= n_bytes
            self._observer.measured(n_bytes, result.n_frames)
        if len(dive.results) == len(found.spans):
            results = [dive.results[i] for i in range(len(found.spans))]
            # A dive that is nearly done comes first: its pieces can go.
            task = _Task(dive, dive.n_attempts)
            self._ready.appendleft((task, self._steps.join, (dive.work, found, results)))

    def _handle_error(self, dive: _Dive, error: BaseException) -> None:
        """Retry the tasks that may succeed, and give up the others."""
        # Attempts at a dive; each costs only what is not finished.
        max_attempts = 3
        again = dive.n_attempts < max_attempts
        if isinstance(error, SpanMismatchError) and dive.probe is not None:
            if not dive.probe.is_whole:
                dive.n_attempts += 1
                dive.results.clear()
                self._expect(dive, dive.probe.n_bytes)
                return self._measure(dive, dive.probe.in_one_piece(str(error)))
        elif isinstance(error, PieceLostError | WorkersLostError) and again:
            dive.probe = None
            return self._start(dive)
        foreseen = isinstance(error, AqualvsError | WorkersLostError)
        words = str(error) if foreseen else f"{type(error).__name__}: {error}"
        drop(dive.work.dataset, dive.work.name, (*OF_DIVE, *OF_NET))
        return self._end(dive, _record(dive, DiveState.FAILED, words))

    def _finish(self, dive: _Dive, facts: Mapping[str, Any], *, reused: bool) -> None:
        work = dive.work
        self._end(dive, DiveRecord.of(work.name, work.request.source, facts, reused=reused))

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
        return task.dive.is_done or task.attempt != task.dive.n_attempts


def _record(dive: _Dive, state: DiveState, words: str) -> DiveRecord:
    work = dive.work
    return DiveRecord(name=work.name, source=work.request.source, state=state, words=words)
