"""The target of a frame: the surface to which the posture is measured, unless it is uncertain."""

from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from aqualvs.geometry.planes import Plane
from aqualvs.optics.rig import Rig
from aqualvs.scanning.assignment import (
    NOT_TESTED,
    AssignmentOutcome,
    AssignmentTest,
    Verdict,
    is_reflection,
)
from aqualvs.scanning.candidates import Candidates, LinkedCandidates
from aqualvs.scanning.net_surfaces import MIN_LINES_PER_LASER
from aqualvs.scanning.posture import Reason, Refusal
from aqualvs.scanning.posture_estimator import MIN_LINES, Measurement
from aqualvs.scanning.surfaces import WORTH_SHARE, Surface, SurfaceFinder, shares_peaks


class TargetKind(StrEnum):
    """Kind of surface that the posture is measured to."""

    AUTO = "auto"
    """A net where there is one, else the largest solid surface."""
    NET = "net"
    """Only a mesh-like surface."""
    SOLID = "solid"
    """Only a surface with unbroken stripes, or with long lit intervals between gaps."""


def as_requested_kind(surfaces: list[Surface], kind: TargetKind) -> list[Surface]:
    """Return the surfaces; if a solid target is wanted, those with long lit intervals as solid.

    A table with gaps, or a wall whose texture breaks the stripes, may look like a net.
    """
    if kind is not TargetKind.SOLID:
        return surfaces
    return [replace(one, is_mesh=one.is_mesh and not one.is_unbroken) for one in surfaces]


def choose_target(
    surfaces: Sequence[Surface], kind: TargetKind, working_range: tuple[float, float]
) -> Surface | None:
    """Choose the surface to which the posture is measured; None if there is none of the kind.

    Surfaces in the working range are preferred to those outside, and nets to solid surfaces: an
    object in front of the net (a fish, a box) or behind it (a tank wall) may have more stripe
    points, but is not the target that the vehicle follows. Of several meshes, the nearest one with
    a large extent is the net: a fish is smaller, and a wall behind the net, lit through its
    openings, may look like a mesh as well. A few points left over from a wall that fills the
    picture are no net.

    Parameters
    ----------
    surfaces : sequence of Surface
        From `SurfaceFinder.find`.
    kind : TargetKind
        Kind of the target.
    working_range : (float, float)
        In metres.
    """
    if len(surfaces) == 1:
        only = surfaces[0]
        fits = kind is TargetKind.AUTO or (kind is TargetKind.NET) == only.is_mesh
        return only if fits else None
    near, far = working_range
    surfaces = [one for one in surfaces if near <= one.plane.offset <= far] or surfaces
    most = max((surface.sampling_weight for surface in surfaces), default=0.0)
    lines = max((surface.n_lines for surface in surfaces), default=0)
    extent = max((_extent(surface) for surface in surfaces), default=0.0)
    # Specks on a plane by chance have less than both shares: of the search lines of the surface
    # with most of them, and of the largest extent; a sparse net has a large extent. Stripes without
    # extent have too few intervals for a pattern.
    lines_share, extent_share = 0.1, 0.5
    meshes = [
        one
        for one in surfaces
        if one.is_mesh
        and one.sampling_weight >= WORTH_SHARE * most
        and (
            (one.extent > 0.0 and one.n_lines >= lines_share * lines)
            or _extent(one) >= extent_share * extent
        )
    ]
    solids = [one for one in surfaces if not one.is_mesh]
    solid = max(solids, key=lambda surface: surface.inlier_weight, default=None)
    net = _nearest_wide(meshes)
    if kind is TargetKind.NET:
        return net
    return solid if kind is TargetKind.SOLID or net is None else net


def _extent(surface: Surface) -> float:
    """Return the extent of a surface; its number of search lines if its stripes have no gaps."""
    return max(surface.extent, surface.n_lines)


