"""`aqualvs score`: answers in plain CSV compared with the truth of a benchmark set.

Systems that come with aqualvs can be run over the set as well: aqualvs itself, and what it is
compared with (`OWN_SYSTEMS`).
"""

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from aqualvs.errors import OptionError
from aqualvs.experiments.benchmark.measures import SCORE_FILES, lines, score_systems, write_scores
from aqualvs.experiments.benchmark.set import TARGET_FILE, BenchmarkSet, load_set, read_system
from aqualvs.nets.target_file import target_facts
from aqualvs.pipeline import run
from aqualvs.results.files import Claim, writing
from aqualvs.results.folder import POSTURE_BARE_CSV
from aqualvs.results.run_request import RunRequest, scanner_options
from aqualvs.scanning.target import TargetKind


@dataclass(frozen=True, slots=True, kw_only=True)
class OwnSystem:
    """Options of `aqualvs run`.

    Attributes
    ----------
    name : str
    detector : {"ridge", "threshold"}
    mesh_filter : {"none", "paper"}
    fit : {"robust", "pseudo_inverse"}
    no_dome : bool
    """

    name: str
    detector: str = "ridge"
    mesh_filter: str = "none"
    fit: str = "robust"
    no_dome: bool = False


OWN_SYSTEMS = (
    OwnSystem(name="aqualvs"),
    OwnSystem(name="no-dome", no_dome=True),
    OwnSystem(name="threshold", detector="threshold"),
    OwnSystem(name="paper-filter", mesh_filter="paper"),
    OwnSystem(name="paper", detector="threshold", mesh_filter="paper", fit="pseudo_inverse"),
)
"""aqualvs as it is; without its dome model; with the paper's detector; with the paper's filter for
nets, which is told the net; and with the paper's detector, filter and fit, dome modelled."""

BARE_LENS = "bare-lens"
"""What aqualvs found, triangulated again without the dome: the stripes are told apart with it."""


def run_own(
    benchmark: BenchmarkSet, folder: Path, tell: Callable[[str], object], *, overwrite: bool
) -> list[str]:
    """Measure every dive of a set with every system of `OWN_SYSTEMS`.

    Parameters
    ----------
    benchmark : BenchmarkSet
    folder : Path
        A run goes to SYSTEM/DIVE in it.
    tell : callable
        Takes one line of text.
    overwrite : bool
        Whether to replace runs that are there.

    Returns
    -------
    arguments : list of str
        NAME=PATH of every system, to be scored.

    Raises
    ------
    AqualvsError
        If a dive cannot be read or the folder not be written.
    """
    for system in OWN_SYSTEMS:
        for dive in benchmark.dives:
            run(
                _request(
                    system,
                    benchmark.folder / dive.name,
                    folder / system.name / dive.name,
                    overwrite,
                )
            )
        tell(f"{system.name}: {len(benchmark.dives)} dives measured into {folder / system.name}")
    bare = folder / BARE_LENS
    files = [bare / f"{dive.name}.csv" for dive in benchmark.dives]
    with Claim("score", files, overwrite=overwrite), writing(bare):
        for dive in benchmark.dives:
            found = folder / OWN_SYSTEMS[0].name / dive.name / POSTURE_BARE_CSV
            shutil.copyfile(found, bare / f"{dive.name}.csv")
    names = [*(system.name for system in OWN_SYSTEMS), BARE_LENS]
    return [f"{name}={folder / name}" for name in names]


def _request(system: OwnSystem, source: Path, out: Path, overwrite: bool) -> RunRequest:
    """Return what to run; a wall is no net, so no filter for nets is laid over it."""
    target, mesh_filter = "auto", "none"
    if system.mesh_filter == "paper":
        told = str(source / TARGET_FILE)
        if target_facts(told).kind is not TargetKind.SOLID:
            target, mesh_filter = told, system.mesh_filter
    return RunRequest(
        source=str(source / "dive.mp4"),
        rig=source / "rig.yaml",
        out=out,
        overwrite=overwrite,
        no_dome=system.no_dome,
        scanner=scanner_options(target, system.detector, mesh_filter, system.fit),
        report=False,
    )


def score_and_tell(
    results: Sequence[str],
    truth: Path,
    tell: Callable[[str], object],
    *,
    own: Path | None,
    out: Path | None,
    dives: bool,
    overwrite: bool = False,
) -> None:
    """Score systems side by side and print the table.

    Parameters
    ----------
    results : sequence of str
        NAME=PATH or paths, as `read_system` takes them.
    truth : Path
        Folder of the set.
    tell : callable
        Takes one line of text.
    own : Path or None
        Folder in which to run what comes with aqualvs first, to be scored too.
    out : Path or None
        Folder for `scores.csv`, `scores.json` and `scores.md`.
    dives : bool
        Whether the table shows every dive.
    overwrite : bool
        Whether to replace what this command wrote to `own` and `out` before.

    Raises
    ------
    AqualvsError
        If truth or results cannot be used, or a folder cannot be written.
    """
    if not results and own is None:
        raise OptionError(
            "RESULTS: missing; give NAME=PATH of what a system answered, or --own DIR"
        )
    benchmark = load_set(truth)
    files = [] if out is None else [out / name for name in SCORE_FILES]
    with Claim("score", files, overwrite=overwrite):
        arguments = list(results)
        systems = [read_system(argument, benchmark) for argument in arguments]
        if own is not None:
            mine = run_own(benchmark, own, tell, overwrite=overwrite)
            systems += [read_system(argument, benchmark) for argument in mine]
        names = [system.name for system in systems]
        twice = next((name for name in names if names.count(name) > 1), None)
        if twice is not None:
            raise OptionError(f"{twice}: two systems of this name; give NAME=PATH")
        scores = score_systems(benchmark, systems)
        for line in lines(scores, dives=dives):
            tell(line)
        for system in systems:
            if system.missing:
                tell(
                    f"{system.name}: no file for {', '.join(system.missing)}: counted as no answer"
                )
        if out is not None:
            with writing(out):
                written = write_scores(scores, out)
            tell(f"scores: {', '.join(map(str, written))}")
