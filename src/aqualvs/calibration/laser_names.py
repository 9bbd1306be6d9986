"""Which found plane is which laser of the rig, and names for lasers that the rig has not."""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Laser, Rig

# Half a radian and a tenth of a metre are as far apart as a laser is ever remounted.
_FAR_ANGLE, _FAR_OFFSET = 0.5, 0.1
# A sheet's normal this near to an axis of `dome` (cosine) makes its stripes level or upright.
_ALONG_AXIS = 0.9


def match_to_rig(rig: Rig, planes: Sequence[Plane]) -> list[int | None]:
    """Return for every laser of the rig which plane is nearest to it, each plane used once.

    None for lasers that are left over where there are fewer planes.
    """
    costs = np.array([[_apart(laser.plane, plane) for plane in planes] for laser in rig.lasers])
    matched: list[int | None] = [None] * len(rig.lasers)
    if costs.size:
        for i_laser, i_plane in zip(*linear_sum_assignment(costs), strict=True):
            matched[int(i_laser)] = int(i_plane)
    return matched


def far_apart(laser: Laser, plane: Plane) -> bool:
    """Return whether a plane is so far from where the rig has the laser that it may be another."""
    return _apart(laser.plane, plane) > 1.0


def named(planes: Sequence[Plane]) -> tuple[list[int], list[Laser]]:
    """Name lasers after the directions of their stripes, or number them.

    A single plane near level is `horizontal`, near upright `vertical`, between them `diagonal`;
    where two would have one name, all are numbered from the left.

    Returns
    -------
    order : list of int
        Index into `planes` of every laser.
    lasers : list of Laser
    """
    words = [_word(plane) for plane in planes]
    if len(set(words)) == len(words):
        order = sorted(range(len(planes)), key=lambda i: _WORDS.index(words[i]))
        return order, [Laser(words[i], positive(planes[i])) for i in order]
    order = sorted(range(len(planes)), key=lambda i: _place(planes[i]))
    return order, [Laser(f"laser_{k + 1}", positive(planes[i])) for k, i in enumerate(order)]


def positive(plane: Plane) -> Plane:
    """Return the plane with the largest component of its normal positive."""
    if plane.normal[int(np.argmax(np.abs(plane.normal)))] < 0.0:
        return Plane(-plane.normal, -plane.offset)
    return plane


def like(plane: Plane, other: Plane) -> Plane:
    """Return the plane with its normal on the same side as another's."""
    if plane.normal @ other.normal < 0.0:
        return Plane(-plane.normal, -plane.offset)
    return plane


_WORDS = ("horizontal", "vertical", "diagonal")


def _word(plane: Plane) -> str:
    if abs(plane.normal[2]) > _ALONG_AXIS:
        return _WORDS[0]
    return _WORDS[1] if abs(plane.normal[0]) > _ALONG_AXIS else _WORDS[2]


def _place(plane: Plane) -> float:
    """Where the plane crosses the view half a metre ahead: from the left, or from the top."""
    ahead = plane.offset - 0.5 * plane.normal[1]
    if abs(plane.normal[0]) >= abs(plane.normal[2]):
        return float(ahead / plane.normal[0])
    return float(-ahead / plane.normal[2]) + 1e3


def _apart(a: Plane, b: Plane) -> float:
    b = like(b, a)
    sine = float(np.linalg.norm(np.cross(a.normal, b.normal)))
    cosine = float(a.normal @ b.normal)
    angle = float(np.arctan2(sine, cosine)) / _FAR_ANGLE
    return float(np.hypot(angle, (a.offset - b.offset) / _FAR_OFFSET))
