"""Tables and texts of a net's condition: `net.csv`, `holes.csv`, `net.geojson`, the summary.

The map and `net.geojson` use coordinates of the unrolled net (`UnrolledNet`): x is metres along the
net to the right, as seen from the vehicle, from where the dive began; y is minus the depth in
metres, or, without a log, metres above the start. Without a track, x is the bearing of the net in
degrees.
"""

import csv
import io
import itertools
import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.nets.condition import NetStretch
from aqualvs.nets.holes import Hole
from aqualvs.nets.lattice import START_FRAMES
from aqualvs.nets.lit_intervals import net_from_dome
from aqualvs.nets.places import DivePostures, NetPlace, NetPlaces, PlacedBy
from aqualvs.optics.rig import Rig
from aqualvs.text import clock, count_text, hole_count, with_sign

# Bands meet in one edge where the cosine of the turn between them is above this.
_SHARP = 0.5
_CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
METRES_PER_DEGREE = 0.17
"""In which widths are drawn where x is a bearing: a cage of 10 m radius."""


@dataclass(frozen=True, slots=True)
class UnrolledNet:
    """Stretches and holes on the unrolled net."""

    # Stretches and holes that were found.
    stretches: Sequence[NetStretch]
    holes: Sequence[Hole]
    # Their places.
    places: NetPlaces
    # Whether x is a bearing in degrees, because there is no track.
    by_bearing: bool
    # Whether y is minus a depth, or metres above the start.
    by_depth: bool
    # Shape (4, 2): of the area that the picture passed over in every stretch: x and y,
    # counter-clockwise.
    outlines: list[FloatArray]
    # Shape (n, 2): of the vehicle's foot on the net: one line for every piece in which the track
    # holds.
    path: list[FloatArray]
    # Shape (H, 2): middles of the holes.
    holes_xy: FloatArray
    # Shape (H, 4): frame whose picture has them nearest to its centre, column and row of their
    # middles in it, and diameter in pixels; NaN where no picture shows any of a hole.
    holes_px: FloatArray


def unroll(
    stretches: Sequence[NetStretch],
    holes: Sequence[Hole],
    places: NetPlaces,
    rig: Rig,
    postures: DivePostures,
) -> UnrolledNet:
    """Project stretches and holes to the plane of the unrolled net.

    All are of one dive; the rig's picture tells how much of the net is seen at a time.
    """
    nodes = [*places.begin[:1], *places.end]
    by_bearing = all(one.placed_by is PlacedBy.NOTHING for one in nodes) and any(
        one.bearing is not None for one in nodes
    )
    by_depth = any(one.depth is not None for one in nodes)
    y = _heights([*nodes, *places.holes], by_depth)
    x = _bearings(nodes) if by_bearing else np.array([one.along for one in nodes])
    at_nodes = np.stack([x, y[: len(nodes)]], axis=-1) if nodes else np.empty((0, 2))
    holes_x = np.array([one.along for one in places.holes])
    if by_bearing:
        when = [one.end_s for one in stretches]
        holes_x = np.interp([hole.time_s for hole in holes], when, x[1:])
    ranges = np.array([one.range for one in stretches])
    half = 0.5 * np.array(rig.size_px) / rig.focal_px * ranges[:, None]
    if by_bearing:
        half[:, 0] /= METRES_PER_DEGREE
    return UnrolledNet(
        stretches=stretches,
        holes=holes,
        places=places,
        by_bearing=by_bearing,
        by_depth=by_depth,
        outlines=bands(at_nodes, half),
        path=_path(at_nodes, stretches),
        holes_xy=np.stack([holes_x, y[len(nodes) :]], axis=-1),
        holes_px=_pixels(holes, postures, rig),
    )


