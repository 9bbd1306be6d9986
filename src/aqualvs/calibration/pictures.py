"""Which pictures the arguments of a command mean."""

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from aqualvs.errors import CalibrationError
from aqualvs.special_files import refuse_special

PICTURE_SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
"""What a folder is searched for."""


def picture_paths(arguments: Sequence[str | Path]) -> list[Path]:
    """Return the pictures that files, folders and patterns mean, each once.

    Parameters
    ----------
    arguments : sequence of str or Path
        Pictures, folders of them, or patterns such as 'air/*.png'. What one argument means is
        sorted naturally (`img2` before `img10`).

    Raises
    ------
    CalibrationError
        If an argument means no picture, or two of the pictures have the same file name: poses and
        reports know pictures by their names.
    """
    paths = [path for argument in arguments for path in _meant(str(argument))]
    if not paths:
        raise CalibrationError("no pictures given; name pictures, a folder, or a pattern")
    unique = list(dict.fromkeys(paths))
    first: dict[str, Path] = {}
    for path in unique:
        other = first.setdefault(path.name, path)
        if other is not path:
            raise CalibrationError(
                f"{path}: has the same file name as {other}; rename one, pictures are known by name"
            )
    return unique


def _meant(argument: str) -> list[Path]:
    path = Path(argument)
    if path.is_dir():
        found = [p for p in path.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES]
        if not found:
            raise CalibrationError(
                f"{path}: no pictures in this folder; looked for "
                f"{', '.join(sorted(PICTURE_SUFFIXES))}"
            )
        return sorted(found, key=_natural)
    if path.exists():
        refuse_special(path, CalibrationError)
        return [path]
    if glob.has_magic(argument):
        matches = [Path(match) for match in glob.glob(argument, recursive=True)]
        found = [p for p in matches if p.is_file()]
        if found:
            return sorted(found, key=_natural)
        raise CalibrationError(f"{argument}: no file matches this pattern; check folder and ending")
    raise CalibrationError(f"{path}: no such picture or folder; check the path")


def _natural(path: Path) -> list[tuple[int, str]]:
    """Return a sort key in which runs of digits count by value."""
    return [(int(n or -1), text) for n, text in re.findall(r"(\d+)|(\D+)", str(path))]
