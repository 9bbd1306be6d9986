"""What a run imports: everything that it does not need costs each run the time to read it."""

import gc
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rich.progress import Progress

from aqualvs.cli.command import importing
from aqualvs.demo import bundled_dive
from aqualvs.terminal import FIRST_RUN, Lines, hidden_progress, progress, rate_text, told_if_slow

# SciPy's linear algebra is missing here, because compiling a kernel for the first time imports it.
NOT_FOR_A_RUN = {
    *("scipy.fft", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.special"),
    *("matplotlib", "pyarrow.compute", "rich", "aqualvs.vehicle_logs", "aqualvs.recording"),
    *("aqualvs.calibration.water_index.estimator", "aqualvs.nets.condition"),
    # Points to pixels: for calibration, simulation and nets. Row motion: for rolling shutters.
    *("aqualvs.optics.projection", "aqualvs.scanning.row_motion"),
}
PROGRAM = """
import sys
from aqualvs.cli.main import main
code = main(sys.argv[1:])
print(code, *sys.modules)
"""


def test_a_run_imports_only_what_it_needs(tmp_path: Path) -> None:
    dive = Path(str(bundled_dive()))
    arguments = ["run", dive / "dive.mp4", "--rig", dive / "rig.yaml", "-o", tmp_path / "out"]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, arguments), "--frames", "0:3", "--workers", "1"],
        capture_output=True,
        text=True,
        check=True,
    )
    code, *modules = done.stdout.splitlines()[-1].split()
    assert code == "0"
    assert {"numba", "pyarrow.parquet", "aqualvs.report.run_page"} <= set(modules)
    assert not NOT_FOR_A_RUN & set(modules)


def test_what_is_slow_says_what_is_waited_for(capsys) -> None:
    with told_if_slow("ready", after_s=60.0):
        pass
    assert capsys.readouterr().err == ""
    said = ""
    with told_if_slow("ready", after_s=0.0):
        while not said:
            said = capsys.readouterr().err
    assert said == f"aqualvs: ready ({FIRST_RUN})\n"


@pytest.mark.parametrize("terminal", [False, True])
def test_a_slow_first_frame_is_explained(terminal: bool, monkeypatch, capsys) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setenv("TTY_COMPATIBLE", "1" if terminal else "")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("aqualvs.terminal._SLOW_S", 0.0)
    said, until_s = "", time.monotonic() + 30.0
    with progress("dive", 2) as tick:
        while FIRST_RUN not in said and time.monotonic() < until_s:
            said += capsys.readouterr().err
        tick(1)
    assert FIRST_RUN in said
    monkeypatch.setattr("aqualvs.terminal._SLOW_S", 60.0)
    with progress("dive", 2) as tick:
        tick(1)
    assert FIRST_RUN not in capsys.readouterr().err


def test_progress_is_said_ever_more_rarely_where_there_is_no_terminal(capsys) -> None:
    seconds = iter(range(101))
    lines = Lines("dive", "of 500 frames", clock=lambda: next(seconds))
    for _ in range(100):
        lines.tick(2)
    assert capsys.readouterr().err.splitlines() == [
        f"aqualvs: dive: {2 * s} of 500 frames after {s} s" for s in (10, 20, 40, 80)
    ]


def test_progress_is_a_bar_on_terminals_and_lines_elsewhere(monkeypatch, capsys) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.delenv("TTY_COMPATIBLE", raising=False)
    with progress("dive", 2) as tick:
        tick(2)
    assert capsys.readouterr().err == "aqualvs: dive: 2 frames\n"
    with progress("picture.png", 1):
        pass
    assert capsys.readouterr().err == "aqualvs: picture.png: 1 frame\n"
    with hidden_progress(), progress("dive", 2) as tick:
        tick(2)
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    with progress("dive", 2) as tick:
        tick(2)
    assert "dive" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("n_done", "seconds", "rate"),
    [
        (0, 5.0, ""),
        (1, 40.0, "0.025 frames/s"),
        (12, 5.0, "2.4 frames/s"),
        (700, 2.0, "350 frames/s"),
    ],
)
def test_no_rate_reads_0(n_done: int, seconds: int, rate: str) -> None:
    """Also of one frame, which Rich knows no rate of, and of less than one a second."""
    now = 0.0
    bar = Progress(get_time=lambda: now, disable=True)
    task = bar.add_task("dive", total=1000)
    now = float(seconds)
    bar.update(task, advance=n_done)
    assert rate_text(bar.tasks[0], "frames") == rate


def test_garbage_is_looked_for_again_after_importing() -> None:
    with importing():
        assert not gc.isenabled()
    gc.unfreeze()
    assert gc.isenabled()
