"""What many workers gain over one, and what it costs to keep them busy.

Run `python -m benchmarks batch`. A dive is made of the bundled one, measured as a batch does it,
and the CPU time of each step taken. With these times

* 1000 such dives are worked through by the batch's own planning on a clock that is simulated, with
  1, 2 and 4 workers: what planning leaves idle shows, what the machine does not let run does not;
* 1000 dives whose steps do nothing are worked through by real processes: what remains is the cost
  of scheduler and planning, a share of the time that the steps take.
"""

import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from fractions import Fraction
from heapq import heappop, heappush
from pathlib import Path
from typing import Any

import av

from aqualvs.batch.parts import PieceResult
from aqualvs.batch.scheduler import DaskWorkers, FinishedTask, Scheduler, Steps
from aqualvs.batch.work import PIECE_FRAMES, DiveProbe, DiveWork
from aqualvs.demo import bundled_dive
from aqualvs.results.run_request import RunRequest
from aqualvs.sources.spans import Span, SpanKind

_SHORT, _FRAMES, _PIECE = 100, 300, 100
_DIVES, _PIECES_A_DIVE = 1000, 15
"""Of about a quarter of an hour each."""


class Unwatched:
    """Tells nobody."""

    def expect(self, n_bytes: int) -> None:
        pass

    def measured(self, n_bytes: int, n_frames: int) -> None:
        pass

    def ended(self, record: object) -> None:
        pass


class SimulatedWorkers:
    """Workers on a clock of their own; a step takes as long as `cost` says."""

    def __init__(self, n: int, cost: Callable[[str], float]) -> None:
        self.n_slots, self.now = n, 0.0
        self._cost = cost
        self._free = [0.0] * n
        self._under_way: list[tuple[float, int, object, Any]] = []
        self._number = 0

    def submit(self, token: object, function: Callable[..., Any], *arguments: object) -> None:
        begins = max(heappop(self._free), self.now)
        ends = begins + self._cost(function.__name__)
        heappush(self._free, ends)
        self._number += 1
        heappush(self._under_way, (ends, self._number, token, function(*arguments)))

    def next_done(self, timeout_s: float) -> FinishedTask | None:  # noqa: ARG002
        if not self._under_way:
            return None
        self.now, _, token, value = heappop(self._under_way)
        return FinishedTask(token, value=value)


def look(work: DiveWork) -> tuple[DiveProbe, dict[str, Any] | None]:
    spans = tuple(
        Span(kind=SpanKind.VIDEO, first=i * PIECE_FRAMES, stop=(i + 1) * PIECE_FRAMES, n_bytes=1)
        for i in range(_PIECES_A_DIVE)
    )
    probe = DiveProbe(
        source_key=work.name,
        result_key="",
        spans=spans,
        why_whole="",
        n_bytes=_PIECES_A_DIVE,
        n_frames=None,
        source={},
    )
    return probe, None


def measure(_work: DiveWork, _probe: DiveProbe) -> PieceResult:
    return PieceResult(n_frames=1, n_valid=1, duration_s=0.0, fault="")


def join(_work: DiveWork, _probe: DiveProbe, results: Sequence[PieceResult]) -> dict[str, Any]:
    return {"fault": "", "n_frames": len(results)}


def work_in(folder: Path, source: Path, rig: Path, name: str = "dive") -> DiveWork:
    return DiveWork(
        name=name,
        request=RunRequest(source=str(source), rig=rig, out=folder / "dives" / name),
        home=folder / "home" / name,
        dataset=folder / "dataset",
        piece_frames=_PIECE,
    )


