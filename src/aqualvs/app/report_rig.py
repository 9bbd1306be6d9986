"""The rig as `run.yaml` holds it: lasers' planes, their own frames, and facts for the table.

A laser behind a window has a bent sheet; it is shown in the plane that fits the sheet best where
the camera sees it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from aqualvs.app.report_run import number
from aqualvs.errors import RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.rigfile import rig_from_mapping
from aqualvs.optics.sheet import sheets_of

# Lasers whose plane is square to the forward axis have no projection of it to use as y.
_SQUARE = 1e-6


@dataclass(frozen=True, slots=True)
class LaserFacts:
    """A laser as the report needs it.

    Attributes
    ----------
    name : str
    normal : array, shape (3,)
        Unit normal in `dome`; NaN where the file has none.
    offset : float
        Metres.
    bent : bool
        Whether the plane only fits a bent sheet.
    """

    name: str
    normal: FloatArray
    offset: float
    bent: bool = False

    @classmethod
    def unknown(cls, index: int) -> "LaserFacts":
        """Return a laser of which only its number is known."""
        return cls(f"laser {index + 1}", np.full(3, np.nan), float("nan"))

    @property
    def known(self) -> bool:
        """Whether the plane is known and has a frame of its own."""
        forward_part = 1.0 - self.normal[1] ** 2
        return bool(np.isfinite(self.offset) and forward_part > _SQUARE)

    def frame(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return origin, e_x and e_y of the laser's frame in `dome` (paper, Eq. 37-40).

        e_y is the dome's forward axis projected into the plane, e_x = e_y x e_z.
        """
        forward = np.array([0.0, 1.0, 0.0])
        e_y = forward - self.normal * self.normal[1]
        e_y /= np.linalg.norm(e_y)
        return self.normal * self.offset, np.cross(e_y, self.normal), e_y


def lasers_of(rig: Mapping[str, Any]) -> list[LaserFacts]:
    """Return the lasers of a rig file's content; what is missing or malformed becomes NaN."""
    entries = rig.get("lasers")
    if not isinstance(entries, list):
        return []
    lasers = [_laser(entry, i) for i, entry in enumerate(entries) if isinstance(entry, dict)]
    return _fitted(lasers, rig) if any(laser.bent for laser in lasers) else lasers


def _fitted(lasers: list[LaserFacts], rig: Mapping[str, Any]) -> list[LaserFacts]:
    """Give the lasers behind windows the planes of their sheets, NaN if the rig does not tell."""
    try:
        known = rig_from_mapping(rig, source_name="run.yaml")
    except RigError:
        nothing = np.full(3, np.nan)
        return [replace(one, normal=nothing, offset=np.nan) if one.bent else one for one in lasers]
    camera = known.camera()
    planes = [sheet.best_plane(camera, known.working_range) for sheet in sheets_of(known)]
    return [
        replace(one, normal=plane.normal, offset=plane.offset) if one.bent else one
        for one, plane in zip(lasers, planes, strict=True)
    ]


def working_range_m(rig: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the nearest and farthest range at which the rig is believed, in metres."""
    pair = rig.get("working_range_mm")
    if not isinstance(pair, list) or len(pair) != 2:
        return None
    near, far = (1e-3 * number(value) for value in pair)
    return (near, far) if np.isfinite(near) and np.isfinite(far) else None


def dome_radius_mm(rig: Mapping[str, Any]) -> float:
    """Return the dome's outer radius in millimetres, NaN where the rig has no dome."""
    dome = rig.get("dome")
    if not isinstance(dome, dict):
        return float("nan")
    return number(dome.get("inner_radius_mm")) + number(dome.get("thickness_mm"))


def facts(content: Mapping[str, Any], skip: tuple[str, ...] = ()) -> list[tuple[str, str]]:
    """Return a nested mapping as rows (dotted key, value) for a table."""
    rows: list[tuple[str, str]] = []
    for key, value in content.items():
        name = str(key)
        if name in skip:
            continue
        if isinstance(value, dict):
            rows += [(f"{name}.{inner}", text) for inner, text in facts(value)]
        else:
            rows.append((name, _shown(value)))
    return rows


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return ", ".join(_shown(item) for item in value)
    return "none" if value is None else str(value)


def _laser(entry: Mapping[str, Any], index: int) -> LaserFacts:
    values = entry.get("normal")
    triple = values if isinstance(values, list) and len(values) == 3 else [None] * 3
    normal = np.array([number(value) for value in triple])
    length = float(np.linalg.norm(normal))
    unknown = LaserFacts.unknown(index)
    name = str(entry.get("name") or unknown.name)
    if not length > 0.0:
        return LaserFacts(name, unknown.normal, unknown.offset)
    # As in rig files, the offset belongs to the unit normal.
    bent = entry.get("window") is not None
    return LaserFacts(name, normal / length, 1e-3 * number(entry.get("offset_mm")), bent)
