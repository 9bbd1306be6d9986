"""Condition of the net in a run's report: section, card and warnings, read from its net files."""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

from aqualvs.report.frames import SampleFrame
from aqualvs.report.html import Card, Raw, data_url, folded, table, text
from aqualvs.report.run_data import mapping
from aqualvs.results.files import read_json
from aqualvs.results.folder import HOLES_CSV, NET_CSV, NET_GEOJSON, NET_MAP_PNG
from aqualvs.text import are_holes_searched, clock, count_text, signed, with_sign

_LONG_TABLE = 12
_NONE = "–"
_PLACED = {"track": "", "bearing": " (by bearing)", "speed": " (by speed)", "nothing": ""}

Row: TypeAlias = Mapping[str, str]


@dataclass(frozen=True, slots=True)
class NetTables:
    """Files on the condition of a net, read from a run's folder."""

    # Rows of `net.csv` and `holes.csv`, column to cell.
    stretches: list[Row]
    holes: list[Row]
    # Whether `holes.csv` is there and holds as many as `net.geojson` counts.
    holes_known: bool
    # Member `aqualvs_net` of `net.geojson`; empty where it is missing.
    facts: Mapping[str, Any]
    # `net_map.png` as an address; "" where it is missing.
    map_address: str

    @property
    def summary(self) -> Mapping[str, Any]:
        """The dive in a few numbers; empty where `net.geojson` is missing."""
        return mapping(self.facts, "summary")

    @property
    def searched(self) -> bool:
        """Whether holes were searched for."""
        return are_holes_searched(len(self.holes), self.summary.get("area_m2"))


def read_net(run_dir: Path) -> tuple[NetTables | None, str]:
    """Read the state of a net from a run's folder, None where it holds none.

    Returns also what is wrong with it, in words; "" if nothing.
    """
    if not (run_dir / NET_CSV).is_file():
        return None, ""
    try:
        stretches = _rows(run_dir / NET_CSV)
        there = (run_dir / HOLES_CSV).is_file()
        holes = _rows(run_dir / HOLES_CSV) if there else []
    except (OSError, UnicodeDecodeError, csv.Error):
        return None, "net.csv or holes.csv cannot be read: the condition of the net is not shown."
    net = NetTables(stretches, holes, there, _facts(run_dir / NET_GEOJSON), _picture(run_dir))
    if there and net.summary.get("n_holes", len(holes)) == len(holes):
        return net, ""
    words = "holes.csv is missing or cut short: whether there are holes is not known."
    return replace(net, holes=[], holes_known=False), words


def net_warnings(summary: Mapping[str, Any]) -> list[str]:
    """Return why places and holes of a net are not to be trusted, by its summary, or by none."""
    if not summary:
        return []
    # Imported here: it brings the evaluation of nets along, which few reports have.
    from aqualvs.nets.tables import track_warnings

    return track_warnings(summary)


def net_cards(net: NetTables | None) -> list[Card]:
    """Return the card of the headline; none without a net."""
    if net is None or not net.stretches:
        return []
    n, words = len(net.holes), []
    value = count_text(n, "hole") if n else "no holes"
    if not net.holes_known or not net.searched:
        value = "holes not known"
    largest = max((_number(row, "diameter_mm") or 0.0 for row in net.holes), default=0.0)
    if largest:
        words.append(f"up to {largest:.0f} mm")
    solidity, fouling = net.summary.get("solidity"), net.summary.get("fouling")
    if isinstance(solidity, float):
        words.append(f"solidity {solidity:.2f}")
    if isinstance(fouling, float):
        words.append(signed(f"fouling {with_sign(fouling, 2)}"))
    return [Card("Net", value, "; ".join(words) or "solidity not measured")]


@dataclass(frozen=True, slots=True)
class HolePicture:
    """Where a hole is to be cut out of the dive's pictures."""

    number: str  # As `holes.csv` has it.
    frame: int
    middle: tuple[float, float]  # Column and row in that frame's picture.
    diameter: float  # In pixels.


