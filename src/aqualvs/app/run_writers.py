"""Everything that a run writes, frame by frame."""

from pathlib import Path

from aqualvs.app.measuring import Measured, ScansFrames
from aqualvs.app.outputs import RunOutputs
from aqualvs.app.run_bare_lens import RunBareLens
from aqualvs.app.run_mcap import RunMcap
from aqualvs.app.run_net import RunNet
from aqualvs.app.run_overlay import RunOverlay
from aqualvs.app.runfile import Status
from aqualvs.app.tally import Tally


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

    def recorded(self, scanner: ScansFrames) -> ScansFrames:
        """Return the scanner to measure with: it has what it finds recorded, if that is wanted."""
        return self._mcap.recorded(scanner)

    def write(self, *found: Measured) -> None:
        """Write what was found in frames, and what stands for lost ones, in their order."""
        self._outputs.write(*(measured.scan for measured in found))
        self._bare_lens.write(*found)
        for measured in found:
            self._overlay.write(measured.frame, measured.scan)
            if measured.is_lost:
                self._mcap.lost(measured.scan)
            else:
                self._net.add(measured.scan)

    def interrupt(self) -> None:
        """Note that the run ends before its source does."""
        self._outputs.status = Status.INTERRUPTED

    def dome_lines(self) -> list[str]:
        """Say what the dome model is worth."""
        return self._bare_lens.lines()

    def net_lines(self, folder: Path, source: str) -> list[str]:
        """Write the state of the net, if it was wanted, and say it in words."""
        return self._net.write(folder, source)
