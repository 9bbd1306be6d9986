"""The developers' tools that measure real photographs, as modules for tests."""

import importlib.util
import sys
from functools import cache
from pathlib import Path
from types import ModuleType

TOOLS = Path(__file__).resolve().parents[1] / "tools"
PHOTOGRAPHS = Path(__file__).resolve().parent / "data" / "real-wall"
# Of the photographs in `PHOTOGRAPHS`, in those they were cropped from: x, y, width, height.
CROP = (100, 60, 1400, 1070)


@cache
def tool(name: str) -> ModuleType:
    """Return `tools/NAME.py` as a module."""
    spec = importlib.util.spec_from_file_location(name, TOOLS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look for their module
    spec.loader.exec_module(module)
    return module
