"""What must hold for markers at known places: sizes, order, planes, units."""

import difflib
from pathlib import Path

import numpy as np

from aqualvs.calibration.target_schema import MarkerPart, MarkersFile
from aqualvs.calibration.targets import aruco_dictionary
from aqualvs.errors import CalibrationError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane

# A ruler's error, as a share of the marker and in millimetres.
_SIDE_TOLERANCE = (0.02, 0.2)
_PLANE_TOLERANCE_MM = 0.5
_SMALLEST_MM = 3.0
# A box whose markers are all nearer to its origin than this, or a target this near to the dome's
# centre, is given in other units: no vehicle fits in, no dome is so small.
_SMALLEST_BOX_MM = 100.0
_NEAREST_TARGET_MM = 30.0
_UNITS = {1e-3: "metres", 1e-1: "centimetres"}


def check_markers(file: MarkersFile, frame: str, source: Path) -> None:
    """Check the markers of a file as a whole; lengths in it are millimetres.

    Raises
    ------
    CalibrationError
        One line on the first fault: file, marker, value, remedy.
    """
    try:
        _check_ids(file)
        planes = {name: _plane(name, part.normal, part.d) for name, part in file.planes.items()}
        for part in file.markers:
            _check_shape(part)
            _check_plane(part, planes)
        corners = np.array([part.corners for part in file.markers])
        _check_extent(corners, frame)
        _check_facing(file, corners, frame)
    except CalibrationError as fault:
        raise CalibrationError(f"{source}: {fault}") from None


def _check_ids(file: MarkersFile) -> None:
    held = len(aruco_dictionary(file.family).bytesList)
    seen: set[int] = set()
    for part in file.markers:
        if part.id in seen:
            raise CalibrationError(f"marker {part.id} is listed twice; every id is one marker")
        if part.id >= held:
            raise CalibrationError(
                f"marker {part.id} is not in {file.family}, which has ids 0 to {held - 1}; check "
                "the id or the family"
            )
        seen.add(part.id)


def _plane(name: str, normal: list[float], d: float) -> Plane:
    try:
        return Plane.from_normal(normal, d)
    except ValueError:
        raise CalibrationError(
            f"planes.{name}.normal is {normal}; a normal has a direction"
        ) from None


def _check_shape(part: MarkerPart) -> None:
    corners = np.array(part.corners)
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    diagonals = np.linalg.norm(corners[2:] - corners[:2], axis=1)
    if part.size_mm < _SMALLEST_MM:
        unit = "metres" if part.size_mm < 0.3 else "centimetres"
        raise CalibrationError(
            f"marker {part.id}: size_mm is {part.size_mm:g}; it looks like {unit}, write "
            "millimetres everywhere"
        )
    for factor, unit in _UNITS.items():
        if np.allclose(sides, factor * part.size_mm, rtol=0.05):
            raise CalibrationError(
                f"marker {part.id}: its corners are {sides[0]:g} apart, but size_mm is "
                f"{part.size_mm:g}; the corners look like {unit}, write millimetres"
            )
    tolerance = max(_SIDE_TOLERANCE[0] * part.size_mm, _SIDE_TOLERANCE[1])
    if np.any(np.abs(sides - np.sqrt(2.0) * part.size_mm) < tolerance):
        raise CalibrationError(
            f"marker {part.id}: its corners are not in order around it; write top-left, "
            "top-right, bottom-right, bottom-left"
        )
    worst = int(np.argmax(np.abs(sides - part.size_mm)))
    if abs(sides[worst] - part.size_mm) > tolerance:
        raise CalibrationError(
            f"marker {part.id}: corners {worst} and {(worst + 1) % 4} are {sides[worst]:.2f} mm "
            f"apart, but size_mm is {part.size_mm:g}; mend the corners or the size"
        )
    if np.any(np.abs(diagonals - np.sqrt(2.0) * part.size_mm) > 2.0 * tolerance):
        raise CalibrationError(
            f"marker {part.id}: its diagonals are {diagonals[0]:.2f} and {diagonals[1]:.2f} mm, "
            "so it is no square; mend the corners"
        )


def _check_plane(part: MarkerPart, planes: dict[str, Plane]) -> None:
    if part.plane is None:
        return
    if part.plane not in planes:
        close = difflib.get_close_matches(part.plane, planes, n=1, cutoff=0.5)
        known = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(planes)}"
        raise CalibrationError(f"marker {part.id}: plane {part.plane!r} is not in planes; {known}")
    off = planes[part.plane].signed_distance(np.array(part.corners))
    worst = int(np.argmax(np.abs(off)))
    if abs(off[worst]) > _PLANE_TOLERANCE_MM:
        raise CalibrationError(
            f"marker {part.id}: corner {worst} lies {abs(off[worst]):.1f} mm off plane "
            f"{part.plane!r}; mend the corner, the plane's d, or the plane's name"
        )


def _check_extent(corners: FloatArray, frame: str) -> None:
    distance = np.linalg.norm(corners, axis=-1)
    if frame == "box" and distance.max() < _SMALLEST_BOX_MM:
        raise CalibrationError(
            f"no corner is farther than {distance.max():.3g} mm from the box's origin; it looks "
            "like centimetres, write millimetres"
        )
    if frame == "dome" and distance.min() < _NEAREST_TARGET_MM:
        raise CalibrationError(
            f"a corner is only {distance.min():.3g} mm from the dome's centre, inside any dome; "
            "check the units (millimetres) and that corners are given in the dome's frame"
        )


def _check_facing(file: MarkersFile, corners: FloatArray, frame: str) -> None:
    """Markers face the viewer: the dome's centre, or the inside of a box of several planes."""
    if frame == "box" and len({part.plane for part in file.markers}) < 2:
        return
    viewer = corners.reshape(-1, 3).mean(axis=0) if frame == "box" else np.zeros(3)
    away = np.cross(corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 0])
    behind = np.einsum("ij,ij->i", away, corners.mean(axis=1) - viewer)
    for part, side in zip(file.markers, behind, strict=True):
        if side < 0.0:
            raise CalibrationError(
                f"marker {part.id}: seen from the camera its corners run anticlockwise; write "
                "top-left, top-right, bottom-right, bottom-left as the camera sees them"
            )
