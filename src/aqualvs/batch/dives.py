"""Dives of a batch: what a user names, with the rig and name of each, and what became of them.

`DiveRecord` is the status of a dive, as tables and pages show it.

Dives of the same file name get different names, which become their folders and partitions. A list
of dives is CSV ::

    dive,rig,name,water_n,temperature_c,salinity,log,log_offset_s
    north/0412.mp4,rig_april.yaml,north_april,,6.5,34,north/0412.tlog,
    north/0610.mp4,rig_june.yaml,north_june,,9.0,33,north/0610.BIN,-3.2

or a list of mappings with the same keys in YAML. Only `dive` is required; paths are relative to the
list.
"""

import csv
import glob
import itertools
import math
import re
import unicodedata
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from aqualvs.batch.dataset import NET_FACTS
from aqualvs.errors import OptionError, RigError, SourceError, check_commas
from aqualvs.optics.water import water_fault
from aqualvs.recording import is_recording
from aqualvs.report.net import net_warnings
from aqualvs.results.folder import RUN_YAML
from aqualvs.results.run_request import Water, checked_index
from aqualvs.sources.images import VIDEO_SUFFIXES, is_image_name, natural_key
from aqualvs.text import count_text, hole_count, with_sign
from aqualvs.yamlfile import parse_yaml, read_text

_LONGEST = 80


def name_dives(sources: Sequence[tuple[Path, str]], known: Mapping[str, str]) -> list[str]:
    """Return a unique name for every dive, also on file systems that ignore case.

    They begin with a letter, so that no reader takes them for numbers or dates, and hold letters,
    digits, dots, underscores and hyphens.

    `sources`: where a dive is, and the name that the user gives it, if any. A dive without is named
    after its file; where that is taken, with the folders before it, as many as it needs. `known`:
    by source, the name that an earlier batch in the same folder gave it, and which stays.

    Raises `OptionError` if the user gives one name to two dives.
    """
    names = {
        str(path): known[str(path)]
        for path, given in sources
        if str(path) in known and (not given or safe_name(given) == known[str(path)])
    }
    for path, given in sources:
        if given:
            # Another dive's name for good: what the earlier batch wrote under it would be lost.
            others = {name for source, name in {**known, **names}.items() if source != str(path)}
            if _folded(safe_name(given)) in map(_folded, others):
                raise OptionError(f"name {given!r}: is that of another dive; choose another")
            names[str(path)] = safe_name(given)
    unnamed = [path for path, _ in sources if str(path) not in names]
    taken = {_folded(name) for name in (*known.values(), *names.values())}
    names |= {
        str(path): name for path, name in zip(unnamed, _unique_names(unnamed, taken), strict=True)
    }
    return [names[str(path)] for path, _ in sources]


def safe_name(text: str) -> str:
    """Return a text as part of a path that every system and every reader of Parquet takes."""
    text = unicodedata.normalize("NFC", text)
    text = "".join(c if c.isalnum() or c in "._-" else "_" for c in text)
    text = re.sub("_+", "_", text).strip("._")[:_LONGEST].rstrip("._")
    return text if text[:1].isalpha() else f"dive_{text}".rstrip("_")


def _unique_names(paths: Sequence[Path], taken: Collection[str]) -> list[str]:
    """Return names after the files; those that clash all get more of their path."""
    used, names = set(taken), dict.fromkeys(paths, "")
    waiting = list(names)
    deepest = 4
    for depth in range(1, deepest + 1):
        called = {path: _name_with_folders(path, depth) for path in waiting}
        counted = [_folded(name) for name in called.values()]
        for path, name in called.items():
            if counted.count(_folded(name)) == 1 and _folded(name) not in used:
                names[path] = name
        used |= {_folded(name) for name in names.values() if name}
        waiting = [path for path in waiting if not names[path]]
    for path in waiting:
        name = _name_with_folders(path, deepest)
        numbered = (f"{name}-{number}" for number in itertools.count(2))
        names[path] = next(one for one in numbered if _folded(one) not in used)
        used.add(_folded(names[path]))
    return [names[path] for path in paths]


def _name_with_folders(path: Path, depth: int) -> str:
    folders = [part for part in path.parent.parts if part.strip("/\\")]
    own = path.name if path.is_dir() else path.stem
    # The file's own end must outlive the cut.
    return safe_name("_".join([*folders[len(folders) - depth + 1 :], own])[-_LONGEST:])


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name.casefold())


LIST_SUFFIXES = frozenset({".csv", ".yaml", ".yml"})

_NUMBERS = ("water_n", "temperature_c", "salinity")
_KEYS = ("dive", "rig", "name", *_NUMBERS, "log", "log_offset_s")


