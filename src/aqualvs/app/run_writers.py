"""Everything that a run writes, frame by frame."""

from pathlib import Path

from aqualvs.app.outputs import RunOutputs
from aqualvs.app.run_bare_lens import RunBareLens
from aqualvs.app.run_mcap import RunMcap, ScansFrames
from aqualvs.app.run_net import RunNet
from aqualvs.app.run_overlay import RunOverlay
from aqualvs.app.runfile import Status
from aqualvs.app.tally import Tally
from aqualvs.scanning.scan import Frame, Scan


class RunWriters:
    """The folder's files, the overlay, the recording and the state of the net, as one.

    Parameters
    ----------
    outputs : RunOutputs
    overlay : RunOverlay
    bare_lens : RunBareLens
    mcap : RunMcap
    net : RunNet
    """

    def __init__(
        self,
        outputs: RunOutputs,
        overlay: RunOverlay,
        bare_lens: RunBareLens,
        mcap: RunMcap,
        net: RunNet,
    ) -> None:
        self._outputs, self._overlay, self._bare_lens = outputs, overlay, bare_lens
        self._mcap, self._net = mcap, net

    @property
    def tally(self) -> Tally:
        """Summary so far."""
        return self._outputs.tally

    def measure(self, scanner: ScansFrames, frame: Frame) -> None:
        """Measure a frame and write what was found."""
        scan = self._mcap.process(scanner, frame)
        self._write(frame, scan)
        self._net.add(scan)

    def lost(self, scan: Scan) -> None:
        """Write the scan that stands for a lost frame."""
        self._mcap.lost(scan)
        self._write(None, scan)

    def interrupt(self) -> None:
        """Note that the run ends before its source does."""
        self._outputs.status = Status.INTERRUPTED

    def dome_lines(self) -> list[str]:
        """Say what the dome model is worth."""
        return self._bare_lens.lines()

    def net_lines(self, folder: Path, source: str) -> list[str]:
        """Write the state of the net, if it was wanted, and say it in words."""
        return self._net.write(folder, source)

    def _write(self, frame: Frame | None, scan: Scan) -> None:
        self._outputs.write(scan)
        self._bare_lens.write(scan)
        self._overlay.write(frame, scan)