def make_dive(path: Path, n_frames: int) -> Path:
    """The bundled dive to and fro, with a key frame every two seconds."""
    with av.open(str(bundled_dive() / "dive.mp4")) as old:
        pictures = list(old.decode(video=0))
    order = [*pictures, *pictures[::-1]][:n_frames]
    with av.open(str(path), "w") as new:
        stream = new.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 720, 576, "yuv420p"
        stream.options = {"preset": "ultrafast", "g": "50"}
        for i, picture in enumerate(order):
            picture.pts, picture.time_base, picture.pict_type = i, Fraction(1, 25), 0
            new.mux(stream.encode(picture))
        new.mux(stream.encode(None))
    return path


def timed(step: Callable[[], Any]) -> tuple[float, Any]:
    began = time.process_time()
    found = step()
    return time.process_time() - began, found


def costs_of(folder: Path, n_frames: int) -> tuple[float, float, float]:
    """CPU seconds of the steps of a short dive: look, all pieces, join."""
    real, name = Steps(), f"dive{n_frames}"
    dive = make_dive(folder / f"{name}.mp4", n_frames)
    work = work_in(folder, dive, Path(str(bundled_dive() / "rig.yaml")), name)
    seen, (probe, _) = timed(lambda: real.look(work))
    pieces = range(len(probe.spans))
    measured, results = timed(lambda: [real.measure(work, probe.only(i)) for i in pieces])
    joined, _ = timed(lambda: real.join(work, probe, results))
    return seen, measured, joined


def step_costs(folder: Path) -> dict[str, float]:
    """CPU seconds of the steps of a dive of `_PIECES_A_DIVE` pieces, from two short ones."""
    # The first loads and compiles what the others need.
    costs_of(folder, _SHORT // 2)
    short, long = costs_of(folder, _SHORT), costs_of(folder, _FRAMES)
    n_frames = _PIECES_A_DIVE * PIECE_FRAMES
    look_s, measure_s, join_s = (
        max(0.0, a + (b - a) * (n_frames - _SHORT) / (_FRAMES - _SHORT))
        for a, b in zip(short, long, strict=True)
    )
    return {"look": look_s, "measure": measure_s / _PIECES_A_DIVE, "join": join_s}


def simulated_s(costs: dict[str, float], n_workers: int, n_dives: int) -> float:
    workers = SimulatedWorkers(n_workers, costs.__getitem__)
    run_scheduler(workers, n_dives)
    return workers.now


def run_scheduler(workers: Any, n_dives: int) -> None:
    nowhere = Path("nowhere")
    works = [(work_in(nowhere, nowhere, nowhere, f"dive{i}"), 1) for i in range(n_dives)]
    Scheduler(works, workers, Unwatched(), Steps(look, measure, join)).run(lambda: False)


def overhead_s(n_dives: int) -> float:
    """CPU seconds of scheduler, planning and processes for dives whose steps do nothing."""
    with DaskWorkers(2) as workers:
        workers.submit("warm", os.getpid)
        workers.next_done(60.0)
        began = time.process_time()
        run_scheduler(workers, n_dives)
        return time.process_time() - began


def row(
    name: str, value: float, unit: str, bar: float | None, ratio: float | None
) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "reference": bar, "ratio": ratio}


def run() -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        costs = step_costs(Path(folder))
    dive_s = costs["look"] + _PIECES_A_DIVE * costs["measure"] + costs["join"]
    rows = [
        row(
            f"{step}, of a dive of {_PIECES_A_DIVE} pieces", 1e3 * costs[step], "ms CPU", None, None
        )
        for step in costs
    ]
    alone = simulated_s(costs, 1, 100)
    for n in (2, 4):
        gain = alone / simulated_s(costs, n, 100)
        bar = 0.9 * n
        rows.append(
            row(f"{n} workers over one, 100 dives, simulated", gain, "times", bar, gain / bar)
        )
    for n_dives in (250, _DIVES):
        share = 100.0 * overhead_s(n_dives) / (n_dives * dive_s)
        bar = 2.0
        rows.append(row(f"scheduler's share, {n_dives} dives", share, "%", bar, bar / share))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    rows.append(row("memory of a process that does all steps", peak, "MiB", 600.0, 600.0 / peak))
    return rows
