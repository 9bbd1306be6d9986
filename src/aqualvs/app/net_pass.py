"""The net's condition over a dive: from scans, one by one, to the files that tell of it.

What evaluates and draws is imported where it is used: every run reads this module, few want a net.
"""

from array import array
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from aqualvs import __version__
from aqualvs.app.disk import writing
from aqualvs.app.net_request import NetRequest
from aqualvs.app.outputs import HOLES_CSV, NET_CSV, NET_GEOJSON, NET_MAP_PNG, NET_MAP_SVG
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Label, Scan

if TYPE_CHECKING:
    from aqualvs.app.net_log import LaidLog
    from aqualvs.app.net_wall import NetWall

# The posture is that of a net if so much of what it rests on is net.
_NET_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class NetResult:
    """What was found of a net and written.

    Attributes
    ----------
    wall : NetWall
        Stretches and holes on the unrolled net.
    summary : dict
        The same in numbers, as `net.geojson` has it.
    lines : list of str
        The summary in words.
    log : LaidLog or None
        The vehicle's log.
    """

    wall: "NetWall"
    summary: dict[str, Any]
    lines: list[str]
    log: "LaidLog | None"


class NetPass:
    """Takes a dive's scans in turn, and writes what they say of the net.

    Parameters
    ----------
    rig : Rig
        That the scans were made with.
    request : NetRequest
        What to find out; its log is read at once.

    Raises
    ------
    AqualvsError
        If the log cannot be read.
    """

    def __init__(self, rig: Rig, request: NetRequest) -> None:
        from aqualvs.app.net_log import open_log
        from aqualvs.scanning.net_condition import NetCondition

        self._rig, self._request = rig, request
        self._log = open_log(request.log, request.log_offset_s)
        self._condition = NetCondition(rig, request.options())
        self._postures = [array("d") for _ in range(4)]
        self._n_frames = 0

    def add(self, scan: Scan) -> None:
        """Take the next scan; what is not a net is passed over."""
        self._n_frames += 1
        posture = scan.posture
        if not isinstance(posture, Posture) or not _is_net(scan):
            return
        values = (scan.time_s, posture.range, posture.pitch, posture.yaw)
        for column, value in zip(self._postures, values, strict=True):
            column.append(value)
        self._condition.add(scan)

    def write(self, folder: Path, video: Path | None = None) -> NetResult:
        """Finish, write the files of `NET_FILES` and return what was found.

        Parameters
        ----------
        folder : Path
            That exists.
        video : Path or None
            Of the dive; its clock may help to lay the log on it.

        Raises
        ------
        OutputError
            If a file cannot be written.
        """
        from aqualvs.app.net_log import lay_log
        from aqualvs.app.net_places import place_net
        from aqualvs.app.net_seen import DivePostures
        from aqualvs.app.net_wall import unroll
        from aqualvs.app.net_words import net_facts, net_lines

        self._condition.finish()
        stretches, holes = self._condition.stretches, self._condition.holes
        postures = DivePostures(*(np.array(column) for column in self._postures))
        log = None
        if self._log is not None:
            log = lay_log(self._log, postures, self._request.log_offset_s, video)
        places = place_net(stretches, holes, postures, log.places if log else None)
        wall = unroll(stretches, holes, places, self._rig)
        area = self._condition.area
        summary = net_facts(wall, area, self._n_frames, len(postures.time_s))
        facts = {
            "version": __version__,
            "options": self._request.facts(),
            "log": None if log is None else log.facts(),
            "summary": summary,
        }
        with writing(folder):
            write_net_files(folder, wall, facts)
        lines = net_lines(wall, area, self._n_frames)
        if log is not None:
            lines += [*log.log.notes, log.words()]
        return NetResult(wall, summary, lines, log)


def write_net_files(folder: Path, wall: "NetWall", facts: dict[str, Any]) -> None:
    """Write tables first, pictures last.

    Raises
    ------
    OSError
        As the system says it.
    """
    from aqualvs.app.net_map import draw_map
    from aqualvs.app.net_tables import (
        HOLE_COLUMNS,
        NET_COLUMNS,
        hole_rows,
        stretch_rows,
        write_geojson,
        write_table,
    )

    write_table(folder / NET_CSV, NET_COLUMNS, stretch_rows(wall))
    write_table(folder / HOLES_CSV, HOLE_COLUMNS, hole_rows(wall))
    write_geojson(folder / NET_GEOJSON, wall, facts)
    draw_map(wall, [folder / NET_MAP_PNG, folder / NET_MAP_SVG])


def _is_net(scan: Scan) -> bool:
    labels = scan.points.label[scan.points.used]
    return bool(np.count_nonzero(labels == Label.NET) > _NET_SHARE * len(labels))
