"""Records of ArduPilot's dataflash logs, binary and text, without decoding those nobody asks for.

Such a log describes itself: `FMT` records give every other kind's number, length, NumPy-like format
and columns. Binary records start with 0xA3 0x95 and their number; they carry no checksum
(https://ardupilot.org/dev/docs/code-overview-adding-a-new-log-message.html).
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from aqualvs.geometry.arrays import BoolArray, FloatArray

HEAD = b"\xa3\x95"
_FMT = 0x80
_FMT_LENGTH = 89
_TYPES = {
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "M": ("u1", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
    "g": ("<f2", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "c": ("<i2", 0.01),
    "C": ("<u2", 0.01),
    "e": ("<i4", 0.01),
    "E": ("<u4", 0.01),
    "L": ("<i4", 1e-7),
    "n": ("S4", 0.0),
    "N": ("S16", 0.0),
    "Z": ("S64", 0.0),
    "a": ("S64", 0.0),
}
"""Format characters: type, and the factor on numbers (0 for what is no number)."""
_BOGUS_TIME_S = 10.0
_NEIGHBOURS = 9


@dataclass(frozen=True, slots=True)
class Format:
    """What an `FMT` record says of a kind of record.

    Attributes
    ----------
    name : str
        Kind, such as 'ATT'.
    length : int
        Bytes of a record, its head of three included.
    codes : str
        One format character a column.
    columns : tuple of str
        Names of the columns.
    """

    name: str
    length: int
    codes: str
    columns: tuple[str, ...]

    @property
    def dtype(self) -> np.dtype[np.void] | None:
        """A record without its head as a NumPy type; None where the description makes no sense."""
        if len(self.codes) != len(self.columns) or any(c not in _TYPES for c in self.codes):
            return None
        named = all(self.columns) and len(set(self.columns)) == len(self.columns)
        if not named or not self.columns:
            return None
        layout = np.dtype(
            [(name, _TYPES[code][0]) for name, code in zip(self.columns, self.codes, strict=True)]
        )
        return layout if layout.itemsize == self.length - 3 else None


@dataclass(frozen=True, slots=True)
class Records:
    """The wanted records of a dataflash log.

    Attributes
    ----------
    tables : mapping of str to mapping of str to array
        Kind to columns; numbers as float64 in the units that the log's text form has. A table
        without records is missing. `time_s`, seconds since the autopilot started, is in each.
    n_records : int
        Records of any kind.
    skipped : tuple of (int, int)
        Stretches without records: place in the file (or line, of text), and length in bytes (or
        lines).
    n_bogus : int
        Wanted records with an impossible time; they are left out.
    """

    tables: Mapping[str, Mapping[str, FloatArray]]
    n_records: int
    skipped: tuple[tuple[int, int], ...]
    n_bogus: int


def read_binary(data: bytes, wanted: Iterable[str]) -> Records:
    """Read wanted kinds of records out of a binary dataflash log."""
    names = frozenset(wanted)
    places: dict[str, list[int]] = {name: [] for name in names}
    formats: dict[str, Format] = {}
    n_records, skipped = _scan(data, names, places, formats)
    octets = np.frombuffer(data, np.uint8)
    tables: dict[str, dict[str, FloatArray]] = {}
    for name, starts in places.items():
        if starts:
            tables[name] = _decode(octets, np.array(starts, np.int64), formats[name])
    return _sound(tables, n_records, skipped)


def _scan(
    data: bytes, names: frozenset[str], places: dict[str, list[int]], formats: dict[str, Format]
) -> tuple[int, list[tuple[int, int]]]:
    """Walk over the records, note where the wanted ones are and what they look like."""
    lengths: dict[int, int] = {_FMT: _FMT_LENGTH}
    lists: dict[int, list[int]] = {}
    skipped: list[tuple[int, int]] = []
    at, size, n_records, last = 0, len(data), 0, 0
    while at + 3 <= size:
        kind = data[at + 2]
        length = lengths.get(kind, 0) if data[at] == 0xA3 and data[at + 1] == 0x95 else 0
        if not length:
            # A record that lost bytes swallows the next ones, so the search begins within it.
            found = _next_record(data, last + 1 if n_records else 0, lengths)
            begin = at if found is None or found >= at else last
            swallower = lists.get(data[last + 2]) if begin == last < at else None
            if swallower and swallower[-1] == last:
                swallower.pop()
            skipped.append((begin, (size if found is None else found) - begin))
            if found is None:
                return n_records, skipped
            last = at = found
            continue
        if at + length > size:
            break
        n_records += 1
        if kind == _FMT:
            number, described = _format(data, at)
            if described.dtype is not None:
                lengths[number] = described.length
                if described.name in names:
                    formats[described.name] = described
                    lists[number] = places[described.name]
            elif described.length > 3 and number != _FMT:
                lengths[number] = described.length
        elif kind in lists:
            lists[kind].append(at)
        last, at = at, at + length
    if at < size:
        skipped.append((at, size - at))
    return n_records, skipped


def _format(data: bytes, at: int) -> tuple[int, Format]:
    def text(start: int, length: int) -> str:
        return data[at + start : at + start + length].split(b"\0")[0].decode("ascii", "replace")

    columns = text(25, 64)
    return data[at + 3], Format(
        text(5, 4), data[at + 4], text(9, 16), tuple(columns.split(",")) if columns else ()
    )


def _next_record(data: bytes, start: int, lengths: Mapping[int, int]) -> int | None:
    """Return where the first record starts that another, or the end of the file, follows."""
    at = data.find(HEAD, start)
    while at >= 0 and at + 3 <= len(data):
        length = lengths.get(data[at + 2], 0)
        end = at + length
        if length and (end == len(data) or data[end : end + 2] == HEAD):
            return at
        at = data.find(HEAD, at + 1)
    return None


def _decode(octets: np.ndarray, at: np.ndarray, form: Format) -> dict[str, FloatArray]:
    layout = form.dtype
    if layout is None:
        return {}
    rows = np.ascontiguousarray(octets[at[:, None] + 3 + np.arange(layout.itemsize)])
    table = rows.view(layout)[:, 0]
    return {
        name: table[name].astype(float) * _TYPES[code][1]
        for name, code in zip(form.columns, form.codes, strict=True)
        if _TYPES[code][1]
    }


def read_text(text: str, wanted: Iterable[str]) -> Records:
    """Read wanted kinds of records out of the text form of a dataflash log."""
    names = frozenset(wanted)
    columns: dict[str, tuple[str, ...]] = {}
    rows: dict[str, list[list[float]]] = {}
    skipped: list[tuple[int, int]] = []
    lines = text.splitlines()
    for number, line in enumerate(lines, start=1):
        cells = re.split(r"\s*,\s*", line.strip())
        name = cells[0]
        if name == "FMT" and len(cells) > 5:
            columns[cells[3]] = tuple(cells[5:])
        elif name in names:
            if name not in columns or len(cells) != len(columns[name]) + 1:
                skipped.append((number, 1))
                continue
            rows.setdefault(name, []).append([_number(cell) for cell in cells[1:]])
    tables = {
        name: dict(zip(columns[name], np.array(found).T, strict=True))
        for name, found in rows.items()
    }
    return _sound(tables, len(lines), skipped)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")


def _sound(
    tables: Mapping[str, dict[str, FloatArray]], n_records: int, skipped: list[tuple[int, int]]
) -> Records:
    """Give each table its times and leave out records whose time is impossible."""
    kept: dict[str, dict[str, FloatArray]] = {}
    n_bogus = 0
    for name, table in tables.items():
        times = _seconds(table)
        if times is None:
            continue
        sound = _believable(times)
        n_bogus += int(np.count_nonzero(~sound))
        if sound.any():
            kept[name] = {column: values[sound] for column, values in table.items()}
            kept[name]["time_s"] = times[sound]
    return Records(kept, n_records, tuple(skipped), n_bogus)


def _seconds(table: Mapping[str, FloatArray]) -> FloatArray | None:
    if "TimeUS" in table:
        return table["TimeUS"] * 1e-6
    # ArduSub before 3.4 wrote milliseconds.
    return table["TimeMS"] * 1e-3 if "TimeMS" in table else None


def _believable(times: FloatArray) -> BoolArray:
    """Return which times are near those of their neighbours in the file."""
    usual = ndimage.median_filter(times, min(_NEIGHBOURS, len(times)), mode="nearest")
    near: BoolArray = np.isfinite(times) & (np.abs(times - usual) <= _BOGUS_TIME_S)
    return near if len(times) > 2 else np.isfinite(times)
