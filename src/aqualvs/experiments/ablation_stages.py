"""Ablations of the stages: stripe detector, plane fit and mesh filter against the paper's.

They compare the sub-pixel stripe detector with the paper's threshold, the robust weighted fit with
the paper's pseudo-inverse, and the adaptive mesh filter with the paper's over a grid of its
parameters.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from aqualvs.experiments.experiment import DataColumns, Experiment, ExperimentResult, ExperimentRow
from aqualvs.experiments.growth_and_sun import scene
from aqualvs.experiments.laboratory import (
    Laboratory,
    RenderedDive,
    Variant,
    compared,
    numbers_text,
    variants_picture,
)
from aqualvs.experiments.mesh_filter import (
    LitTruth,
    PrecisionRecall,
    adaptive_pixels,
    mean_score,
    net_dive,
    papers_centres,
    papers_pixels,
    score_reflections,
)
from aqualvs.experiments.tank import wall_dive
from aqualvs.scanner import ScannerOptions
from aqualvs.scanning.paper.detector import FilteredPeaks
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions
from aqualvs.scanning.posture_estimator import FitMethod
from aqualvs.scanning.stripe import StripeOptions, ThresholdOptions
from aqualvs.simulation.scenario import Scenario, parse_scenario

# Thresholds in grey levels, and the scenes besides the wall.
_LEVELS = (100, 140, 180)
_NETS = {"sun": "net in sun", "growth": "grown net"}


def _run_stripes(laboratory: Laboratory) -> ExperimentResult:
    dives = {"wall": wall_dive(laboratory)} | {
        where: laboratory.dive(scene(name)) for name, where in _NETS.items()
    }
    variants = [one for where, dive in dives.items() for one in _variants(laboratory, dive, where)]
    return compared(
        "ablation_stripes",
        "Root mean square errors with the sub-pixel detector and with thresholds.",
        variants,
        sentence=_sentence(variants, list(dives)),
        notes=(
            "Everything after the detector is the same: filter, target and robust fit. If its "
            "level suits a scene, a threshold is as accurate as the sub-pixel detector: a stripe "
            "has many points, and their rounding errors cancel. But no level suits every scene.",
        ),
    )


def _sentence(variants: list[Variant], places: list[str]) -> str:
    """Return a sentence on each detector's result in its worst scene."""
    found = {
        what: [v.measured for v in variants if v.name.startswith(what)]
        for what in ("sub-pixel", *(f"threshold {level}" for level in _LEVELS))
    }
    shares = {what: min(m.valid_percent for m in dives) for what, dives in found.items()}
    worst = {what: max(float(m.rms[0]) for m in dives) for what, dives in found.items()}
    ours = f"{worst['sub-pixel']:.2f} % in {shares['sub-pixel']:.0f} % of the frames"
    others = "; ".join(
        f"{what} has {numbers_text([worst[what]])} % in {shares[what]:.0f} %"
        for what in shares
        if what != "sub-pixel"
    )
    return (
        f"In its worst scene ({', '.join(places)}) the sub-pixel detector has a "
        f"range error of {ours}; {others}."
    )


def _variants(laboratory: Laboratory, dive: RenderedDive, where: str) -> list[Variant]:
    ours = ScannerOptions(detector=StripeOptions())
    found = [Variant(f"sub-pixel, {where}", laboratory.measure(dive, ours), ours=True)]
    for level in _LEVELS:
        options = ScannerOptions(detector=ThresholdOptions(level=level))
        found.append(Variant(f"threshold {level}, {where}", laboratory.measure(dive, options)))
    return found


STRIPES = Experiment(
    title="Why a sub-pixel detector",
    about="The wall at the paper's four distances, and the net in the sun, with the sub-pixel "
    "stripe detector and with fixed thresholds as in section 3.1.",
    run=_run_stripes,
)


_FITS = {"robust": FitMethod.ROBUST, "pseudo-inverse": FitMethod.PSEUDO_INVERSE}


def _run_fits(laboratory: Laboratory) -> ExperimentResult:
    dives = {
        "wall": wall_dive(laboratory),
        "net": net_dive(laboratory),
        "grown net": laboratory.dive(scene("growth")),
    }
    variants = [
        Variant(
            f"{fit}, {where}",
            laboratory.measure(dive, ScannerOptions(fit=method)),
            ours=method is FitMethod.ROBUST,
        )
        for where, dive in dives.items()
        for fit, method in _FITS.items()
    ]
    rms = [one.measured.rms[0] for one in variants]
    times = [theirs / ours for ours, theirs in zip(rms[::2], rms[1::2], strict=True)]
    return compared(
        "ablation_fits",
        "Root mean square errors with the robust fit and with the pseudo-inverse of Eq. 24, on the "
        "same points of the target.",
        variants,
        sentence="Fitted by the paper's pseudo-inverse to the same target points, the range error "
        f"is {numbers_text(times)} times that of the robust fit on {', '.join(dives)}.",
        notes=(
            "The points are those that our own search has assigned to the target; it has already "
            "removed most of the outliers that affect the pseudo-inverse.",
        ),
    )


