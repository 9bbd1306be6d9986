"""The target: the surface in view that the posture is measured to."""

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum

from aqualvs.scanning.surfaces import WORTH_SHARE, Surface

# Specks that share a plane by chance have less than these shares of the search lines of the surface
# that has most, and of the extent of the one that reaches farthest; a sparse net reaches far.
_LINES_SHARE, _REACH_SHARE = 0.1, 0.5
# A mesh reaches far with this share of the widest mesh's extent.
_EXTENT_SHARE = 0.75
# And it is well supported with this share of the best one's support.
_INLIER_SHARE = 0.35


class TargetKind(StrEnum):
    """Kind of surface that the posture is measured to."""

    AUTO = "auto"
    """A net where there is one, else the largest solid surface."""
    NET = "net"
    """Only a mesh-like surface."""
    SOLID = "solid"
    """Only a surface with unbroken stripes, or with long stretches between gaps."""


def as_requested_kind(surfaces: list[Surface], kind: TargetKind) -> list[Surface]:
    """Return the surfaces, classified as solid where possible if a solid target is wanted.

    A table with gaps, or a wall whose texture breaks the stripes, may look like a net.
    """
    if kind is not TargetKind.SOLID:
        return surfaces
    return [replace(one, is_mesh=one.is_mesh and not one.is_unbroken) for one in surfaces]


def choose_target(
    surfaces: Sequence[Surface], kind: TargetKind, working_range: tuple[float, float]
) -> Surface | None:
    """Choose the surface that the posture is measured to, or None where the kind is absent.

    Surfaces in the working range come before those outside.

    A net is preferred to anything solid: an object in front of it (a fish, a box) or behind it (a
    tank wall) may have more stripe points, but is not the target that the vehicle follows. Of
    several meshes the nearest that reaches far across the picture is the net: a fish is smaller,
    and a wall behind the net, lit through its openings, may look broken as well. A few left-over
    points that look like a mesh are no net beside a wall that fills the picture.
    """
    if len(surfaces) == 1:
        only = surfaces[0]
        fits = kind is TargetKind.AUTO or (kind is TargetKind.NET) == only.is_mesh
        return only if fits else None
    near, far = working_range
    surfaces = [one for one in surfaces if near <= one.plane.offset <= far] or surfaces
    most = max((surface.sampling_weight for surface in surfaces), default=0.0)
    lines = max((surface.n_lines for surface in surfaces), default=0)
    # Unbroken stripes have no extent; their number of search lines serves as one.
    reach = max((max(surface.extent, surface.n_lines) for surface in surfaces), default=0.0)
    meshes = [
        one
        for one in surfaces
        if one.is_mesh
        and one.sampling_weight >= WORTH_SHARE * most
        and (one.n_lines >= _LINES_SHARE * lines or one.extent >= _REACH_SHARE * reach)
    ]
    solids = [one for one in surfaces if not one.is_mesh]
    solid = max(solids, key=lambda surface: surface.inlier_weight, default=None)
    net = _nearest_far_reaching(meshes)
    if kind is TargetKind.NET:
        return net
    return solid if kind is TargetKind.SOLID or net is None else net


def _nearest_far_reaching(meshes: Sequence[Surface]) -> Surface | None:
    farthest = max((surface.extent for surface in meshes), default=0.0)
    # What has long intervals as well may be a wall in a net's shadows: no measure of a net's light.
    broken = [surface for surface in meshes if not surface.is_unbroken] or meshes
    most = max((surface.sampling_weight for surface in broken), default=0.0)
    wide = [
        one
        for one in meshes
        if one.extent >= _EXTENT_SHARE * farthest and one.sampling_weight >= _INLIER_SHARE * most
    ]
    best = max(meshes, key=lambda surface: surface.sampling_weight, default=None)
    return min(wide, key=lambda surface: surface.plane.offset, default=best)
