"""`dive.mcap`: the recording that a run writes on request."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from aqualvs.app.disk import writing
from aqualvs.app.measuring import ScansFrames
from aqualvs.app.outputs import DIVE_MCAP, RUN_FILES
from aqualvs.app.run_replay import Replay
from aqualvs.app.run_water import WaterFollowingScanner
from aqualvs.closing import Closing
from aqualvs.errors import OptionError
from aqualvs.optics.rig import Rig
from aqualvs.scanning.pipeline import Scanner, ScannerOptions
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.scanning.search import SearchAxis
from aqualvs.scanning.stripe import Returns

if TYPE_CHECKING:
    from aqualvs.live.recorder import Recording
    from aqualvs.live.sample import LiveSample

Measured = tuple[Rig, Scan, dict[SearchAxis, Returns]]


class RunMcap(Closing):
    """Writes `dive.mcap` while a run goes on, or does nothing; a context manager.

    Parameters
    ----------
    folder : Path
    rig : Rig
        For frames that were lost.
    options : ScannerOptions
        That the run measures with.
    wanted : bool
        False makes it measure frames and nothing else.

    Raises
    ------
    OutputError
        From every method, if the file cannot be written.
    """

    def __init__(self, folder: Path, rig: Rig, options: ScannerOptions, *, wanted: bool) -> None:
        self._path, self._rig = folder / DIVE_MCAP, rig
        self._began_ns = time.time_ns()
        self._recording: Recording | None = None
        if wanted:
            with writing(self._path):
                self._recording = _recording(self._path, options)

    def recorded(self, scanner: ScansFrames) -> ScansFrames:
        """Return a scanner that measures as this one does, and has what it finds recorded."""
        return scanner if self._recording is None else _RecordedScanner(self, scanner)

    def write(self, rig: Rig, scan: Scan, returns: dict[SearchAxis, Returns]) -> None:
        """Record a scan with the rig and the stripes that it was made from."""
        if self._recording is not None:
            with writing(self._path):
                self._recording.write(self._sample(rig, scan, returns))

    def lost(self, scan: Scan) -> None:
        """Record the scan of a frame that was lost."""
        self.write(self._rig, scan, {})

    def _sample(self, rig: Rig, scan: Scan, returns: dict[SearchAxis, Returns]) -> "LiveSample":
        from aqualvs.live.health import Health
        from aqualvs.live.sample import Instants, LiveSample

        at_ns = round(1e9 * scan.time_s)
        return LiveSample(
            rig=rig,
            scan=scan,
            returns=returns,
            frame=None,
            # As if the dive had begun with the run.
            utc_ns=self._began_ns + at_ns,
            instants=Instants(at_ns, at_ns, at_ns),
            filtered=None,
            health=Health(),
        )

    def close(self) -> None:
        """Close the file; readable in any case."""
        if self._recording is not None:
            with writing(self._path):
                self._recording.close()


class _RecordedScanner:
    """Measures as another scanner does, and records what it finds."""

    def __init__(self, mcap: RunMcap, scanner: ScansFrames) -> None:
        self._mcap, self._scanner = mcap, scanner

    def process(self, frame: Frame) -> Scan:
        rig, scan, returns = _measured(self._scanner, frame)
        self._mcap.write(rig, scan, returns)
        return scan


def _recording(path: Path, options: ScannerOptions) -> "Recording":
    """Open a recording; what records is imported here and above, as few runs write one."""
    from aqualvs.live.recorder import RecorderOptions, Recording

    return Recording(path, RecorderOptions(scanner=options))


def check_source_stays(folder: Path, source: str) -> None:
    """Make sure that a run in a folder does not replace what it reads.

    Raises
    ------
    OptionError
        If the run's own source would be replaced.
    """
    path = Path(source)
    is_ours = path.is_file() and path.name in RUN_FILES
    if is_ours and path.resolve().parent == folder.resolve():
        raise OptionError(f"{path}: is what the run reads; write to another folder")


def _measured(scanner: ScansFrames, frame: Frame) -> Measured:
    """Return the scan of a frame, and what it was made with and of."""
    if isinstance(scanner, Replay):
        return scanner.measured(frame)
    if isinstance(scanner, WaterFollowingScanner):
        if scanner.is_due(frame):
            scanner.look(frame)
        scanner = scanner.scanner
    if not isinstance(scanner, Scanner):
        raise TypeError(f"{type(scanner).__name__} does not tell its stripes")
    returns = scanner.detect(frame)
    return scanner.rig, scanner.measure(frame.index, frame.time_s, returns), returns
