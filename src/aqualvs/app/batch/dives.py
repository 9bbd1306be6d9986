"""Which dives a batch is about: files, folders, patterns and lists, and the rig of each dive."""

import glob
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from aqualvs.app.batch.dive_lists import LIST_SUFFIXES, ListedDive, read_list
from aqualvs.app.outputs import RUN_YAML
from aqualvs.app.run_inputs import Water
from aqualvs.errors import OptionError, RigError, SourceError
from aqualvs.live.recorder import is_recording
from aqualvs.live.sources.images import IMAGE_SUFFIXES

VIDEO_SUFFIXES = frozenset(
    [
        ".avi",
        ".h264",
        ".h265",
        ".m2ts",
        ".m4v",
        ".mkv",
        ".mov",
        ".mp4",
        ".mpeg",
        ".mpg",
        ".mts",
        ".ts",
        ".webm",
        ".wmv",
    ]
)
"""Files that are dives when a folder is given; a file that is named may have any suffix."""

RIG_YAML = "rig.yaml"
_RECORDING = ".mcap"


@dataclass(frozen=True, slots=True, kw_only=True)
class Dive:
    """A dive to be measured.

    Attributes
    ----------
    source : Path
        Video, folder of images or recording; absolute.
    rig : Path or None
        Absolute; None for a recording, which has its own.
    name : str
        As the user calls it; empty if it shall be named after its file.
    water : Water
        What the user says about the water of this dive.
    log : Path or None
        The vehicle's; absolute.
    log_offset_s : float or None
        Its clock minus the dive's, where it is known.
    """

    source: Path
    rig: Path | None
    name: str = ""
    water: Water = field(default_factory=Water)
    log: Path | None = None
    log_offset_s: float | None = None


def find_dives(
    wanted: Sequence[str], *, rig: Path | None, water: Water, out: Path | None = None
) -> list[Dive]:
    """Return the dives that the user means, each once, in natural order of what was given.

    Parameters
    ----------
    wanted : sequence of str
        Files, folders (searched through), patterns such as `2026/*/dive*.mp4`, and lists
        (`read_list`).
    rig : Path or None
        For all dives but those for which a list names another. None takes what lies beside each
        dive: `NAME.rig.yaml` for `NAME.mp4`, else `rig.yaml` in its folder.
    water : Water
        Of all dives for which a list does not say better.
    out : Path or None
        The batch's own folder, in which no dive is looked for.

    Raises
    ------
    SourceError
        If there is no such file, a folder holds no dive, or the log of one is not there.
    RigError
        If a dive has no rig.
    OptionError
        If a dive is given twice with different rigs, water or names, or a list cannot be read.
    """
    found: dict[Path, Dive] = {}
    for listed in _listed(wanted, out):
        source = listed.source.resolve()
        dive = Dive(
            source=source,
            rig=_rig_of(source, listed.rig or rig),
            name=listed.name,
            water=listed.water if listed.water != Water() else water,
            log=_log_of(source, listed.log),
            log_offset_s=listed.log_offset_s,
        )
        if found.setdefault(source, dive) != dive:
            raise OptionError(f"{source}: given twice, with different words; name it once")
    return list(found.values())


def _listed(wanted: Iterable[str], out: Path | None) -> Iterator[ListedDive]:
    for text in wanted:
        for path in _expanded(text):
            if path.suffix.lower() in LIST_SUFFIXES and path.is_file():
                yield from read_list(path)
            elif path.is_dir():
                yield from (ListedDive(inner) for inner in _dives_in(path, out))
            elif path.exists():
                yield ListedDive(path)
            else:
                raise SourceError(f"{path}: no such file or folder; check the path")


def _expanded(text: str) -> list[Path]:
    """Return the path, or what a pattern matches where no path of that name exists."""
    if Path(text).exists() or not glob.has_magic(text):
        return [Path(text)]
    found = sorted(map(Path, glob.glob(text, recursive=True)), key=natural_key)
    if not found:
        raise SourceError(f"{text}: matches no file; check the pattern")
    return found


def _dives_in(folder: Path, out: Path | None) -> list[Path]:
    """Return the dives below a folder; without any video, each folder of images is one."""
    own = out.resolve() if out is not None else None
    found = []
    for path in sorted(folder.rglob("*"), key=natural_key):
        if own is not None and path.resolve().is_relative_to(own):
            continue
        # What a run has written about a dive is no other dive.
        if _is_dive(path) and not (path.parent / RUN_YAML).exists():
            found.append(path)
    found = found or _image_folders(folder)
    if found:
        return found
    raise SourceError(f"{folder}: holds no dive; name videos, recordings or folders of images")


def _image_folders(folder: Path) -> list[Path]:
    folders = [folder, *(path for path in folder.rglob("*") if path.is_dir())]
    return sorted((path for path in folders if _holds_images(path)), key=natural_key)


def _holds_images(folder: Path) -> bool:
    if (folder / RUN_YAML).exists():
        return False
    return any(path.suffix.lower() in IMAGE_SUFFIXES for path in folder.iterdir())


def natural_key(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts `dive2` before `dive10`."""
    return [(int(n or -1), text) for n, text in re.findall(r"(\d+)|(\D+)", str(path))]


def _is_dive(path: Path) -> bool:
    suffix = path.suffix.lower()
    if suffix == _RECORDING:
        return is_recording(path)
    return suffix in VIDEO_SUFFIXES and path.is_file()


def _log_of(source: Path, given: Path | None) -> Path | None:
    if given is None:
        return None
    if not given.is_file():
        raise SourceError(f"{given}: no such log, which the list names for {source}; check it")
    return given.resolve()


def _rig_of(source: Path, given: Path | None) -> Path | None:
    if given is not None:
        return given.resolve()
    if is_recording(source):
        return None
    own = source.with_name(f"{source.stem}.rig.yaml")
    shared = (source if source.is_dir() else source.parent) / RIG_YAML
    for path in (own, shared, source.parent / RIG_YAML):
        if path.is_file():
            return path
    raise RigError(
        f"{source}: has no rig; put {own.name} or {RIG_YAML} beside it, or give --rig for all dives"
    )
