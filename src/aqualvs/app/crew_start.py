"""How the processes of a crew begin; to be imported before anything heavy."""

import multiprocessing
import os
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from multiprocessing.context import ForkServerContext, SpawnContext

_HEAVY = ["aqualvs.app.crew_work"]


def prepare() -> None:
    """Begin the process that others are copied from, where the system has such a thing.

    It imports what they need while this process imports what it needs itself.
    """
    if _has_server():
        from multiprocessing import forkserver

        context().set_forkserver_preload(_HEAVY)
        forkserver.ensure_running()


def context() -> "ForkServerContext | SpawnContext":
    """Return how processes begin: as copies of one that has done nothing but import.

    A copy of this process would begin faster still, but with the locks of threads that it lacks:
    of OpenCV's, for example.
    """
    if _has_server():
        return multiprocessing.get_context("forkserver")
    return multiprocessing.get_context("spawn")


def n_cores() -> int:
    """Return how many processes can work at a time on this machine."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _has_server() -> bool:
    return sys.platform != "win32"
