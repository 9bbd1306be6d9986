"""`net.csv`, `holes.csv` and `net.geojson`: the state of a net as tables."""

import csv
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from aqualvs.app.net_places import NetPlace
from aqualvs.app.net_wall import NetWall
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.net_condition import NetStretch
from aqualvs.scanning.net_holes import Hole

Cell: TypeAlias = int | float | str | None

_PLACE = ("along_m", "placed_by", "depth_m", "bearing_deg")
NET_COLUMNS = (
    *("stretch", "first_frame", "last_frame", "begin_s", "end_s", "n_frames"),
    *("piece", "right_m", "up_m", *_PLACE, "heading_deg", "range_m"),
    *("mesh", "bar_mm", "sigma_bar_mm", "twine_mm", "sigma_twine_mm"),
    *("solidity", "sigma_solidity", "clean_solidity", "fouling", "n_strands", "seen_m"),
)
"""Columns of `net.csv`, one row for every stretch; empty where not measured or not known."""
HOLE_COLUMNS = (
    *("hole", "piece", "right_m", "up_m", *_PLACE),
    *("width_mm", "height_mm", "diameter_mm", "sigma_diameter_mm", "missing_meshes"),
    *("frame", "time_s", "n_looks"),
)
"""Columns of `holes.csv`, one row for every hole."""

_DIGITS = {"s": 3, "m": 3, "deg": 1, "mm": 2}
_SHARE_DIGITS = 4


def stretch_rows(wall: NetWall) -> list[dict[str, Cell]]:
    """Return the rows of `net.csv`."""
    return [
        _rounded(_stretch(i, one, place))
        for i, (one, place) in enumerate(zip(wall.stretches, wall.places.middle, strict=True))
    ]


def hole_rows(wall: NetWall) -> list[dict[str, Cell]]:
    """Return the rows of `holes.csv`."""
    return [
        _rounded(_hole(i, hole, place))
        for i, (hole, place) in enumerate(zip(wall.holes, wall.places.holes, strict=True))
    ]


def fouling_of(stretch: NetStretch) -> float | None:
    """Return the solidity beyond that of the bare twine; None where it was not measured."""
    if stretch.solidity is None or stretch.clean_solidity is None:
        return None
    return stretch.solidity - stretch.clean_solidity


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Cell]]) -> None:
    """Write a table as CSV.

    Raises
    ------
    OSError
        As the system says it.
    """
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(
        {key: "" if cell is None else cell for key, cell in row.items()} for row in rows
    )
    path.write_text(text.getvalue(), encoding="utf-8", newline="")


def write_geojson(path: Path, wall: NetWall, facts: Mapping[str, Any]) -> None:
    """Write stretches (Polygon) and holes (Point) in the plane of the unrolled net.

    Parameters
    ----------
    path : Path
        A FeatureCollection as in RFC 7946, but for its coordinates: they are local.
    wall : NetWall
        What to write; properties are the columns of the tables.
    facts : mapping
        What else belongs to it, for the foreign member `aqualvs_net`.

    Raises
    ------
    OSError
        As the system says it.
    """
    content = {
        "type": "FeatureCollection",
        "aqualvs_net": {"coordinates": coordinates(wall), **facts},
        "features": [*_polygons(wall), *_points(wall)],
    }
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def coordinates(wall: NetWall) -> dict[str, str]:
    """Return what the coordinates in `net.geojson` are."""
    return {
        "system": "local: the net wall unrolled into a plane, as seen from the vehicle; "
        "not longitude and latitude",
        "x": "bearing of the net in degrees, clockwise from north; may pass 360 or 0"
        if wall.by_bearing
        else "metres along the net to the right, from where the dive began",
        "y": "minus the depth in metres" if wall.by_depth else "metres above where the dive began",
    }


def _stretch(i: int, one: NetStretch, place: NetPlace) -> dict[str, Cell]:
    lattice, twine, mm = one.lattice, one.twine, 1e3
    cells: tuple[Cell, ...] = (
        *(i + 1, one.first_frame, one.last_frame, one.begin_s, one.end_s, one.n_frames),
        *(one.piece, *map(float, one.place), *_place_cells(place)),
        *(_degrees(place.heading), one.range),
        *(
            (None,) * 3
            if lattice is None
            else (lattice.mesh, mm * lattice.bar, mm * lattice.sigma_bar)
        ),
        *((None,) * 2 if twine is None else (mm * twine.thickness, mm * twine.sigma)),
        *(one.solidity, one.sigma_solidity, one.clean_solidity, fouling_of(one)),
        *(None if lattice is None else one.n_strands, one.seen_length),
    )
    return dict(zip(NET_COLUMNS, cells, strict=True))


def _hole(i: int, hole: Hole, place: NetPlace) -> dict[str, Cell]:
    mm = 1e3
    cells: tuple[Cell, ...] = (
        *(i + 1, hole.piece, *map(float, hole.place), *_place_cells(place)),
        *(mm * hole.extent[0], mm * hole.extent[1]),
        *(mm * hole.diameter, mm * hole.sigma_diameter, hole.missing_meshes),
        *(hole.frame, hole.time_s, hole.n_looks),
    )
    return dict(zip(HOLE_COLUMNS, cells, strict=True))


def _place_cells(place: NetPlace) -> tuple[Cell, ...]:
    return place.along, place.placed_by, place.depth, _degrees(place.bearing)


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else float(np.rad2deg(angle)) % 360.0


def _rounded(row: Mapping[str, Cell]) -> dict[str, Cell]:
    """Return a row with no more digits than the numbers are worth, and plain types."""
    return {name: _round(name, cell) for name, cell in row.items()}


def _round(name: str, cell: Cell) -> Cell:
    if isinstance(cell, str):
        return str(cell)
    if cell is None or isinstance(cell, int):
        return cell
    # Adding zero turns a negative zero into a plain one.
    return round(float(cell), _DIGITS.get(name.rsplit("_", 1)[-1], _SHARE_DIGITS)) + 0.0


def _polygons(wall: NetWall) -> Iterator[dict[str, Any]]:
    for row, outline in zip(stretch_rows(wall), wall.outlines, strict=True):
        ring = _corners(np.concatenate([outline, outline[:1]]))
        yield _feature("stretch", row, {"type": "Polygon", "coordinates": [ring]})


def _points(wall: NetWall) -> Iterator[dict[str, Any]]:
    for row, middle in zip(hole_rows(wall), wall.holes_xy, strict=True):
        yield _feature("hole", row, {"type": "Point", "coordinates": _corners(middle[None])[0]})


def _feature(kind: str, row: Mapping[str, Cell], geometry: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "type": "Feature",
        "id": f"{kind}-{row[kind]}",
        "properties": {"kind": kind, **row},
        "geometry": geometry,
    }


def _corners(places: FloatArray) -> list[list[float]]:
    return [[round(float(x), 4) + 0.0, round(float(y), 4) + 0.0] for x, y in places]