def _nearest_wide(meshes: Sequence[Surface]) -> Surface | None:
    """Return the nearest mesh with a large extent and weight, else the one with most weight."""
    wide_share = 0.75  # Least extent, as a share of the largest one.
    weight_share = 0.35  # Least sampling weight, as a share of the largest one.
    # Least extent of the mesh with the largest weight, likewise: a fish may hide half of a net.
    main_share = 0.5
    widest = max((surface.extent for surface in meshes), default=0.0)
    # A mesh with long lit intervals may be a wall in a net's shadows: its weight does not count.
    broken = [surface for surface in meshes if not surface.is_unbroken] or meshes
    most = max((surface.sampling_weight for surface in broken), default=0.0)
    wide = [
        one
        for one in meshes
        if one.sampling_weight >= weight_share * most
        and one.extent >= (main_share if one.sampling_weight >= most else wide_share) * widest
    ]
    best = max(meshes, key=lambda surface: surface.sampling_weight, default=None)
    return min(wide, key=lambda surface: surface.plane.offset, default=best)


class TargetChoice(NamedTuple):
    """The target among the surfaces of a frame, and evidence against it."""

    surfaces: list[Surface]  # Of the requested kind.
    target: Surface | None = None
    overlooked: Surface | None = None  # Nearer than the target; may be the net instead.
    # Test of the target's peaks against their assignment to other lasers.
    tested: AssignmentOutcome = NOT_TESTED


