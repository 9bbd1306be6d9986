"""From frames to what a run writes of them, a few frames at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

from aqualvs.app.blocks import block_length
from aqualvs.optics.rig import Rig
from aqualvs.scanning.comparison import BareLensComparison
from aqualvs.scanning.pipeline import Scanner
from aqualvs.scanning.posture import Posture, Refusal
from aqualvs.scanning.scan import Frame, Scan


class ScansFrames(Protocol):
    """What a run needs of a scanner."""

    def process(self, frame: Frame) -> Scan:
        """Return the scan of one frame."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What was found in a frame.

    Attributes
    ----------
    scan : Scan
    bare : Posture, Refusal or None
        What ignoring the dome would make of it; None for a rig without a dome.
    frame : Frame or None
        None for a frame that was lost, or that another process has measured.
    is_lost : bool
        Whether the scan stands for a frame that could not be decoded.
    """

    scan: Scan
    bare: Posture | Refusal | None
    frame: Frame | None = None
    is_lost: bool = False


class Meter:
    """Measures frames, with the dome and without.

    Parameters
    ----------
    rig : Rig
    scanner : ScansFrames
        For the same rig.

    Attributes
    ----------
    block_length : int
        How many frames it is best given at a time.
    """

    def __init__(self, rig: Rig, scanner: ScansFrames) -> None:
        self._scanner = scanner
        self.block_length = block_length(rig.size_px) if isinstance(scanner, Scanner) else 1
        self._bare_lens = BareLensComparison(rig) if rig.dome is not None else None

    def measure(self, frames: Sequence[Frame]) -> list[Measured]:
        """Measure frames, in their order."""
        return [
            Measured(scan, self._bare(scan), frame)
            for scan, frame in zip(self._scans(frames), frames, strict=True)
        ]

    def lost(self, scan: Scan) -> Measured:
        """Complete the scan that stands for a lost frame."""
        return Measured(scan, self._bare(scan), is_lost=True)

    def _bare(self, scan: Scan) -> Posture | Refusal | None:
        return None if self._bare_lens is None else self._bare_lens.measure(scan)

    def _scans(self, frames: Sequence[Frame]) -> list[Scan]:
        scanner = self._scanner
        if not isinstance(scanner, Scanner):
            return [scanner.process(frame) for frame in frames]
        # Step by step for all of them: code that has just run is still in the caches, where
        # decoding and the other step would displace it.
        returns = [scanner.detect(frame) for frame in frames]
        return [
            scanner.measure(frame.index, frame.time_s, found)
            for frame, found in zip(frames, returns, strict=True)
        ]


def measured_blocks(
    blocks: Iterator[list[tuple[list[Scan], Frame]]], meter: Meter
) -> Iterator[list[Measured]]:
    """Yield what is found in frames, and what stands for lost ones, in the order of the dive.

    Parameters
    ----------
    blocks : iterator of list
        Of frames with the scans that stand for the lost ones right before, see `with_losses`.
    meter : Meter

    Yields
    ------
    found : list of Measured
        Of one block; what stands for lost frames before it comes by itself.
    """
    for block in blocks:
        (before, _), *others = block
        if before:
            # Before anything is recorded of the block's own frames.
            yield [meter.lost(scan) for scan in before]
        first, *more = meter.measure([frame for _, frame in block])
        found = [first]
        for (lost, _), measured in zip(others, more, strict=True):
            found += [meter.lost(scan) for scan in lost]
            found.append(measured)
        yield found
