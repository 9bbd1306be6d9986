"""Numba kernels without reference counts.

A ray passes tables of arrays through a dozen small functions. Counting references to them at
every call takes five times as long as tracing the ray; kernels here only borrow arrays that the
caller in Python holds, and must not create any.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

from aqualvs.geometry.compiled import _FAST_BUT_NAN_SAFE

F = TypeVar("F", bound=Callable[..., Any])


def ray_kernel(function: F) -> F:
    """Compile a batch kernel that creates no arrays; cached on disk for the next process."""
    return _compiled(function, forceinline=False)


def inline_ray_kernel(function: F) -> F:
    """Compile a scalar function that ray kernels call; always inlined by LLVM."""
    return _compiled(function, forceinline=True)


def _compiled(function: F, *, forceinline: bool) -> F:
    compiled = numba.njit(
        cache=True,
        error_model="numpy",
        fastmath=_FAST_BUT_NAN_SAFE,
        nogil=True,
        forceinline=forceinline,
        _nrt=False,
    )(function)
    return cast(F, compiled)
