"""How processes that measure begin; to be imported before anything heavy."""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

FOR_RUNS = ("aqualvs.app.crew_work",)
FOR_BATCHES = ("distributed.nanny", "aqualvs.app.batch.season")
"""What the processes of a run, and those of a batch, import first."""


def prepare(modules: tuple[str, ...]) -> None:
    """Begin the process that others are copied from, where the system has such a thing.

    It imports what they need while this process imports what it needs itself.
    """
    if has_server():
        from multiprocessing import forkserver

        context().set_forkserver_preload(list(modules))
        with deaf_to_interrupts():
            forkserver.ensure_running()


def context() -> "ForkServerContext | SpawnContext":
    """Return how processes begin: as copies of one that has done nothing but import.

    A copy of this process would begin faster still, but with the locks of threads that it lacks:
    of OpenCV's, for example.
    """
    if has_server():
        return multiprocessing.get_context("forkserver")
    return multiprocessing.get_context("spawn")


def n_cores() -> int:
    """Return how many processes can work at a time on this machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def has_server() -> bool:
    """Return whether the system copies a process that has imported much.

    Libraries of macOS do not bear it once they are loaded, and Windows cannot.
    """
    return sys.platform == "linux"


@contextlib.contextmanager
def deaf_to_interrupts() -> Iterator[None]:
    """Let no thread or process that is begun here, or by one of these, hear Ctrl-C.

    A terminal sends it to all processes; this one decides what becomes of the others.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    from multiprocessing import resource_tracker

    # Begun later, it would have the thread that begins it hear again.
    resource_tracker.ensure_running()
    heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, heard)
