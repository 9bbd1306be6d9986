"""What it costs that the lens is not in the dome's centre."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from aqualvs.app.check_accuracy import index_sigma
from aqualvs.app.design.calibrated import lasers_by
from aqualvs.app.design.settings import Design
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.expected_error import WallView
from aqualvs.optics.rig import Rig

INDEX_ERROR = 0.005
"""About what sea water's index is above fresh water's."""

_USUAL = (0.0, 0.5e-3, 1e-3, 2e-3, 5e-3, 10e-3, 20e-3, 40e-3)
# A lens farther out than this share of the inner radius has no room.
_ROOM = 0.9


@dataclass(frozen=True, slots=True)
class OffsetCost:
    """What an offset of the lens, ahead of the dome's centre, costs.

    Attributes
    ----------
    offset : float
        Metres.
    neglected : array, shape (W, 3)
        Errors of (range, pitch, yaw), in m and rad, where the lens is taken to be in the centre
        and all else is right.
    calibrated : array, shape (W, 3)
        The same where the lasers, too, were calibrated with the lens taken to be in the centre: on
        boards, whose places are then wrong as well. NaN where no board's place can be told.
    aside : array, shape (W, 3)
        As `neglected`, for an equal offset to the right.
    index_error : array, shape (W, 3)
        Errors where the offset is known, but the water's index is taken too large by
        `INDEX_ERROR`.
    index_sigma : float
        How well one picture of a known target tells the water's index; see
        `aqualvs.app.check_accuracy.index_sigma`.
    """

    offset: float
    neglected: FloatArray
    calibrated: FloatArray
    aside: FloatArray
    index_error: FloatArray
    index_sigma: float


def offset_costs(design: Design, ranges: Sequence[float]) -> tuple[OffsetCost, ...]:
    """Return the costs of offsets from none to what the dome has room for.

    Among them are the design's own offset and its centring tolerance. None without a dome.

    Parameters
    ----------
    design : Design
        With its lasers tilted as they will be.
    ranges : sequence of float
        Walls square ahead, metres.
    """
    dome = design.rig.dome
    if dome is None:
        return ()
    own = float(np.linalg.norm(design.rig.dome_from_cam.translation))
    offsets = {round(value, 5) for value in (*_USUAL, own, design.centring)}
    rig = design.nominal_rig()
    room = _ROOM * dome.inner_radius
    return tuple(_cost(rig, offset, ranges) for offset in sorted(offsets) if offset <= room)


def _cost(rig: Rig, offset: float, ranges: Sequence[float]) -> OffsetCost:
    centred = _with_lens(rig, (0.0, 0.0, 0.0))
    ahead, aside = _with_lens(rig, (0.0, offset, 0.0)), _with_lens(rig, (offset, 0.0, 0.0))
    return OffsetCost(
        offset=offset,
        neglected=_errors(ahead, centred, ranges),
        calibrated=_errors(ahead, lasers_by(centred, ahead), ranges),
        aside=_errors(aside, centred, ranges),
        index_error=_errors(ahead, ahead.in_water(rig.n_water + INDEX_ERROR), ranges),
        index_sigma=index_sigma(ahead),
    )


def _with_lens(rig: Rig, position: tuple[float, float, float]) -> Rig:
    return replace(rig, dome_from_cam=SE3(rig.dome_from_cam.rotation, np.array(position)))


def _errors(true: Rig, believed: Rig | None, ranges: Sequence[float]) -> FloatArray:
    """Return what `believed` reads of what `true` sees, less the truth (W, 3); NaN where none."""
    if believed is None:
        return np.full((len(ranges), 3), np.nan)
    read = [WallView.ahead(true, wall).read_by(believed) - [wall, 0.0, 0.0] for wall in ranges]
    return np.array(read)
