"""Optimisation of a design: best angles of its lasers, and the changes that help most.

Angles: coordinate exchange (Meyer & Nachtsheim 1995, Technometrics 37, 60-69). Each laser in turn
takes the best of its candidate angles while the others are held, until none changes. The
information of stripes is additive over lasers (`stripes`), so that candidates are evaluated once
for each grid; grids become finer around the best.

Changes: each one is tried with the lasers' angles optimised again (`changes`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from aqualvs.design.judge import Judge, StripeSet, predict, score
from aqualvs.design.settings import Design, Mount, tangential
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3

TILT_LIMITS = (math.radians(-40.0), math.radians(60.0))
"""Limits of the search for the best tilt."""

_DEG = math.pi / 180.0
# Steps of tilt and stripe in each grid, and their number to each side in all but the first grid,
# which covers all angles.
_TILT_STEPS = (2.5 * _DEG, 0.5 * _DEG, 0.1 * _DEG)
_STRIPE_STEPS = (15.0 * _DEG, 5.0 * _DEG, 1.0 * _DEG)
_HALF_TILTS, _HALF_STRIPES = 6, 3
# Number of initial choices of each kind, see `_starts`.
_N_STARTS = 8
# Limit of exchanges, in case two choices alternate.
_MAX_ROUNDS = 20


def best_angles(design: Design, *, quick: bool = False) -> Design:
    """Return the design with the best angles of the mounts whose angles are free.

    The fans of these mounts are swung so that their middles are beside the forward axis at the
    middle of the working range.

    `quick`: start from the mounts' own angles only, which is sufficient after small changes.
    """
    if not any(mount.free_tilt or mount.free_stripe for mount in design.mounts):
        return design
    judge = Judge(design)
    halfway = math.sqrt(math.prod(design.rig.working_range))
    mounts = list(design.mounts)
    for i in range(len(_TILT_STEPS)):
        lots = [_candidates(mount, i, halfway) for mount in mounts]
        traced = [judge.trace(lot) for lot in lots]
        starts = [[_nearest(one, lot) for one, lot in zip(mounts, lots, strict=True)]]
        if i == 0 and not quick:
            starts += _starts(lots)
        _, picked = min((_exchange(judge, traced, one) for one in starts), key=lambda x: x[0])
        mounts = [lot[k] for lot, k in zip(lots, picked, strict=True)]
    return design.with_mounts(mounts)


def _exchange(
    judge: Judge, lots: Sequence[StripeSet], start: Sequence[int]
) -> tuple[float, list[int]]:
    """Exchange each laser for its best candidate until none changes.

    Returns the score of the choice, and the index of the candidate of each laser.
    """
    picked, least = list(start), math.inf
    for _ in range(_MAX_ROUNDS):
        before = list(picked)
        for i, lot in enumerate(lots):
            others = lot.take([])
            for j, other in enumerate(lots):
                if j != i:
                    others = others.joined(other.take([picked[j]]))
            _, totals = judge.judge(lot, others)
            picked[i] = int(np.argmin(totals))
            least = float(totals[picked[i]])
        if picked == before:
            break
    return least, picked


def _candidates(mount: Mount, i_grid: int, halfway: float) -> list[Mount]:
    """Return a mount at all angles of a grid; all but the first grid are centred on the mount."""
    if not (mount.free_tilt or mount.free_stripe):
        return [mount]
    tilts, stripes = [mount.tilt], [mount.stripe]
    first = i_grid == 0
    # Factor on the width of the first grid if the stripe's direction is free, too.
    wider = 2.0
    if mount.free_tilt:
        low, high = TILT_LIMITS
        step = _TILT_STEPS[0] * (wider if mount.free_stripe else 1.0)
        whole = np.arange(low, high + 1e-9, step).tolist()
        tilts = whole if first else _around(mount.tilt, _TILT_STEPS[i_grid], _HALF_TILTS)
    if mount.free_stripe:
        whole = np.arange(0.0, math.pi - 1e-9, _STRIPE_STEPS[0]).tolist()
        stripes = whole if first else _around(mount.stripe, _STRIPE_STEPS[i_grid], _HALF_STRIPES)
    # A stripe is turned only as far as half of the baseline remains: one whose sheet passes the
    # lens does not move with range.
    least = 0.5 * math.hypot(mount.position[0], mount.position[2]) if mount.free_stripe else 0.0
    turned = [replace(mount, stripe=stripe % math.pi) for stripe in stripes]
    return [
        replace(one, tilt=float(np.clip(tilt, *TILT_LIMITS))).aimed_at(halfway)
        for one in turned
        if one.baseline >= least
        for tilt in tilts
    ]


def _nearest(mount: Mount, lot: Sequence[Mount]) -> int:
    """Return the candidate whose angles are nearest to a mount's."""
    off = [abs(one.tilt - mount.tilt) + abs(math.sin(one.stripe - mount.stripe)) for one in lot]
    return int(np.argmin(off))


def _around(middle: float, step: float, half: int) -> list[float]:
    steps: list[float] = (middle + step * np.arange(-half, half + 1)).tolist()
    return steps


def _starts(lots: Sequence[Sequence[Mount]]) -> list[list[int]]:
    """Return initial choices: the same for all lasers, and random ones with a fixed seed."""
    shares = (np.arange(_N_STARTS) + 0.5) / _N_STARTS
    alike = [[share] * len(lots) for share in shares.tolist()]
    mixed = np.random.default_rng(0).uniform(size=(_N_STARTS, len(lots))).tolist()
    return [
        [int(share * len(lot)) for share, lot in zip(start, lots, strict=True)]
        for start in alike + mixed
    ]