FITS = Experiment(
    title="Why a robust fit",
    about="The points of the target in three dives, fitted robustly with their covariances, and "
    "with equal weights by pseudo-inverse.",
    run=_run_fits,
)


# Two frames at about each of three ranges, in mm.
_RANGES = {"0.4 m": (400, 450), "0.6 m": (600, 650), "0.8 m": (800, 850)}
# The diamond has the r_min and r_max of section 5.2. A laser perpendicular to the strands of the
# square net crosses one every 25 mm: region C then contains two neighbours.
_FILTERS_NETS = ("diamond", "square")
# The paper does not state its threshold, so several are tried, in grey levels.
_FILTERS_LEVELS = (140, 180, 220)
# Filters of lower precision are of no use, however much of the net they keep.
_MIN_PRECISION = 0.9


class _Set(NamedTuple):
    """Parameters of threshold and filter.

    Threshold in grey levels, None for sub-pixel centres; rd_theta, dd, r_min and r_max in mm.
    """

    level: int | None
    lengths_mm: tuple[float, float, float, float]

    @property
    def options(self) -> MeshFilterOptions:
        """Options of the filter."""
        rd_theta, dd, r_min, r_max = (1e-3 * length for length in self.lengths_mm)
        return MeshFilterOptions(rd_theta=rd_theta, dd=dd, r_min=r_min, r_max=r_max)

    @property
    def scanner(self) -> ScannerOptions:
        """Options of the scanner with this detector and filter."""
        if self.level is None:
            return ScannerOptions(mesh_filter=self.options)
        detector = ThresholdOptions(level=self.level)
        return ScannerOptions(detector=detector, mesh_filter=self.options)

    @property
    def text(self) -> str:
        """The parameters as text."""
        lengths = "/".join(f"{length:g}" for length in self.lengths_mm)
        return f"{lengths} mm" if self.level is None else f"level {self.level}, {lengths} mm"


_LENGTHS_MM = tuple(
    (rd_theta, dd, r_min, r_max)
    for rd_theta in (10.0, 20.0, 30.0)
    for dd in (1.0, 3.0, 8.0, 14.0)
    for r_min, r_max in ((8.0, 25.0), (15.0, 35.0))
    if rd_theta < r_max
)
_GRID = tuple(_Set(level, lengths) for level in _FILTERS_LEVELS for lengths in _LENGTHS_MM)
_KINDS = {
    "section 5.2": tuple(_Set(level, (10.0, 1.0, 15.0, 35.0)) for level in _FILTERS_LEVELS),
    "best of the grid": _GRID,
    "best of the grid, one centre per peak": tuple(_Set(None, one) for one in _LENGTHS_MM),
}


@dataclass(frozen=True, slots=True)
class _Seen:
    """Results of the adaptive filter and of each set on one net, frame by frame."""

    net: str
    adaptive: list[PrecisionRecall]
    papers: dict[_Set, list[PrecisionRecall]] = field(default_factory=dict)


def nets_at_ranges(net: str) -> Scenario:
    """Return a dive before a net with bars of 25 mm and a wall, in steps through the ranges."""
    values = [one for pair in _RANGES.values() for one in pair]
    facts = {
        "duration_s": 0.04 * len(values),
        "motion": {
            "range_mm": {"values": values, "mode": "steps"},
            "pitch_deg": [2, -2],
            "yaw_deg": [-4, 3],
        },
        "net": {"mesh": net, "bar_mm": 25, "twine_mm": 2},
        "walls": [{"behind_mm": 700, "yaw_deg": 3, "tile_mm": 150}],
    }
    return parse_scenario(facts, f"filters_{net}", f"filters_{net}")


