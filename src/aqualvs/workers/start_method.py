"""Start methods of the measuring processes; light to import."""

import contextlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.context import ForkContext, ForkServerContext, SpawnContext


FOR_BATCHES = ("distributed.nanny", "aqualvs.batch.scheduler")
"""Modules that the processes of a batch import first."""


def prepare(modules: tuple[str, ...]) -> None:
    """Start the server that worker processes are forked from, on systems that have one.

    It imports `modules` while this process goes on with its own imports.
    """
    if can_fork():
        from multiprocessing import forkserver

        multiprocessing.get_context("forkserver").set_forkserver_preload(list(modules))
        with ignored_interrupts():
            forkserver.ensure_running()


def context() -> "ForkContext | ForkServerContext | SpawnContext":
    """Return the start method: if possible, copies of this process with all its imports.

    Copies are impossible where this process has threads, those of libraries included: a copy would
    have their locks, but not the threads that release them.
    """
    if not can_fork():
        return multiprocessing.get_context("spawn")
    if n_threads() == 1:
        return multiprocessing.get_context("fork")
    return multiprocessing.get_context("forkserver")


def n_threads() -> int | None:
    """Return how many threads this process has, those of libraries included; None if unknown."""
    try:
        return len(os.listdir("/proc/self/task"))
    except OSError:
        return None


def n_cores() -> int:
    """Return how many processes can work at a time on this machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def can_fork() -> bool:
    """Return whether the system can fork a process that has loaded many libraries.

    Libraries of macOS fail in a fork once they are loaded, and Windows has no fork.
    """
    return sys.platform == "linux"


@contextlib.contextmanager
def ignored_interrupts() -> Iterator[None]:
    """Ignore Ctrl-C in all threads and processes started here, and in their own.

    A terminal sends it to all processes; this one decides what becomes of the others.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    from multiprocessing import resource_tracker

    # Started later, it would unblock the signal in the starting thread.
    resource_tracker.ensure_running()
    with blocked_interrupts():
        yield


@contextlib.contextmanager
def blocked_interrupts() -> Iterator[None]:
    """Block Ctrl-C; copies of this process that are started here never receive it."""
    heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, heard)
