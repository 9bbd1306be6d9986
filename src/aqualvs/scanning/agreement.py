"""Whether the lasers agree with each other on flat targets, and which one has drifted if not.

Two lines on a flat target share a plane, three more so: a laser whose sheet is no longer where the
rig says leaves it. What one frame shows of that is little (of three lines, each with a shift and a
turn, the target's own plane takes three numbers), but a sheet that has moved has done so by the
same three numbers in all frames, at every range and angle of the target, and no bulge of a net or
fish in front of it follows that pattern. So each laser in turn is taken for the one that has moved,
and it is named if that explains all frames, and no other does.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import sheets_of
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.optics.uncertainty import LASER_PARAMETERS
from aqualvs.scanning.agreement_fit import Explanation, SeenStripes, explain
from aqualvs.scanning.scan import Scan
from aqualvs.scanning.search import SearchAxis, plan_searches
from aqualvs.scanning.stripe_bins import bin_stripes

# Frames judged; when there are twice as many, every other one goes.
_MAX_FRAMES = 24
_MIN_FRAMES = 5
# At first one frame in so many is looked at: neighbours say the same.
_EVERY = 3
# Pieces of stripe that every laser must show for a frame to count.
_MIN_PIECES = 4
# An alarm needs a step this clear, and one that matters: to the angle, or to the range.
_SIGNIFICANT = 5.0
_ANGLE, _EFFECT = math.radians(0.15), 0.005
# Beyond this it is the target that is bent: a laser so far off shows next to nothing.
_UNLIKELY = math.radians(5.0)
# A target is flat, and a laser the one that has moved, if so much of the stripes is explained.
_EXPLAINED = 0.6
# Another laser is out of the question if its mean square is worse by this and by this share; one
# has moved at all if that none has is worse by as much and by the second share.
_WORSE, _WORSE_SHARE, _WORSE_SHARE_OF_NONE = 0.1, 0.1, 0.3


class AgreementState(StrEnum):
    """How the lasers stand to each other; the value is what `run.yaml` says."""

    AGREE = "agree"
    DRIFTED = "drifted"
    """One laser has moved, and it is known which."""
    DISAGREE = "disagree"
    """One laser has moved, but it could be one of several."""
    NOT_FLAT = "not_flat"
    """The targets are not flat enough to say."""
    NOT_CHECKED = "not_checked"
    """Too few frames show a stripe of every laser."""


@dataclass(frozen=True, slots=True)
class AgreementVerdict:
    """Whether the lasers agree, and what is wrong if not.

    Attributes
    ----------
    state : AgreementState
    n_frames : int
        That the verdict rests on.
    suspects : tuple of int
        Lasers one of which has moved, by their number from 0, the likeliest first.
    names : tuple of str
        Of the suspects.
    angle, sigma_angle : float
        By how much the first of them has turned (rad) if it is the one; NaN without suspects.
    effect : float
        How far its stripe lies off the plane of the others, as a share of the range; NaN likewise.
    """

    state: AgreementState
    n_frames: int
    suspects: tuple[int, ...] = ()
    names: tuple[str, ...] = ()
    angle: float = math.nan
    sigma_angle: float = math.nan
    effect: float = math.nan

    def facts(self) -> dict[str, Any]:
        """Return the verdict as `run.yaml` holds it."""
        found: dict[str, Any] = {"state": self.state.value, "n_frames": self.n_frames}
        if self.suspects:
            found["suspects"] = list(self.names)
            found["angle_deg"] = round(math.degrees(self.angle), 3)
            found["sigma_angle_deg"] = round(math.degrees(self.sigma_angle), 3)
            found["off_range_share"] = round(self.effect, 5)
            found["words"] = self.sentence()
        return found

    def sentence(self) -> str:
        """Say what is wrong and what to do; empty if nothing is."""
        if not self.suspects:
            return ""
        named = [
            f"laser {i + 1} ({name})" for i, name in zip(self.suspects, self.names, strict=True)
        ]
        off = f"off by {math.degrees(self.angle):.2g} deg"
        remedy = "recalibrate with 'aqualvs calibrate lasers'"
        if self.state is AgreementState.DRIFTED:
            share = f"{self.effect:.1%} of the range"
            return f"{named[0]} is {off} (its stripe lies {share} off the others' plane): {remedy}"
        return f"the lasers disagree: {' or '.join(named)} is {off} or so: {remedy}"


class LaserAgreement:
    """Watches the lasers of a rig over a dive.

    Parameters
    ----------
    rig : Rig
        The one that the scans were made with. What it says about how well its lasers are known
        counts: a disagreement that the calibration leaves open is none.
    """

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._camera = rig.camera()
        self._known = rig_uncertainty(rig)
        axes = [search.axis for search in plan_searches(rig, self._camera)]
        self._along_x = np.array([axis is SearchAxis.ALONG_X for axis in axes], np.int64)
        self._middles: list[FloatArray] = []
        self._n_scans, self._every = 0, _EVERY
        self._verdict: AgreementVerdict | None = None

    def add(self, scan: Scan) -> None:
        """Take note of one frame; frames without a posture say nothing."""
        self._n_scans += 1
        if not scan.posture or self._n_scans % self._every or len(self._along_x) < 2:
            return
        m = scan.posture.normal_in_dome / scan.posture.range
        middles = bin_stripes(scan.points, m, self._along_x, self._rig.size_px)
        if np.isfinite(middles[..., 0]).sum(axis=1).min() < _MIN_PIECES:
            return
        self._verdict = None
        self._middles.append(middles)
        if len(self._middles) >= 2 * _MAX_FRAMES:
            self._middles = self._middles[::2]
            self._every *= 2

    def verdict(self) -> AgreementVerdict:
        """Return what the frames so far say."""
        if self._verdict is None:
            self._verdict = self._judged()
        return self._verdict

    def _judged(self) -> AgreementVerdict:
        middles = self._middles[:: max(1, math.ceil(len(self._middles) / _MAX_FRAMES))]
        n_frames = len(middles)
        if n_frames < _MIN_FRAMES:
            return AgreementVerdict(AgreementState.NOT_CHECKED, n_frames)
        stripes = SeenStripes.of(middles, self._camera, self._along_x)
        sheets = sheets_of(self._rig)
        none = explain(stripes, sheets, None)
        found = sorted(
            (explain(stripes, sheets, laser) for laser in range(len(sheets))),
            key=lambda one: one.cost,
        )
        best = found[0]
        if not self._is_off(best):
            return _no_alarm(best, n_frames)
        if not _is_worse(none, best, _WORSE_SHARE_OF_NONE):
            return _no_alarm(none, n_frames)
        if best.inliers < _EXPLAINED or float(np.linalg.norm(best.step[:2])) > _UNLIKELY:
            return AgreementVerdict(AgreementState.NOT_FLAT, n_frames)
        suspects = [one for one in found if one is best or not _is_worse(one, best)]
        if len(suspects) == len(found) > 2:
            # What any of three lasers could have done, none has: the target is no plane.
            return AgreementVerdict(AgreementState.NOT_FLAT, n_frames)
        return self._told(suspects, n_frames)

    def _told(self, suspects: list[Explanation], n_frames: int) -> AgreementVerdict:
        best = suspects[0]
        numbers = tuple(one.laser for one in suspects if one.laser is not None)
        tilt = best.step[:2]
        angle = float(np.linalg.norm(tilt))
        covariance = self._covariance(best)[:2, :2]
        state = AgreementState.DRIFTED if len(suspects) == 1 else AgreementState.DISAGREE
        return AgreementVerdict(
            state=state,
            n_frames=n_frames,
            suspects=numbers,
            names=tuple(self._rig.lasers[i].name for i in numbers),
            angle=angle,
            sigma_angle=math.sqrt(float(tilt @ covariance @ tilt)) / angle,
            effect=best.effect,
        )

    def _is_off(self, found: Explanation) -> bool:
        """Whether a laser has moved clearly, and enough to matter."""
        step = found.step
        sigmas = math.sqrt(float(step @ np.linalg.solve(self._covariance(found), step)))
        matters = found.effect > _EFFECT or float(np.linalg.norm(step[:2])) > _ANGLE
        return sigmas > _SIGNIFICANT and matters

    def _covariance(self, found: Explanation) -> FloatArray:
        """Covariance of a step, by the stripes' errors and by what the calibration leaves open."""
        names = [f"{laser.name}:{name}" for laser in self._rig.lasers for name in LASER_PARAMETERS]
        spill = found.spill()
        total: FloatArray = found.covariance() + spill @ self._known.of(names) @ spill.T
        return total


def _no_alarm(found: Explanation, n_frames: int) -> AgreementVerdict:
    """All is well, if flat targets and no step worth speaking of explain what was seen."""
    flat = found.inliers >= _EXPLAINED
    return AgreementVerdict(AgreementState.AGREE if flat else AgreementState.NOT_FLAT, n_frames)


def _is_worse(one: Explanation, best: Explanation, share: float = _WORSE_SHARE) -> bool:
    return one.cost - best.cost > _WORSE + share * best.cost
