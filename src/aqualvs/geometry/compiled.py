"""Typed decorators for Numba: every compiled kernel of the project uses one of them.

Kernels round after every operation, in the order in which it is written, as Python does. If LLVM
fused or reordered operations, the last bits of a result would depend on the processor, on the
alignment of arrays, and on the caller for which a kernel was compiled: a dive measured on several
machines, or by several processes, would differ from the same dive measured by one.
"""

import contextlib
import functools
import os
import threading
import time
import types
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

# Numba colours every message that it might report: with colorama installed, as on Windows, that
# takes a twentieth of the compile time.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import numba
import numpy as np
from numba.extending import overload, typeof_impl
from numpy.typing import NDArray

ZERO = cast(int, np.int64(0))
"""Initial value of a count that kernels pass to others; for a literal 0 Numba would compile these
once more."""

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a batch kernel; the machine code is cached on disk for the next process."""
    return _compiled(function)


def borrowing_kernel(function: F) -> F:
    """Compile a batch kernel that creates no arrays, without reference counting.

    Counting references to arrays at every call of a small function, or for every row of an array,
    can take longer than the work itself. Compilation fails where an array is created.
    """
    return _compiled(function, _nrt=False)


def lazy_kernel(function: F) -> F:
    """Compile a batch kernel only after Python has run it for a while; short runs never compile it.

    Compiling a kernel for a few hundred candidates takes as long as Python needs for a hundred
    frames of them. Both give the same bits if the kernel uses only loops, arithmetic of 64-bit
    numbers (NumPy's narrower integers wrap around where compiled code widens them), and functions
    that round alike (`squared` and `hypot` of `linear_algebra`, not `x**2` and `math.hypot`).
    """
    return cast(F, _LazyKernel(function, {}))


def lazy_borrowing_kernel(function: F) -> F:
    """Compile a `borrowing_kernel` as late as a `lazy_kernel`."""
    return cast(F, _LazyKernel(function, {"_nrt": False}))


@contextlib.contextmanager
def compiled_at_once() -> Iterator[None]:
    """Make this thread compile lazy kernels at their first call, before work that must not wait."""
    before = _interpreter.is_allowed
    _interpreter.is_allowed = False
    try:
        yield
    finally:
        _interpreter.is_allowed = before


def inner_kernel(function: F) -> F:
    """Compile a function that is called by kernels, and hardly ever by Python.

    For kernels it is compiled without the wrapper for calls from Python, which converts arguments
    and result and is a third of the code of a small function. The machine code becomes part of the
    kernels that call it. The first call from Python compiles it once more.
    """
    return _inner(function)


def inner_borrowing_kernel(function: F) -> F:
    """Compile an `inner_kernel` without reference counting, as a `borrowing_kernel`."""
    return _inner(function, _nrt=False)


def inline_kernel(function: F) -> F:
    """Compile an `inner_kernel` that LLVM always inlines: a scalar function."""
    return _inner(function, forceinline=True)


def inline_borrowing_kernel(function: F) -> F:
    """Compile an `inline_kernel` without reference counting, which borrowing kernels may call."""
    return _inner(function, forceinline=True, _nrt=False)


def is_cached_on_disk(kernel: Callable[..., Any]) -> bool:
    """Return whether the machine code of a kernel is cached on disk for the next process."""
    return _cache_file(kernel) is not None


def python_of(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return the uncompiled Python function of a kernel.

    A scalar kernel without branches works on arrays, too, in this form.
    """
    function: Callable[..., Any] = cast(Any, kernel).py_func
    return function


def dispatch_by_class(kernels: Mapping[type, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a function that kernels call in place of one of several inline kernels.

    The class of the first argument, a named tuple, selects the kernel when the caller is compiled:
    there is no branch at run time, and the other kernels are not compiled.
    """

    def stand_in(*arguments: Any) -> Any:
        raise TypeError(f"only kernels can call what is dispatched by class, not {arguments!r}")

    def choose(*arguments: Any) -> Any:
        chosen: Any = kernels.get(getattr(arguments[0], "instance_class", type(None)))
        return None if chosen is None else chosen.py_func

    overload(stand_in, strict=False, jit_options={**_OPTIONS, "forceinline": True})(choose)
    stand_in._stands_for = tuple(kernels.values())  # type: ignore[attr-defined]
    return stand_in


# Without the wrapper for calls from C, which nothing here makes.
_OPTIONS = {"error_model": "numpy", "nogil": True, "fastmath": False, "no_cfunc_wrapper": True}


def _compiled(function: F, **options: object) -> F:
    options = {**_OPTIONS, **options}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        # Numba has no cache folder: neither the package's nor the user's is writable.
        return cast(F, numba.njit(**options)(function))
    _depend_on_callees(compiled, repr(sorted(options.items())))
    return cast(F, compiled)


class _Interpreter(threading.local):
    """State of a thread: whether Python may run lazy kernels, and whether it is running one now.

    The kernels that an interpreted kernel calls are interpreted as well.
    """

    is_allowed = True
    runs = False


_interpreter = _Interpreter()

_LAZY_S_PER_BYTE = 1e-4
"""CPU time for which Python runs a lazy kernel in a process, for each byte of bytecode of it and
its callees: a quarter of the compile time (3 kB and 1.2 s in the median of 22 kernels)."""


class _Kernel:
    """A function that is compiled on demand: most programs call few kernels that they import."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, object]) -> None:
        functools.update_wrapper(cast(Any, self), function)
        self.py_func = function
        self._options = options
        _stamp_of(function.__code__.co_filename)


class _LazyKernel(_Kernel):
    """A function that Python runs for a while before it is compiled, unless its code is on disk."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, object]) -> None:
        super().__init__(function, options)
        self._run = self._run_first
        self._left_s = 0.0

    def __call__(self, *arguments: Any) -> Any:
        return self._run(*arguments)

    @functools.cached_property
    def _compiled(self) -> Callable[..., Any]:
        return _compiled(self.py_func, **self._options)

    def _run_first(self, *arguments: Any) -> Any:
        file = _cache_file(self._compiled)
        if file is not None and file._load_index():
            self._run = self._compiled
        else:
            self._left_s = _LAZY_S_PER_BYTE * _n_bytes(self.py_func, set())
            self._run = self._interpret
        return self._run(*arguments)

    def _interpret(self, *arguments: Any) -> Any:
        if _interpreter.runs:
            return self.py_func(*arguments)
        if self._left_s > 0.0 and _interpreter.is_allowed:
            return self._run_by_python(arguments)
        with _turn_to_compile(self.py_func) as has_turn:
            if has_turn or not _interpreter.is_allowed:
                self._run = self._compiled
                return self._run(*arguments)
        return self._run_by_python(arguments)

    def _run_by_python(self, arguments: tuple[Any, ...]) -> Any:
        started = time.thread_time()
        written = [(array, array.copy()) for array in _arrays(arguments) if array.flags.writeable]
        _interpreter.runs = True
        try:
            with np.errstate(all="ignore"):
                return _native(self.py_func(*arguments))
        except Exception:
            # Python raises where compiled code goes on, as in division of a Python number by zero:
            # undo what was written, and run the compiled kernel.
            for array, before in written:
                array[...] = before
        finally:
            _interpreter.runs = False
            self._left_s -= time.thread_time() - started
        return self._compiled(*arguments)


@contextlib.contextmanager
def _turn_to_compile(function: Callable[..., Any]) -> Iterator[bool]:
    """Yield whether no other process is compiling a kernel of the same module.

    Processes that share a dive need the same kernels at the same time: each compiles those of
    another module, and loads the rest from disk later.
    """
    has_turn = True
    with contextlib.ExitStack() as stack:
        try:
            import fcntl

            source = stack.enter_context(Path(function.__code__.co_filename).open("rb"))
            fcntl.flock(source, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            has_turn = False
        except (ImportError, OSError):
            # Without locks, as on Windows, each process compiles for itself.
            pass
        yield has_turn


def _n_bytes(function: Callable[..., Any], counted: set[Callable[..., Any]]) -> int:
    """Return the size of the bytecode of a kernel and of the kernels that it calls."""
    if function in counted:
        return 0
    counted.add(function)
    code = function.__code__
    named: Iterator[Any] = (function.__globals__.get(name) for name in code.co_names)
    callees = [one.py_func for one in named if hasattr(one, "py_func")]
    return len(code.co_code) + sum(_n_bytes(callee, counted) for callee in callees)


def _arrays(arguments: tuple[Any, ...]) -> Iterator[NDArray[Any]]:
    """Yield the arrays among arguments and in tuples of them."""
    for one in arguments:
        if isinstance(one, np.ndarray):
            yield one
        elif isinstance(one, tuple):
            yield from _arrays(one)


def _native(result: Any) -> Any:
    """Return the result of a kernel with NumPy's scalars as Python's, as compiled code returns."""
    if isinstance(result, np.generic):
        return result.item()
    if isinstance(result, tuple):
        items = map(_native, result)
        return type(result)(*items) if hasattr(result, "_fields") else tuple(items)
    return result


class _InnerKernel(_Kernel):
    """A function that is compiled once for kernels, and once more if Python calls it."""

    def __call__(self, *arguments: Any) -> Any:
        run = self.py_func if _interpreter.runs else self._for_python
        return run(*arguments)

    # Kernels that are loaded from disk already contain its code.
    @functools.cached_property
    def _for_kernels(self) -> Callable[..., Any]:
        return _compiled(self.py_func, no_cpython_wrapper=True, **self._options)

    @functools.cached_property
    def _for_python(self) -> Callable[..., Any]:
        # Numba names cache files by qualified name: under the same one, a process could load the
        # code without a wrapper for Python, and crash.
        f = self.py_func
        own = types.FunctionType(
            f.__code__, f.__globals__, f.__name__, f.__defaults__, f.__closure__
        )
        functools.update_wrapper(own, f)
        own.__qualname__ += "_for_python"
        return _compiled(own, **self._options)


typeof_impl.register(_InnerKernel)(lambda inner, _: numba.typeof(inner._for_kernels))
typeof_impl.register(_LazyKernel)(lambda lazy, _: numba.typeof(lazy._compiled))


def _inner(function: F, **options: object) -> F:
    return cast(F, _InnerKernel(function, options))


def _depend_on_callees(compiled: Any, options: str) -> None:
    """Invalidate cached machine code if its options or the files of kernels it may call change.

    Numba compares only the stamp of the function's own file, so a change in an inlined kernel of
    another module would leave stale machine code in use. All kernels that the module imports
    count, whether this function calls them or not.
    """
    own = _cache_file(compiled)
    if own is None:
        return
    files = sorted(_files_of_kernels(compiled.py_func))
    own._source_stamp = (options, *map(_stamp_of, files))
    own._load_index = _without_stale_classes(own._load_index)


def _files_of_kernels(function: Callable[..., Any]) -> frozenset[str]:
    """Return the files of the kernels that a kernel's module defines or imports, recursively."""
    path = function.__code__.co_filename
    if path not in _files:
        named = list(function.__globals__.values())
        kernels = [one for value in named for one in getattr(value, "_stands_for", (value,))]
        others = {
            one.py_func.__code__.co_filename: one.py_func
            for one in kernels
            if hasattr(one, "py_func")
        }
        others.pop(path, None)
        _files[path] = frozenset({path}.union(*map(_files_of_kernels, others.values())))
    return _files[path]


_files: dict[str, frozenset[str]] = {}


@functools.cache
def _stamp_of(path: str) -> tuple[int, int]:
    """Return modification time (ns) and size of a file when its first kernel was imported.

    The file may be edited after that, before the imported code is compiled.
    """
    status = os.stat(path)
    return status.st_mtime_ns, status.st_size


def _without_stale_classes(load_index: Callable[[], Any]) -> Callable[[], Any]:
    """Return a loader of a cache index that is empty if it names classes that no longer exist.

    Numba unpickles the index, with the types of arguments, before it compares stamps: after an
    upgrade that renames such a class, every run would end with a traceback.
    """

    def load() -> Any:
        try:
            return load_index()
        except (AttributeError, ImportError):
            return {}

    return load


def _cache_file(compiled: Any) -> Any:
    """Return Numba's record of the cache of a compiled function, None for anything else."""
    return getattr(getattr(compiled, "_cache", None), "_cache_file", None)