@dataclass(frozen=True, slots=True)
class Dive:
    """A dive as the user names it, or as `find_dives` completes it, with absolute paths."""

    source: Path  # Video, folder of images or recording.
    rig: Path | None = None  # None where it is not said, or for a recording, which has its own.
    name: str = ""  # As the user calls it; empty if it shall be named after its file.
    water: Water = field(default_factory=Water)  # What the user says about the water of this dive.
    log: Path | None = None  # The vehicle's, where the list says it.
    log_offset_s: float | None = None  # Its clock minus the dive's, where the list says it.


def read_list(path: Path) -> list[Dive]:
    """Read a list of dives.

    Raises `OptionError` if it cannot be read, a row has no dive, or what it says is not understood.
    """
    text = read_text(path, "a list of dives", OptionError)
    rows = list(_csv_rows(text, path) if path.suffix.lower() == ".csv" else _yaml_rows(text, path))
    if not rows:
        raise OptionError(f"{path}: lists no dives; give at least one row")
    return [_dive_of_row(row, path, number) for number, row in enumerate(rows, 1)]


def _csv_rows(text: str, path: Path) -> Iterator[Mapping[str, Any]]:
    try:
        table = csv.DictReader(text.splitlines(), skipinitialspace=True)
        check_commas(table.fieldnames or (), path, OptionError)
        for row in table:
            yield {str(key).strip(): value for key, value in row.items() if value not in ("", None)}
    except csv.Error as fault:
        raise OptionError(f"{path}: cannot be read as a list of dives ({fault})") from fault


def _yaml_rows(text: str, path: Path) -> Iterable[Mapping[str, Any]]:
    content = parse_yaml(text, str(path), OptionError)
    if isinstance(content, dict) and set(content) == {"dives"}:
        content = content["dives"]
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise OptionError(
            f"{path}: not a list of dives; give mappings with the keys {', '.join(_KEYS)}"
        )
    return content


def _dive_of_row(row: Mapping[str, Any], path: Path, number: int) -> Dive:
    unknown = sorted(str(key) for key in set(row) - set(_KEYS))
    if unknown:
        raise OptionError(f"{path}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}")
    if "dive" not in row:
        raise OptionError(f"{path}: row {number} names no dive; fill in the column 'dive'")
    rig, log = row.get("rig"), row.get("log")
    return Dive(
        source=path.parent / str(row["dive"]).strip(),
        rig=None if rig is None else path.parent / str(rig).strip(),
        name=str(row.get("name", "")).strip(),
        water=_water(row, path, number),
        log=None if log is None else path.parent / str(log).strip(),
        log_offset_s=_number(row, "log_offset_s", path, number),
    )


def _water(row: Mapping[str, Any], path: Path, number: int) -> Water:
    n_water, temperature_c, salinity = (_number(row, key, path, number) for key in _NUMBERS)
    if n_water is not None:
        checked_index(n_water, f"{path}: row {number}: water_n")
    key, remedy = water_fault(temperature_c, salinity)
    if key:
        raise OptionError(f"{path}: row {number}: {key} {row[key]}: {remedy}")
    return Water(n_water=n_water, temperature_c=temperature_c, salinity=salinity)


def _number(row: Mapping[str, Any], key: str, path: Path, number: int) -> float | None:
    if key not in row:
        return None
    try:
        value = float(row[key])
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise OptionError(f"{path}: row {number}: {key} is {row[key]!r}; give a number")
    return value


RIG_YAML = "rig.yaml"


def find_dives(wanted: Sequence[str], *, rig: Path | None, water: Water, out: Path) -> list[Dive]:
    """Return the dives that the user means, each once, in natural order of what was given.

    `wanted`: files, folders (searched through), patterns such as `2026/*/dive*.mp4`, and lists
    (`read_list`). `rig`: of all dives but those for which a list names another; None takes what
    lies beside each dive: `NAME.rig.yaml` for `NAME.mp4`, else `rig.yaml` in its folder. `water`:
    of all dives for which a list does not say better. `out`: the batch's own folder, in which no
    dive is looked for.

    Raises `SourceError` if there is no such file, a folder holds no dive, or the log of one is not
    there. Raises `RigError` if a dive has no rig. Raises `OptionError` if a dive is given twice
    with different rigs, water or names, a folder of dives is `out` or in it, or a list cannot be
    read.
    """
    found: dict[Path, Dive] = {}
    for listed in _found_dives(wanted, out):
        source = listed.source.resolve()
        dive = replace(
            listed,
            source=source,
            rig=_rig_of(source, listed.rig or rig),
            water=listed.water if listed.water != Water() else water,
            log=_log_of(source, listed.log),
        )
        if found.setdefault(source, dive) != dive:
            raise OptionError(f"{source}: given twice with different settings; name it once")
    return list(found.values())


