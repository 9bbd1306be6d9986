"""Names of dives: folders and partitions that keep dives of the same file name apart."""

import re
import unicodedata
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from aqualvs.errors import OptionError

_LONGEST = 80
_DEEPEST = 4


def name_dives(sources: Sequence[tuple[Path, str]], known: Mapping[str, str]) -> list[str]:
    """Return a name for every dive, no two the same, whatever the file system makes of case.

    Parameters
    ----------
    sources : sequence of (Path, str)
        Where a dive is, and the name that the user gives it, if any. A dive without is named after
        its file; where that is taken, with the folders before it, as many as it needs.
    known : mapping
        Source to the name that an earlier batch in the same folder gave it, and which stays.

    Returns
    -------
    names : list of str
        They begin with a letter, so that no reader takes them for numbers or dates, and hold
        letters, digits, dots, underscores and hyphens.

    Raises
    ------
    OptionError
        If the user gives one name to two dives.
    """
    names = {str(path): known[str(path)] for path, given in sources if _keeps(path, given, known)}
    for path, given in sources:
        if given:
            # Another dive's name for good: what the earlier batch wrote under it would be lost.
            others = {name for source, name in {**known, **names}.items() if source != str(path)}
            if _folded(safe_name(given)) in map(_folded, others):
                raise OptionError(f"name {given!r}: is that of another dive; choose another")
            names[str(path)] = safe_name(given)
    unnamed = [path for path, _ in sources if str(path) not in names]
    taken = {_folded(name) for name in (*known.values(), *names.values())}
    names |= {str(path): name for path, name in zip(unnamed, _own(unnamed, taken), strict=True)}
    return [names[str(path)] for path, _ in sources]


def safe_name(text: str) -> str:
    """Return a text as part of a path that every system and every reader of Parquet takes."""
    text = unicodedata.normalize("NFC", text)
    text = "".join(c if c.isalnum() or c in "._-" else "_" for c in text)
    text = re.sub("_+", "_", text).strip("._")[:_LONGEST].rstrip("._")
    return text if text[:1].isalpha() else f"dive_{text}".rstrip("_")


def _keeps(path: Path, given: str, known: Mapping[str, str]) -> bool:
    return str(path) in known and (not given or safe_name(given) == known[str(path)])


def _own(paths: Sequence[Path], taken: Collection[str]) -> list[str]:
    """Return names after the files; those that clash all get more of their path."""
    used, names = set(taken), dict.fromkeys(paths, "")
    waiting = list(names)
    for depth in range(1, _DEEPEST + 1):
        called = {path: _called(path, depth) for path in waiting}
        counted = [_folded(name) for name in called.values()]
        for path, name in called.items():
            if counted.count(_folded(name)) == 1 and _folded(name) not in used:
                names[path] = name
        used |= {_folded(name) for name in names.values() if name}
        waiting = [path for path in waiting if not names[path]]
    for path in waiting:
        names[path] = _numbered(_called(path, _DEEPEST), used)
        used.add(_folded(names[path]))
    return [names[path] for path in paths]


def _called(path: Path, depth: int) -> str:
    folders = [part for part in path.parent.parts if part.strip("/\\")]
    own = path.name if path.is_dir() else path.stem
    # The file's own end must outlive the cut.
    return safe_name("_".join([*folders[len(folders) - depth + 1 :], own])[-_LONGEST:])


def _numbered(name: str, used: Collection[str]) -> str:
    number = 2
    while _folded(f"{name}-{number}") in used:
        number += 1
    return f"{name}-{number}"


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name.casefold())
