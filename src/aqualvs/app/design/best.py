"""The best angles for a design's lasers.

Coordinate exchange (Meyer & Nachtsheim 1995, Technometrics 37, 60-69): one laser after the other
takes the best of its candidates, the others being as they are, until none changes. What a stripe
tells adds up over the lasers (`stripes`), so the candidates are traced once for each grid; grids
become finer about the best.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from aqualvs.app.design.judge import Judge, Lot
from aqualvs.app.design.mount import Mount
from aqualvs.app.design.settings import Design

TILT_LIMITS = (math.radians(-40.0), math.radians(60.0))
"""Tilts among which the best is sought."""

_DEG = math.pi / 180.0
# Steps of tilt and stripe from grid to grid, and how many to each side after the first.
_TILT_STEPS = (2.5 * _DEG, 0.5 * _DEG, 0.1 * _DEG)
_STRIPE_STEPS = (15.0 * _DEG, 5.0 * _DEG, 1.0 * _DEG)
_HALF_TILTS, _HALF_STRIPES = 6, 3
# The first grid is so much wider where the stripe's direction is free, too.
_WIDER = 2.0
# Choices of each kind that the exchange starts from.
_N_STARTS = 8
_MOST_ROUNDS = 20


def best_angles(design: Design, *, quick: bool = False) -> Design:
    """Return the design with the best angles for the mounts that are free to turn.

    The fans of the mounts that turn are swung so that their middles are abreast of the forward
    axis halfway through the working range.

    Parameters
    ----------
    design : Design
    quick : bool
        Start from the mounts' own angles alone: enough where a design has changed but little.
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


def _exchange(judge: Judge, lots: Sequence[Lot], start: Sequence[int]) -> tuple[float, list[int]]:
    """Let every laser take its best candidate until none changes."""
    picked, least = list(start), math.inf
    for _ in range(_MOST_ROUNDS):
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
    """Return a mount at all angles of a grid; the middle of later grids is the mount itself."""
    if not (mount.free_tilt or mount.free_stripe):
        return [mount]
    tilts, stripes = [mount.tilt], [mount.stripe]
    first = i_grid == 0
    if mount.free_tilt:
        low, high = TILT_LIMITS
        step = _TILT_STEPS[0] * (_WIDER if mount.free_stripe else 1.0)
        whole = np.arange(low, high + 1e-9, step).tolist()
        tilts = whole if first else _around(mount.tilt, _TILT_STEPS[i_grid], _HALF_TILTS)
    if mount.free_stripe:
        whole = np.arange(0.0, math.pi - 1e-9, _STRIPE_STEPS[0]).tolist()
        stripes = whole if first else _around(mount.stripe, _STRIPE_STEPS[i_grid], _HALF_STRIPES)
    return [
        replace(mount, tilt=float(np.clip(tilt, *TILT_LIMITS)), stripe=stripe % math.pi).aimed_at(
            halfway
        )
        for stripe in stripes
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
    """Return choices to start from: alike for all lasers, and mixed (the same at every call)."""
    shares = (np.arange(_N_STARTS) + 0.5) / _N_STARTS
    alike = [[share] * len(lots) for share in shares.tolist()]
    mixed = np.random.default_rng(0).uniform(size=(_N_STARTS, len(lots))).tolist()
    return [
        [int(share * len(lot)) for share, lot in zip(start, lots, strict=True)]
        for start in alike + mixed
    ]