class TargetSelector:
    """Selection of the target in frames of one rig, and refusal of an uncertain one.

    Parameters
    ----------
    rig : Rig
        Focal length and working range.
    kind : TargetKind
        Kind of the target.
    assignment : AssignmentTest
        Of the same rig.
    finder : SurfaceFinder
        Of the same rig.
    """

    def __init__(
        self, rig: Rig, kind: TargetKind, assignment: AssignmentTest, finder: SurfaceFinder
    ) -> None:
        self._kind, self._assignment, self._finder = kind, assignment, finder
        self._working_range, self._focal_px = rig.working_range, rig.focal_px
        self.has_fan = bool(assignment.fans)

    def choose(self, linked: LinkedCandidates, surfaces: list[Surface]) -> TargetChoice:
        """Choose the target, and test whether other lasers explain its peaks as well.

        Parameters
        ----------
        linked : LinkedCandidates
            Of a frame.
        surfaces : list of Surface
            All that were found in it.
        """
        # Number of times that a rival replaces the target, and is tested in its turn.
        max_rivals = 3
        choice = self._choose_once(linked, as_requested_kind(surfaces, self._kind))
        for _ in range(max_rivals):
            (verdict, other, _), target = choice.tested, choice.target
            if target is None or verdict is not Verdict.RIVAL or other is None:
                break
            surfaces = self._with_rival(linked, choice.surfaces, target, other)
            choice = self._choose_once(linked, surfaces)
        return choice

    def accept(
        self, linked: LinkedCandidates, choice: TargetChoice, *, has_colour: bool
    ) -> Surface | Refusal:
        """Return the target, or its refusal: it is missing, ambiguous, or there by chance.

        Parameters
        ----------
        linked : LinkedCandidates
            Of a frame.
        choice : TargetChoice
            From `choose`.
        has_colour : bool
            Whether colour was evidence for the peaks.
        """
        surfaces, target, overlooked, tested = choice
        assignment = self._assignment
        if target is None:
            return self._no_target(linked.candidates, surfaces)
        if overlooked is not None:
            return _ambiguous(target.plane, overlooked.plane)
        if assignment.is_by_chance(linked, surfaces, target):
            detail = "the best plane is small, and lasers that should be seen on it are not"
            return Refusal(Reason.NOT_A_PLANE, detail)
        if not has_colour and not assignment.is_certain(linked, surfaces, target):
            detail = "without colour, the lasers do not show the best plane evenly enough"
            return Refusal(Reason.NOT_A_PLANE, detail)
        if tested.verdict is Verdict.AMBIGUOUS and tested.other is not None:
            return _ambiguous(target.plane, tested.other)
        if assignment.may_be_exchanged(linked.subsegments, target):
            detail = (
                f"two lasers alone show a steep surface at {target.plane.offset:.3f} m, and would "
                "show another if each stripe were the other laser's"
            )
            return Refusal(Reason.AMBIGUOUS, detail)
        beyond = assignment.beyond(linked.subsegments, target)
        if beyond is not None:
            return _ambiguous(target.plane, beyond)
        others = assignment.other_lines(linked, surfaces, target, has_colour=has_colour)
        if others is not None:
            detail = (
                f"beside the stripes on the surface at {target.plane.offset:.3f} m there is "
                f"{others:.1f} times their light in other lines; does the rig name all lasers?"
            )
            return Refusal(Reason.AMBIGUOUS, detail)
        if self._kind is TargetKind.AUTO and assignment.may_hide_net(linked, surfaces, target):
            detail = (
                f"much light in front of the surface at {target.plane.offset:.3f} m lies in no "
                "common plane, as on a net in folds"
            )
            return Refusal(Reason.AMBIGUOUS, detail)
        return target

    def contradiction(
        self, linked: LinkedCandidates, surfaces: Sequence[Surface], target: Surface
    ) -> Refusal | None:
        """Return the refusal of a net that lacks a laser, if another one is nearer; else None."""
        nearer = self._assignment.nearer_net(linked.subsegments, surfaces, target)
        return None if nearer is None else _ambiguous(target.plane, nearer.plane)

    def as_other_kind(
        self, linked: LinkedCandidates, choice: TargetChoice, found: Measurement
    ) -> TargetChoice | None:
        """Return the choice with the target as solid, or as a net, if it is likely to be that.

        Noise and codecs break the lines of a dim or overexposed picture as twine does: a net whose
        strands are too few for a posture, or lie in no plane, is solid if it is lit on much of its
        lines. Growth fills the gaps of a net: what has small gaps only, but no long lines either,
        and is rough, is a net.

        Parameters
        ----------
        linked : LinkedCandidates
            Of a frame.
        choice : TargetChoice
            From `choose`.
        found : Measurement
            Of its target.
        """
        target, posture = choice.target, found.posture
        if target is None or self._kind is not TargetKind.AUTO:
            return None
        no_net = (Reason.ONE_LASER, Reason.COLLINEAR, Reason.TOO_FEW_POINTS, Reason.NOT_A_PLANE)
        is_no_net = isinstance(posture, Refusal) and posture.reason in no_net
        # Points scatter about walls by 0.15 to 0.5 px, in strong sun by 0.8, about grown nets that
        # pass as solid by 0.5 to 1.6.
        rough_px = 0.7
        if target.is_mesh and (is_no_net or found.folded):
            is_other = self._assignment.fills_lines(linked.subsegments, target)
        elif posture and posture.rms * self._focal_px > rough_px * posture.range:
            is_other = not target.is_mesh and not target.is_unbroken
        else:
            is_other = False
        if not is_other:
            return None
        other = replace(target, is_mesh=not target.is_mesh)
        return choice._replace(surfaces=_with_replaced(choice.surfaces, other), target=other)

    def _choose_once(self, linked: LinkedCandidates, surfaces: list[Surface]) -> TargetChoice:
        surfaces, target = self._best_target(linked, surfaces)
        nearer = None
        if target is not None and self._kind is TargetKind.AUTO:
            nearer = self._assignment.overlooked(linked, surfaces, target)
            if nearer is None and self.has_fan:
                surfaces, target = self._with_net_before(linked, surfaces, target)
        if target is None:
            return TargetChoice(surfaces)
        if nearer is not None and nearer.is_mesh:
            surfaces, target, nearer = _with_replaced(surfaces, nearer), nearer, None
        outcome = self._assignment.test(linked, target)
        return TargetChoice(surfaces, target, nearer, outcome)

    def _with_net_before(
        self, linked: LinkedCandidates, surfaces: list[Surface], target: Surface
    ) -> tuple[list[Surface], Surface | None]:
        """Return the surfaces and the target, with a net that was missed among many lasers.

        It replaces something solid if all light on its plane, also that which the solid surface
        explains, shows most lasers. False edges make meshes, too, but of few lasers.
        """
        subsegments = linked.subsegments
        before = self._finder.find_before(linked, surfaces, target)
        if before is None or not before.is_mesh or is_reflection(linked, before, target):
            return surfaces, target
        if target.is_mesh:
            return self._best_target(linked, [*surfaces, before])
        # Its light may have been read as the next lasers'.
        verdict, other, _ = self._assignment.test(linked, before)
        plane = before.plane if other is None or verdict is not Verdict.RIVAL else other
        whole = self._finder.on_plane(subsegments, plane)
        if self._assignment.is_faint(whole, subsegments):
            return surfaces, target
        return [*surfaces, before], before

    def _best_target(
        self, linked: LinkedCandidates, surfaces: list[Surface]
    ) -> tuple[list[Surface], Surface | None]:
        """Return the target and the surfaces, without those that other light explains.

        It is that of other lasers' stripes, or of double reflections.
        """
        assignment, subsegments = self._assignment, linked.subsegments
        target = choose_target(surfaces, self._kind, self._working_range)
        while target is not None and len(surfaces) > 1:
            if not (
                assignment.may_be_exchanged(subsegments, target)
                or (assignment.fans and assignment.may_be_shifted(subsegments, surfaces, target))
                or any(is_reflection(linked, target, one) for one in surfaces if one is not target)
            ):
                break
            surfaces = [one for one in surfaces if one is not target]
            target = choose_target(surfaces, self._kind, self._working_range)
        return surfaces, target

    def _with_rival(
        self, linked: LinkedCandidates, surfaces: list[Surface], target: Surface, other: Plane
    ) -> list[Surface]:
        """Replace a surface by the rival that explains the picture better.

        A net before the rival remains with the light that is not the rival's.
        """
        subsegments = linked.subsegments
        rival = self._finder.on_plane(subsegments, other)
        rest = self._finder.left_over(linked, target, rival)
        kept = [] if rest is None or not rest.is_mesh else [rest]
        kept += [
            one
            for one in surfaces
            if one is not target and not shares_peaks(one, rival, subsegments)
        ]
        return as_requested_kind([rival, *kept], self._kind)

    def _no_target(self, candidates: Candidates, surfaces: list[Surface]) -> Refusal:
        peaks, candidate, candidates_of = np.unique(
            candidates.source, return_index=True, return_counts=True
        )
        if not len(peaks):
            return Refusal(Reason.NO_STRIPES, "no laser stripe in the picture")
        if surfaces:
            detail = f"surfaces in view, but none of kind {self._kind.value}"
            return Refusal(Reason.NO_TARGET, detail)
        if len(peaks) < MIN_LINES:
            return Refusal(Reason.TOO_FEW_POINTS, f"only {len(peaks)} stripe points")
        # Lasers with many peaks that can belong to no other laser.
        own = np.bincount(candidates.laser[candidate[candidates_of == 1]])
        if np.count_nonzero(own >= MIN_LINES_PER_LASER) == 1:
            return Refusal(Reason.ONE_LASER, "stripes of one laser only")
        return Refusal(Reason.NOT_A_PLANE, f"{len(peaks)} stripe points share no plane")


def is_better(again: Measurement, before: Measurement) -> bool:
    """Return whether a target is better measured as of the other kind."""
    if not before.posture:
        return True
    # A rough wall is no net in folds.
    if not again.posture or again.folded:
        return False
    # Ratio of the scatter about a wall to that about the mean plane of what were no folds: 0.1 on
    # overexposed photographs of a wall. Nets in folds, fitted as solid, have 0.4 and more.
    clearly_less = 0.25
    return not before.folded or again.posture.rms < clearly_less * before.posture.rms


def _with_replaced(surfaces: list[Surface], changed: Surface) -> list[Surface]:
    """Return the surfaces with one of them replaced by its changed copy."""
    return [changed if one.members is changed.members else one for one in surfaces]


def _ambiguous(one: Plane, other: Plane) -> Refusal:
    apart = np.rad2deg(np.arccos(min(float(one.normal @ other.normal), 1.0)))
    detail = (
        f"planes at {one.offset:.3f} m and {other.offset:.3f} m, {apart:.1f} deg apart, explain "
        "the stripes about as well"
    )
    return Refusal(Reason.AMBIGUOUS, detail)
