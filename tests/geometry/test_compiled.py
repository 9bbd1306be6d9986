"""The door to Numba: machine code on disk must follow the source, callees included."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

import aqualvs
from aqualvs.demo import bundled_dive
from aqualvs.geometry.compiled import (
    compiled_at_once,
    inline_kernel,
    is_cached_on_disk,
    kernel,
    lazy_kernel,
)
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner
from aqualvs.sources import open_source
from whole import WHOLE

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

TERMS = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 1001))


@kernel
def _dot(a, b):
    total = 0.0
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@inline_kernel
def _quotient(a, b):
    return a / b


@kernel
def _quotients(a, out):
    for i in range(a.shape[0]):
        out[i] = 1.0 - _quotient(a[i], 3.0) * a[i]


def run_caller(folder: Path, name: str = "caller.py", *arguments: str) -> list[str]:
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder / "cache")}
    command = [sys.executable, name, *arguments]
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.split()


def test_kernels_round_as_python_does() -> None:
    """Neither sums in another order, nor fused products, nor reciprocals: the bits are the same."""
    a, b = TERMS
    assert _dot(a, b) == _dot.py_func(a, b)
    compiled, plain = np.empty(len(a)), np.empty(len(a))
    _quotients(a, compiled)
    for i, one in enumerate(a.tolist()):
        plain[i] = 1.0 - one / 3.0 * one
    np.testing.assert_array_equal(compiled, plain)


def test_python_may_call_what_kernels_have_inlined() -> None:
    """Their code has no entry for Python; a call gets code of its own, with the same rules."""
    out = np.empty(1)
    _quotients(np.ones(1), out)
    assert out[0] == 1.0 - _quotient(1.0, 3.0)
    assert _quotient(1.0, 0.0) == np.inf


OF_BOTH = """
import sys
import numpy as np
from aqualvs.geometry.compiled import inner_kernel, kernel

@inner_kernel
def doubled(x):
    return 2.0 * x

@kernel
def summed(x):
    return doubled(x[0]) + doubled(x[1])

calls = {"python": lambda: doubled(1.0), "kernel": lambda: summed(np.ones(2))}
inner = doubled._for_kernels, doubled._for_python
print(*(calls[word]() for word in ORDER), *(sum(one.stats.cache_hits.values()) for one in inner))
"""


# In the other order it is the same code, of Python first.
ORDERS = [["python", "kernel"], ["kernel", "python"]] if WHOLE else [["kernel", "python"]]


@pytest.mark.parametrize("order", ORDERS)
def test_code_for_kernels_and_for_python_are_kept_apart_on_disk(
    order: list[str], tmp_path: Path
) -> None:
    """One process loads what another left there; of the same code, it would jump nowhere."""
    (tmp_path / "of_both.py").write_text(OF_BOTH.replace("ORDER", repr(order)))
    said = {"python": "2.0", "kernel": "4.0"}
    assert run_caller(tmp_path, "of_both.py") == [*(said[word] for word in order), "0", "0"]
    if WHOLE:
        # `summed` is loaded as a whole, and needs no `doubled`.
        assert run_caller(tmp_path, "of_both.py") == [*(said[word] for word in order), "0", "1"]
    for path in (tmp_path / "cache").rglob("*summed*"):
        path.unlink()
    assert run_caller(tmp_path, "of_both.py") == [*(said[word] for word in order), "1", "1"]


def test_where_no_code_can_be_kept_kernels_are_compiled_for_each_process(monkeypatch) -> None:
    compile_for_now = numba.njit

    def njit(*arguments, cache=False, **options):
        if cache:
            raise RuntimeError("cannot cache function 'later': no locator available for file")
        return compile_for_now(*arguments, **options)

    monkeypatch.setattr(numba, "njit", njit)

    def later(x):
        return x + 1.0

    at_once: Any = kernel(later)
    lazy: Any = lazy_kernel(later)
    assert at_once(1.0) == lazy(1.0) == 2.0
    assert len(at_once.signatures) == 1
    assert not lazy._compiled.signatures
    assert not is_cached_on_disk(at_once)
    assert is_cached_on_disk(_dot)


def test_cached_kernels_follow_their_callees(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "callee.py").write_text(CALLEE.format(increment=1))
    assert run_caller(tmp_path) == ["3", "0"]
    assert run_caller(tmp_path) == ["3", "1"]
    (tmp_path / "callee.py").write_text(CALLEE.format(increment=1000))
    assert run_caller(tmp_path) == ["2001", "0"]


EDITING = """
import sys
from pathlib import Path
from aqualvs.geometry.compiled import compiled_at_once, lazy_kernel
from callee import step

@lazy_kernel
def twice(x):
    return step(step(x))

if len(sys.argv) > 1:
    path = Path("callee.py")
    path.write_text(path.read_text().replace("+ 1", "+ 1000"))
