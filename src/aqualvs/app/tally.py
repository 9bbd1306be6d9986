"""Summary numbers of a run, gathered frame by frame."""

import contextlib
import csv
import math
import statistics
from array import array
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aqualvs.app.net_check import NetCheck
from aqualvs.scanning.agreement import LaserAgreement
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Scan


@dataclass(slots=True)
class Tally:
    """Counts of frames, postures and refusals, and the ranges found.

    Attributes
    ----------
    n_frames : int
    refused : counter
        Frames without posture, by reason.
    ranges : array of float
        Metres, one for each valid frame.
    agreement : LaserAgreement or None
        What watches over the lasers, if anything does.
    net_check : NetCheck or None
        What compares the net with the target file's, if the file describes one.
    """

    n_frames: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    ranges: "array[float]" = field(default_factory=lambda: array("d"))
    agreement: LaserAgreement | None = None
    net_check: NetCheck | None = None

    @property
    def n_valid(self) -> int:
        """Frames with a posture."""
        return len(self.ranges)

    def add(self, scan: Scan) -> None:
        """Count one frame."""
        self.n_frames += 1
        if self.agreement is not None:
            self.agreement.add(scan)
        if self.net_check is not None:
            self.net_check.add(scan)
        if isinstance(scan.posture, Posture):
            self.ranges.append(scan.posture.range)
        else:
            self.refused[scan.posture.reason.value] += 1

    def facts(self) -> dict[str, Any]:
        """Return the summary for `run.yaml`; ranges are absent where no frame is valid."""
        found: dict[str, Any] = {"n_frames": self.n_frames, "n_valid": self.n_valid}
        if self.n_frames:
            found["valid_share"] = round(self.n_valid / self.n_frames, 4)
        if self.ranges:
            found["range_median_m"] = round(statistics.median(self.ranges), 6)
            found["range_min_m"] = round(min(self.ranges), 6)
            found["range_max_m"] = round(max(self.ranges), 6)
        if self.refused:
            found["refused"] = dict(self.refused.most_common())
        if self.agreement is not None:
            found["laser_agreement"] = self.agreement.verdict().facts()
        if self.net_check is not None:
            found["net_check"] = self.net_check.facts()
        return found

    def lines(self) -> list[str]:
        """Return the summary in words."""
        if not self.n_frames:
            return ["no frame was measured"]
        share = 100 * self.n_valid / self.n_frames
        text = [f"posture in {self.n_valid} of {self.n_frames} frames ({share:.1f} %)"]
        if self.ranges:
            low, high = min(self.ranges), max(self.ranges)
            middle = statistics.median(self.ranges)
            text.append(f"range {middle:.3f} m (median), from {low:.3f} to {high:.3f} m")
        if self.refused:
            counts = (f"{n} {reason}" for reason, n in self.refused.most_common())
            text.append(f"no posture: {', '.join(counts)}")
        sentence = "" if self.agreement is None else self.agreement.verdict().sentence()
        about_net = "" if self.net_check is None else self.net_check.sentence()
        return [*text, *(words for words in (sentence, about_net) if words)]


def tally_of(posture_csv: Path) -> Tally:
    """Gather the summary of a run from its `posture.csv`; damaged and cut rows are left out."""
    tally = Tally()
    with (
        posture_csv.open(newline="", encoding="ascii", errors="replace") as file,
        contextlib.suppress(csv.Error),
    ):
        for row in csv.DictReader(file):
            if row.get("n_water") is None:
                continue
            if row.get("valid") != "1":
                tally.refused[str(row.get("reason"))] += 1
            else:
                try:
                    tally.ranges.append(float(row.get("range_m") or math.nan))
                except ValueError:
                    continue
            tally.n_frames += 1
    return tally
