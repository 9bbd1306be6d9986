"""Shared fixtures."""

import gc
import os
import sys
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

from repository import ROOT

# Files and folders in the order in which they begin, before all others. Each of the first has other
# kernels compiled that many tests need: those of a frame, of rendering, of calibrations and of the
# vehicle. Then the longest tests; those of commands in processes of their own, which would compile
# the same kernels once more, only when these are there.
LONG = (
    "test_scanner.py",
    "simulation/test_render.py",
    "calibration",
    "control",
    "recovery/test_closed_loop.py",
    "calibrate/test_shutter.py",
    "experiments/test_experiment.py",
    "recovery/test_real_light.py",
    "docs/test_doc_commands.py",
    "cli/test_fuzz.py",
    "recovery",
    "cli/test_calibrate.py",
    "live/test_command.py",
    "cli",
    "batch",
    "docs",
    "geometry/test_compiled.py",
    "report/test_run_page_browser.py",
    "test_pipeline_fields.py",
)

# As the command line does it, and before any test imports NumPy.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The same examples every time. On a busy machine one, or the making of it, may take seconds.
settings.register_profile(
    "aqualvs", derandomize=True, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("aqualvs")
# Imports and thousands of tests leave nothing to free: searching them is a third of collecting.
gc.disable()


@pytest.fixture(scope="session")
def samples() -> Path:
    """Folder of the independently rendered samples; skips where they are absent."""
    default = ROOT.parent / "shared" / "samples"
    folder = Path(os.environ.get("AQUALVS_SAMPLES", default))
    if not folder.is_dir():
        pytest.skip(f"no independent samples at {folder} (set AQUALVS_SAMPLES)")
    return folder


def pytest_configure(config: pytest.Config) -> None:
    """Have the processes of one run compile each kernel once, those of collecting among them."""
    if hasattr(config, "workerinput"):
        from kernel_locks import compile_one_at_a_time

        compile_one_at_a_time()


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Have one process import a file of tests, and the others find its byte code on disk.

    Where there is none yet, making it is most of collecting: pytest rewrites every assertion.
    """
    if sys.platform == "win32" or not isinstance(collector, pytest.Module):
        return (yield)
    import fcntl

    with collector.path.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        return (yield)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put long files first: of several processes, none is left with one at the end."""
    long = [ROOT / "tests" / name for name in LONG]
    for path in long:
        assert path.exists(), f"{path} is in LONG of tests/conftest.py"

    def place(path: Path) -> int:
        found = (i for i, one in enumerate(long) if path.is_relative_to(one))
        return next(found, len(long))

    # Asked once for each file: there are thousands of tests.
    places = {path: place(path) for path in {item.path for item in items}}
    items.sort(key=lambda item: places[item.path])


def pytest_collection_finish() -> None:
    """Free memory as usual from here, without searching what was collected again and again."""
    gc.freeze()
    # As the command line does it.
    gc.set_threshold(50_000, 20, 50)
    gc.enable()