class Change(NamedTuple):
    """Effect of a change of a design; all numbers are ratios of errors, after to before."""

    words: str  # Description of the change.
    score: float  # Root mean square of all errors, in goals, on walls and nets.
    # Errors of a single frame on a wall, from noise alone, root mean square over the range.
    noise_range: float
    noise_angle: float
    # Errors from the tolerances of lasers and water.
    systematic_range: float
    systematic_angle: float


def changes(design: Design) -> list[Change]:
    """Evaluate every change and return them, the most helpful first.

    `design`: with the final tilts of its lasers. Free angles are optimised again for each change.
    """
    now = _measures(design)
    tried = ((words, change(design)) for words, change in _CHANGES.items())
    found = [
        Change(words, *(_measures(best_angles(new, quick=True)) / now).tolist())
        for words, new in tried
        if new is not None
    ]
    return sorted(found, key=lambda change: change.score)


def _measures(design: Design) -> FloatArray:
    """Return the score, then noise and tolerances for range (as a share) and angles."""
    errors = predict(design)
    parts = [score(design).error]
    for sigma in (errors.wall, errors.systematic_total):
        parts.append(_rms(sigma[:, 0] / errors.ranges))
        parts.append(_rms(np.hypot(sigma[:, 1], sigma[:, 2])))
    return np.array(parts)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _for_mounts(design: Design, change: Callable[[Mount], Mount]) -> Design:
    return design.with_mounts([change(mount) for mount in design.mounts])


def _moved_out(mount: Mount) -> Mount:
    x, y, z = mount.position
    return replace(mount, position=(1.2 * x, y, 1.2 * z))


def _finer(design: Design) -> Design:
    rig = design.rig
    lens, (width, height) = rig.lens, rig.size_px
    # The centre of the top-left pixel is (0, 0), its corner (-0.5, -0.5).
    cx, cy = 2.0 * lens.cx + 0.5, 2.0 * lens.cy + 0.5
    finer = replace(lens, fx=2.0 * lens.fx, fy=2.0 * lens.fy, cx=cx, cy=cy)
    return replace(design, rig=replace(rig, lens=finer, size_px=(2 * width, 2 * height)))


def _longer_lens(share: float) -> Callable[[Design], Design]:
    def change(design: Design) -> Design:
        lens = design.rig.lens
        longer = replace(lens, fx=share * lens.fx, fy=share * lens.fy)
        return replace(design, rig=replace(design.rig, lens=longer))

    return change


def _one_more(design: Design) -> Design | None:
    """Add a laser at the best free place across the axis from an existing one."""
    names = {mount.name for mount in design.mounts}
    name = next(name for name in (f"extra_{i}" for i in range(1, 99)) if name not in names)
    tilt, fan = design.mounts[0].tilt, design.mounts[0].fan
    places = [mount.position for mount in design.mounts]
    # Least distance between lasers, in metres.
    room = 0.03
    added = [
        Mount(name=name, position=place, stripe=tangential(place), tilt=tilt, fan=fan)
        for place in ((-x, y, -z) for x, y, z in places)
        if all(math.dist(place, other) > room for other in places)
    ]
    tried = (best_angles(design.with_mounts([*design.mounts, one]), quick=True) for one in added)
    return min(tried, key=lambda one: score(one).total, default=None)


def _turned(design: Design) -> Design | None:
    if all(mount.free_stripe for mount in design.mounts):
        return None
    return _for_mounts(design, lambda mount: replace(mount, free_stripe=True))


def _centred(design: Design) -> Design | None:
    pose = design.rig.dome_from_cam
    if design.rig.dome is None or float(np.linalg.norm(pose.translation)) < 1e-4:
        return None
    centred = SE3(pose.rotation, np.zeros(3))
    return replace(design, rig=replace(design.rig, dome_from_cam=centred))


def _halved(part: str, *names: str) -> Callable[[Design], Design]:
    """Return the change that halves these numbers of a part of the design."""

    def change(design: Design) -> Design:
        before = getattr(design, part)
        halved = {name: 0.5 * getattr(before, name) for name in names}
        return replace(design, **{part: replace(before, **halved)})

    return change


def _nearer(design: Design) -> Design | None:
    near, far = design.rig.working_range
    if 0.8 * far <= near:
        return None
    return replace(design, rig=replace(design.rig, working_range=(near, 0.8 * far)))


_CHANGES: dict[str, Callable[[Design], Design | None]] = {
    "baseline 20 % longer": lambda design: _for_mounts(design, _moved_out),
    "twice the pixels, each way": _finer,
    "focal length 25 % longer": _longer_lens(1.25),
    "focal length 20 % shorter": _longer_lens(0.8),
    "one more laser": _one_more,
    "stripes turned to their best directions": _turned,
    "stripes may cross": lambda design: (
        replace(design, avoid_crossings=False) if design.avoid_crossings else None
    ),
    "fan of 90 degrees": lambda design: _for_mounts(
        design, lambda mount: replace(mount, fan=math.radians(90.0))
    ),
    "lens in the dome's centre": _centred,
    # Of frames with stripes at different places of the target. The shift of the light on twine
    # stays: it depends on twine and water, not on the place.
    "mean of four frames": _halved("noise", "point", "strand", "shared"),
    "lasers known twice as well": _halved("tolerances", "laser_angle", "laser_offset"),
    "water's index known twice as well": _halved("tolerances", "n_water"),
    "working range ends 20 % nearer": _nearer,
}