def hole_pictures(net: NetTables) -> list[HolePicture]:
    """Return what shows the largest holes, of those whose nearest look has them in its picture."""
    by_size = sorted(net.holes, key=lambda row: _number(row, "diameter_mm") or 0.0, reverse=True)
    found = []
    for row in by_size[:_LONG_TABLE]:
        values = [_number(row, name) for name in ("picture_frame", "u_px", "v_px", "diameter_px")]
        frame, u, v, diameter = (math.nan if value is None else value for value in values)
        if math.isfinite(frame + u + v + diameter):
            found.append(HolePicture(row["hole"], int(frame), (u, v), diameter))
    return found


def net_view(net: NetTables | None, crops: Mapping[str, SampleFrame] = MappingProxyType({})) -> str:
    """Return the section on the net, with pictures by the numbers of holes; nothing without one."""
    if net is None:
        return ""
    head = '<section id="net"><h2>Net</h2>\n'
    if not net.stretches:
        return f'{head}<p class="note">No net was seen.</p></section>'
    return "\n".join(
        [head + _lead(net), _map(net), _holes(net, crops), _stretches(net), _log(net), "</section>"]
    )


def _lead(net: NetTables) -> str:
    facts, words = net.summary, []
    bar, twine, area = (facts.get(name) for name in ("bar_mm", "twine_mm", "area_m2"))
    if isinstance(bar, int | float):
        words.append(f"{str(facts.get('mesh')).capitalize()} meshes of {bar:.1f} mm bar")
    if isinstance(twine, int | float):
        words.append(f"twine {twine:.1f} mm")
    if isinstance(area, int | float):
        words.append(f"{area:.2f} m² searched for holes")
    said = f"{text(', '.join(words))}. " if words else ""
    return (
        f'<p class="lead">{said}Solidity is the share of the net’s area covered by strands and '
        "growth; fouling is the solidity beyond that of bare twine.</p>"
    )


def _map(net: NetTables) -> str:
    if not net.map_address:
        return '<p class="note">net_map.png is missing.</p>'
    return (
        f'<figure><img class="wide" src="{net.map_address}" '
        'alt="Map of the net wall: fouling, holes and the vehicle’s track"></figure>'
    )


def _holes(net: NetTables, crops: Mapping[str, SampleFrame]) -> str:
    if not net.holes:
        said = "None was found." if net.searched else "Not searched for."
        said = said if net.holes_known else "Not known: holes.csv is damaged."
        return f"<h3>Holes</h3><p>{said}</p>"
    names = (
        *("hole", "diameter, mm", "width × height, mm", "meshes", *_PLACE_HEAD),
        *("heading, °", "nearest at", "in frame"),
    )
    rows = [
        (
            *(_cell(row, "hole"), Raw(_diameter(row))),
            f"{_cell(row, 'width_mm', 0)} × {_cell(row, 'height_mm', 0)}",
            *(_cell(row, "missing_meshes", 0), *_place(row), _cell(row, "heading_deg", 0)),
            *(_time(row, "time_s"), _cell(row, "frame")),
        )
        for row in net.holes
    ]
    shown = "\n".join(_crop(row, crops[row["hole"]]) for row in net.holes if row["hole"] in crops)
    pictures = f'<div class="crops">{shown}</div>' if shown else ""
    found = folded(table(names, rows), len(rows), "holes", longest=_LONG_TABLE)
    return f"<h3>Holes</h3>{pictures}{found}"


def _crop(row: Row, picture: SampleFrame) -> str:
    """Return the picture of a hole and the way back to it."""
    name = f"Hole {row['hole']}"
    values = (
        ("depth {} m", _cell(row, "depth_m", 2)),
        ("heading {}°", _cell(row, "heading_deg", 0)),
        ("{} m along the net", _cell(row, "along_m", 2)),
        ("nearest at {}", _time(row, "time_s")),
        ("shown in frame {}", _cell(row, "picture_frame")),
    )
    way = ", ".join(words.format(value) for words, value in values if value != _NONE)
    return (
        f"<figure>{picture.tag(f'{name} with its surroundings')}"
        f"<figcaption><b>{text(name)}: {_diameter(row)} mm</b><br>{way}</figcaption></figure>"
    )


