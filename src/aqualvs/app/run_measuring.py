"""What a run finds in the frames of a dive, by one process or by several."""

from collections.abc import Generator, Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Self

from aqualvs.app.blocks import in_blocks, read_ahead
from aqualvs.app.crew import Crew
from aqualvs.app.crew_work import CrewWork
from aqualvs.app.measuring import Measured, Meter, ScansFrames, measured_blocks
from aqualvs.app.run_frames import ready, window_of, with_losses
from aqualvs.app.run_inputs import FrameWindow
from aqualvs.app.run_replay import Replay
from aqualvs.closing import Closing
from aqualvs.live.sources import FrameSource, ImageSource, VideoSource
from aqualvs.optics.rig import Rig
from aqualvs.scanning.scan import Frame


class RunMeasuring(Closing):
    """Measures the frames of a dive; a context manager, within which processes are at work.

    Parameters
    ----------
    source : FrameSource or Replay
        Open, and not yet read from.
    rig : Rig
    window : FrameWindow
        Of the frames to measure.
    work : CrewWork or None
        How processes may share the dive; None has this process measure it.
    n_processes : int
    """

    def __init__(
        self,
        source: FrameSource,
        rig: Rig,
        window: FrameWindow,
        work: CrewWork | None,
        n_processes: int,
    ) -> None:
        self._source, self._rig, self._window = source, rig, window
        self._crew = None if work is None else Crew(work, n_processes)
        self._head: list[Measured] | None = None
        self._shared: Iterator[list[Measured]] = iter(())
        self._frames: Iterator[Frame] = iter(())
        self._stack = ExitStack()

    def blocks(
        self, scanner: ScansFrames, *, one_by_one: bool
    ) -> Generator[list[Measured], None, None]:
        """Yield what is found, in the order of the dive; to be closed before the source is.

        Parameters
        ----------
        scanner : ScansFrames
            For what this process measures.
        one_by_one : bool
            Whether nothing may be measured before what was found in the frame before is yielded.

        Raises
        ------
        SourceError
            From the source, at the end of what it has.
        """
        if self._head is not None and self._crew is not None:
            yield self._head
            yield from self._shared
            if self._crew.is_done:
                return
            # The whole video tells what becomes of damage; what came before it stands.
            self._window = replace(self._window, first=self._crew.next_frame)
            self._frames = window_of(self._source, self._window)
        # A recording tells of lost frames itself; what it lacks was skipped on purpose.
        first = None if isinstance(self._source, Replay) else self._window.first
        pairs = with_losses(self._frames, first, self._rig.n_water)
        ahead = _is_at_hand(self._source) and not one_by_one
        meter = Meter(self._rig, scanner)
        frames = in_blocks(pairs, meter.block_length if ahead else 1)
        yield from measured_blocks(read_ahead(frames) if ahead else frames, meter)

    def await_first(self) -> None:
        """Wait for the first frame; to be called before `blocks`.

        Raises
        ------
        SourceError, OptionError
            If there is none.
        """
        self._head = next(self._shared, None)
        if self._head is None:
            frames = window_of(self._source, self._window)
            self._frames = ready(frames, self._source, self._window)

    def __enter__(self) -> Self:
        """Start the processes."""
        if self._crew is not None:
            self._shared = self._stack.enter_context(self._crew).blocks()
        return self

    def close(self) -> None:
        """End the processes."""
        self._stack.close()


def _is_at_hand(source: FrameSource) -> bool:
    """Return whether frames come as fast as they are asked for."""
    return isinstance(source, VideoSource | ImageSource) and Path(source.name).exists()
