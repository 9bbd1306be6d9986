"""What ignoring the dome would have made of a run, frame by frame."""

import statistics
from array import array
from dataclasses import replace
from pathlib import Path

from aqualvs.app.disk import writing
from aqualvs.app.measuring import Measured
from aqualvs.app.outputs import POSTURE_BARE_CSV
from aqualvs.app.posture_csv import PostureCsv
from aqualvs.closing import Closing
from aqualvs.optics.rig import Rig
from aqualvs.scanning.posture import Posture


class RunBareLens(Closing):
    """Writes `posture_bare.csv` while a run goes on, or does nothing for a rig without a dome.

    Parameters
    ----------
    folder : Path
    rig : Rig

    Raises
    ------
    OutputError
        From every method, if the file cannot be written.
    """

    def __init__(self, folder: Path, rig: Rig) -> None:
        self._path = folder / POSTURE_BARE_CSV
        self._ratios = array("d")
        self._file: PostureCsv | None = None
        if rig.dome is not None:
            with writing(self._path):
                self._file = PostureCsv(self._path)

    def write(self, *found: Measured) -> None:
        """Append the rows of frames."""
        if self._file is None:
            return
        rows = []
        for measured in found:
            scan, posture = measured.scan, measured.bare
            if isinstance(posture, Posture) and isinstance(scan.posture, Posture):
                self._ratios.append(posture.range / scan.posture.range)
            if posture is not None:
                rows.append(replace(scan, posture=posture))
        with writing(self._path):
            self._file.write(*rows)

    def lines(self) -> list[str]:
        """Say in words what the dome is worth."""
        if not self._ratios:
            return []
        percent = 100.0 * (statistics.median(self._ratios) - 1.0)
        return [f"without the dome model the range would read {percent:+.1f} % (median)"]

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
