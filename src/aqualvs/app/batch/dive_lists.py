"""Lists of dives, as CSV or YAML.

::

    dive,rig,name,water_n,temperature_c,salinity,log,log_offset_s
    north/0412.mp4,rig_april.yaml,north_april,,6.5,34,north/0412.tlog,
    north/0610.mp4,rig_june.yaml,north_june,,9.0,33,north/0610.BIN,-3.2

or the same as a list of mappings in YAML. Only `dive` is needed; paths are relative to the list.
"""

import csv
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from aqualvs.app.run_inputs import Water
from aqualvs.errors import OptionError
from aqualvs.yamlfile import parse_yaml, read_text

LIST_SUFFIXES = frozenset({".csv", ".yaml", ".yml"})

_NUMBERS = ("water_n", "temperature_c", "salinity")
_KEYS = ("dive", "rig", "name", *_NUMBERS, "log", "log_offset_s")


@dataclass(frozen=True, slots=True)
class ListedDive:
    """A dive as the user names it.

    Attributes
    ----------
    source : Path
    rig : Path or None
        None where the list does not say.
    name : str
        Empty where the list does not say.
    water : Water
        Nothing where the list does not say.
    log : Path or None
        The vehicle's, where the list says it.
    log_offset_s : float or None
        Its clock minus the dive's, where the list says it.
    """

    source: Path
    rig: Path | None = None
    name: str = ""
    water: Water = field(default_factory=Water)
    log: Path | None = None
    log_offset_s: float | None = None


def read_list(path: Path) -> list[ListedDive]:
    """Read a list of dives.

    Raises
    ------
    OptionError
        If it cannot be read, a row has no dive, or what it says is not understood.
    """
    text = read_text(path, "a list of dives", OptionError)
    rows = list(_csv_rows(text, path) if path.suffix.lower() == ".csv" else _yaml_rows(text, path))
    if not rows:
        raise OptionError(f"{path}: lists no dive; give at least one row")
    return [_listed(row, path, number) for number, row in enumerate(rows, 1)]


def _csv_rows(text: str, path: Path) -> Iterator[Mapping[str, Any]]:
    try:
        for row in csv.DictReader(text.splitlines(), skipinitialspace=True):
            yield {str(key).strip(): value for key, value in row.items() if value not in ("", None)}
    except csv.Error as fault:
        raise OptionError(f"{path}: cannot be read as a list of dives ({fault})") from fault


def _yaml_rows(text: str, path: Path) -> Iterable[Mapping[str, Any]]:
    content = parse_yaml(text, str(path), OptionError)
    if isinstance(content, dict) and set(content) == {"dives"}:
        content = content["dives"]
    if not isinstance(content, list) or not all(isinstance(row, dict) for row in content):
        raise OptionError(
            f"{path}: no list of dives; give mappings with the keys {', '.join(_KEYS)}"
        )
    return content


def _listed(row: Mapping[str, Any], path: Path, number: int) -> ListedDive:
    unknown = sorted(str(key) for key in set(row) - set(_KEYS))
    if unknown:
        raise OptionError(f"{path}: unknown key {unknown[0]!r}; known are {', '.join(_KEYS)}")
    if "dive" not in row:
        raise OptionError(f"{path}: row {number} names no dive; fill in the column 'dive'")
    rig, log = row.get("rig"), row.get("log")
    return ListedDive(
        source=path.parent / str(row["dive"]).strip(),
        rig=None if rig is None else path.parent / str(rig).strip(),
        name=str(row.get("name", "")).strip(),
        water=_water(row, path, number),
        log=None if log is None else path.parent / str(log).strip(),
        log_offset_s=_number(row, "log_offset_s", path, number),
    )


def _water(row: Mapping[str, Any], path: Path, number: int) -> Water:
    values = {key: _number(row, key, path, number) for key in _NUMBERS}
    return Water(
        n_water=values["water_n"],
        temperature_c=values["temperature_c"],
        salinity=values["salinity"],
    )


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
