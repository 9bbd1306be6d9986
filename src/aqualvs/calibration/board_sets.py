"""What `calibrate dome` is given: sets of views of boards, each in one medium, and options."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np

from aqualvs.calibration.view import View
from aqualvs.errors import CalibrationError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.rig import Rig

_MIN_VIEWS = 3
_MIN_POINTS = 60


class GivenPose(Protocol):
    """What was measured of a board's pose beforehand."""

    @property
    def dome_from_board(self) -> SE3 | None:
        """The whole pose, or None."""

    @property
    def distance(self) -> float | None:
        """Where the board's plane meets the dome's y axis, in metres, or None."""


class PoseKind(StrEnum):
    """How much is known of a board's pose."""

    EXACT = "exact"
    DISTANCE = "distance"
    UNKNOWN = "unknown"


def kind_of(given: GivenPose | None) -> PoseKind:
    """Return how much is known of a pose."""
    if given is None:
        return PoseKind.UNKNOWN
    if given.dome_from_board is not None:
        return PoseKind.EXACT
    return PoseKind.UNKNOWN if given.distance is None else PoseKind.DISTANCE


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardSet:
    """Views taken in one medium.

    Attributes
    ----------
    name : str
        For messages: "air", "pool", a folder.
    views : tuple of View
        One for each picture.
    poses : tuple of GivenPose or None
        What is known of each view's board; empty where nothing is known of any.
    n_medium : float
        Index outside the dome (vacuum = 1).
    sigma_medium : float
        How well it is known; 0 takes it as exact.
    """

    name: str
    views: tuple[View, ...]
    poses: Sequence[GivenPose | None] = ()
    n_medium: float = 1.0003
    sigma_medium: float = 0.0

    def __post_init__(self) -> None:
        if self.poses and len(self.poses) != len(self.views):
            raise ValueError(f"{len(self.poses)} poses given for {len(self.views)} views")

    def given(self, i_view: int) -> GivenPose | None:
        """Return what is known of a view's board."""
        return self.poses[i_view] if self.poses else None


@dataclass(frozen=True, slots=True, kw_only=True)
class DomeOptions:
    """What `calibrate dome` assumes and does; SI units and radians.

    Attributes
    ----------
    inner_radius_sigma, thickness_sigma : float
        How well the dome's sizes are known; 0 takes one as exact.
    n_acrylic_sigma : float
        How well the dome's index is known.
    distance_sigma : float
        How well given distances are known, one apart from the other.
    distance_offset_sigma : float
        How well the point is known that they are all measured from: an error that they share
        shifts the lens as a whole.
    tilt_sigma : float
        How square to the dome boards at known distances stand that were set up well, about each
        axis. Boards that were not may be off by any amount, as long as they are a minority.
    refine_intrinsics : bool
        Whether intrinsics move within what the camera's calibration says of them. If not, they are
        held, and their uncertainty is passed on to the result.
    check_held_back : bool
        Whether the dome is compared with a bare lens on views held back.
    """

    inner_radius_sigma: float = 1e-4
    thickness_sigma: float = 1e-4
    n_acrylic_sigma: float = 3e-3
    distance_sigma: float = 2e-4
    distance_offset_sigma: float = 2e-4
    tilt_sigma: float = field(default=float(np.deg2rad(0.2)))
    refine_intrinsics: bool = True
    check_held_back: bool = True

    def __post_init__(self) -> None:
        if self.distance_sigma <= 0.0 or self.tilt_sigma <= 0.0:
            raise CalibrationError(
                f"distances known to {1e3 * self.distance_sigma:g} mm and boards square to "
                f"{np.rad2deg(self.tilt_sigma):g} deg; both must be positive"
            )


def check_sets(rig: Rig, sets: Sequence[BoardSet]) -> None:
    """Refuse a rig without a dome, and sets that hold too little.

    Raises
    ------
    CalibrationError
        With what there is and what it takes.
    """
    if rig.dome is None:
        raise CalibrationError(
            f"rig {rig.name} has no dome; write its inner_radius_mm, thickness_mm and n_acrylic "
            "into the rig file"
        )
    views = [view for one in sets for view in one.views]
    exact = any(
        kind_of(one.given(i)) is PoseKind.EXACT for one in sets for i in range(len(one.views))
    )
    needed = 1 if exact else _MIN_VIEWS
    if len(views) < needed:
        raise CalibrationError(
            f"{len(views)} pictures show the board; the dome needs {needed} at least, and 10 to 15 "
            "at distances all over the working range to be good"
        )
    points = sum(len(view) for view in views)
    if points < _MIN_POINTS:
        raise CalibrationError(
            f"{points} board corners in {len(views)} pictures; the dome needs {_MIN_POINTS} at "
            "least; show more of the board, or more often"
        )
