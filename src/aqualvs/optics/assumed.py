"""Uncertainty of what nobody has calibrated: stated defaults for numbers written by hand."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from aqualvs.optics.rig import Rig
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.optics.uncertainty import LASER_PARAMETERS, RigUncertainty

FOCAL_SHARE = 0.002
"""Of the focal length. Calibrations of one camera from other pictures differ by 0.2 to 0.4 %."""
ASPECT_SHARE = 0.0005
"""Of fy over fx: pixels are made far better than a focal length is measured."""
CENTRE_SHARE = 0.002
"""Of the image centre, along each axis, as a share of the picture's width."""
DISTORTION_K1 = 0.005
"""Of the first distortion coefficient, where the rig has any."""
LENS_M = 1e-3
"""Of the lens's place in the dome, along each axis: measured with a caliper."""
RADIUS_M, THICKNESS_M, N_ACRYLIC = 1e-4, 1e-4, 3e-3
"""Of the dome: the tolerances of the part that `calibrate dome` assumes as well."""
N_WATER = 3e-3
"""Of the water's index: between fresh and sea water, with which `calibrate dome` starts as well."""
LASER_TILT, LASER_OFFSET_M = math.radians(0.2), 1e-3
"""Of a laser's plane, its normal in each direction and its offset: a mount measured by hand."""

_LENS = ("lens_x", "lens_y", "lens_z")
_SHELL = ("inner_radius", "thickness", "n_acrylic")
# An index outside that is the one inside is air, which is known.
_AIR = 1e-3


@dataclass(frozen=True, slots=True)
class Assumption:
    """Default uncertainty of numbers of a rig that belong together.

    Attributes
    ----------
    what : str
        In words.
    words : str
        The standard deviations in words.
    uncertainty : RigUncertainty
    """

    what: str
    words: str
    uncertainty: RigUncertainty


def assumptions(rig: Rig) -> tuple[Assumption, ...]:
    """Return the defaults for what a rig does not say the uncertainty of.

    A group of numbers (intrinsics, place of the lens, dome, water, each laser) of which
    `solved_from.uncertainty` names one was calibrated; what it does not name of the group was held
    there, and counts as exact. Exact by definition are the origin and the axes of the frame `dome`
    as far as nothing physical fixes them: the camera's rotation, and a bare lens's place.

    Raises
    ------
    RigError
        As `rig_uncertainty`.
    """
    known = set(rig_uncertainty(rig).names)
    return tuple(one for one in _defaults(rig) if known.isdisjoint(_settled_by(one)))


def completed_uncertainty(rig: Rig) -> RigUncertainty:
    """Return the uncertainty written down in a rig, with the defaults for what it leaves out.

    Raises
    ------
    RigError
        As `rig_uncertainty`.
    """
    parts = (rig_uncertainty(rig), *(one.uncertainty for one in assumptions(rig)))
    names = tuple(name for part in parts for name in part.names)
    covariance = np.zeros((len(names), len(names)))
    first = 0
    for part in parts:
        stop = first + len(part.names)
        covariance[first:stop, first:stop] = part.covariance
        first = stop
    return RigUncertainty(names, covariance)


def _settled_by(one: Assumption) -> tuple[str, ...]:
    """Return the numbers any of which tells that a calibration has dealt with the group."""
    names = one.uncertainty.names
    # The dome's calibration decides which of its sizes are uncertain.
    return (*names, *_LENS) if names[0] in _SHELL else names


def _defaults(rig: Rig) -> Iterator[Assumption]:
    yield _intrinsics(rig)
    if rig.dome is not None:
        yield Assumption(
            "lens's place",
            f"{LENS_M * 1e3:g} mm",
            RigUncertainty.independent(dict.fromkeys(_LENS, LENS_M)),
        )
        sizes = dict(zip(_SHELL, (RADIUS_M, THICKNESS_M, N_ACRYLIC), strict=True))
        yield Assumption(
            "dome",
            f"{RADIUS_M * 1e3:g} mm in radius and thickness, {N_ACRYLIC:g} in index",
            RigUncertainty.independent(sizes),
        )
    bends = rig.dome is not None or any(laser.window is not None for laser in rig.lasers)
    if bends and abs(rig.n_water - rig.n_air) > _AIR:
        yield Assumption(
            "water's index", f"{N_WATER:g}", RigUncertainty.independent({"n_water": N_WATER})
        )
    for laser in rig.lasers:
        sigmas = zip(LASER_PARAMETERS, (LASER_TILT, LASER_TILT, LASER_OFFSET_M), strict=True)
        yield Assumption(
            f"laser '{laser.name}'",
            f"{math.degrees(LASER_TILT):g} degrees and {LASER_OFFSET_M * 1e3:g} mm",
            RigUncertainty.independent({f"{laser.name}:{name}": s for name, s in sigmas}),
        )


def _intrinsics(rig: Rig) -> Assumption:
    """Return that of the lens: fx and fy err together but for the pixels' aspect."""
    lens = rig.lens
    centre = CENTRE_SHARE * rig.size_px[0]
    sigmas = {"fx": FOCAL_SHARE * lens.fx, "fy": FOCAL_SHARE * lens.fy, "cx": centre, "cy": centre}
    words = f"{FOCAL_SHARE:.1%} in focal length, {CENTRE_SHARE:.1%} of the width in image centre"
    if "k1" in lens.parameter_names:
        sigmas["k1"] = DISTORTION_K1
        words += f", {DISTORTION_K1:g} in k1"
    covariance = RigUncertainty.independent(sigmas).covariance
    covariance[0, 1] = covariance[1, 0] = FOCAL_SHARE**2 * lens.fx * lens.fy
    covariance[0, 0] += (0.5 * ASPECT_SHARE * lens.fx) ** 2
    covariance[1, 1] += (0.5 * ASPECT_SHARE * lens.fy) ** 2
    covariance[0, 1] -= 0.25 * ASPECT_SHARE**2 * lens.fx * lens.fy
    covariance[1, 0] = covariance[0, 1]
    return Assumption("set of intrinsics", words, RigUncertainty(tuple(sigmas), covariance))
