"""A typed door to Numba: every compiled kernel of the project goes through `kernel`.

Kernels round after every operation, in the order in which it is written, as Python does. Were LLVM
free to fuse and to reorder, the last bits of a result would depend on the processor, on where
arrays lie in memory, and on which of its callers a kernel was compiled for: a dive measured on
several machines, or by several processes, would not equal the same dive measured by one.
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

# Numba prepares colours for every error that it might report: where colorama is installed, as on
# Windows, that is a twentieth of its compiling.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import numba
import numpy as np
from numba.extending import overload, typeof_impl
from numpy.typing import NDArray

ZERO = cast(int, np.int64(0))
"""Initial value of a count that kernels pass on and get back; they would be compiled once more for
a literal 0."""

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a batch kernel; the machine code is cached on disk for the next process."""
    return _compiled(function)


def borrowing_kernel(function: F) -> F:
    """Compile a batch kernel that only borrows its arrays and creates none.

    Counting references to arrays at every call of a small function, or for every row that is
    looked at, can take longer than the work itself. Compilation fails where an array is created.
    """
    return _compiled(function, _nrt=False)


def lazy_kernel(function: F) -> F:
    """Compile a batch kernel once Python has run it for a while; most first runs need no more.

    Compiling what measures a few hundred candidates takes as long as Python needs for a hundred
    frames of them. Both give the same bits for kernels that keep to loops, to arithmetic of 64-bit
    numbers (NumPy's narrower integers wrap around where compiled code widens them), and to
    functions that round alike (`squared` and `hypot` of `linear_algebra`, not `x**2` and
    `math.hypot`).
    """
    return cast(F, _LazyKernel(function, {}))


def lazy_borrowing_kernel(function: F) -> F:
    """Compile a `borrowing_kernel` when its calls have taken a while, as a `lazy_kernel`."""
    return cast(F, _LazyKernel(function, {"_nrt": False}))


@contextlib.contextmanager
def compiled_at_once() -> Iterator[None]:
    """Have this thread compile lazy kernels when first called, before work that must not wait."""
    before = _interpreter.is_allowed
    _interpreter.is_allowed = False
    try:
        yield
    finally:
        _interpreter.is_allowed = before


def inner_kernel(function: F) -> F:
    """Compile a function that kernels call, and Python hardly ever.

    Within kernels it is compiled without what calls from Python need: the conversion of every
    argument and of the result, which makes a third of the code of a small function. The machine
    code is part of the kernels that call it. From Python it is compiled once more.
    """
    return _inner(function)


def inner_borrowing_kernel(function: F) -> F:
    """Compile an `inner_kernel` that only borrows its arrays, as a `borrowing_kernel` does."""
    return _inner(function, _nrt=False)


def inline_kernel(function: F) -> F:
    """Compile an `inner_kernel` that LLVM always inlines: a scalar function."""
    return _inner(function, forceinline=True)


def inline_borrowing_kernel(function: F) -> F:
    """Compile an `inline_kernel` that borrowing kernels call."""
    return _inner(function, forceinline=True, _nrt=False)


def keeps_code(kernel: Callable[..., Any]) -> bool:
    """Return whether the machine code of a kernel is kept on disk for the next process."""
    return _cache_file(kernel) is not None


