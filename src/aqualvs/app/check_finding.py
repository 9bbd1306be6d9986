"""Findings: what `aqualvs check` has to say, one sentence each."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from rich.table import Table


class Severity(StrEnum):
    """How much a finding matters."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    """Makes the rig useless as it is."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing found about a rig.

    Attributes
    ----------
    severity : Severity
    sentence : str
        What was found, with the value, and the remedy where one is needed.
    """

    severity: Severity
    sentence: str


def findings_table(findings: Sequence[Finding]) -> Table:
    """Return the findings for a terminal, a line each."""
    style = {Severity.OK: "green", Severity.WARN: "yellow", Severity.BAD: "bold red"}
    table = Table(box=None, show_header=False, padding=(0, 1))
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for finding in findings:
        mark = style[finding.severity]
        table.add_row(f"[{mark}]{finding.severity.value}[/]", escaped(finding.sentence))
    return table


def escaped(text: str) -> str:
    """Return text that a terminal shows as it is, square brackets included."""
    return text.replace("[", r"\[")


def count_words(n: int, word: str) -> str:
    """Return a number of things: "1 fault", "2 faults"."""
    return f"{n} {word}" if n == 1 else f"{n} {word}s"