def _run_filters(laboratory: Laboratory) -> ExperimentResult:
    seen = [_see(laboratory, net) for net in _FILTERS_NETS]
    rows = [_row(one, k, where) for one in seen for k, where in enumerate(_RANGES)]
    ours = [row.adaptive.recall for row in rows]
    named, best, centres = (max(row.paper[kind][1].recall for row in rows) for kind in _KINDS)
    return ExperimentResult(
        sentence=f"The adaptive filter keeps at least {100 * min(ours):.0f} % of a net's "
        "reflections without a parameter. The paper's, given every bright pixel, keeps "
        f"{100 * named:.0f} % at best with section 5.2's parameters, and {100 * best:.0f} % with "
        f"the best of {len(_GRID)} sets for that net and range; given one centre per peak "
        f"{100 * centres:.0f} %.",
        findings=tuple(finding for row in rows for finding in row.findings()),
        pictures=(
            variants_picture(
                "ablation_filters",
                "Posture on the net of the mesh experiment with the adaptive filter, and "
                "with a threshold and the paper's filter before the same search and fit.",
                _postures(laboratory, net_dive(laboratory), rows),
            ),
        ),
        series=(_series(rows),),
        notes=(
            "Reflections are groups of connected bright pixels of one laser. Each net and range "
            "has its own best set, of those whose precision is "
            f"{_MIN_PRECISION:g} or more: level of the threshold, rd_theta/dd/r_min/r_max. The "
            "level of section 5.2's row is the best of the same three. One centre per peak is the "
            "output of the sub-pixel detector on each search line, and not the paper's method.",
        ),
    )


def _see(laboratory: Laboratory, net: str) -> _Seen:
    """Evaluate the adaptive filter and all sets of the paper's on one net."""
    scenario = nets_at_ranges(net)
    frames = tuple(range(scenario.n_frames))
    dive = laboratory.dive(scenario, point_frames=frames)
    truth = [LitTruth.read(dive.folder / f"points_{i:04d}.npz") for i in frames]
    measured = laboratory.measure(dive)
    seen = _Seen(net, _judged(adaptive_pixels(measured.scans, dive.rig), truth))
    for one in itertools.chain(*_KINDS.values()):
        if one.level is None:
            found = papers_centres(laboratory, dive, one.options)
        else:
            found = papers_pixels(laboratory, dive, one.options, one.level)
        seen.papers[one] = _judged(found, truth)
    return seen


def _judged(found: Sequence[FilteredPeaks], truth: Sequence[LitTruth]) -> list[PrecisionRecall]:
    return [score_reflections(one, lit) for one, lit in zip(found, truth, strict=True)]


@dataclass(frozen=True, slots=True)
class _Row:
    """Results on one net at one range: of the adaptive filter, and of the paper's best sets."""

    where: str
    adaptive: PrecisionRecall
    paper: Mapping[str, tuple[_Set, PrecisionRecall]]

    def findings(self) -> list[ExperimentRow]:
        """Return the rows of the table."""
        what = f"{self.where}: precision, recall of net reflections"
        return [ExperimentRow(what=f"{what}, adaptive", ours=numbers_text(self.adaptive))] + [
            ExperimentRow(what=f"{what}, {kind}", ours=f"{numbers_text(judged)} ({one.text})")
            for kind, (one, judged) in self.paper.items()
        ]


def _row(seen: _Seen, k: int, where: str) -> _Row:
    here = slice(2 * k, 2 * k + 2)
    judged = {one: mean_score(found[here]) for one, found in seen.papers.items()}
    return _Row(
        f"{seen.net}, {where}",
        mean_score(seen.adaptive[here]),
        {kind: _best({one: judged[one] for one in sets}) for kind, sets in _KINDS.items()},
    )


def _best(judged: Mapping[_Set, PrecisionRecall]) -> tuple[_Set, PrecisionRecall]:
    """Return the set with the largest recall among those of sufficient precision."""
    return max(
        judged.items(),
        key=lambda item: -1.0 if item[1].precision < _MIN_PRECISION else item[1].recall,
    )


def _postures(laboratory: Laboratory, dive: RenderedDive, rows: Sequence[_Row]) -> list[Variant]:
    variants = [Variant("adaptive", laboratory.measure(dive), ours=True)]
    sets = [one for row in rows for one, _ in row.paper.values() if row.where.startswith("diamond")]
    for one in dict.fromkeys(sets):
        variants.append(Variant(f"paper, {one.text}", laboratory.measure(dive, one.scanner)))
    return variants


def _series(rows: Sequence[_Row]) -> DataColumns:
    judged = {f"{row.where}, adaptive": row.adaptive for row in rows}
    judged |= {
        f"{row.where}, {kind}, {one.text}": found
        for row in rows
        for kind, (one, found) in row.paper.items()
    }
    return DataColumns(
        name="ablation_filters",
        columns={
            "filter": list(judged),
            "precision": np.array([one.precision for one in judged.values()]),
            "recall": np.array([one.recall for one in judged.values()]),
        },
    )


FILTERS = Experiment(
    title="Why an adaptive mesh filter",
    about="Two nets at three ranges, and the net of the mesh experiment; a threshold and the "
    "paper's filter on every bright pixel, with its own and with other parameters, compared "
    "with the adaptive filter.",
    run=_run_filters,
)
