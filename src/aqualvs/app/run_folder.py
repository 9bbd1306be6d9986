"""What a run leaves behind: its folder's files, its report, and how it compares with the truth."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from aqualvs.app.measuring import Measured
from aqualvs.app.outputs import POSTURE_CSV, RunOutputs, prepare_folder
from aqualvs.app.overwriting import Claim
from aqualvs.app.progress import Tick
from aqualvs.app.report import write_report
from aqualvs.app.run_bare_lens import RunBareLens
from aqualvs.app.run_inputs import RunRequest, source_facts
from aqualvs.app.run_mcap import RunMcap, check_source_stays
from aqualvs.app.run_net import RunNet
from aqualvs.app.run_overlay import RunOverlay
from aqualvs.app.run_writers import RunWriters
from aqualvs.app.stopping import StopSignals
from aqualvs.app.truth import TruthComparison, compare_with_truth
from aqualvs.live.sources import FrameSource
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping


def prepare(request: RunRequest) -> Claim:
    """Make sure that the run can be written; returns the claim to be closed at its end.

    Raises
    ------
    OutputError
        If it cannot, or its folder holds another that may not be replaced.
    """
    check_source_stays(request.out, request.source)
    return prepare_folder(request.out, overwrite=request.overwrite)


@contextmanager
def writers(
    request: RunRequest, rig: Rig, source: FrameSource, net: RunNet
) -> Iterator[RunWriters]:
    """Open everything that the run writes; it is completed however the run ends."""
    facts, options = source_facts(source), request.facts()
    with (
        RunOutputs(request.out, source=facts, rig=rig_to_mapping(rig), options=options) as outputs,
        RunOverlay(request.out, rig, source, wanted=request.overlay) as overlay,
        RunBareLens(request.out, rig) as bare_lens,
        RunMcap(request.out, rig, request.scanner, wanted=request.mcap) as mcap,
    ):
        yield RunWriters(outputs, overlay, bare_lens, mcap, net)


def write_all(
    blocks: Iterable[list[Measured]], writers: RunWriters, stop: StopSignals, tick: Tick
) -> None:
    """Write what is found until it ends, or a signal stops it."""
    for block in blocks:
        writers.write(*block)
        tick(len(block))
        if stop.caught:
            writers.interrupt()
            return


def report(request: RunRequest) -> Path | None:
    """Write the report, if it is wanted."""
    return write_report(request.out, truth=request.truth) if request.report else None


def comparison(request: RunRequest) -> TruthComparison | None:
    """Compare the postures with the truth, where there is one."""
    if request.truth is None:
        return None
    return compare_with_truth(request.out / POSTURE_CSV, request.truth)
