"""Processes of tests that compile the same kernel: one does, the others load what it made."""

import os
import subprocess
import sys

import pytest

from repository import HELPERS

PROGRAM = f"""
import sys
import numpy as np
sys.path.insert(0, {str(HELPERS)!r})
from aqualvs.geometry.compiled import kernel
from kernel_locks import compile_one_at_a_time

compile_one_at_a_time()

@kernel
def inner(x):
    return np.sort(x)[len(x) // 2]

@kernel
def outer(x):
    return inner(x) + inner(2.0 * x)

print("ready", flush=True)
sys.stdin.readline()
print(outer(np.arange(5.0)), *(sum(one.stats.cache_hits.values()) for one in (inner, outer)))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="there are no such locks")
def test_of_two_processes_one_compiles(tmp_path):
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    both = [
        subprocess.Popen(
            [sys.executable, str(program)],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for one in both:
        assert one.stdout.readline() == "ready\n"
    for one in both:
        one.stdin.write("go\n")
        one.stdin.flush()
    said = [one.communicate()[0].split() for one in both]
    # Whoever compiles finds nothing on disk; the other finds what it called, and needs no more.
    assert sorted(said) == [["6.0", "0", "0"], ["6.0", "0", "1"]]
