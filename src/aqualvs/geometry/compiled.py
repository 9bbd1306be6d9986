"""A typed door to Numba: every compiled kernel of the project goes through `kernel`."""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

# What `kernel_loading` uses of Numba is private: no other version than those tested is trusted.
_LOADS_LIGHTLY = numba.__version__.startswith("0.68.")
if _LOADS_LIGHTLY:
    from aqualvs.geometry.kernel_loading import load_lightly

F = TypeVar("F", bound=Callable[..., Any])

# Contraction to fused multiply-add and reassociation let LLVM vectorise the sums; NaN and
# infinity keep their meaning, because validity masks rely on them.
_FAST_BUT_NAN_SAFE = {"contract", "reassoc", "nsz", "arcp"}


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


def exact_borrowing_kernel(function: F) -> F:
    """Compile a borrowing kernel whose sums are taken in the order in which they are written."""
    return _compiled(function, fastmath=False, _nrt=False)


def inline_exact_borrowing_kernel(function: F) -> F:
    """Compile a scalar function that exact kernels call; always inlined by LLVM."""
    return _compiled(function, forceinline=True, fastmath=False, _nrt=False)


def _compiled(function: F, **options: object) -> F:
    compiled = numba.njit(
        cache=True,
        error_model="numpy",
        nogil=True,
        **{"fastmath": _FAST_BUT_NAN_SAFE, **options},
    )(function)
    _depend_on_callees(compiled, function)
    if _LOADS_LIGHTLY:
        load_lightly(compiled)
    return cast(F, compiled)


def _depend_on_callees(compiled: Any, function: Callable[..., Any]) -> None:
    """Make the machine code on disk depend on the files of the kernels that it may call as well.

    Numba compares only the stamp of the function's own file, so a change in an inlined kernel of
    another module would leave stale machine code in use. Counted are all kernels that the module
    has imported, whether this function calls them or not.
    """
    own = _cache_file(compiled)
    if own is None:
        return
    files = (_cache_file(value) for value in function.__globals__.values())
    stamps = {stamp for file in files if file is not None for stamp in file._source_stamp}
    own._source_stamp = tuple(sorted(stamps | {own._source_stamp}))


def _cache_file(compiled: Any) -> Any:
    """Return Numba's record of the cache of a compiled function, None for anything else."""
    return getattr(getattr(compiled, "_cache", None), "_cache_file", None)
