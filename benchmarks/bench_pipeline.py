"""A whole `run`, from the file to the report, next to decoding the same file with plain PyAV.

Run `python -m benchmarks pipeline` for a table. Frames a second are by the clock, the fastest of
some rounds in turns; milliseconds are CPU time of all threads, which other work on the machine
changes little. PyAV decodes with as many threads as the process may use; "as it comes" it decodes
H.264 on one core. Stages are cumulative: each does what the one above does and more. A report
costs the same for a short dive as for a long one; "each further frame" is what a dive of three
times the length costs more. With all cores, a run has a process for each and its report, and time
is by the clock.
"""

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
from benchmarks.dive_files import Dive, small_dive, wide_dive
from benchmarks.history import machine

from aqualvs.optics.rigfile import load_rig
from aqualvs.pipeline import run as run_dive
from aqualvs.results.run_request import RunRequest
from aqualvs.scanner import Scanner
from aqualvs.sources import open_source

# A run may take so many times as long as decoding.
_ASKED = 1.25
_LONGER = 3


@dataclass(frozen=True, slots=True)
class Cost:
    """Of one pass over a dive: seconds by the clock, and of CPU."""

    clock_s: float
    cpu_s: float

    def best(self, other: "Cost") -> "Cost":
        return Cost(min(self.clock_s, other.clock_s), min(self.cpu_s, other.cpu_s))


def plain_decode(path: Path, *, as_it_comes: bool = False) -> int:
    """Decode a file with every core, or as PyAV does it by itself, and count its frames."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        if not as_it_comes:
            stream.codec_context.thread_type = "AUTO"
            stream.codec_context.thread_count = machine().cores
        return sum(1 for _ in container.decode(stream))


def frames(dive: Dive) -> int:
    with open_source(str(dive.path)) as source:
        return sum(1 for _ in source)


def scans(dive: Dive, scanner: Scanner) -> int:
    n_valid = 0
    with open_source(str(dive.path)) as source:
        for frame in source:
            n_valid += bool(scanner.process(frame).posture)
    return n_valid


def whole(dive: Dive, out: Path, *, report: bool, n_processes: int = 1) -> int:
    request = RunRequest(
        source=str(dive.path),
        rig=dive.rig,
        out=out,
        overwrite=True,
        report=report,
        n_processes=n_processes,
    )
    result = run_dive(request)
    if result.fault is not None or result.summary.n_frames != dive.n_frames:
        raise RuntimeError(f"{dive.path}: {result.summary.n_frames} frames, {result.fault}")
    return result.summary.n_frames


def best_costs(jobs: dict[str, Callable[[], object]], rounds: int) -> dict[str, Cost]:
    """Run all jobs in turns, so that what disturbs one disturbs all."""
    best: dict[str, Cost] = {}
    for _ in range(rounds):
        for name, job in jobs.items():
            clock, cpu = time.perf_counter(), time.process_time()
            job()
            cost = Cost(time.perf_counter() - clock, time.process_time() - cpu)
            best[name] = cost.best(best.get(name, cost))
    return best


def rows(short: Dive, long: Dive, out: Path, rounds: int) -> list[dict[str, Any]]:
    scanner = Scanner(load_rig(short.rig))
    jobs: dict[str, Callable[[], object]] = {
        "plain": lambda: plain_decode(short.path),
        "frames": lambda: frames(short),
        "scan": lambda: scans(short, scanner),
        "written": lambda: whole(short, out, report=False),
        "reported": lambda: whole(short, out, report=True),
        "plain, long": lambda: plain_decode(long.path),
        "as it comes, long": lambda: plain_decode(long.path, as_it_comes=True),
        "written, long": lambda: whole(long, out, report=False),
        "shared": lambda: whole(short, out, report=True, n_processes=machine().cores),
        "shared, long": lambda: whole(long, out, report=True, n_processes=machine().cores),
    }
    whole(short, out, report=True)
    cost = best_costs(jobs, rounds)
    return [*whole_rows(short, long, cost), *stage_rows(short, cost)]


def whole_rows(short: Dive, long: Dive, cost: dict[str, Cost]) -> list[dict[str, Any]]:
    plain, written = cost["plain, long"], cost["written, long"]
    more = long.n_frames - short.n_frames
    step = 1e3 * (written.cpu_s - cost["written"].cpu_s) / more
    plain_step = 1e3 * (plain.cpu_s - cost["plain"].cpu_s) / more
    clock = 1e3 * (cost["shared, long"].clock_s - cost["shared"].clock_s) / more
    plain_clock = 1e3 * (plain.clock_s - cost["plain"].clock_s) / more
    share = 100.0 * plain.cpu_s / written.cpu_s
    report = 1e3 * (cost["reported"].cpu_s - cost["written"].cpu_s)
    n = long.n_frames
    speed, plain_speed = n / written.clock_s, n / plain.clock_s
    one_core = n / cost["as it comes, long"].clock_s
    return [
        row(f"{short.name}: {n} frames, PyAV on all cores", speed, "frames/s", plain_speed),
        row(f"{short.name}: {n} frames, PyAV as it comes", speed, "frames/s", one_core),
        row(f"{short.name}: each further frame", step, "ms CPU", plain_step),
        row(f"{short.name}: each further frame, all cores", clock, "ms", plain_clock),
        {
            "name": f"{short.name}: decode share of {n} frames",
            "value": share,
            "unit": "% CPU",
            "reference": 100.0 / _ASKED,
            "ratio": share * _ASKED / 100.0,
        },
        row(f"{short.name}: report, once", report, "ms CPU", None),
    ]


def stage_rows(dive: Dive, cost: dict[str, Cost]) -> list[dict[str, Any]]:
    stages = {
        "frames": "decode and views of the planes",
        "scan": "and scan",
        "written": "and write tables",
        "reported": "and report",
    }
    each = 1e3 / dive.n_frames
    plain = each * cost["plain"].cpu_s
    return [
        row(f"{dive.name}, {dive.n_frames}: {words}", each * cost[key].cpu_s, "ms CPU", plain)
        for key, words in stages.items()
    ]


def row(name: str, value: float, unit: str, reference: float | None) -> dict[str, Any]:
    """A row of the table; more frames a second are better, fewer milliseconds are."""
    ratio = None
    if reference is not None:
        ratio = value / reference if unit == "frames/s" else reference / value
    return {"name": name, "value": value, "unit": unit, "reference": reference, "ratio": ratio}


def run(quick: bool = False) -> list[dict[str, Any]]:
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    rounds = 1 if quick else 3
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        small, wide = small_dive(folder), wide_dive(folder, 24 if quick else 48)
        found = []
        for dive, n in ((small, 1 if quick else 3), (wide, 1 if quick else 4)):
            found += rows(dive.times(n), dive.times(_LONGER * n), folder / "out", rounds)
    return found
