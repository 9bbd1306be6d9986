"""What a command says on standard error, without the lines that tell how far it is."""

import re

from aqualvs.terminal import FIRST_RUN


def complaints(said: str) -> list[str]:
    """Return the lines but those of the progress, each with its line feed."""
    later = re.compile(r"aqualvs: .*: \d+ .* after \d+ s\s*")
    lines = said.splitlines(keepends=True)
    return [line for line in lines if FIRST_RUN not in line and not later.fullmatch(line)]
