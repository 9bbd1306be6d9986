"""`aqualvs score`: hold answers in plain CSV against the truth of a benchmark set."""

from collections.abc import Callable, Sequence
from pathlib import Path

from aqualvs.app.disk import writing
from aqualvs.app.overwriting import Claim
from aqualvs.app.score_own import run_own
from aqualvs.app.score_results import read_system
from aqualvs.app.score_set import load_set
from aqualvs.app.score_table import SCORE_FILES, lines, score_systems, write_scores
from aqualvs.errors import OptionError


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
    """Score systems side by side and tell the table.

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
