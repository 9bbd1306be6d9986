"""A typed door to Numba: every compiled kernel of the project goes through `kernel`.

Kernels round after every operation, in the order in which it is written, as Python does. Were LLVM
free to fuse and to reorder, the last bits of a result would depend on the processor, on where
arrays lie in memory, and on which of its callers a kernel was compiled for: a dive measured on
several machines, or by several processes, would not equal the same dive measured by one.
"""

import functools
import os
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar, cast

# Numba prepares colours for every error that it might report: where colorama is installed, as on
# Windows, that is a twentieth of its compiling.
os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")

import numba
import numpy as np
from numba.extending import overload, typeof_impl

# What `kernel_loading` uses of Numba is private: no other version than those tested is trusted.
_LOADS_LIGHTLY = numba.__version__.startswith("0.68.")
if _LOADS_LIGHTLY:
    from aqualvs.geometry.kernel_loading import load_lightly

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
    compiled = numba.njit(cache=True, **options)(function)
    _depend_on_callees(compiled, function, repr(sorted(options.items())))
    if _LOADS_LIGHTLY:
        load_lightly(compiled)
    return cast(F, compiled)


class _InnerKernel:
    """A function that is compiled once for kernels, and once more if Python calls it."""

    def __init__(self, function: Callable[..., Any], options: Mapping[str, object]) -> None:
        functools.update_wrapper(self, function)
        self.py_func = function
        self._options = options
        self._for_kernels = _compiled(function, no_cpython_wrapper=True, **options)
        self._stands_for = (self._for_kernels,)

    def __call__(self, *arguments: Any) -> Any:
        return self._for_python(*arguments)

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


typeof_impl.register(_InnerKernel)(_type_of_inner)


def _inner(function: F, **options: object) -> F:
    return cast(F, _InnerKernel(function, options))


def _depend_on_callees(compiled: Any, function: Callable[..., Any], options: str) -> None:
    """Make machine code on disk depend on its options and the files of kernels that it may call.

    Numba compares only the stamp of the function's own file, so a change in an inlined kernel of
    another module would leave stale machine code in use. Counted are all kernels that the module
    has imported, whether this function calls them or not.
    """
    own = _cache_file(compiled)
    if own is None:
        return
    files = (file for value in function.__globals__.values() for file in _cache_files(value))
    stamps = {stamp for file in files for stamp in file._source_stamp}
    own._source_stamp = tuple(sorted(stamps | {own._source_stamp, options}, key=repr))
    own._load_index = _forgiving(own._load_index)


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


def _cache_files(value: Any) -> Iterator[Any]:
    """Yield Numba's records of the caches of all compiled functions that a global stands for."""
    for compiled in getattr(value, "_stands_for", (value,)):
        file = _cache_file(compiled)
        if file is not None:
            yield file


def _cache_file(compiled: Any) -> Any:
    """Return Numba's record of the cache of a compiled function, None for anything else."""
    return getattr(getattr(compiled, "_cache", None), "_cache_file", None)