def _diameter(row: Row) -> str:
    return f"{_cell(row, 'diameter_mm', 0)} ± {_cell(row, 'sigma_diameter_mm', 0)}"


_PLACE_HEAD = ("along, m", "depth, m", "bearing, °")


def _stretches(net: NetTables) -> str:
    names = (
        *("stretch", "from", "to", *_PLACE_HEAD, "range, mm", "bar, mm", "twine, mm"),
        *("solidity", "fouling"),
    )
    rows = [
        (
            *(_cell(row, "stretch"), _time(row, "begin_s"), _time(row, "end_s"), *_place(row)),
            *(_cell(row, "range_m", 0, scale=1e3), _with_sigma(row, "bar_mm", 1)),
            *(_with_sigma(row, "twine_mm", 1), _with_sigma(row, "solidity", 2)),
            _cell(row, "fouling", 2, sign="+"),
        )
        for row in net.stretches
    ]
    shown = folded(table(names, rows), len(rows), "stretches", longest=_LONG_TABLE)
    return f"<h3>Stretches</h3>{shown}"


def _log(net: NetTables) -> str:
    log = net.facts.get("log")
    if not isinstance(log, dict):
        return (
            '<p class="note">No log of the vehicle was given, so depth and bearing are not known: '
            "add <code>--log</code> to aqualvs net.</p>"
        )
    name = text(log.get("file", ""))
    if not log.get("used"):
        why = text(log.get("refused") or "it covers none of the dive")
        return f'<p class="note">The vehicle’s log {name} is not used: {why}.</p>'
    sigma = f" ± {log.get('sigma_offset_s')}" if log.get("sigma_offset_s") else ""
    covered = log.get("covered")
    part = f" It covers {100 * covered:.0f} % of the dive." if isinstance(covered, float) else ""
    return signed(
        f'<p class="note">Depth and bearing are from {name}; its clock minus the dive’s is '
        f"{text(log.get('offset_s'))}{text(sigma)} s ({text(log.get('offset_from'))}).{part}</p>"
    )


def _place(row: Row) -> tuple[str, str, str]:
    along = _cell(row, "along_m", 2)
    placed = _PLACED.get(row.get("placed_by") or "", "")
    return along + placed, _cell(row, "depth_m", 2), _cell(row, "bearing_deg", 0)


def _with_sigma(row: Row, name: str, digits: int) -> str:
    value = _cell(row, name, digits)
    sigma = _number(row, f"sigma_{name}")
    return value if value == _NONE or not sigma else f"{value} ± {sigma:.{digits}f}"


def _time(row: Row, name: str) -> str:
    value = _number(row, name)
    return _NONE if value is None else clock(value)


def _cell(
    row: Row, name: str, digits: int | None = None, *, scale: float = 1.0, sign: str = ""
) -> str:
    value = _number(row, name)
    if value is None:
        return _NONE
    return row[name] if digits is None else signed(f"{scale * value:{sign}.{digits}f}")


def _number(row: Row, name: str) -> float | None:
    try:
        return float(row.get(name) or "")
    except ValueError:
        return None


def _rows(path: Path) -> list[Row]:
    with path.open(newline="", encoding="utf-8") as file:
        rows: list[Row] = list(csv.DictReader(file))
    # A damaged table may have lost a hole: better no table than one of fewer holes.
    if any(None in row or None in row.values() for row in rows):
        raise csv.Error("rows differ in length")
    return rows


def _facts(path: Path) -> Mapping[str, Any]:
    try:
        content = read_json(path)
    except (OSError, ValueError):
        return {}
    return mapping(content, "aqualvs_net") if isinstance(content, dict) else {}


def _picture(run_dir: Path) -> str:
    try:
        return data_url((run_dir / NET_MAP_PNG).read_bytes(), "png")
    except OSError:
        return ""
