"""From what a rig was solved, how long ago and how well; and what should not be believed of it."""

import itertools
import math
from collections.abc import Iterator
from datetime import datetime

import numpy as np

from aqualvs.app.check_finding import Finding, Severity, count_words
from aqualvs.optics.assumed import assumptions
from aqualvs.optics.camera_params import POSE_PARAMETERS
from aqualvs.optics.rig import Rig
from aqualvs.optics.solved import ASSUMED, SolvedStep, is_exact
from aqualvs.optics.uncertainty import RigUncertainty, laser_parameter_names

SURFACES = "surfaces"
"""Extra of the step `lasers`: the surfaces that lasers were seen on, or how many there were."""

# What good pictures leave: corners 0.05 to 0.2 px, stripes 0.1 to 0.3.
_LARGE_RMS_PX = 1.0
_OLD_DAYS = 365
_FEW_PICTURES = {"camera": 5, "dome": 2}
# Beyond these a calibration has not found what it was for.
_LENS_M, _TURN, _FOCAL_SHARE, _INDEX = 2e-3, math.radians(0.5), 0.005, 2e-3
_TILT, _OFFSET_M = math.radians(0.25), 2e-3


def check_solved(
    rig: Rig, steps: dict[str, SolvedStep], uncertainty: RigUncertainty, now: datetime
) -> Iterator[Finding]:
    """Return what is worth saying about how a rig was calibrated.

    Parameters
    ----------
    rig : Rig
    steps : dict of SolvedStep
        As `solved_steps` gives them.
    uncertainty : RigUncertainty
        Of the rig.
    now : datetime
        With a time zone.
    """
    for name, step in steps.items():
        yield _told(name, step, now)
        yield from _doubts(name, step, now)
    yield from _out_of_order(steps)
    yield from _assumed(rig, steps)
    yield from _loose(rig, uncertainty)


def age_words(date: datetime, now: datetime) -> str:
    """Return how long ago a date is: "today", "3 days ago", "5 months ago"."""
    days = (now - date).days
    if days < 1:
        return "today"
    for length, word, most in ((1, "day", 14), (7, "week", 60), (30.44, "month", 730)):
        if days < most:
            return f"{count_words(round(days / length), word)} ago"
    return f"{count_words(round(days / 365.25), 'year')} ago"


def _told(name: str, step: SolvedStep, now: datetime) -> Finding:
    verb = "were" if name == "lasers" else "was"
    sentence = (
        f"The {name} {verb} calibrated {age_words(step.date, now)} from "
        f"{count_words(step.pictures, 'picture')} with {count_words(step.points, 'point')}, to "
        f"{step.rms_px:.2g} px rms"
    )
    if step.rms_px > _LARGE_RMS_PX:
        return Finding(
            Severity.WARN,
            f"{sentence}: good pictures leave 0.3 px or less; check the board's square size and "
            "the medium, and calibrate again.",
        )
    return Finding(Severity.OK, f"{sentence}.")


def _doubts(name: str, step: SolvedStep, now: datetime) -> Iterator[Finding]:
    days = (now - step.date).days
    if days < -1:
        yield Finding(
            Severity.WARN,
            f"The date of solved_from.{name}, {step.date:%Y-%m-%d}, is yet to come; set the clock "
            "of the computer that calibrates.",
        )
    if days > _OLD_DAYS:
        yield Finding(
            Severity.WARN,
            f"The calibration of the {name} is more than a year old; take one picture of a known "
            "target, or calibrate again.",
        )
    if step.rms_px <= 0.0 and step.points > 0:
        yield Finding(
            Severity.WARN,
            f"solved_from.{name}.rms_px is {step.rms_px:g}: no real picture fits that well.",
        )
    if step.pictures < _FEW_PICTURES.get(name, 1):
        yield Finding(
            Severity.WARN,
            f"The calibration of the {name} rests on {count_words(step.pictures, 'picture')}; take "
            f"at least {_FEW_PICTURES.get(name, 1)}, at different tilts and distances.",
        )
    surfaces = step.extras.get(SURFACES)
    count = len(surfaces) if isinstance(surfaces, list) else surfaces
    if isinstance(count, int | float) and count < 2:
        yield Finding(
            Severity.WARN,
            "The lasers were seen on one surface only, and any plane through such a line fits it; "
            "show their stripes at two distances at least.",
        )


