"""The state of a net in a few words and numbers."""

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from aqualvs.app.net_places import NetPlace
from aqualvs.app.net_tables import fouling_of
from aqualvs.app.net_wall import NetWall
from aqualvs.app.report_words import clock, hole_count
from aqualvs.scanning.net_condition import NetStretch
from aqualvs.scanning.net_holes import Hole

_MOST_LISTED = 20


def net_facts(wall: NetWall, area: float, n_frames: int, n_net_frames: int) -> dict[str, Any]:
    """Return the numbers that sum a dive up; None where not measured.

    Parameters
    ----------
    wall : NetWall
        What was found.
    area : float
        Looked at for holes, in square metres.
    n_frames, n_net_frames : int
        Frames of the dive, and those with a posture to a net.
    """
    stretches = wall.stretches
    solidity = _mean(stretches, lambda one: one.solidity)
    fouling = _mean(stretches, fouling_of)
    shapes = Counter(one.lattice.mesh.value for one in stretches if one.lattice is not None)
    return {
        "n_frames": n_frames,
        "n_net_frames": n_net_frames,
        "n_stretches": len(stretches),
        "n_holes": len(wall.holes),
        "area_m2": round(area, 3),
        "way_m": round(_way(wall), 3),
        "mesh": shapes.most_common(1)[0][0] if shapes else None,
        "bar_mm": _rounded(_mean(stretches, _bar_mm), 2),
        "twine_mm": _rounded(_mean(stretches, _twine_mm), 2),
        "solidity": _rounded(solidity, 4),
        "fouling": _rounded(fouling, 4),
        "track_slip_m": round(wall.places.slip, 2),
        "largest_hole_mm": _rounded(max((1e3 * h.diameter for h in wall.holes), default=None), 1),
    }


def net_lines(wall: NetWall, area: float, n_frames: int) -> list[str]:
    """Return the summary in words, line by line."""
    if not wall.stretches:
        return [f"no net was seen in {n_frames} frames"]
    facts = net_facts(wall, area, n_frames, n_frames)
    lines = [_mesh_line(facts), *_fouling_lines(wall, facts), *_hole_lines(wall, facts)]
    return lines if not wall.places.slip else [*lines, f"warning: {slip_words(wall.places.slip)}"]


def slip_words(slip: float) -> str:
    """Return what it means that track and log disagree about the height."""
    return (
        f"the track and the log's depth part by {slip:.1f} m: meshes were counted wrongly, so "
        "places along the net and sizes of holes are not to be trusted"
    )


def place_words(place: NetPlace) -> str:
    """Return where something is."""
    words = [] if place.placed_by == "nothing" else [f"{place.along:.2f} m along"]
    words.append(
        f"{place.depth:.2f} m deep" if place.depth is not None else f"{place.up:+.2f} m up"
    )
    if place.bearing is not None:
        words.append(f"bearing {np.rad2deg(place.bearing):.0f}°")
    return ", ".join(words)


def size_words(hole: Hole) -> str:
    """Return how large a hole is."""
    width, height = (1e3 * side for side in hole.extent)
    return f"{1e3 * hole.diameter:.0f} mm ({width:.0f} x {height:.0f} mm)"


def _mesh_line(facts: dict[str, Any]) -> str:
    if facts["bar_mm"] is None:
        return "net: its mesh could not be made out"
    bar = facts["bar_mm"]
    words = f"net: {facts['mesh']} meshes of {bar:.1f} mm bar ({2.0 * bar:.0f} mm stretched)"
    return words if facts["twine_mm"] is None else f"{words}, twine {facts['twine_mm']:.1f} mm"


def _fouling_lines(wall: NetWall, facts: dict[str, Any]) -> list[str]:
    if facts["fouling"] is None:
        return ["solidity: not measured in any stretch"]
    clean = facts["solidity"] - facts["fouling"]
    fouling = [fouling_of(one) for one in wall.stretches]
    worst = int(np.argmax([-np.inf if value is None else value for value in fouling]))
    return [
        f"solidity {facts['solidity']:.2f}, of bare twine {clean:.2f}: "
        f"fouling {facts['fouling']:+.2f}; most at {place_words(wall.places.middle[worst])}: "
        f"{fouling[worst]:+.2f}"
    ]


def _hole_lines(wall: NetWall, facts: dict[str, Any]) -> list[str]:
    n = len(wall.holes)
    seen = (
        f"looked at {facts['area_m2']:.2f} m² of net over {facts['way_m']:.1f} m: {hole_count(n)}"
    )
    order = np.argsort([-hole.diameter for hole in wall.holes], kind="stable")[:_MOST_LISTED]
    lines = [
        f"  {size_words(hole)}, {hole.missing_meshes:.0f} meshes: {place_words(place)}, "
        f"at {clock(hole.time_s)} (frame {hole.frame})"
        for hole, place in ((wall.holes[i], wall.places.holes[i]) for i in sorted(order))
    ]
    if n > _MOST_LISTED:
        lines.append(f"  and {n - _MOST_LISTED} smaller ones, see holes.csv")
    return [seen, *lines]


def _way(wall: NetWall) -> float:
    """Return how far the vehicle moved along the net, in metres."""
    pairs = zip(wall.places.begin, wall.places.end, strict=True)
    return float(sum(np.hypot(b.along - a.along, b.up - a.up) for a, b in pairs))


def _mean(
    stretches: Sequence[NetStretch], value: Callable[[NetStretch], float | None]
) -> float | None:
    """Return the mean over stretches, weighed by how much of them was seen."""
    pairs = [(value(one), one.seen_length) for one in stretches]
    known = [(float(found), weight) for found, weight in pairs if found is not None]
    total = sum(weight for _, weight in known)
    return sum(found * weight for found, weight in known) / total if total > 0.0 else None


def _bar_mm(stretch: NetStretch) -> float | None:
    return None if stretch.lattice is None else 1e3 * stretch.lattice.bar


def _twine_mm(stretch: NetStretch) -> float | None:
    return None if stretch.twine is None else 1e3 * stretch.twine.thickness


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(float(value), digits)
