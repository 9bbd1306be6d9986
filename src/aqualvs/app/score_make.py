"""`aqualvs benchmark`: render the public benchmark set, or a part of it."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import yaml

from aqualvs import __version__
from aqualvs.app.disk import writing
from aqualvs.app.overwriting import Claim
from aqualvs.app.progress import progress
from aqualvs.app.score_readme import README
from aqualvs.app.score_set import SET_FILE, TARGET_FILE
from aqualvs.errors import OptionError
from aqualvs.simulation.benchmark_dive import render_benchmark_dive
from aqualvs.simulation.benchmark_scenarios import (
    BENCHMARK_NAME,
    LEVELS,
    N_FRAMES,
    BenchmarkDive,
    benchmark_checksum,
    benchmark_dives,
    benchmark_rig,
)
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.visible import CONTRAST_LIMIT, VISIBLE_LIMIT

_README_MD = "README.md"


def make_set(
    out: Path,
    names: Sequence[str],
    tell: Callable[[str], object],
    *,
    n_frames: int | None,
    overwrite: bool,
) -> None:
    """Render dives of the set, with truth and a README, into a folder.

    Parameters
    ----------
    out : Path
        Folder to write.
    names : sequence of str
        Levels or dives; none for all.
    tell : callable
        Takes one line of text.
    n_frames : int or None
        Frames of every dive; None for all.
    overwrite : bool
        Whether a set that is there may be replaced.

    Raises
    ------
    OptionError
        If a name is not known or the number of frames makes no sense.
    OutputError
        If the folder holds a set already or cannot be written.
    """
    dives = chosen_dives(names, n_frames)
    files = [out / name for name in (SET_FILE, _README_MD, *(dive.name for dive in dives))]
    claim = Claim("benchmark", files, overwrite=overwrite)
    renderer = Renderer(benchmark_rig(), threads=os.cpu_count() or 1)
    total = sum(dive.scenario.n_frames for dive in dives)
    with claim, writing(out), progress(BENCHMARK_NAME, total) as tick:
        # Written last: a set that was interrupted is none.
        (out / SET_FILE).unlink(missing_ok=True)
        for dive in dives:
            render_benchmark_dive(dive, renderer, out / dive.name, tick=tick)
            (out / dive.name / TARGET_FILE).write_text(target_text(dive), encoding="utf-8")
        (out / _README_MD).write_text(README, encoding="utf-8")
        content = yaml.safe_dump(set_facts(dives), sort_keys=False, width=100)
        (out / SET_FILE).write_text(content, encoding="utf-8")
    tell(f"{len(dives)} dives, {total} frames: {out}")
    tell(f"what is in it, and what to write: {out / _README_MD}")
    tell(f"next: aqualvs score mine=RESULTS --truth {out}")


def chosen_dives(names: Sequence[str], n_frames: int | None) -> list[BenchmarkDive]:
    """Return the dives of some levels or names, in the set's order, shortened if wished.

    Raises
    ------
    OptionError
        If a name is not known or the number of frames makes no sense.
    """
    dives = benchmark_dives()
    known = [*LEVELS, *(dive.name for dive in dives)]
    for name in names:
        if name not in known:
            raise OptionError(f"{name}: no such level or dive; choose from {', '.join(known)}")
    if n_frames is not None and not 2 <= n_frames <= N_FRAMES:
        raise OptionError(f"--frames {n_frames}: give 2 to {N_FRAMES}")
    chosen = [dive for dive in dives if not names or dive.level in names or dive.name in names]
    if n_frames is None:
        return chosen
    return [dive.shortened(n_frames) for dive in chosen]


def target_text(dive: BenchmarkDive) -> str:
    """Return what may be known of a target beforehand, as `aqualvs run --target` takes it."""
    if dive.level == "empty":
        return "kind: auto\n"
    if not dive.scenario.nets:
        return "kind: solid\n"
    net = dive.scenario.nets[0]
    bar, twine = 1e3 * net.bar, 1e3 * net.twine
    return f"kind: net\nnet: {{mesh: {net.mesh}, bar_mm: {bar:g}, twine_mm: {twine:g}}}\n"


def set_facts(dives: Sequence[BenchmarkDive]) -> dict[str, Any]:
    """Return the content of the set's file."""
    whole = len(dives) == len(benchmark_dives())
    whole &= all(dive.scenario.n_frames == N_FRAMES for dive in dives)
    return {
        "aqualvs_benchmark": 1,
        "name": BENCHMARK_NAME,
        "checksum": benchmark_checksum(),
        "whole": whole,
        "rendered_with": f"aqualvs {__version__}",
        "visible_contrast_grey_levels": CONTRAST_LIMIT,
        "measurable_from_visible_points": VISIBLE_LIMIT,
        "levels": dict(LEVELS),
        "dives": {
            dive.name: {
                "level": dive.level,
                "n_frames": dive.scenario.n_frames,
                "fps": dive.scenario.fps,
                "seed": dive.scenario.seed,
            }
            for dive in dives
        },
    }


def tell_dives(tell: Callable[[str], object]) -> None:
    """Tell the levels and their dives, one line each."""
    for level, about in LEVELS.items():
        names = (dive.name for dive in benchmark_dives() if dive.level == level)
        tell(f"{level:8} {about}: {', '.join(names)}")
