"""Kernels from disk without setting up Numba's compiler.

Before Numba loads machine code from its cache, it registers everything that it can compile; it
imports the modules that the code was once compiled from, SciPy's linear algebra among them; and it
reads what other functions would inline. That takes three quarters of all loading, and only
compiling needs it: here it waits until something is compiled. It rests on private parts of Numba,
and is used with versions of it that it was tested with.
"""

import functools
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from numba.core import environment
from numba.core.codegen import JITCodeLibrary, ll
from numba.core.runtime import rtsys

_NUMBA = "numba."
# What is used of Numba beyond what it documents.
_OF_CACHES = ("_load_overload", "_guard_against_spurious_io_errors")
_OF_LIBRARIES = (
    "_unserialize",
    "_finalize_final_module",
    "_get_module_for_linking",
    "_set_compiled_object",
    "enable_object_caching",
)

# Names of modules of Numba that are not imported, and what stands for their contents.
_absent: dict[str, dict[str, Any]] = {}


def load_lightly(compiled: Any) -> None:
    """Have a compiled function load its machine code without what only compiling needs.

    Parameters
    ----------
    compiled : Any
        What `numba.njit` returned.
    """
    cache = getattr(compiled, "_cache", None)
    if _IS_KNOWN and all(hasattr(cache, name) for name in _OF_CACHES):
        cache.load_overload = functools.partial(_load_overload, cache)  # type: ignore[union-attr]


class _Library(JITCodeLibrary):  # type: ignore[misc]
    """Machine code whose intermediate code, for others to inline, is read when they want it."""

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
            # Names stand as they are in either code, and this one is the function's own.
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

    Called under Numba's lock for compiling, as `Cache.load_overload`, whose place it takes.
    """
    found = None
    # The code may call it, and Numba would have it set up among all the rest.
    rtsys.initialize(target)
    target.codegen()._library_class = _Library
    with _without_imports(), cache._guard_against_spurious_io_errors():
        found = cache._load_overload(signature, target)
    if found is None:
        _import_absent()
    return found


@contextmanager
def _without_imports() -> Iterator[None]:
    """Leave modules of Numba alone that code was compiled from.

    Every function has an environment with the contents of its module, for Python objects that code
    may look up by name; kernels have none.
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
    """Give environments their contents: something is about to be compiled."""
    for name, contents in _absent.items():
        contents.update(vars(importlib.import_module(name)))
    _absent.clear()