def _pixels(holes: Sequence[Hole], postures: DivePostures, rig: Rig) -> FloatArray:
    """Return where the holes are in the dive's pictures (`UnrolledNet.holes_px`)."""
    found, normals, camera = np.full((len(holes), 4), np.nan), postures.normals(), rig.camera()
    size = np.array(rig.size_px)
    for i, hole in enumerate(holes):
        feet = [(hole.frame, hole.time_s, hole.place - hole.from_foot), *hole.feet]
        points = np.empty((len(feet), 2, 3))
        for k, (_, time_s, foot) in enumerate(feet):
            at = min(int(np.searchsorted(postures.time_s, time_s)), len(normals) - 1)
            middle = [*(hole.place - foot), 0.0]
            rim = np.add(middle, [0.5 * hole.diameter, 0.0, 0.0])
            dome_from_net = net_from_dome(normals[at], float(postures.range[at])).inverse()
            points[k] = dome_from_net.apply(np.stack([middle, rim]))
        pixels, seen = camera.project(points)
        off = np.where(seen.all(axis=1), np.hypot(*(pixels[:, 0] - 0.5 * size).T), np.inf)
        best = int(np.argmin(off))
        diameter = 2.0 * float(np.hypot(*(pixels[best, 1] - pixels[best, 0])))
        # Up to its rim a hole may lie beyond the picture.
        beyond = np.abs(pixels[best, 0] - 0.5 * size) - 0.5 * size
        if np.isfinite(off[best]) and np.all(beyond < 0.5 * diameter):
            found[i] = [feet[best][0], *pixels[best, 0], diameter]
    return found


def _heights(places: Sequence[NetPlace], by_depth: bool) -> FloatArray:
    """Return minus the depth; gaps of the log are bridged by the track."""
    up = np.array([one.up for one in places])
    if not by_depth:
        return up
    minus = np.array([np.nan if one.depth is None else -one.depth for one in places])
    level = float(np.nanmedian(minus - up))
    return np.where(np.isfinite(minus), minus, up + level)


def _bearings(nodes: Sequence[NetPlace]) -> FloatArray:
    """Return bearings in degrees that do not jump by a full turn."""
    found = np.array([np.nan if one.bearing is None else one.bearing for one in nodes])
    known = np.isfinite(found)
    turned = np.rad2deg(np.unwrap(found[known]))
    return np.asarray(np.interp(np.arange(len(found)), np.flatnonzero(known), turned))


def _path(nodes: FloatArray, stretches: Sequence[NetStretch]) -> list[FloatArray]:
    """Cut the vehicle's path where the track was lost."""
    pieces = np.array([one.piece for one in stretches])
    parts = np.split(np.arange(len(nodes)), np.flatnonzero(np.diff(pieces)) + 2)
    return [nodes[part] for part in parts if len(part)]


def bands(nodes: FloatArray, half: FloatArray) -> list[FloatArray]:
    """Return the outlines of the areas that a picture passes over from node to node.

    Parameters
    ----------
    nodes : array, shape (n + 1, 2)
        Places of the picture's middle, in turn.
    half : array, shape (n, 2)
        Half its width and height on the way from each to the next.

    Returns
    -------
    outlines : list of n arrays, shape (4, 2)
        Counter-clockwise. Bands that follow each other meet in one edge, unless the way turns
        sharply; where the picture hardly moves, it is the picture itself.
    """
    moves = np.diff(nodes, axis=0)
    length = np.hypot(*moves.T)
    # A stretch in which the vehicle moved less than this share of what the picture shows is no
    # band.
    min_move = 0.15
    still = length < min_move * half.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = np.stack([-moves[:, 1], moves[:, 0]], axis=-1) / length[:, None]
    # From the middle to the left edge: half of what the picture measures square to the way.
    reach = across * np.sum(np.abs(across) * half, axis=1)[:, None]
    reach[still] = np.nan
    found = []
    for i, (begin, end) in enumerate(itertools.pairwise(nodes)):
        if still[i]:
            found.append(0.5 * (begin + end) + _CORNERS * half[i])
            continue
        first = _edge(reach[i], reach[i - 1] if i else None)
        last = _edge(reach[i], reach[i + 1] if i + 1 < len(reach) else None)
        found.append(np.array([begin - first, end - last, end + last, begin + first]))
    return found


def _edge(reach: FloatArray, beside: FloatArray | None) -> FloatArray:
    """Return the edge that two bands share, halfway between theirs; its own after a sharp turn."""
    if beside is None or not np.isfinite(beside).all():
        return reach
    straight = float(reach @ beside) > _SHARP * float(np.hypot(*reach) * np.hypot(*beside))
    return np.asarray(0.5 * (reach + beside)) if straight else reach


Cell: TypeAlias = int | float | str | None

_PLACE = ("along_m", "placed_by", "depth_m", "bearing_deg", "heading_deg")
NET_COLUMNS = (
    *("stretch", "first_frame", "last_frame", "begin_s", "end_s", "n_frames"),
    *("piece", "right_m", "up_m", *_PLACE, "range_m"),
    *("mesh", "bar_mm", "sigma_bar_mm", "twine_mm", "sigma_twine_mm"),
    *("solidity", "sigma_solidity", "clean_solidity", "fouling", "n_strands", "seen_m"),
)
"""Columns of `net.csv`, one row for every stretch; empty where not measured or not known."""
HOLE_COLUMNS = (
    *("hole", "piece", "right_m", "up_m", *_PLACE),
    *("width_mm", "height_mm", "diameter_mm", "sigma_diameter_mm", "missing_meshes"),
    *("frame", "time_s", "n_looks", "picture_frame", "u_px", "v_px", "diameter_px"),
)
"""Columns of `holes.csv`, one row for every hole."""

