"""The rig as `run.yaml` holds it: lasers' planes, their own frames, and facts for the table."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from aqualvs.app.report_run import number
from aqualvs.geometry.arrays import FloatArray

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
    """

    name: str
    normal: FloatArray
    offset: float

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
    return [_laser(entry, i) for i, entry in enumerate(entries) if isinstance(entry, dict)]


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
    return LaserFacts(name, normal / length, 1e-3 * number(entry.get("offset_mm")))