def _found_dives(wanted: Iterable[str], out: Path) -> Iterator[Dive]:
    for text in wanted:
        for path in _expanded(text):
            if path.suffix.lower() in LIST_SUFFIXES and path.is_file():
                yield from read_list(path)
            elif path.is_dir():
                yield from (Dive(inner) for inner in _dives_in(path, out))
            elif path.exists():
                yield Dive(path)
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


def _dives_in(folder: Path, out: Path) -> list[Path]:
    """Return the dives below a folder; without any video, each folder of images is one."""
    own = out.resolve()
    if folder.resolve().is_relative_to(own):
        raise OptionError(f"-o {out}: is where {folder} is; choose another folder for the results")
    found = []
    for path in _visible(folder):
        if path.resolve().is_relative_to(own):
            continue
        suffix = path.suffix.lower()
        is_dive = suffix in VIDEO_SUFFIXES and path.is_file()
        is_dive |= suffix == ".mcap" and is_recording(path)
        # What a run has written about a dive is no other dive.
        if is_dive and not (path.parent / RUN_YAML).exists():
            found.append(path)
    folders = [folder, *(path for path in _visible(folder) if path.is_dir())]
    found = found or [
        one
        for one in folders
        if not (one / RUN_YAML).exists() and any(map(is_image_name, one.iterdir()))
    ]
    if found:
        return found
    raise SourceError(f"{folder}: holds no dive; name videos, recordings or folders of images")


def _visible(folder: Path) -> list[Path]:
    """Return what is below a folder, in natural order, but for hidden names and what they hold.

    macOS puts a `._NAME` beside each file on foreign disks, and deleted ones into `.Trashes`.
    """
    found = (
        path
        for path in folder.rglob("*")
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    )
    return sorted(found, key=natural_key)


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
    """Status and results of a dive."""

    name: str
    source: str  # Where the dive is.
    state: DiveState
    words: str = ""  # Why it is not finished; empty if it is.
    # From `with_net`; empty without a result.
    facts: Mapping[str, Any] = field(default_factory=dict)
    # Whether an earlier batch had finished it.
    reused: bool = False

    @classmethod
    def of(cls, name: str, source: str, facts: Mapping[str, Any], *, reused: bool) -> "DiveRecord":
        """Return the record of a dive with a result."""
        faults = [str(facts["fault"])]
        if "net_fault" in facts:
            faults.append(f"condition of the net: {facts['net_fault']}")
        fault = "; ".join(filter(None, faults))
        state = DiveState.INCOMPLETE if fault else DiveState.FINISHED
        return cls(name=name, source=source, state=state, words=fault, facts=facts, reused=reused)

    @property
    def summary(self) -> Mapping[str, Any]:
        """Return the summary as `run.yaml` has it, empty without a result."""
        found: Mapping[str, Any] = self.facts.get("summary", {})
        return found

    @property
    def warnings(self) -> list[str]:
        """Return what is wrong with source, rig or track, as `run` and `net` warn of it."""
        return [*self.summary.get("warnings", []), *net_warnings(self.net)]

    @property
    def net(self) -> Mapping[str, Any]:
        """Return the condition of the net as `net_dict` has it, empty if it was not evaluated."""
        found: Mapping[str, Any] = self.facts.get("net", {})
        return found

    def net_text(self) -> str:
        """Return the condition of the net in a few words; empty if it was not evaluated."""
        if not self.net:
            return ""
        if not self.net["n_stretches"]:
            return "no net seen"
        holes, fouling = hole_count(self.net["n_holes"], self.net["area_m2"]), self.net["fouling"]
        return holes if fouling is None else f"fouling {with_sign(fouling, 2)}, {holes}"

    def line(self) -> str:
        """Return the dive in one line."""
        if not self.facts:
            return f"{self.name}: {self.state.value}" + (f": {self.words}" if self.words else "")
        n_frames, share = self.facts["n_frames"], 100 * self.summary.get("valid_share", 0.0)
        said = f"{self.name}: {count_text(n_frames, 'frame')}, posture in {share:.1f} %"
        if "range_median_m" in self.summary:
            said += f", range {self.summary['range_median_m']:.3f} m"
        if self.net:
            said += f", {self.net_text()}"
        if self.words:
            said += f"; {self.state.value}: {self.words}"
        said += "".join(f"; warning: {words}" for words in self.warnings)
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
            **{f"net_{name}": self.net.get(name) for name in NET_FACTS},
        }
