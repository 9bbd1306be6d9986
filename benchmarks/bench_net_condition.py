"""Condition of random nets: mesh, twine, solidity, holes, false alarms, and what it costs.

Short rendered dives (`AQUALVS_NET_DIVES` of each kind, default 4, half a minute each); long
rendered ones past many holes (`AQUALVS_NET_LONG`, default 4, a minute and a square metre each); and
short ones without pictures, in which the true lit points are what the detector returns but for
drop-outs, until `AQUALVS_NET_AREA` square metres (default 10) are passed.
"""

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from benchmarks.random_scenes import Difficulty

from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.condition import NetCondition, NetStretch
from aqualvs.nets.holes import Hole
from aqualvs.optics.rig import Rig
from aqualvs.scanning.scan import Scan
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig
from aqualvs.simulation.scene import Net
from net_cases import NetCamera
from net_dives import (
    Dive,
    long_dive,
    passed_holes,
    random_dive,
    scans_of,
    shown_holes,
    true_solidity,
)
from quick_pictures import quick_scans

SERIES = 2031
# Of rendered dives: difficulty; whether there is a hole, a compressed video, another rig.
KINDS: dict[str, tuple[Any, bool, bool, bool]] = {
    "hole-usual": ("usual", True, False, False),
    "hole-hard": ("hard", True, False, False),
    "hole-usual-x": ("usual", True, True, False),
    "plain-clean": ("clean", False, False, False),
    "plain-usual": ("usual", False, False, False),
    "plain-hard": ("hard", False, False, False),
    "plain-usual-x": ("usual", False, True, False),
    "plain-usual-w": ("usual", False, False, True),
}
# Of long dives, in turn.
_LONG: tuple[Difficulty, ...] = ("usual", "hard", "clean", "hard", "usual", "hard")
_HOLE_BARS = (2.0, 7.0)
# Without pictures: share of lights that are lost in a frame, and in every frame.
_MISSED, _DARK = 0.05, 0.01
# A move of more bars between frames is ambiguous: the velocity is told, to so many m/s.
_AMBIGUOUS, _SIGMA_TOLD = 0.4, 0.02
# A frame whose range is off by more has another target; dives with many such frames do not count.
_WRONG_RANGE, _WRONG_SHARE = 0.05, 0.2
_MIN_STRANDS = 5.0
_MESH, _TWINE, _SOLIDITY, _LARGE_HOLE = 0.05, 0.20, 0.05, 3.0
_TARGET_MS = 3.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """One dive: the best stretch against truth, and holes.

    Attributes
    ----------
    stretch : NetStretch or None
        The last with a lattice.
    errors : array, shape (3,)
        Of mesh and twine as a share, and of solidity; NaN where not measured.
    sigmas : array, shape (3,)
        What they were said to be, in the same units.
    holes : list of (float, bool)
        Diameter in bars of every hole that was passed, and whether it was found.
    n_false : int
        Holes found where none is.
    area : float
        Square metres looked at.
    right_target : bool
        Whether the scanner measured the net and not what is behind.
    """

    stretch: NetStretch | None
    errors: FloatArray
    sigmas: FloatArray
    holes: list[tuple[float, bool]]
    n_false: int
    area: float
    right_target: bool

    @property
    def counts(self) -> bool:
        """Whether mesh, twine and solidity must be right."""
        shown = self.stretch is not None and self.stretch.n_strands >= _MIN_STRANDS
        return shown and self.right_target


def run() -> list[dict[str, Any]]:
    """Rows of the table."""
    n = int(os.environ.get("AQUALVS_NET_DIVES", "4"))
    rendered = {kind: [rendered_dive(kind, i) for i in range(n)] for kind in KINDS}
    rows = []
    for kind, outcomes in rendered.items():
        rows += accuracy_rows(kind, outcomes)
    everything = [one for outcomes in rendered.values() for one in outcomes]
    rows += accuracy_rows("all rendered", everything) + hole_rows("rendered", everything)
    n = int(os.environ.get("AQUALVS_NET_LONG", "4"))
    rows += hole_rows("long rendered", [long_rendered_dive(i) for i in range(n)])
    area = float(os.environ.get("AQUALVS_NET_AREA", "10"))
    rows += hole_rows("without pictures", dives_without_pictures(area))
    return [*rows, cost_row()]


