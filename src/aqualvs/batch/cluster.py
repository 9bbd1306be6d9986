"""Worker processes of a batch: on this machine, or of a Dask scheduler (dask.distributed).

Dask sends tasks to processes, restarts a process that died, and gives its task to another. It is
imported here and nowhere else.
"""

import logging
import queue
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from aqualvs.closing import Closing
from aqualvs.errors import AqualvsError, OptionError
from aqualvs.results.run_request import versions
from aqualvs.workers import start_method

_MEMORY_BYTES = 2_000_000_000
"""A process that takes more is started again; one needs less than a third of it."""

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
_COUNT_EVERY_S = 5.0
_NO_WORKER_S = 300.0
_STARTS = 3


@dataclass(frozen=True, slots=True)
class FinishedTask:
    """A task that has ended.

    Attributes
    ----------
    token : object
        As it was submitted.
    value : object
        What it returned; None after an error.
    error : Exception or None
        What it raised.
    """

    token: Any
    value: Any = None
    error: BaseException | None = None


class WorkersLostError(Exception):
    """The processes that worked on a task died, again and again."""


class WorkersGoneError(AqualvsError):
    """There is no worker left, and none has come for minutes."""


class Workers(Protocol):
    """Pool of processes that take tasks."""

    @property
    def n_slots(self) -> int:
        """Tasks that can be under way at a time."""

    def submit(self, token: object, function: Callable[..., Any], *arguments: object) -> None:
        """Have a task done."""

    def next_done(self, timeout_s: float) -> FinishedTask | None:
        """Return a task that has ended; None if none does within the time."""


class DaskWorkers(Closing):
    """Workers of a Dask scheduler; a context manager.

    Parameters
    ----------
    n_workers : int or None
        Processes on this machine, each with one thread; None for one per core.
    scheduler : str or None
        Address of a scheduler whose workers are used instead.

    Raises
    ------
    OptionError
        If `distributed` is missing, or the scheduler does not answer.
    """

    def __init__(self, n_workers: int | None = None, scheduler: str | None = None) -> None:
        distributed = _distributed()
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

        Raises
        ------
        WorkersGoneError
            If there has been no worker for minutes.
        """
        now_s = time.monotonic()
        if now_s >= self._count_again_s:
            # Machines may join a scheduler while a batch goes on; asking takes its time.
            n_slots = sum(self._client.nthreads().values())
            if n_slots:
                self._seen_s = now_s
            elif now_s > self._seen_s + _NO_WORKER_S:
                raise WorkersGoneError(
                    f"no worker has been there for {_NO_WORKER_S:.0f} s; what is finished is kept, "
                    "see to the workers and run the same command again"
                )
            self._n_slots = max(1, n_slots)
            self._count_again_s = now_s + _COUNT_EVERY_S
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
            error = WorkersLostError("the processes that worked on it died, again and again")
        return FinishedTask(token, error=error)

    def check_sight(self, path: Path) -> None:
        """Raise unless every worker sees a file and has the same versions as this process.

        Raises
        ------
        OptionError
            If one does not.
        """
        mine, option = versions(), f"--scheduler {self._client.scheduler.address}"
        try:
            found: Mapping[str, Any] = self._client.run(_sight, str(path))
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


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as fault:
        raise OptionError(
            "aqualvs batch needs distributed; install it with pip install 'aqualvs[batch]'"
        ) from fault
    return distributed


def _local_cluster(distributed: Any, n_workers: int | None) -> Any:
    import dask
    from dask.system import CPU_COUNT
    from distributed.system import MEMORY_LIMIT

    n_workers = n_workers or CPU_COUNT
    settings = dict(_SETTINGS)
    if start_method.has_server():
        start_method.prepare(start_method.FOR_BATCHES)
        settings["distributed.worker.multiprocessing-method"] = "forkserver"
        # It would import whatever it can find, to have it in the server, which is there already.
        distributed.utils._forkserver_preload_set = True
    # What Dask says of dying processes helps nobody: the task is done by another.
    with dask.config.set(settings), start_method.deaf_to_interrupts():
        for _ in range(_STARTS):
            try:
                return distributed.LocalCluster(
                    n_workers=n_workers,
                    threads_per_worker=1,
                    processes=True,
                    memory_limit=min(_MEMORY_BYTES, MEMORY_LIMIT // n_workers),
                    # Any free port, for this machine alone; Dask's own may be taken.
                    dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                )
            except RuntimeError as fault:
                # A process died before it was there; on a busy machine that may happen once.
                trouble = fault
        raise OptionError(
            f"--workers {n_workers}: the processes do not start ({trouble}); "
            "take fewer, and see whether there is memory left"
        ) from trouble


def _sight(path: str) -> tuple[bool, dict[str, str]]:
    return Path(path).exists(), versions()
