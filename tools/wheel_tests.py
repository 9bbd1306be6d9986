"""Build the wheel, install it in an empty environment, and try it there.

Runs the demo, and tests of the parts below for a limited time, part by part. The tests lie in a
copy of the repository without `src`, so that whatever the wheel lacks is missing.

    python tools/wheel_tests.py [--minutes 20] [--folder out/wheel]
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# What a new user meets first comes first.
PARTS = (
    *("cli/test_run.py", "report", "test_scanner.py", "scanning", "optics", "geometry", "sources"),
    *("results", "calibration_files", "check", "nets", "live/dashboard", "live/mavlink"),
    *("calibration", "recording", "vehicle_logs", "control", "simulation"),
)
NEEDED = ("hypothesis>=6.110", "pytest>=8.3", "pytest-xdist>=3.8")


def main() -> int:
    """Return the number of parts whose tests failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=20.0, help="begin no part after this time")
    parser.add_argument("--folder", type=Path, default=ROOT / "out" / "wheel", help="is replaced")
    options = parser.parse_args()
    folder = options.folder.resolve()
    shutil.rmtree(folder, ignore_errors=True)
    python = installed(folder)
    run(python, "-m", "aqualvs", "demo", "-o", folder / "demo", cwd=folder)
    copy = folder / "repository"
    ignored = shutil.ignore_patterns("src", "out", ".git", ".venv", ".*_cache", "__pycache__")
    shutil.copytree(ROOT, copy, ignore=ignored)
    place = "import aqualvs, sys; sys.exit(not aqualvs.__file__.startswith(sys.prefix))"
    run(python, "-c", place, cwd=copy)
    end_s = time.monotonic() + 60.0 * options.minutes
    failed, left_out = [], []
    for part in PARTS:
        if time.monotonic() > end_s:
            left_out.append(part)
            continue
        print(f"== tests/{part}", flush=True)
        tests = ("--numprocesses=2", "--dist=loadfile", "--quiet", f"tests/{part}")
        try:
            run(python, "-m", "pytest", *tests, cwd=copy)
        except subprocess.CalledProcessError:
            failed.append(part)
    print(f"failed: {', '.join(failed) or 'none'}; left out: {', '.join(left_out) or 'none'}")
    return len(failed)


def installed(folder: Path) -> Path:
    """Return the Python of a new environment with the wheel, extra `live`, and pytest."""
    run(sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder / "dist", ROOT)
    (wheel,) = (folder / "dist").glob("aqualvs-*.whl")
    run(sys.executable, "-m", "venv", folder / "venv")
    python = folder / "venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    run(python, "-m", "pip", "install", "-q", f"{wheel}[live]", *NEEDED)
    return python


def run(*command: object, cwd: Path | None = None) -> None:
    """Run a command that must succeed, without the caller's own packages."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([str(one) for one in command], check=True, cwd=cwd, env=clean)


if __name__ == "__main__":
    sys.exit(main())