_DIGITS = {"s": 3, "m": 3, "deg": 1, "mm": 2, "px": 1}


def stretch_rows(wall: UnrolledNet) -> list[dict[str, Cell]]:
    """Return the rows of `net.csv`."""
    pairs = zip(wall.stretches, wall.places.middle, strict=True)
    return [_stretch_row(i, one, place) for i, (one, place) in enumerate(pairs, start=1)]


def hole_rows(wall: UnrolledNet) -> list[dict[str, Cell]]:
    """Return the rows of `holes.csv`."""
    found = zip(wall.holes, wall.places.holes, wall.holes_px, strict=True)
    return [_hole_row(i, *one) for i, one in enumerate(found, start=1)]


def fouling_of(stretch: NetStretch) -> float | None:
    """Return the solidity beyond that of the bare twine; None where it was not measured."""
    if stretch.solidity is None or stretch.clean_solidity is None:
        return None
    return stretch.solidity - stretch.clean_solidity


def write_table(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Cell]]) -> None:
    """Write a table as CSV.

    Raises `OSError` as the system says it.
    """
    text = io.StringIO(newline="")
    table = csv.DictWriter(text, columns, lineterminator="\n")
    table.writeheader()
    table.writerows(
        {key: "" if cell is None else cell for key, cell in row.items()} for row in rows
    )
    path.write_text(text.getvalue(), encoding="utf-8", newline="")


def write_geojson(path: Path, wall: UnrolledNet, facts: Mapping[str, Any]) -> None:
    """Write stretches (Polygon) and holes (Point) in the plane of the unrolled net.

    The file is a FeatureCollection as in RFC 7946, but for its coordinates: they are local.
    Properties are the columns of the tables, and `facts` go into the foreign member `aqualvs_net`.
    Raises `OSError` as the system says it.
    """
    content = {
        "type": "FeatureCollection",
        "aqualvs_net": {"coordinates": coordinates(wall), **facts},
        "features": list(_features(wall)),
    }
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def coordinates(wall: UnrolledNet) -> dict[str, str]:
    """Return what the coordinates in `net.geojson` are."""
    return {
        "system": "local: the net wall unrolled into a plane, as seen from the vehicle; "
        "not longitude and latitude",
        "x": "bearing of the net in degrees, clockwise from north; may pass 360 or 0"
        if wall.by_bearing
        else "metres along the net to the right, from where the dive began",
        "y": "minus the depth in metres" if wall.by_depth else "metres above where the dive began",
    }


def _stretch_row(i: int, one: NetStretch, place: NetPlace) -> dict[str, Cell]:
    lattice, twine, mm = one.lattice, one.twine, 1e3
    mesh: Sequence[Cell] = (None,) * 3
    if lattice is not None:
        mesh = lattice.mesh, mm * lattice.bar, mm * lattice.sigma_bar
    cells: tuple[Cell, ...] = (
        *(i, one.first_frame, one.last_frame, one.begin_s, one.end_s, one.n_frames),
        *(one.piece, *map(float, one.place), *_place_cells(place), one.range, *mesh),
        *((None,) * 2 if twine is None else (mm * twine.thickness, mm * twine.sigma)),
        *(one.solidity, one.sigma_solidity, one.clean_solidity, fouling_of(one)),
        *(None if lattice is None else one.n_strands, one.seen_length),
    )
    return {name: _rounded(name, cell) for name, cell in zip(NET_COLUMNS, cells, strict=True)}


def _hole_row(i: int, hole: Hole, place: NetPlace, pixels: FloatArray) -> dict[str, Cell]:
    mm = 1e3
    cells: tuple[Cell, ...] = (
        *(i, hole.piece, *map(float, hole.place), *_place_cells(place)),
        *(mm * hole.extent[0], mm * hole.extent[1]),
        *(mm * hole.diameter, mm * hole.sigma_diameter, hole.missing_meshes),
        *(hole.frame, hole.time_s, hole.n_looks),
        *((int(pixels[0]), *map(float, pixels[1:])) if np.isfinite(pixels[0]) else (None,) * 4),
    )
    return {name: _rounded(name, cell) for name, cell in zip(HOLE_COLUMNS, cells, strict=True)}


