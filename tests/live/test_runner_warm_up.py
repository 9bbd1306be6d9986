"""The made-up picture that makes a scanner ready must be one that it can measure."""

import itertools
from collections.abc import Callable
from typing import Any

import pytest

from aqualvs.demo import bundled_dive
from aqualvs.geometry.compiled import _LazyKernel
from aqualvs.live.runner import warm_up
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from aqualvs.sources import open_source
from lazy_cases import lazy_kernels


@pytest.mark.parametrize("rig", [example_rig(), bluerov2_rig()], ids=["576", "1080"])
def test_the_whole_path_is_walked(rig: Rig) -> None:
    posture = warm_up(Scanner(rig)).posture
    assert posture
    # Painted with whole-pixel lines: a tenth of a pixel is about 0.1 % of the range.
    assert posture.range == pytest.approx(0.5 * sum(rig.working_range), rel=3e-3)
    assert abs(posture.yaw) < 0.01
    assert abs(posture.pitch) < 0.01


def test_no_kernel_is_compiled_before_a_net(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would stop the loop for seconds, in the middle of the first dive on a machine."""
    called = set()

    def noting(kernel: _LazyKernel) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            called.add(kernel.py_func.__qualname__)
            return kernel._compiled(*arguments)

        return run

    for kernel in lazy_kernels():
        monkeypatch.setattr(kernel, "_run", noting(kernel))
    warm_up(Scanner(example_rig()))
    warm, folder = frozenset(called), bundled_dive()
    scanner = Scanner(load_rig(folder / "rig.yaml"))
    with open_source(str(folder / "dive.mp4")) as source:
        for frame in itertools.islice(source, 0, None, 10):
            scanner.process(frame)
    assert len(warm) > 30
    assert called <= warm
