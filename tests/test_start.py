"""What a run imports: everything that it does not need costs each run the time to read it."""

import gc
import subprocess
import sys
from pathlib import Path

from aqualvs.cli.command import importing
from aqualvs.demo import bundled_dive
from aqualvs.terminal import progress

# SciPy's linear algebra is missing here, because compiling a kernel for the first time imports it.
NOT_FOR_A_RUN = {
    *("scipy.fft", "scipy.ndimage", "scipy.optimize", "scipy.signal", "scipy.special"),
    *("matplotlib", "pyarrow.compute", "rich", "aqualvs.vehicle_logs", "aqualvs.recording"),
    *("aqualvs.calibration.water_index.estimator", "aqualvs.nets.condition"),
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


def test_progress_is_shown_on_terminals_only(monkeypatch, capsys) -> None:
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.delenv("TTY_COMPATIBLE", raising=False)
    with progress("dive", 2) as tick:
        tick(2)
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("TERM", "xterm")
    with progress("dive", 2) as tick:
        tick(2)
    assert "dive" in capsys.readouterr().err


def test_garbage_is_looked_for_again_after_importing() -> None:
    with importing():
        assert not gc.isenabled()
    gc.unfreeze()
    assert gc.isenabled()