def _out_of_order(steps: dict[str, SolvedStep]) -> Iterator[Finding]:
    """Each of camera, dome and lasers rests on the one before."""
    chain = [name for name in ("camera", "dome", "lasers") if name in steps]
    for before, after in itertools.pairwise(chain):
        if steps[before].date > steps[after].date:
            verb = "were" if after == "lasers" else "was"
            yield Finding(
                Severity.WARN,
                f"The {before} was calibrated after the {after}, which {verb} found with the "
                f"{before} as it was before; run 'aqualvs calibrate {after}' again.",
            )


def _assumed(rig: Rig, steps: dict[str, SolvedStep]) -> Iterator[Finding]:
    """Numbers that nobody has said the uncertainty of, and what is assumed in its place."""
    if is_exact(rig):
        yield Finding(
            Severity.OK,
            "The rig's numbers count as exact (solved_from.uncertainty), as those of a simulated "
            "dive are; take that out for a rig that was built.",
        )
    alike: dict[str, list[str]] = {}
    for one in assumptions(rig):
        alike.setdefault(one.words, []).append(f"the {one.what}")
    for words, what in alike.items():
        verb = "is" if len(what) == 1 else "are"
        yield Finding(
            Severity.OK,
            f"How well {', '.join(what)} {verb} known is not written down; assumed (one sigma): "
            f"{words}. 'aqualvs calibrate' finds it out.",
        )
    for name, step in steps.items():
        numbers = step.extras.get(ASSUMED)
        if isinstance(numbers, list) and numbers:
            yield Finding(
                Severity.OK,
                f"The calibration of the {name} assumed how well {', '.join(map(str, numbers))} "
                "are known: they were written by hand.",
            )


def _loose(rig: Rig, uncertainty: RigUncertainty) -> Iterator[Finding]:
    """Numbers that are known so badly that the calibration did not determine them."""
    lens = _largest(uncertainty, POSE_PARAMETERS[:3])
    if lens > _LENS_M:
        yield _warning(
            f"The lens's place in the dome is known only to {lens * 1e3:.1f} mm",
            "show the board nearer and in water, or at known distances",
        )
    turn = _largest(uncertainty, POSE_PARAMETERS[3:])
    if turn > _TURN:
        yield _warning(
            f"The camera's rotation in the dome is known only to {math.degrees(turn):.1f} degrees",
            "give the poses of the boards",
        )
    focal = _largest(uncertainty, ("fx", "fy")) / rig.focal_px
    if focal > _FOCAL_SHARE:
        yield _warning(
            f"The focal length is known only to {focal:.1%}",
            "show the board tilted, and as large as the picture",
        )
    index = _largest(uncertainty, ("n_water",))
    if index > _INDEX:
        yield _warning(
            f"The water's index is known only to {index:.1g}",
            "give temperature and salinity",
        )
    for laser in rig.lasers:
        tilt_1, tilt_2, offset = laser_parameter_names(laser)[:3]
        tilt, shift = _largest(uncertainty, (tilt_1, tilt_2)), _largest(uncertainty, (offset,))
        if tilt > _TILT or shift > _OFFSET_M:
            yield _warning(
                f"Laser '{laser.name}' is known only to {math.degrees(tilt):.2g} degrees and "
                f"{shift * 1e3:.2g} mm",
                "show its stripe on more surfaces, near and far",
            )


def _largest(uncertainty: RigUncertainty, names: tuple[str, ...]) -> float:
    """Largest standard deviation of any combination of some numbers; 0 where none is known."""
    return math.sqrt(max(float(np.linalg.eigvalsh(uncertainty.of(names))[-1]), 0.0))


def _warning(fact: str, remedy: str) -> Finding:
    return Finding(Severity.WARN, f"{fact} (one sigma); {remedy}, and calibrate again.")
