"""`aqualvs batch`: many dives measured on one machine or on many."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from aqualvs.batch.dataset import clear, read_manifest, write_dives
from aqualvs.batch.dives import Dive, DiveRecord, DiveState, find_dives, name_dives
from aqualvs.batch.parts import JOINED
from aqualvs.batch.scheduler import DaskWorkers, Scheduler, known_net
from aqualvs.batch.summary_page import SUMMARY_HTML, write_summary
from aqualvs.batch.work import DiveWork, size_of
from aqualvs.closing import Closing
from aqualvs.errors import OptionError, OutputError
from aqualvs.optics.rigfile import load_rig
from aqualvs.results.files import AppendFile, Claim, is_locked, read_json, replace_text, writing
from aqualvs.results.run_request import RunRequest
from aqualvs.terminal import Echo, StopSignals
from aqualvs.text import count_text

DIVES, DATASET, HOME = "dives", "dataset", ".batch"
"""Folders of a batch: results by dive, the data set, and what is under way."""

_NAMES, _LOCK = "names.json", "lock"


@dataclass(frozen=True, slots=True, kw_only=True)
class BatchRequest:
    """Request for a batch: dives, rig, options and the folder to write."""

    dives: tuple[str, ...]  # As `find_dives` takes them.
    # Run of every dive, but for its source, its own rig, water and log, and its folder in `out`,
    # which is that of the batch: to write, or of an earlier batch to go on with.
    run: RunRequest
    scheduler: str | None = None  # Address of a Dask scheduler; None works on this machine.
    n_workers: int | None = None  # Processes on this machine; None for one per core.


def batch(request: BatchRequest, echo: Echo) -> int:
    """Measure dives, report progress line by line, and write results, summary and data set.

    What an earlier batch in the same folder has finished, of the same dives with the same rig,
    options and versions, is checked and taken as it is. The exit code is 0 if all dives are
    finished, 1 if one is not, 128 + signal if it was stopped. Raises `AqualvsError` if nothing can
    be begun: no such dive, a dive without a rig, a folder that cannot be written, no workers.
    """
    _check(request)
    run, out = request.run, request.run.out
    dives = find_dives(request.dives, rig=run.rig, water=run.water, out=out)
    # What an earlier batch of this folder has finished is gone on with, not replaced.
    files = [out / name for name in (SUMMARY_HTML, DIVES, DATASET)]
    known = files if (out / HOME).is_dir() else []
    claim = Claim("batch", files, overwrite=True, known=known)
    with writing(out):
        (out / HOME).mkdir(parents=True, exist_ok=True)
    lock = out / HOME / _LOCK
    if is_locked(lock):
        raise OutputError(f"{out}: another batch is running here; wait for it to end")
    with writing(lock):
        held = AppendFile(lock)
        held.lock()
    with closing(held):
        with writing(out):
            works = _works(request, dives)
        with (
            StopSignals() as stop,
            DaskWorkers(request.n_workers, request.scheduler) as workers,
            BatchProgress(len(works), echo) as progress,
        ):
            if request.scheduler is not None:
                workers.check_access(lock)
            sized = [(work, size_of(Path(work.request.source))) for work in works]
            found = Scheduler(sized, workers, progress).run(lambda: stop.caught is not None)
        records = _all_records(out, found)
        with writing(out):
            _tidy(out / HOME)
            (out / DATASET).mkdir(exist_ok=True)
            write_dives(out / DATASET, [record.row() for record in records])
        for line in _summary_lines(out, found, stop.caught.name if stop.caught else ""):
            echo(line)
        echo(f"summary: {write_summary(out, records)}")
    claim.close()
    if stop.caught:
        return stop.exit_code
    return int(any(record.state is not DiveState.FINISHED for record in found.values()))


def _check(request: BatchRequest) -> None:
    if not request.dives:
        raise OptionError("DIVES: missing; name videos, folders, patterns or a list of dives")
    if request.run.rig is not None:
        load_rig(request.run.rig)
    if request.scheduler is not None and request.n_workers is not None:
        raise OptionError("--workers: the scheduler has its own workers; leave one of them out")
    if request.n_workers is not None and request.n_workers < 1:
        raise OptionError(f"--workers {request.n_workers}: give at least 1")


def _works(request: BatchRequest, dives: Sequence[Dive]) -> list[DiveWork]:
    """Return the work for each dive, under the name that it has in the folder for good."""
    out = request.run.out.resolve()
    known = _with_moved(_known_names(out), dives, out)
    names = name_dives([(dive.source, dive.name) for dive in dives], known)
    known |= {str(dive.source): name for dive, name in zip(dives, names, strict=True)}
    replace_text(out / HOME / _NAMES, json.dumps(known, indent=1, ensure_ascii=False))
    return [_work(request, dive, name, out) for dive, name in zip(dives, names, strict=True)]


def _work(request: BatchRequest, dive: Dive, name: str, out: Path) -> DiveWork:
    run = request.run
    own = replace(
        run,
        source=str(dive.source),
        rig=dive.rig,
        out=out / DIVES / name,
        water=dive.water,
        fps=run.fps if dive.source.is_dir() else None,
        index_target=None if run.index_target is None else run.index_target.resolve(),
        net=run.net and replace(run.net, log=dive.log, log_offset_s=dive.log_offset_s),
    )
    return DiveWork(name=name, request=own, home=out / HOME / DIVES / name, dataset=out / DATASET)


def _known_names(out: Path) -> dict[str, str]:
    """Return source to name of all dives that this folder has ever had."""
    try:
        found = read_json(out / HOME / _NAMES)
    except (OSError, ValueError):
        return {}
    return {str(key): str(value) for key, value in found.items()}


def _with_moved(known: dict[str, str], dives: Sequence[Dive], out: Path) -> dict[str, str]:
    """Return the names with those of files that were moved under their new places.

    A file was moved if one of its name and size is missing at its old place. Counted as another
    dive, it would be in the data set twice.
    """
    gone = {source: name for source, name in known.items() if not Path(source).exists()}
    for dive in dives:
        if str(dive.source) in known or dive.name:
            continue
        for source, name in gone.items():
            if Path(source).name != dive.source.name or source not in known:
                continue
            manifest = _finished(out, name)
            if manifest and manifest["facts"]["source"].get("size_bytes") == size_of(dive.source):
                known[str(dive.source)] = known.pop(source)
                break
    return known


def _finished(out: Path, name: str) -> dict[str, Any] | None:
    """Return the manifest of a dive whose pieces are joined; None of any other."""
    return read_manifest(out / HOME / DIVES / name / JOINED)


def _tidy(home: Path) -> None:
    """Remove what processes left that were killed."""
    for path in list(home.rglob("*.part")):
        clear(path)
        if path.is_file():
            path.unlink(missing_ok=True)


def _all_records(out: Path, found: Mapping[str, DiveRecord]) -> list[DiveRecord]:
    """Return how all dives of the folder stand, those of earlier batches too, by name."""
    records = dict(found)
    for source, name in _known_names(out).items():
        manifest = _finished(out, name)
        if name not in records and manifest is not None:
            facts = manifest["facts"] | known_net(out / HOME / DIVES / name, manifest["key"])
            records[name] = DiveRecord.of(name, source, facts, reused=True)
    return [records[name] for name in sorted(records, key=str.casefold)]


def _summary_lines(out: Path, found: Mapping[str, DiveRecord], stopped_by: str) -> list[str]:
    counts = Counter(record.state for record in found.values())
    lines = [
        f"{count_text(len(found), 'dive')}: "
        + ", ".join(f"{n} {s.value}" for s, n in counts.items())
    ]
    if stopped_by:
        lines.append(
            f"stopped by {stopped_by}; finished work is kept; run the same command to resume"
        )
    return [*lines, f"data set: {out / DATASET}"]


class BatchProgress(Closing):
    """Progress of a batch: a bar on a terminal, and a line for each dive; a context manager."""

    def __init__(self, n_dives: int, echo: Echo) -> None:
        self._n_dives, self._n_ended, self._n_frames = n_dives, 0, 0
        self._total = 0
        self._echo = echo
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
        # Pieces take seconds, so that the last half minute says little of the speed.
        speed_over_s = 600.0
        self._bar = Progress(
            *columns,
            TextColumn("time left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=speed_over_s,
        )
        self._task = self._bar.add_task(self._words(), total=None)

    def expect(self, n_bytes: int) -> None:
        """Note that there is so much more, or less, to be worked through than was said."""
        self._total += n_bytes
        self._bar.update(self._task, total=max(self._total, 1))

    def measured(self, n_bytes: int, n_frames: int) -> None:
        """Note that a piece is done."""
        self._n_frames += n_frames
        self._bar.update(self._task, advance=n_bytes, description=self._words())

    def ended(self, record: DiveRecord) -> None:
        """Note that a dive is done, or given up."""
        self._n_ended += 1
        self._bar.update(self._task, description=self._words())
        self._echo(record.line())

    def _words(self) -> str:
        dives, frames = count_text(self._n_dives, "dive"), count_text(self._n_frames, "frame")
        return f"{self._n_ended} of {dives}, {frames}"

    def __enter__(self) -> Self:
        """Show the bar."""
        self._bar.start()
        return self

    def close(self) -> None:
        """Take the bar away."""
        self._bar.stop()
