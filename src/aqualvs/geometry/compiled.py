"""Numba decorators of the compiled kernels: `kernel` and its variants, typed, with a disk cache.

Kernels round after every operation, in the order in which it is written, as Python does. If LLVM
could fuse and reorder operations, the last bits of a result would depend on the processor, on the
memory layout of arrays and on the callers that a kernel was compiled for: a dive measured by
several machines or processes would not equal the same dive measured by one.

Machine code on disk is loaded without setting up Numba's compiler (`load_lightly`). By default
Numba first registers everything that it can compile, imports the modules that the code was compiled
from (SciPy's linear algebra among them), and reads the intermediate code that other functions could
inline. These steps take three quarters of the loading time, and only compilation needs them, so
they are deferred until something is compiled. This relies on private parts of Numba and is enabled
only for the versions that it was tested with.
"""

import functools
import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast

import numba
from numba.core import environment
from numba.core.codegen import JITCodeLibrary, ll
from numba.core.runtime import rtsys

_NUMBA = "numba."
# Private parts of Numba that are used.
_OF_CACHES = ("_load_overload", "_guard_against_spurious_io_errors")
_OF_LIBRARIES = (
    "_unserialize",
    "_finalize_final_module",
    "_get_module_for_linking",
    "_set_compiled_object",
    "enable_object_caching",
)

# Names of modules of Numba that are not imported, and placeholders for their contents.
_absent: dict[str, dict[str, Any]] = {}


def load_lightly(compiled: Any) -> None:
    """Make a compiled function load its machine code without setting up the compiler.

    Parameters
    ----------
    compiled : Any
        Return value of `numba.njit`.
    """
    cache = getattr(compiled, "_cache", None)
    if _IS_KNOWN and all(hasattr(cache, name) for name in _OF_CACHES):
        cache.load_overload = functools.partial(_load_overload, cache)  # type: ignore[union-attr]


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """Machine code whose intermediate code, for inlining by others, is read on demand."""

    _unread: bytes | None = None

    @classmethod
    def _unserialize(cls, codegen: Any, state: Any) -> Any:
        name, kind, content = state
        if kind != "object":
            return super()._unserialize(codegen, state)
        library = cls(codegen, name)
        library.enable_object_caching()
        library._set_compiled_object(content[0])
        library._unread = content[1]
        library._finalize_final_module()
        return library

    def get_pointer_to_function(self, name: str) -> Any:
        """Return the address of a function; 0 where the library has no such function."""
        engine = self._codegen._engine
        if self._unread is not None and not engine.is_symbol_defined(name):
            # Names are the same in either code, and this one is the function's own.
            if name.encode() in self._unread:
                engine._defined_symbols.add(name)
            else:
                self._read()
        return super().get_pointer_to_function(name)

    def _get_module_for_linking(self) -> Any:
        self._read()
        return super()._get_module_for_linking()

    def _read(self) -> None:
        if self._unread is not None:
            self._shared_module = ll.parse_bitcode(self._unread)
            self._unread = None
            self._codegen._engine._load_defined_symbols(self._shared_module)


_IS_KNOWN = (
    hasattr(environment, "_rebuild_env")
    and hasattr(rtsys, "initialize")
    and all(hasattr(JITCodeLibrary, name) for name in _OF_LIBRARIES)
)


def _load_overload(cache: Any, signature: Any, target: Any) -> Any:
    """Return the machine code for a signature, None where the cache has none.

    Replaces `Cache.load_overload`; called under Numba's lock for compiling.
    """
    found = None
    # The code may call the runtime, which Numba would set up with everything else.
    rtsys.initialize(target)
    target.codegen()._library_class = _Library
    with _without_imports(), cache._guard_against_spurious_io_errors():
        found = cache._load_overload(signature, target)
    if found is None:
        _import_absent()
    return found


@contextmanager
def _without_imports() -> Iterator[None]:
    """Avoid importing the modules of Numba that code was compiled from.

    Every function has an environment with the contents of its module, for Python objects that code
    may look up by name; kernels look up none.
    """
    usual = environment._rebuild_env

    def rebuild(module: str, constants: list[Any], name: str) -> Any:
        known = not module.startswith(_NUMBA) or module in sys.modules
        if known or environment.lookup_environment(name) is not None:
            return usual(module, constants, name)
        contents = _absent.setdefault(module, {"__name__": module})
        found = environment.Environment(contents)
        found.consts[:] = constants
        found.env_name = name
        environment.Environment._memo[name] = found
        return found

    environment._rebuild_env = rebuild
    try:
        yield
    finally:
        environment._rebuild_env = usual


def _import_absent() -> None:
    """Fill the environments with their contents before something is compiled."""
    for name, contents in _absent.items():
        contents.update(vars(importlib.import_module(name)))
    _absent.clear()


# `load_lightly` uses private parts of Numba: only versions that it was tested with are trusted.
_LOADS_LIGHTLY = numba.__version__.startswith("0.68.")
if _LOADS_LIGHTLY:
    pass

F = TypeVar("F", bound=Callable[..., Any])


def kernel(function: F) -> F:
    """Compile a batch kernel; the machine code is cached on disk for the next process."""
    return _compiled(function)


def inline_kernel(function: F) -> F:
    """Compile a scalar function that batch kernels call; always inlined by LLVM."""
    return _compiled(function, forceinline=True)


def borrowing_kernel(function: F) -> F:
    """Compile a batch kernel that only borrows its arrays and creates none.

    Counting references to arrays at every call of a small function, or for every row that is
    looked at, can take longer than the work itself. Compilation fails where an array is created.
    """
    return _compiled(function, _nrt=False)


def inline_borrowing_kernel(function: F) -> F:
    """Compile a scalar function that borrowing kernels call; always inlined by LLVM."""
    return _compiled(function, forceinline=True, _nrt=False)


def _compiled(function: F, **options: object) -> F:
    options = {"error_model": "numpy", "nogil": True, "fastmath": False, **options}
    compiled = numba.njit(cache=True, **options)(function)
    _depend_on_callees(compiled, function, repr(sorted(options.items())))
    if _LOADS_LIGHTLY:
        load_lightly(compiled)
    return cast(F, compiled)


def _depend_on_callees(compiled: Any, function: Callable[..., Any], options: str) -> None:
    """Make machine code on disk depend on its options and the files of kernels that it may call.

    Numba compares only the stamp of the function's own file, so a change in an inlined kernel of
    another module would leave stale machine code in use. The stamps of all kernels that the module
    imports are included, whether this function calls them or not.
    """
    own = _cache_file(compiled)
    if own is None:
        return
    files = (_cache_file(value) for value in function.__globals__.values())
    stamps = {stamp for file in files if file is not None for stamp in file._source_stamp}
    own._source_stamp = tuple(sorted(stamps | {own._source_stamp, options}, key=repr))


def _cache_file(compiled: Any) -> Any:
    """Return Numba's record of the cache of a compiled function, None for anything else."""
    return getattr(getattr(compiled, "_cache", None), "_cache_file", None)