def _place_cells(place: NetPlace) -> tuple[Cell, ...]:
    bearing, heading = _degrees(place.bearing), _degrees(place.heading)
    return place.along, place.placed_by, place.depth, bearing, heading


def _degrees(angle: float | None) -> float | None:
    return None if angle is None else float(np.rad2deg(angle)) % 360.0


def _rounded(name: str, cell: Cell) -> Cell:
    """Return a cell with no more digits than the number is worth, and of a plain type."""
    if isinstance(cell, str):
        return str(cell)
    if cell is None or isinstance(cell, int):
        return cell
    share_digits = 4
    # Adding zero turns a negative zero into a plain one.
    return round(float(cell), _DIGITS.get(name.rsplit("_", 1)[-1], share_digits)) + 0.0


def _features(wall: UnrolledNet) -> Iterator[dict[str, Any]]:
    rings = [[_local([*outline, outline[0]])] for outline in wall.outlines]
    for kind, shape, rows, places in (
        ("stretch", "Polygon", stretch_rows(wall), rings),
        ("hole", "Point", hole_rows(wall), _local(wall.holes_xy)),
    ):
        for row, place in zip(rows, places, strict=True):
            yield {
                "type": "Feature",
                "id": f"{kind}-{row[kind]}",
                "properties": {"kind": kind, **row},
                "geometry": {"type": shape, "coordinates": place},
            }


def _local(places: Iterable[FloatArray]) -> list[Any]:
    return [[round(float(x), 4) + 0.0, round(float(y), 4) + 0.0] for x, y in places]


def net_dict(wall: UnrolledNet, area: float, n_frames: int, n_net_frames: int) -> dict[str, Any]:
    """Return the numbers that sum a dive up; None where not measured.

    `area`: looked at for holes, in square metres. `n_frames`, `n_net_frames`: frames of the dive,
    and those with a posture to a net.
    """
    stretches = wall.stretches
    largest = max((hole.diameter for hole in wall.holes), default=None)
    shapes = Counter(one.lattice.mesh.value for one in stretches if one.lattice is not None)
    return {
        "n_frames": n_frames,
        "n_net_frames": n_net_frames,
        "n_stretches": len(stretches),
        "n_holes": len(wall.holes),
        "area_m2": round(area, 3),
        "way_m": round(_way(wall), 3),
        "mesh": shapes.most_common(1)[0][0] if shapes else None,
        "bar_mm": _mean(stretches, lambda one: 1e3 * one.lattice.bar if one.lattice else None, 2),
        "twine_mm": _mean(
            stretches, lambda one: 1e3 * one.twine.thickness if one.twine else None, 2
        ),
        "solidity": _mean(stretches, lambda one: one.solidity, 4),
        "fouling": _mean(stretches, fouling_of, 4),
        "track_slip_m": round(wall.places.slip, 2),
        "track_breaks": stretches[-1].piece if stretches else 0,
        "fast_frames": sum(one.n_frames for one in stretches if _is_fast(one)),
        "largest_hole_mm": None if largest is None else round(1e3 * float(largest), 1),
    }


def net_lines(wall: UnrolledNet, area: float, n_frames: int) -> list[str]:
    """Return the summary in words, line by line."""
    if not wall.stretches:
        return [f"no net was seen in {count_text(n_frames, 'frame')}"]
    facts = net_dict(wall, area, n_frames, sum(one.n_frames for one in wall.stretches))
    lines = [_mesh_line(facts), _fouling_line(wall, facts), *_hole_lines(wall, facts)]
    return [*lines, *(f"warning: {words}" for words in track_warnings(facts))]


def track_warnings(summary: Mapping[str, Any]) -> list[str]:
    """Return why places and holes are not to be trusted, by a summary as of `net_dict`."""
    slip, breaks, n_fast, n_frames = (
        found if isinstance(found := summary.get(name), int | float) else 0
        for name in ("track_slip_m", "track_breaks", "fast_frames", "n_net_frames")
    )
    words = []
    if slip > 0.0:
        words.append(
            f"the track and the log's depth differ by {slip:.1f} m: meshes were miscounted, so "
            "places along the net and sizes of holes are unreliable"
        )
    # Pieces that are shorter, in the mean, than the frames to which the start of one is fitted.
    if breaks * START_FRAMES > n_frames:
        words.append(
            f"the track along the net broke {count_text(int(breaks), 'time')} in "
            f"{count_text(int(n_frames), 'frame')}: a hole may count once for each piece, and "
            "places are unreliable; frames are too far apart, or images lack their rate (--fps)"
        )
    # A part of the dive that is worth another one.
    good_part = 0.2
    if n_fast > good_part * n_frames:
        words.append(
            f"the net moves by about half a mesh or more from frame to frame in {int(n_fast)} of "
            f"{count_text(int(n_frames), 'frame')}: meshes may be miscounted, so that places, "
            "and number and sizes of holes, are unreliable; move slower, or record more frames per "
            "second"
        )
    return words


