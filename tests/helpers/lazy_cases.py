"""The lazy kernels of all modules that are imported."""

import sys

from aqualvs.geometry.compiled import _LazyKernel


def lazy_kernels() -> list[_LazyKernel]:
    """Return the lazy kernels, each once, of modules that are imported."""
    modules = [one for name, one in sys.modules.items() if name.startswith("aqualvs.")]
    found = {
        id(value): value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, _LazyKernel)
    }
    assert len(found) > 40
    return list(found.values())