def python_of(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return the Python function that a kernel is compiled from.

    It takes numbers of NumPy, and arrays where it has no branches, and need not be compiled.
    """
    function: Callable[..., Any] = cast(Any, kernel).py_func
    return function


def chosen_by_class(kernels: Mapping[type, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a function for kernels to call that stands for one of several inline kernels.

    The class of the first argument, a named tuple, chooses among them when the caller is compiled:
    nothing is decided, and nothing of the others is compiled, at run time.
    """

    def stand_in(*arguments: Any) -> Any:
        raise TypeError(f"only kernels can call what is chosen by class, not {arguments!r}")

    def choose(*arguments: Any) -> Any:
        chosen: Any = kernels.get(getattr(arguments[0], "instance_class", type(None)))
        return None if chosen is None else chosen.py_func

    overload(stand_in, strict=False, jit_options={**_OPTIONS, "forceinline": True})(choose)
    stand_in._stands_for = tuple(kernels.values())  # type: ignore[attr-defined]
    return stand_in


# C code, which the wrapper left out would serve, calls no kernel.
_OPTIONS = {"error_model": "numpy", "nogil": True, "fastmath": False, "no_cfunc_wrapper": True}


def _compiled(function: F, **options: object) -> F:
    options = {**_OPTIONS, **options}
    try:
        compiled = numba.njit(cache=True, **options)(function)
    except RuntimeError:
        # Numba finds no folder for its code: neither the package's nor the user's can be written.
        return cast(F, numba.njit(**options)(function))
    _depend_on_callees(compiled, repr(sorted(options.items())))
    return cast(F, compiled)


class _Interpreter(threading.local):
    """State of a thread: whether Python may run lazy kernels, and whether it runs one now.

    All that a kernel calls is run by the same means.
    """

    is_allowed = True
    runs = False


_interpreter = _Interpreter()

_LAZY_S_PER_BYTE = 1e-4
"""CPU time for which Python runs a lazy kernel in a process, for each byte of Python's code for it
and its callees: a quarter of what compiling takes (3 kB and 1.2 s in the median of 22 kernels)."""


class _LazyKernel:
    """A function that Python runs for a while before it is compiled, unless its code is on disk."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, object]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._options = options
        _stamp_of(function.__code__.co_filename)
        self._run = self._run_first
        self._left_s = 0.0

    def __call__(self, *arguments: Any) -> Any:
        return self._run(*arguments)

    # Most programs call few of the kernels that they import.
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
            # Compiled code goes on where Python raises, as in dividing one of its own numbers by
            # zero.
            for array, before in written:
                array[...] = before
        finally:
            _interpreter.runs = False
            self._left_s -= time.thread_time() - started
        return self._compiled(*arguments)


@contextlib.contextmanager
def _turn_to_compile(function: Callable[..., Any]) -> Iterator[bool]:
    """Yield whether no other process is compiling a kernel of the same module.

    The processes that share a dive want the same kernels at the same time. So each compiles others,
    and finds the rest on disk later.
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
    """Return the length of Python's code for a kernel and for the kernels that it calls."""
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
    """Return what a kernel returned with Python's numbers, as compiled code gives them."""
    if isinstance(result, np.generic):
        return result.item()
    if isinstance(result, tuple):
        items = map(_native, result)
        return type(result)(*items) if hasattr(result, "_fields") else tuple(items)
    return result


class _InnerKernel:
    """A function that is compiled once for kernels, and once more if Python calls it."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, object]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._options = options
        _stamp_of(function.__code__.co_filename)

    def __call__(self, *arguments: Any) -> Any:
        run = self.py_func if _interpreter.runs else self._for_python
        return run(*arguments)

    # Kernels that are on disk contain it.
    @functools.cached_property
    def _for_kernels(self) -> Callable[..., Any]:
        return _compiled(self.py_func, no_cpython_wrapper=True, **self._options)

    @functools.cached_property
    def _for_python(self) -> Callable[..., Any]:
        # Numba names files on disk by functions: under one name, a process could load the code
        # without an entry for Python, and jump nowhere.
        function = self.py_func
        own = types.FunctionType(
            function.__code__,
            function.__globals__,
            function.__name__,
            function.__defaults__,
            function.__closure__,
        )
        functools.update_wrapper(own, function)
        own.__qualname__ += "_for_python"
        return _compiled(own, **self._options)


def _type_of_inner(inner: _InnerKernel, _: object) -> Any:
    return numba.typeof(inner._for_kernels)


def _type_of_lazy(lazy: _LazyKernel, _: object) -> Any:
    return numba.typeof(lazy._compiled)


typeof_impl.register(_InnerKernel)(_type_of_inner)
typeof_impl.register(_LazyKernel)(_type_of_lazy)


def _inner(function: F, **options: object) -> F:
    return cast(F, _InnerKernel(function, options))


def _depend_on_callees(compiled: Any, options: str) -> None:
    """Make machine code on disk depend on its options and the files of kernels that it may call.

    Numba compares only the stamp of the function's own file, so a change in an inlined kernel of
    another module would leave stale machine code in use. Counted are all kernels that the module
    has imported, whether this function calls them or not.
    """
    own = _cache_file(compiled)
    if own is None:
        return
    files = sorted(_files_of_kernels(compiled.py_func))
    own._source_stamp = (options, *map(_stamp_of, files))
    own._load_index = _forgiving(own._load_index)


def _files_of_kernels(function: Callable[..., Any]) -> frozenset[str]:
    """Return the files of the kernels that a kernel's module has or has imported, and of theirs."""
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
    """Return the stamp of a file as it was when its first kernel was imported.

    It may be edited before a kernel is compiled, from the code of before.
    """
    status = os.stat(path)
    return status.st_mtime_ns, status.st_size


def _forgiving(load_index: Callable[[], Any]) -> Callable[[], Any]:
    """Have an index of machine code be empty if it names classes that are gone.

    Numba reads the index before it compares stamps, and the index holds the types of arguments: one
    from before an upgrade that renamed such a class would end every run with a traceback.
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
