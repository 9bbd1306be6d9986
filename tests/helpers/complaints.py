"""What a command says on standard error, without the line that tells what it begins with."""

from aqualvs.terminal import FIRST_RUN


def complaints(said: str) -> list[str]:
    """Return the lines but that of the progress, each with its line feed."""
    return [line for line in said.splitlines(keepends=True) if FIRST_RUN not in line]
