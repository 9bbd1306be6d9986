"""The summary of a dive from the notes of its pieces."""

from array import array
from collections.abc import Sequence
from pathlib import Path

from aqualvs.app.batch.pieces import NOTES
from aqualvs.app.batch.watchers import stand_ins, stored_bars, stored_ranges
from aqualvs.app.batch.work import OpenDive
from aqualvs.app.net_check import net_check
from aqualvs.app.run import agreement_for
from aqualvs.app.tally import Tally


def joined_tally(dive: OpenDive, pieces: Sequence[Path]) -> Tally:
    """Return the summary that a run of the whole dive would have gathered.

    Parameters
    ----------
    dive : OpenDive
    pieces : sequence of Path
        Folders of all pieces, in order.

    Raises
    ------
    UnlikeSurveyError
        If a watcher asks for what the pieces did not keep.
    """
    tally = Tally(agreement=agreement_for(dive.request, dive.rig))
    for piece in pieces:
        for scan in stand_ins(piece / NOTES):
            tally.add(scan)
    tally.net_check = net_check(dive.request.target, dive.rig)
    if tally.net_check is not None:
        for piece in pieces:
            tally.net_check.bars.extend(stored_bars(piece / NOTES))
    return tally


def joined_ranges(pieces: Sequence[Path]) -> "array[float]":
    """Return the range of every frame in metres, NaN without a posture."""
    found = array("d")
    for piece in pieces:
        found.extend(stored_ranges(piece / NOTES))
    return found
