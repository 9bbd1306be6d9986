"""The door to Numba: machine code on disk must follow the source, callees included."""

import os
import subprocess
import sys
from pathlib import Path

CALLEE = """
from aqualvs.geometry.compiled import inline_kernel

@inline_kernel
def step(x):
    return x + {increment}
"""
CALLER = """
from aqualvs.geometry.compiled import inline_kernel, kernel
from callee import step

@kernel
def twice(x):
    return later(step(x))

@inline_kernel
def later(x):
    return step(x)

print(int(twice(1)), sum(twice.stats.cache_hits.values()))
"""


def run_caller(folder: Path) -> list[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, "caller.py"]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_cached_kernels_follow_their_callees(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE.format(increment=1))
    assert run_caller(tmp_path) == ["3", "0"]
    assert run_caller(tmp_path) == ["3", "1"]
    (tmp_path / "callee.py").write_text(CALLEE.format(increment=1000))
    assert run_caller(tmp_path) == ["2001", "0"]
