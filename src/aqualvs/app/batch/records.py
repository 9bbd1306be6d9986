"""How the dives of a batch stand."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from aqualvs.app.report_words import hole_count

_OF_NET = ("area_m2", "bar_mm", "twine_mm", "solidity", "fouling", "largest_hole_mm")


class DiveState(StrEnum):
    """How a dive stands; the value is what `dives.parquet` says in `state`."""

    FINISHED = "finished"
    INCOMPLETE = "incomplete"
    """The source broke off, and what came before is measured; or its net's state is not told."""
    FAILED = "failed"
    """There is no result."""
    UNFINISHED = "unfinished"
    """The batch was stopped before it was done."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiveRecord:
    """How a dive stands, and what was found.

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
        """Return the state of the net as `net_facts` has it, empty where it was not told."""
        found: Mapping[str, Any] = self.facts.get("net", {})
        return found

    def net_words(self) -> str:
        """Return the state of the net in a few words; empty where it was not told."""
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
