"""What a command says on standard error, without the lines that tell how far it is."""

import re

from aqualvs.terminal import FIRST_RUN


def complaints(said: str) -> list[str]:
    """Return the lines but those of the progress, each with its line feed."""
    first, later = r"aqualvs: .*: (\d+ )?(frames?|pictures?)", r"aqualvs: .*: \d+ .* after \d+ s"
    progress = re.compile(rf"({first}|{later}|.*{FIRST_RUN}.*)\s*")
    return [line for line in said.splitlines(keepends=True) if not progress.fullmatch(line)]
