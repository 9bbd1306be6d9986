"""One process at a time compiles a kernel; those that want the same one wait, and load it.

Several workers begin with the same kernels. Without a lock each compiles them, which takes minutes
of the processor, and all results but one are thrown away.
"""

import contextlib
import hashlib
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher


def compile_one_at_a_time() -> None:
    """Have this process wait for any other that compiles the same kernel."""
    if sys.platform == "win32":
        return
    folder = Path(tempfile.gettempdir()) / f"aqualvs-kernel-locks-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    plain = Dispatcher.compile

    def compile_kernel(self: Any, signature: Any) -> Any:
        # Numba's own lock first, which the threads of this process hold in turn: in the other order
        # two of them could wait for each other.
        with global_compiler_lock, locked(folder / _name(self)):
            return plain(self, signature)

    Dispatcher.compile = compile_kernel


def _name(dispatcher: Any) -> str:
    """Return a name that is the same in all processes, another for each function."""
    code = dispatcher.py_func.__code__
    where = f"{code.co_filename}:{code.co_firstlineno}:{code.co_qualname}"
    return hashlib.sha256(where.encode()).hexdigest()[:24]


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of a name, which ends with this process at the latest.

    Kernels are compiled within their callers, and calls go in one direction: no process waits for
    one that waits for it.
    """
    import fcntl

    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            # A copy of this process that was made meanwhile has the file open, too.
            fcntl.flock(file, fcntl.LOCK_UN)
