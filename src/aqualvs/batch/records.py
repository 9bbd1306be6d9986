"""Status of a batch: a record for each dive, and its progress on standard error.

Progress is a bar with the time left, and a line for every dive that has ended.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from aqualvs.closing import Closing
from aqualvs.text import hole_count

_OF_NET = ("area_m2", "bar_mm", "twine_mm", "solidity", "fouling", "largest_hole_mm")


class DiveState(StrEnum):
    """Status of a dive; the value is that of `state` in `dives.parquet`."""

    FINISHED = "finished"
    INCOMPLETE = "incomplete"
    """The source broke off, and what came before is measured; or its net's state is not told."""
    FAILED = "failed"
    """There is no result."""
    UNFINISHED = "unfinished"
    """The batch was stopped before it was done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiveRecord:
    """Status and results of a dive.

    Attributes
    ----------
    name : str
    source : str
        Where the dive is.
    state : DiveState
    words : str
        Why it is not finished; empty if it is.
    facts : mapping
        From `with_net`; empty without a result.
    reused : bool
        Whether an earlier batch had finished it.
    """

    name: str
    source: str
    state: DiveState
    words: str = ""
    facts: Mapping[str, Any] = field(default_factory=dict)
    reused: bool = False

    @classmethod
    def of(cls, name: str, source: str, facts: Mapping[str, Any], *, reused: bool) -> "DiveRecord":
        """Return the record of a dive with a result."""
        faults = [str(facts["fault"])]
        if "net_fault" in facts:
            faults.append(f"state of the net: {facts['net_fault']}")
        fault = "; ".join(filter(None, faults))
        state = DiveState.INCOMPLETE if fault else DiveState.FINISHED
        return cls(name=name, source=source, state=state, words=fault, facts=facts, reused=reused)

    @property
    def summary(self) -> Mapping[str, Any]:
        """Return the summary as `run.yaml` has it, empty without a result."""
        found: Mapping[str, Any] = self.facts.get("summary", {})
        return found

    @property
    def net(self) -> Mapping[str, Any]:
        """Return the condition of the net as `net_facts` has it, empty if it was not evaluated."""
        found: Mapping[str, Any] = self.facts.get("net", {})
        return found

    def net_words(self) -> str:
        """Return the condition of the net in a few words; empty if it was not evaluated."""
        if not self.net:
            return ""
        if not self.net["n_stretches"]:
            return "no net seen"
        holes, fouling = hole_count(self.net["n_holes"]), self.net["fouling"]
        # Adding zero turns a negative zero into a plain one.
        return holes if fouling is None else f"fouling {round(fouling, 2) + 0.0:+.2f}, {holes}"

    def line(self) -> str:
        """Return the dive in one line."""
        if not self.facts:
            return f"{self.name}: {self.state.value}" + (f": {self.words}" if self.words else "")
        n_frames, share = self.facts["n_frames"], 100 * self.summary.get("valid_share", 0.0)
        said = f"{self.name}: {n_frames} frames, posture in {share:.1f} %"
        if "range_median_m" in self.summary:
            said += f", range {self.summary['range_median_m']:.3f} m"
        if self.net:
            said += f", {self.net_words()}"
        if self.words:
            said += f"; {self.state.value}: {self.words}"
        return said + (" (was finished)" if self.reused else "")

    def row(self) -> dict[str, Any]:
        """Return the dive as a row of `dives.parquet`."""
        agreement = self.summary.get("laser_agreement") or {}
        kept = ("n_frames", "n_valid", "duration_s", "rig", "rig_file", "n_water")
        ranges = ("range_median_m", "range_min_m", "range_max_m")
        return {
            "dive": self.name,
            "source": self.source,
            "state": self.state.value,
            "words": self.words,
            "lasers": agreement.get("state"),
            **{name: self.facts.get(name) for name in kept},
            **{name: self.summary.get(name) for name in ranges},
            "net_holes": self.net.get("n_holes"),
            **{f"net_{name}": self.net.get(name) for name in _OF_NET},
        }


# Pieces take seconds, so that the last half minute says little of the speed.
_SPEED_OVER_S = 600.0


class BatchProgress(Closing):
    """Progress of a batch: a bar on a terminal, and a line for each dive; a context manager.

    Parameters
    ----------
    n_dives : int
    tell : callable
        Takes one line of text.
    """

    def __init__(self, n_dives: int, tell: Callable[[str], object]) -> None:
        self._n_dives, self._n_ended, self._n_frames = n_dives, 0, 0
        self._total = 0
        self._tell = tell
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn())
        self._bar = Progress(
            *columns,
            TextColumn("time left"),
            TimeRemainingColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
            speed_estimate_period=_SPEED_OVER_S,
        )
        self._task = self._bar.add_task(self._words(), total=None)

    def expect(self, n_bytes: int) -> None:
        """Note that there is so much more, or less, to be worked through than was said."""
        self._total += n_bytes
        self._bar.update(self._task, total=max(self._total, 1))

    def measured(self, n_bytes: int, n_frames: int) -> None:
        """Note that a piece is done."""
        self._n_frames += n_frames
        self._bar.update(self._task, advance=n_bytes, description=self._words())

    def ended(self, record: DiveRecord) -> None:
        """Note that a dive is done, or given up."""
        self._n_ended += 1
        self._bar.update(self._task, description=self._words())
        self._tell(record.line())

    def _words(self) -> str:
        return f"{self._n_ended} of {self._n_dives} dives, {self._n_frames} frames"

    def __enter__(self) -> Self:
        """Show the bar."""
        self._bar.start()
        return self

    def close(self) -> None:
        """Take the bar away."""
        self._bar.stop()