def _is_fast(stretch: NetStretch) -> bool:
    """Return whether the net moves nearly half a mesh a frame: by more, meshes are miscounted."""
    n_steps = stretch.last_frame - stretch.first_frame
    if stretch.lattice is None or n_steps == 0:
        return False
    near_half = 0.4
    meshes = stretch.lattice.basis @ (stretch.place - stretch.begin_place) / n_steps
    return bool(np.hypot(*meshes) > near_half)


def place_text(place: NetPlace) -> str:
    """Return where something is."""
    words = [] if place.placed_by == "nothing" else [f"{place.along:.2f} m along"]
    words.append(
        f"{place.depth:.2f} m deep" if place.depth is not None else f"{with_sign(place.up, 2)} m up"
    )
    if place.bearing is not None:
        words.append(f"bearing {np.rad2deg(place.bearing):.0f}°")
    return ", ".join(words)


def size_text(hole: Hole) -> str:
    """Return how large a hole is."""
    width, height = (1e3 * side for side in hole.extent)
    return f"{1e3 * hole.diameter:.0f} mm ({width:.0f} x {height:.0f} mm)"


def _mesh_line(facts: dict[str, Any]) -> str:
    if facts["bar_mm"] is None:
        return "net: its mesh could not be determined"
    bar = facts["bar_mm"]
    words = f"net: {facts['mesh']} meshes of {bar:.1f} mm bar ({2.0 * bar:.0f} mm stretched)"
    return words if facts["twine_mm"] is None else f"{words}, twine {facts['twine_mm']:.1f} mm"


def _fouling_line(wall: UnrolledNet, facts: dict[str, Any]) -> str:
    if facts["fouling"] is None:
        return "solidity: not measured in any stretch"
    clean = facts["solidity"] - facts["fouling"]
    fouling = [-np.inf if (value := fouling_of(one)) is None else value for one in wall.stretches]
    worst = int(np.argmax(fouling))
    return (
        f"solidity {facts['solidity']:.2f}, of bare twine {clean:.2f}: "
        f"fouling {with_sign(facts['fouling'], 2)}; most at "
        f"{place_text(wall.places.middle[worst])}: {with_sign(fouling[worst], 2)}"
    )


def _hole_lines(wall: UnrolledNet, facts: dict[str, Any]) -> list[str]:
    n = len(wall.holes)
    area, way, max_listed = facts["area_m2"], facts["way_m"], 20
    lines = [f"looked at {area:.2f} m² of net over {way:.1f} m: {hole_count(n, area)}"]
    order = np.argsort([-hole.diameter for hole in wall.holes], kind="stable")[:max_listed]
    for i in sorted(order):
        hole, place = wall.holes[i], wall.places.holes[i]
        lines.append(
            f"  {i + 1}: {size_text(hole)}, {hole.missing_meshes:.0f} meshes: {place_text(place)}, "
            f"at {clock(hole.time_s)} (frame {hole.frame})"
        )
    if n > max_listed:
        lines.append(f"  and {n - max_listed} smaller ones, see holes.csv")
    return lines


def _way(wall: UnrolledNet) -> float:
    """Return how far the vehicle moved along the net, in metres."""
    pairs = zip(wall.places.begin, wall.places.end, strict=True)
    return float(sum(np.hypot(b.along - a.along, b.up - a.up) for a, b in pairs))


def _mean(
    stretches: Sequence[NetStretch], value: Callable[[NetStretch], float | None], digits: int
) -> float | None:
    """Return the rounded mean over stretches, weighed by how much of them was seen."""
    pairs = [(value(one), one.seen_length) for one in stretches]
    known = [(float(found), weight) for found, weight in pairs if found is not None]
    total = sum(weight for _, weight in known)
    if not total > 0.0:
        return None
    return round(sum(found * weight for found, weight in known) / total, digits)
