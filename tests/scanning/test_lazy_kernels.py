"""Kernels that Python runs before they are compiled: the bits are the same either way."""

import dataclasses
import dis
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.random_nets import shots

from aqualvs.demo import bundled_dive
from aqualvs.geometry.compiled import _InnerKernel, _LazyKernel
from aqualvs.live.runner import wall_frame
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner, ScannerOptions
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.scanning.target import TargetKind
from aqualvs.simulation.scenarios import example_rig
from aqualvs.sources import open_source
from lazy_cases import lazy_kernels
from whole import WHOLE

N_NETS = 30 if WHOLE else 2


@pytest.fixture
def run_by(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Have every lazy kernel run by Python or by compiled code, and none change over."""

    compiled_of: dict[int, Any] = {}

    def choose(means: str) -> None:
        for kernel in lazy_kernels():
            compiled = compiled_of.setdefault(id(kernel), kernel._compiled)
            by_python = means == "python"
            monkeypatch.setattr(kernel, "_run", kernel._interpret if by_python else compiled)
            monkeypatch.setattr(kernel, "_left_s", np.inf)
            monkeypatch.setattr(kernel, "_compiled", None if by_python else compiled)

    return choose


def frames() -> Iterator[tuple[str, Scanner, Frame]]:
    """Yield nets, the bundled dive and a wall, each with its scanner."""
    rig, folder = example_rig(), Path(str(bundled_dive()))
    for shot in shots(N_NETS, 0, None):
        yield f"net {shot.number}", Scanner(rig), shot.frame
    yield "wall", Scanner(rig), wall_frame(rig)
    with open_source(str(folder / "dive.mp4")) as source:
        dive = list(source)[::40] if WHOLE else [next(iter(source))]
    for target in TargetKind:
        scanner = Scanner(load_rig(folder / "rig.yaml"), ScannerOptions(target=target))
        for frame in dive:
            yield f"dive {frame.index}, {target}", scanner, frame


def bits(scan: Scan) -> dict[str, Any]:
    """Return the values of a scan with their types, arrays as bytes."""
    parts = {**_fields(scan.posture), **_fields(scan.points)}
    return {
        name: (type(value).__name__, value.tobytes() if isinstance(value, np.ndarray) else value)
        for name, value in parts.items()
    }


def _fields(record: Any) -> dict[str, Any]:
    return {field.name: getattr(record, field.name) for field in dataclasses.fields(record)}


def test_python_and_compiled_code_give_the_same_bits(run_by: Callable[[str], None]) -> None:
    n_postures = 0
    for name, scanner, frame in frames():
        found = []
        for means in ("python", "compiled"):
            run_by(means)
            found.append(scanner.process(frame))
        assert bits(found[0]) == bits(found[1]), name
        n_postures += bool(found[0].posture)
    assert n_postures > N_NETS


def test_lazy_kernels_keep_to_operations_that_round_alike() -> None:
    """Python's `x**2` is a call of `pow`, and its `math.hypot` no call of the C library's."""
    found, counted = [], set[Callable[..., Any]]()

    def look_at(function: Callable[..., Any]) -> None:
        if function in counted:
            return
        counted.add(function)
        before = None
        for step in dis.get_instructions(function):
            is_square = step.opname == "BINARY_OP" and "**" in step.argrepr
            if (is_square and before == 2) or (step.argval == "hypot" and "ATTR" in step.opname):
                found.append(f"{function.__module__}.{function.__qualname__}: {step.argrepr}")
            before = step.argval
        for name in function.__code__.co_names:
            callee = function.__globals__.get(name)
            if isinstance(callee, _InnerKernel | _LazyKernel):
                look_at(callee.py_func)

    for kernel in lazy_kernels():
        look_at(kernel.py_func)
    assert not found
