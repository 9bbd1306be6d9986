"""How long the command takes to start, and how much memory a dive takes, in processes of their own.

Run `python -m benchmarks start` for a table. Times are CPU time of the process, the least of some
rounds in turns with the reference; kernels come from the cache on disk. The reference of a start
is a program that does as much with the same packages and nothing of aqualvs; that of memory is
plain PyAV decoding the same file.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.dive_files import small_dive

from aqualvs.demo import bundled_dive

# Growth of a dive's memory that still counts as none, of the memory of a short one.
_FLAT = 5.0

_PLAIN_HELP = """
import argparse
parser = argparse.ArgumentParser()
commands = parser.add_subparsers()
for name in ("run", "live", "calibrate", "simulate"):
    commands.add_parser(name).add_argument("--rig")
parser.print_help()
"""

_FIRST_POSTURE = """
import sys
from aqualvs.sources import open_source
from aqualvs.optics.rigfile import load_rig
from aqualvs.scanner import Scanner
scanner = Scanner(load_rig(sys.argv[2]))
with open_source(sys.argv[1]) as source:
    assert scanner.process(next(iter(source))).posture
"""

_PLAIN_FIRST_PEAKS = """
import sys
import av, cv2, numba, numpy, pydantic, scipy.optimize, yaml
with open(sys.argv[2]) as file:
    yaml.safe_load(file)
with av.open(sys.argv[1]) as container:
    frame = next(container.decode(video=0)).to_ndarray(format="bgr24")
grey = cv2.GaussianBlur(cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), (5, 5), 0)
assert grey.argmax(axis=1).any()
"""

_PLAIN_DECODE = """
import sys
import av
with av.open(sys.argv[1]) as container:
    stream = container.streams.video[0]
    stream.codec_context.thread_type = "FRAME"
    stream.codec_context.thread_count = 2
    assert sum(1 for _ in container.decode(stream))
"""

# A process counts the memory of the one that started it as its own: this one is small.
_WATCH = """
import os, sys
child = os.posix_spawn(
    sys.argv[1],
    sys.argv[1:],
    os.environ,
    file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)],
)
_, status, used = os.wait4(child, 0)
print(used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status) != 0)
"""


@dataclass(frozen=True, slots=True)
class Used:
    """What a process used: CPU in milliseconds, memory at its peak in MiB."""

    cpu_ms: float
    peak_mib: float


def used(arguments: Sequence[str]) -> Used:
    """Run Python with arguments to its end; RuntimeError with its last words where it fails."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-S", "-c", _WATCH, sys.executable, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)[:80]}: {done.stderr.strip()[-300:]}")
    cpu_s, peak = map(float, done.stdout.split())
    per_mib = 1024.0**2 if sys.platform == "darwin" else 1024.0
    return Used(1e3 * cpu_s, peak / per_mib)


def start_row(name: str, ours: Sequence[str], plain: Sequence[str], rounds: int) -> dict[str, Any]:
    """Least CPU time of both, in turns, after one round that fills the caches."""
    used(ours)
    pairs = [(used(ours).cpu_ms, used(plain).cpu_ms) for _ in range(rounds)]
    value, reference = (min(column) for column in zip(*pairs, strict=True))
    return row(name, value, "ms CPU", reference)


def start_rows(rounds: int, *, with_imports: bool) -> list[dict[str, Any]]:
    demo = [str(bundled_dive() / name) for name in ("dive.mp4", "rig.yaml")]
    imports = {
        "aqualvs.optics": "numpy, numba",
        "aqualvs.scanner": "numpy, numba, cv2",
        "aqualvs.pipeline": "numpy, numba, cv2, av, pydantic, yaml",
        "aqualvs.run_outputs": "numpy, numba, cv2, av, pydantic, yaml, pyarrow",
    }
    found = [
        start_row("aqualvs --help", ["-m", "aqualvs", "--help"], ["-c", _PLAIN_HELP], rounds),
        start_row(
            "first posture, kernels cached",
            ["-c", _FIRST_POSTURE, *demo],
            ["-c", _PLAIN_FIRST_PEAKS, *demo],
            rounds,
        ),
    ]
    for ours, plain in imports.items() if with_imports else ():
        found.append(
            start_row(f"import {ours}", ["-c", f"import {ours}"], ["-c", f"import {plain}"], rounds)
        )
    return found


def memory_rows(folder: Path, n_times: int) -> list[dict[str, Any]]:
    found, peaks = [], []
    for times in (1, n_times):
        dive, out = small_dive(folder).times(times), ["-o", str(folder / "out"), "--overwrite"]
        words = ["-m", "aqualvs", "run", str(dive.path), "--rig", str(dive.rig)]
        peaks.append(used([*words, *out]).peak_mib)
        plain = used(["-c", _PLAIN_DECODE, str(dive.path)]).peak_mib
        name = f"memory of run, {dive.n_frames} frames with report"
        found.append(row(name, peaks[-1], "MiB", plain))
    growth = 100.0 * max(peaks[1] / peaks[0] - 1.0, 1e-3)
    found.append(row(f"memory, {n_times} times the frames", growth, "% more", _FLAT))
    return found


def row(name: str, value: float, unit: str, reference: float) -> dict[str, Any]:
    ratio = reference / value
    return {"name": name, "value": value, "unit": unit, "reference": reference, "ratio": ratio}


def run(quick: bool = False) -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        return [
            *start_rows(rounds=1 if quick else 5, with_imports=not quick),
            *memory_rows(Path(folder), n_times=3 if quick else 20),
        ]
