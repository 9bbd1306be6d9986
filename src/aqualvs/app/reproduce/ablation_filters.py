"""What the adaptive mesh filter is worth over the paper's, whatever its parameters."""

import numpy as np

from aqualvs.app.reproduce.experiment import Experiment, Finding, Outcome, Picture, Series
from aqualvs.app.reproduce.laboratory import Laboratory
from aqualvs.app.reproduce.mesh_filter import net_dive, truth_of
from aqualvs.app.reproduce.papers_points import papers_points
from aqualvs.app.reproduce.point_truth import Judged, judge, mean_judged
from aqualvs.app.reproduce.variants import Variant, drawn, told
from aqualvs.scanning.mesh import MeshFilterOptions
from aqualvs.scanning.pipeline import ScannerOptions

_SETS_MM = {
    "section 5.2": (10.0, 1.0, 15.0, 35.0),
    "thread as it is": (4.0, 1.0, 15.0, 35.0),
    "mesh as it is": (10.0, 1.0, 22.0, 45.0),
    "coarse cells": (10.0, 2.0, 15.0, 35.0),
    "twice too large": (20.0, 1.0, 30.0, 70.0),
}
"""rd_theta, dd, r_min and r_max."""


def _run(laboratory: Laboratory) -> Outcome:
    dive = net_dive(laboratory)
    truth, ours = truth_of(dive), laboratory.measure(dive)
    mine = mean_judged([judge(ours.scans[i].points, lit) for i, lit in truth])
    judged, variants = {"adaptive": mine}, [Variant("adaptive", (ours,), ours=True)]
    for name, lengths in _SETS_MM.items():
        options = _options(lengths)
        kept = papers_points(laboratory, dive, options)
        judged[f"paper, {name}"] = mean_judged([kept[i].judged(lit) for i, lit in truth])
        before = laboratory.measure(dive, ScannerOptions(mesh_filter=options))
        variants.append(Variant(f"paper, {name}", (before,)))
    best = max(one.recall for name, one in judged.items() if name != "adaptive")
    return Outcome(
        sentence=f"The adaptive filter keeps {100 * mine.recall:.0f} % of the net without a "
        f"parameter; the paper's keeps {100 * best:.0f} % with the best of {len(_SETS_MM)} sets of "
        "parameters.",
        findings=tuple(_row(name, one) for name, one in judged.items()),
        pictures=(
            Picture(
                name="ablation_filters",
                caption="Posture on the net with the adaptive filter alone, and with the paper's "
                "filter in front of the same search and fit.",
                figure=drawn(variants),
            ),
        ),
        series=(_series(judged),),
    )


def _options(lengths_mm: tuple[float, float, float, float]) -> MeshFilterOptions:
    rd_theta, dd, r_min, r_max = (1e-3 * length for length in lengths_mm)
    return MeshFilterOptions(rd_theta=rd_theta, dd=dd, r_min=r_min, r_max=r_max)


def _row(name: str, one: Judged) -> Finding:
    return Finding(what=f"{name}: precision, recall of net points", paper="", ours=told(one))


def _series(judged: dict[str, Judged]) -> Series:
    return Series(
        name="ablation_filters",
        columns={
            "filter": list(judged),
            "precision": np.array([one.precision for one in judged.values()]),
            "recall": np.array([one.recall for one in judged.values()]),
        },
    )


EXPERIMENT = Experiment(
    name="filters",
    title="Why an adaptive mesh filter",
    paper="",
    about="The net of the mesh experiment; the paper's filter with its own and with four other "
    "sets of parameters, on threshold reflections, against the adaptive filter.",
    run=_run,
)