def rendered_dive(kind: str, index: int) -> Outcome:
    """Render, scan and judge a dive of a fixed series."""
    _, _, compressed, wide = KINDS[kind]
    rig = bluerov2_rig() if wide else example_rig()
    dive = dive_of(kind, index)
    return judge(dive, scans_of(dive, rig, h264=compressed, seed=index), rig)


def long_rendered_dive(index: int, series: int = 2 * SERIES) -> Outcome:
    """Render, scan and judge a long dive: of its holes, those of which enough could be seen."""
    rig = example_rig()
    rng = np.random.default_rng([series, index])
    dive = long_dive(rng, _LONG[index // 2 % len(_LONG)])
    scans = quick_scans(dive, rig, seed=index)
    shown = shown_holes(dive, rig, scans, opening_of(dive.net))
    return judge(dive, scans, rig, shown)


def opening_of(net: Net) -> float:
    """Area of a mesh, from strand to strand, in square metres."""
    if net.mesh == "hexagon":
        return float(1.5 * np.sqrt(3.0) * net.bar**2)
    if net.mesh == "square":
        return net.bar**2
    return float(net.bar**2 * np.sin(2.0 * np.arcsin(net.hanging_ratio)))


def dive_of(kind: str, index: int, series: int = SERIES) -> Dive:
    """Return a dive of a series: 3 s past a hole, or 0.8 s."""
    difficulty, hole, _, _ = KINDS[kind]
    rng = np.random.default_rng([series, sum(kind.encode()), index])
    if not hole:
        return random_dive(rng, difficulty)
    return random_dive(rng, difficulty, seconds=3.0, speed=(0.12, 0.25), hole_bars=_HOLE_BARS)


def dives_without_pictures(area: float, series: int = SERIES + 1) -> list[Outcome]:
    """Judge hard dives until an area is passed; every other has a hole in the way."""
    rig = example_rig()
    camera = NetCamera(rig, missed=_MISSED, dark=_DARK)
    outcomes: list[Outcome] = []
    while sum(one.area for one in outcomes) < area:
        index = len(outcomes)
        rng = np.random.default_rng([series, index])
        bars = _HOLE_BARS if index % 2 else None
        dive = random_dive(rng, "hard", seconds=6.0, fps=12.0, speed=(0.1, 0.3), hole_bars=bars)
        scans = [camera.scan(dive.scene_at(t), float(t), i) for i, t in enumerate(dive.times)]
        outcomes.append(judge(dive, scans, rig))
    return outcomes


def judge(
    dive: Dive,
    scans: Sequence[Scan],
    rig: Rig,
    passed: Sequence[tuple[FloatArray, float]] | None = None,
) -> Outcome:
    """Compare what is said about a dive's net with the truth; holes passed are swept half over."""
    condition = NetCondition(rig)
    told = told_velocity(dive)
    for scan in scans:
        condition.add(scan, told)
    condition.finish()
    measured = [one for one in condition.stretches if one.lattice is not None]
    stretch = measured[-1] if measured else None
    errors, sigmas = _errors(dive, stretch)
    if passed is None:
        passed = passed_holes(dive, rig) if dive.net.holes else []
    return Outcome(
        stretch=stretch,
        errors=errors,
        sigmas=sigmas,
        holes=[
            (2.0 * radius / dive.net.bar, any(_at(one, dive, *hole) for one in condition.holes))
            for hole in passed
            for radius in hole[1:]
        ],
        n_false=sum(
            not any(_at(one, dive, np.array([x, z]), radius) for x, z, radius in dive.net.holes)
            for one in condition.holes
        ),
        area=condition.area,
        right_target=_right_target(dive, scans),
    )


def told_velocity(dive: Dive) -> FloatArray | None:
    """Velocity from another sensor, for dives that are too fast to go without."""
    if float(np.hypot(*dive.velocity)) < _AMBIGUOUS * dive.net.bar * dive.fps:
        return None
    rng = np.random.default_rng(dive.net.seed)
    return dive.velocity + rng.normal(0.0, _SIGMA_TOLD, 2)


def _at(found: Hole, dive: Dive, middle: FloatArray, radius: float) -> bool:
    """Whether a hole that was found is the one at a place on the net."""
    place = dive.velocity * found.time_s + found.from_foot
    return bool(np.hypot(*(place - middle)) < radius + dive.net.bar)


def _errors(dive: Dive, stretch: NetStretch | None) -> tuple[FloatArray, FloatArray]:
    errors, sigmas = np.full(3, np.nan), np.full(3, np.nan)
    if stretch is None or stretch.lattice is None:
        return errors, sigmas
    errors[0] = stretch.lattice.bar / dive.net.bar - 1.0
    sigmas[0] = stretch.lattice.sigma_bar / dive.net.bar
    if stretch.twine is not None:
        errors[1] = stretch.twine.thickness / dive.net.twine - 1.0
        sigmas[1] = stretch.twine.sigma / dive.net.twine
    if stretch.solidity is not None and stretch.sigma_solidity is not None:
        errors[2] = stretch.solidity - true_solidity(dive)
        sigmas[2] = stretch.sigma_solidity
    return errors, sigmas


def _right_target(dive: Dive, scans: Sequence[Scan]) -> bool:
    wrong, n = 0, 0
    for scan, t in zip(scans, dive.times, strict=True):
        if scan.posture:
            plane = dive.scene_at(t).target_plane()
            wrong += abs(scan.posture.range / plane.offset - 1.0) > _WRONG_RANGE
            n += 1
    return n > 0 and wrong <= _WRONG_SHARE * n


def accuracy_rows(name: str, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Rows on mesh, twine and solidity."""
    some = [one for one in outcomes if one.counts]
    rows = []
    if some:
        errors, sigmas = np.array([one.errors for one in some]), np.array([o.sigmas for o in some])
        bars = (_MESH, _TWINE, _SOLIDITY)
        for k, what in enumerate(("mesh within 5 %", "twine within 20 %", "solidity within 0.05")):
            known = np.isfinite(errors[:, k])
            share = float(np.mean(np.abs(errors[known, k]) <= bars[k]))
            z = float(np.sqrt(np.mean((errors[known, k] / sigmas[known, k]) ** 2)))
            label = f"{name}: {what}, {np.count_nonzero(known)} dives, z {z:.1f}"
            rows.append(_row(label, 100.0 * share, "%", 100.0, share))
    right = [one for one in outcomes if one.right_target]
    label = f"{name}: dives with a lattice, of {len(right)}"
    rows.append(_row(label, sum(one.stretch is not None for one in right), "dives", None, None))
    return rows


def hole_rows(name: str, outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """Rows on holes."""
    rows = []
    large = [found for one in outcomes for bars, found in one.holes if bars >= _LARGE_HOLE]
    small = [found for one in outcomes for bars, found in one.holes if bars < _LARGE_HOLE]
    for label, found in (("of 3 meshes or more", large), ("of 2 to 3 meshes", small)):
        if found:
            share = float(np.mean(found))
            text = f"{name}: holes {label} found, of {len(found)}"
            rows.append(_row(text, 100.0 * share, "%", 95.0, share / 0.95))
    n_false, area = sum(one.n_false for one in outcomes), sum(one.area for one in outcomes)
    text = f"{name}: false alarms on {area:.0f} m2"
    rows.append(_row(text, n_false, "holes", max(area / 100.0, 1.0), None))
    return rows


def cost_row() -> dict[str, Any]:
    """Time for a frame, amortised over a minute of a dive to and fro; the best of three."""
    rig = example_rig()
    dive = dive_of("hole-usual", 3)
    camera = NetCamera(rig, missed=_MISSED)
    seen = [camera.scan(dive.scene_at(t), float(t), i) for i, t in enumerate(dive.times)]
    scans = [
        replace(scan, index=i, time_s=i / dive.fps)
        for i, scan in enumerate((seen + seen[::-1]) * (1500 // (2 * len(seen))))
    ]
    best = np.inf
    for _ in range(3):
        condition = NetCondition(rig)
        start = time.process_time()
        condition.add_all(scans)
        best = min(best, (time.process_time() - start) / len(scans))
    return _row("cost of a frame", 1e3 * best, "ms", _TARGET_MS, _TARGET_MS / (1e3 * best))


def _row(
    name: str, value: float, unit: str, reference: float | None, ratio: float | None
) -> dict[str, Any]:
    return {"name": name, "value": value, "unit": unit, "reference": reference, "ratio": ratio}
