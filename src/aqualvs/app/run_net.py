"""The state of the net while a dive is run, if it is wanted."""

from pathlib import Path

from aqualvs.app.net_pass import NetPass
from aqualvs.app.net_request import NetRequest
from aqualvs.app.outputs import NET_MAP_PNG
from aqualvs.optics.rig import Rig
from aqualvs.scanning.scan import Scan


class RunNet:
    """Evaluates the net as the frames come; does nothing where nobody asked.

    Parameters
    ----------
    rig : Rig
        Of the run.
    request : NetRequest or None
        What to find out, if anything.

    Raises
    ------
    AqualvsError
        If the log that the request names cannot be read.
    """

    def __init__(self, rig: Rig, request: NetRequest | None) -> None:
        self._net = None if request is None else NetPass(rig, request)

    def add(self, scan: Scan) -> None:
        """Take the next scan."""
        if self._net is not None:
            self._net.add(scan)

    def write(self, folder: Path, source: str) -> list[str]:
        """Finish, write the net's files and return the summary in words.

        Parameters
        ----------
        folder : Path
            Of the run.
        source : str
            Of the frames; the clock of a video may help to lay a log on it.

        Raises
        ------
        OutputError
            If a file cannot be written.
        """
        if self._net is None:
            return []
        video = Path(source) if Path(source).is_file() else None
        result = self._net.write(folder, video)
        return [*result.lines, f"map of the net: {folder / NET_MAP_PNG}"]