with compiled_at_once():
    print(int(twice(1)))
"""


def test_code_from_before_an_edit_is_not_kept_as_that_from_after(tmp_path: Path) -> None:
    (tmp_path / "editing.py").write_text(EDITING)
    (tmp_path / "callee.py").write_text(CALLEE.format(increment=1))
    assert run_caller(tmp_path, "editing.py", "edit") == ["3"]
    assert run_caller(tmp_path, "editing.py") == ["2001"]


LAZY = """
import sys
import numpy as np
from aqualvs.geometry.compiled import compiled_at_once, inner_kernel, lazy_kernel

@inner_kernel
def inverse(x):
    return 1.0 / x

@lazy_kernel
def add(total, x):
    total[0] += 1.0
    total[0] += inverse(x)
    return total[0], total[0] > 1.0

@lazy_kernel
def count(n):
    total = 0
    for i in range(n):
        total += i
    return total

def n_compiled(kernel):
    return len(kernel._compiled.signatures)

total = np.zeros(1)
if "at_once" in sys.argv:
    with compiled_at_once():
        add(total, 1.0)
    print(n_compiled(add), n_compiled(count))
else:
    found = add(total, np.float64(2.0))
    print(*found, *(type(one).__name__ for one in found), n_compiled(add))
    # Python cannot divide by zero: the call is done once, by compiled code.
    total[0] = 4.0
    print(*add(total, 0.0), n_compiled(add))
    print(*((count(1_000_000), n_compiled(count)) for _ in range(2)))
"""


def test_a_lazy_kernel_is_compiled_when_python_has_run_it_for_a_while(tmp_path: Path) -> None:
    (tmp_path / "lazy.py").write_text(LAZY)
    by_python, compiled = ["1.5", "True", "float", "bool"], ["inf", "True"]
    counted = ["(499999500000,", "1)"]
    at_first = [*by_python, "0", *compiled, "1", "(499999500000,", "0)", *counted]
    assert run_caller(tmp_path, "lazy.py") == at_first
    # The next process finds the code on disk.
    assert run_caller(tmp_path, "lazy.py") == [*by_python, "1", *compiled, "1", *counted, *counted]


def test_lazy_kernels_can_be_compiled_at_once(tmp_path: Path) -> None:
    (tmp_path / "lazy.py").write_text(LAZY)
    assert run_caller(tmp_path, "lazy.py", "at_once") == ["1", "0"]


def test_lazy_kernels_of_a_module_are_compiled_by_one_process_at_a_time(tmp_path: Path) -> None:
    fcntl = pytest.importorskip("fcntl", reason="Windows has no such locks")
    path = tmp_path / "lazy.py"
    path.write_text(LAZY)
    with path.open("rb") as source:
        fcntl.flock(source, fcntl.LOCK_EX)
        said = run_caller(tmp_path, "lazy.py")
    # Without another process at it the second is compiled, as above.
    assert said[-4:] == ["(499999500000,", "0)"] * 2


PAIR = """
from typing import NamedTuple

class {name}(NamedTuple):
    x: float

def pair():
    return {name}(2.0)
"""
OF_PAIR = """
from aqualvs.geometry.compiled import kernel
from pair import pair

@kernel
def half(pair):
    return 0.5 * pair.x

print(half(pair()))
"""


def test_code_on_disk_for_a_class_that_is_gone_is_compiled_anew(tmp_path: Path) -> None:
    (tmp_path / "of_pair.py").write_text(OF_PAIR)
    for name in ("Before", "After"):
        (tmp_path / "pair.py").write_text(PAIR.format(name=name))
        assert run_caller(tmp_path, "of_pair.py") == ["1.0"]
    assert list((tmp_path / "cache").rglob("of_pair.half*.nbi"))


def test_no_kernel_of_a_scan_is_compiled_for_one_number() -> None:
    """A count that begins at a literal 0 compiles what it is passed to for 0 and for any number."""
    scanner = Scanner(load_rig(str(bundled_dive() / "rig.yaml")))
    with open_source(str(bundled_dive() / "dive.mp4")) as source, compiled_at_once():
        assert scanner.process(next(iter(source))).posture
    kernels = {
        f"{module}.{name}": value._for_kernels._cache._cache_file
        for module, content in list(sys.modules.items())
        if module.startswith("aqualvs.scanning.")
        for name, value in vars(content).items()
        if hasattr(value, "_for_kernels")
    }
    # Code of an earlier version stays on disk until its kernel changes.
    changed = max(path.stat().st_mtime for path in Path(aqualvs.__path__[0]).rglob("*.py"))
    n = 0
    for name, file in kernels.items():
        for key, data in file._load_index().items():
            n += 1
            is_ours = Path(file._data_path(data)).stat().st_mtime > changed
            assert not is_ours or not any(isinstance(one, numba.types.Literal) for one in key[0]), (
                name,
                key[0],
            )
    assert n > 100
