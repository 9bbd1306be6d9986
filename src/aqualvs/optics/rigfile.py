"""The rig file: `rig.yaml` to `Rig` and back.

Files use millimetres and degrees, `Rig` metres and radians. A value that was loaded from a file is
written back bit for bit; a rotation is written to 1e-12 degrees. Before a file is replaced, a copy
is kept under its date in UTC, such as `rig.2026-11-23T141503.yaml` (`keep_dated`). docs/rig.md
explains every key.
"""

import contextlib
import math
import os
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.calibration_formats import refuse_foreign
from aqualvs.errors import AqualvsError, OptionError, OutputError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.optics.camera import Housing
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import COEFFICIENT_COUNTS, Lens, LensModel
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Laser, Rig, Window, common_wavelength
from aqualvs.optics.rigschema import (
    VERSION,
    LaserPart,
    RigFile,
    ShutterPart,
    WaterPart,
    missing_text,
    parse_rig,
    range_fault,
)
from aqualvs.optics.shutter import AT_ONCE, Shutter, ShutterKind
from aqualvs.optics.solved import rig_uncertainty
from aqualvs.optics.water import index_in_seawater, seawater_index_vacuum, water_fault
from aqualvs.schema import StrictPart, si_values
from aqualvs.yamlfile import carry_comments, parse_yaml, read_text, rig_text

_STAMP = re.compile(r"\.(\d{4}-\d\d-\d\dT\d{6})(?:-(\d+))?")


def keep_dated(path: Path, now: datetime | None = None) -> Path:
    """Copy a file beside itself, under a name with the time that no other file has.

    `now`: with a time zone; the current time if left out. Raises `OutputError` if it cannot be
    copied.
    """
    stamp = (now or datetime.now(UTC)).astimezone(UTC).strftime("%Y-%m-%dT%H%M%S")
    number, file = 1, None
    try:
        content = path.read_bytes()
        while file is None:
            again = f"-{number}" if number > 1 else ""
            copy = path.with_name(f"{path.stem}.{stamp}{again}{path.suffix}")
            number += 1
            with contextlib.suppress(FileExistsError):
                file = copy.open("xb")
        try:
            with file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            copy.unlink(missing_ok=True)
            raise
    except OSError as fault:
        raise OutputError(
            f"{path}: cannot be kept as a dated copy ({fault.strerror}), so it is not replaced; "
            "free the disk or choose another place"
        ) from fault
    return copy


def dated_copies(path: Path) -> list[Path]:
    """Return the dated copies of a file, the newest first."""
    found = []
    for copy in path.parent.glob("*"):
        middle = copy.name.removeprefix(path.stem).removesuffix(path.suffix)
        stamp = _STAMP.fullmatch(middle)
        if stamp is not None and copy.name == f"{path.stem}{middle}{path.suffix}":
            found.append((stamp[1], int(stamp[2] or 1), copy))
    return [copy for _, _, copy in sorted(found, reverse=True)]


_MILLI = 1e3
_ROTATION_DECIMALS = 12
# Cosine between the normals of sheet and window; nearer ones mean that no light could cross.
_MAX_ACROSS = math.cos(math.radians(30.0))


def load_rig(path: str | Path, *, need_lasers: bool = True) -> Rig:
    """Load a rig file.

    Parameters
    ----------
    path : path
        A `rig.yaml`, see docs/rig.md.
    need_lasers : bool
        Refuse a rig without lasers; calibrations that come before the lasers' set it to False.

    Raises
    ------
    RigError
        One line that names the file, the place in it, the value and the remedy.
    """
    text = read_text(Path(path), "a rig file", RigError)
    if "aqualvs_rig" not in text:
        refuse_foreign(text, Path(path), "a rig file", RigError)
    content = parse_yaml(text, str(path), RigError)
    return rig_from_mapping(content, source_name=str(path), need_lasers=need_lasers)


def save_rig(rig: Rig, path: str | Path, *, comments_of: str | Path | None = None) -> Path | None:
    """Write a rig file that `load_rig` turns into the same rig; an old file is replaced at once.

    An existing rig file is kept under a dated name, such as `rig.2026-11-23T141503.yaml` (UTC),
    unless its content is the same. Its comments are carried over to the new file.

    Parameters
    ----------
    rig : Rig
    path : path
    comments_of : path, optional
        Rig file whose comments to take over where `path` does not exist yet.

    Returns
    -------
    copy : Path or None
        Path under which the old file is kept.

    Raises
    ------
    OutputError
        If the file cannot be written, or `path` is a file but no rig.
    RigError
        If `solved_from` holds a value that YAML cannot represent.
    """
    target, copy = Path(path), None
    text = rig_text(rig_to_mapping(rig))
    if os.path.lexists(target):
        old = _old_rig(target)
        text = carry_comments(old, text)
        if text == old:
            return None
        copy = keep_dated(target)
    elif comments_of is not None:
        text = carry_comments(read_text(Path(comments_of), "a rig file", RigError), text)
    draft = target.with_name(target.name + ".part")
    try:
        draft.write_text(text, encoding="utf-8")
        os.replace(draft, target)
    except OSError as error:
        raise OutputError(
            f"{target}: cannot write the rig ({error.strerror}); choose another place"
        ) from error
    finally:
        draft.unlink(missing_ok=True)
    return copy


def check_rig_place(path: Path) -> None:
    """Make sure that `save_rig` may write there, before anything is computed.

    Raises `OutputError` if the path is a file but no rig.
    """
    if os.path.lexists(path):
        _old_rig(path)


def _old_rig(path: Path) -> str:
    """Return the text of a rig file that is about to be replaced.

    Raises `OutputError` if the file is no rig file, and so must not be replaced by one.
    """
    try:
        text = read_text(path, "a rig file", OutputError)
        content = parse_yaml(text, str(path), OutputError)
    except OutputError:
        content = None
    if not isinstance(content, Mapping) or "aqualvs_rig" not in content:
        raise OutputError(f"{path}: exists and is not a rig file; choose another place for the rig")
    return text


def rig_to_mapping(rig: Rig) -> dict[str, Any]:
    """Return a rig as plain numbers, lists and mappings, in the order and units of the file."""
    content: dict[str, Any] = {
        "aqualvs_rig": VERSION,
        "name": rig.name,
        "image": {"width_px": int(rig.size_px[0]), "height_px": int(rig.size_px[1])},
        "camera": _camera_mapping(rig),
    }
    if rig.dome is not None:
        content["dome"] = {
            "inner_radius_mm": _to_milli(rig.dome.inner_radius),
            "thickness_mm": _to_milli(rig.dome.thickness),
            "n_acrylic": float(rig.dome.n_acrylic),
        }
    if rig.flat_port is not None:
        port = rig.flat_port
        tilt = np.rad2deg([port.tilt_x, port.tilt_y])
        content["housing"] = "flat"
        content["flat"] = {
            "distance_mm": _to_milli(port.distance),
            "thickness_mm": _to_milli(port.thickness),
            "n_port": float(port.n_port),
            "tilt_deg": [round(float(value), _ROTATION_DECIMALS) + 0.0 for value in tilt],
        }
    content["n_air"] = float(rig.n_air)
    content["water"] = {"n": float(rig.n_water)}
    content["lasers"] = [_laser_mapping(laser) for laser in rig.lasers]
    content["working_range_mm"] = _all_to_mm(rig.working_range)
    if rig.solved_from:
        content["solved_from"] = _plain(rig.solved_from, "solved_from")
    return content


def rig_from_mapping(
    mapping: Mapping[str, Any], *, source_name: str, need_lasers: bool = True
) -> Rig:
    """Make a rig from the content of a rig file.

    Parameters
    ----------
    mapping : mapping
        As `rig_to_mapping` gives it, or as YAML reads it.
    source_name : str
        Name of the file in messages.
    need_lasers : bool
        As in `load_rig`.

    Raises
    ------
    RigError
        One line that names the file, the place in it, the value and the remedy.
    """
    file = parse_rig(mapping, source_name)
    try:
        rig = _rig(file)
        _check_whole(file, need_lasers)
        # Every measurement with the rig reads the uncertainty.
        rig_uncertainty(rig)
    except AqualvsError as error:
        raise RigError(f"{source_name}: {error}") from None
    return rig


def _rig(file: RigFile) -> Rig:
    camera = file.camera
    turn = rotation_from_rotvec(np.deg2rad(camera.rotation_deg))
    lasers = tuple(_laser(f"lasers[{i}]", part) for i, part in enumerate(file.lasers))
    return Rig(
        name=file.name,
        size_px=(file.image.width_px, file.image.height_px),
        lens=Lens(
            model=LensModel(camera.model),
            fx=camera.fx_px,
            fy=camera.fy_px,
            cx=camera.cx_px,
            cy=camera.cy_px,
            distortion=_distortion(file),
        ),
        dome_from_cam=SE3(turn @ DOME_FROM_CAM_NOMINAL, np.array(_position_mm(file)) / _MILLI),
        housing=_housing(file),
        n_air=file.n_air,
        n_water=_water_index(file, lasers),
        lasers=lasers,
        working_range=(file.working_range_mm[0] / _MILLI, file.working_range_mm[1] / _MILLI),
        solved_from=dict(file.solved_from),
        shutter=shutter_from_part(camera.shutter),
    )


def _housing(file: RigFile) -> Housing | None:
    found = housing_of(file.dome, file.flat)
    kind = "dome" if file.dome is not None else "flat" if file.flat is not None else "none"
    if file.housing not in (None, kind):
        said = "neither 'dome' nor 'flat' is given" if kind == "none" else f"'{kind}' is given"
        raise RigError(f"housing is {file.housing!r} but {said}; make them agree")
    return found


def housing_of(dome: StrictPart | None, flat: StrictPart | None) -> Housing | None:
    """Return the housing that one of two sections of a file describes; None without both.

    Raises `RigError` if both are given, or a length is in metres.
    """
    if dome is not None and flat is not None:
        raise RigError("dome and flat: both are given; leave one out, a camera has one housing")
    if dome is not None:
        values = si_values(dome)
        _refuse_metres("dome.inner_radius_mm", values["inner_radius"])
        return Dome(**values)
    if flat is None:
        return None
    values = si_values(flat)
    _refuse_metres("flat.distance_mm", values["distance"])
    tilt_x, tilt_y = values.pop("tilt", (0.0, 0.0))
    return FlatPort(**values, tilt_x=tilt_x, tilt_y=tilt_y)


def _refuse_metres(key: str, length: float) -> None:
    """Raise `RigError` for a length, in metres, that no housing has because it is in another unit.

    It must be positive; what is not is refused where the housing is made.
    """
    # No dome has so small a radius, and no lens its pupil so near a port.
    smallest = 1e-4
    if 0.0 < length < smallest:
        raise RigError(
            f"{key} is {_MILLI * length:g}, but these are millimetres; write "
            f"{_MILLI**2 * length:g} if metres are meant"
        )


def shutter_from_part(part: ShutterPart) -> Shutter:
    """Return the shutter that a file's `camera.shutter` describes.

    Raises `RigError` if its values contradict each other.
    """
    try:
        return Shutter(
            kind=ShutterKind(part.kind),
            readout=part.readout_ms / _MILLI,
            exposure=part.exposure_ms / _MILLI,
            first_field=part.first_field,
        )
    except RigError as fault:
        raise RigError(f"camera.shutter.{fault}") from None


def _distortion(file: RigFile) -> tuple[float, ...]:
    values, model = file.camera.distortion, file.camera.model
    allowed = COEFFICIENT_COUNTS[LensModel(model)]
    if len(values) not in allowed:
        raise RigError(
            f"camera.distortion has {len(values)} values; the {model} model takes "
            f"{', '.join(map(str, allowed[:-1]))} or {allowed[-1]}"
        )
    return tuple(float(value) for value in values)


def _position_mm(file: RigFile) -> list[float]:
    """Return the lens's place; a bare lens is the origin of the frame unless it is said."""
    position = file.camera.position_mm
    if position is not None:
        return position
    if file.dome is not None:
        raise RigError(missing_text("camera.position_mm"))
    return [0.0, 0.0, 0.0]


def _water_index(file: RigFile, lasers: Sequence[Laser]) -> float:
    """Return the index outside; where nothing refracts it need not be said, and is that of air."""
    if file.water is None:
        housed = file.dome is not None or file.flat is not None
        if housed or any(laser.window is not None for laser in file.lasers):
            raise RigError(missing_text("water"))
        return file.n_air
    return water_index(file.water, file.n_air, lasers)


def water_index(water: WaterPart, n_air: float, lasers: Sequence[Laser]) -> float:
    """Return the index relative to vacuum that a file's `water` gives, or Quan & Fry (1995) do.

    They do for the light that `water` names, or else for that of the lasers.

    Raises `RigError` if it gives none or more than one, or numbers that are none of water.
    """
    measured = (water.temperature_c, water.salinity_permille, water.wavelength_nm)
    if water.n is not None:
        if any(value is not None for value in measured):
            raise RigError(
                "water gives n and what it would follow from; keep either n, or temperature_c "
                "and salinity_permille"
            )
        return water.n
    if water.temperature_c is None or water.salinity_permille is None:
        raise RigError(
            "water has no index; write 'water: {n: 1.3333}', or both temperature_c and "
            "salinity_permille"
        )
    name, remedy = water_fault(water.temperature_c, water.salinity_permille)
    if name:
        key = "salinity_permille" if name == "salinity" else name
        raise RigError(f"water.{key} is {getattr(water, key):g}; {remedy}")
    try:
        if water.wavelength_nm is None:
            light_nm = common_wavelength(lasers)
            return index_in_seawater(water.temperature_c, water.salinity_permille, light_nm, n_air)
        return float(
            seawater_index_vacuum(
                water.temperature_c, water.salinity_permille, water.wavelength_nm, n_air=n_air
            )
        )
    except OptionError as error:
        raise RigError(f"water: {error}") from None


def _laser(place: str, part: LaserPart) -> Laser:
    plane = _plane(place, part.normal, part.offset_mm)
    if part.window is None:
        return Laser(part.name, plane, wavelength_nm=part.wavelength_nm)
    place, face = f"{place}.window", part.window
    window = Window(
        _plane(place, face.normal, face.offset_mm), np.array(face.source_mm, np.float64) / _MILLI
    )
    _check_window(place, face.source_mm, plane, window)
    return Laser(part.name, plane, window, part.wavelength_nm)


def _check_window(place: str, source_mm: list[float], sheet: Plane, window: Window) -> None:
    """Refuse a source off its sheet or not behind the window, and a window without any light."""
    off = float(sheet.signed_distance(window.source))
    # A source measured with a ruler lies at most this far off its laser's plane, in metres.
    off_sheet = 5e-3
    min_behind = 1e-4
    if abs(off) > off_sheet:
        raise RigError(
            f"{place}.source_mm is {source_mm}, {abs(off) * _MILLI:.1f} mm off the laser's plane; "
            "the light comes from a point in it: correct source_mm, or the laser's normal and "
            "offset_mm"
        )
    across = abs(float(sheet.normal @ window.face.normal))
    if across > _MAX_ACROSS:
        raise RigError(
            f"{place}.normal is {math.degrees(math.acos(min(across, 1.0))):.0f} degrees from the "
            "laser's normal, so its light would run along the glass; give the normal of the "
            "window, which lies rather in the laser's plane"
        )
    source = window.source - off * sheet.normal
    ahead = np.array([0.0, 1.0, 0.0]) - sheet.normal[1] * sheet.normal
    behind = -float(window.face.signed_distance(source))
    # Light that goes forward must meet the face after leaving the source.
    if abs(behind) < min_behind or behind * float(window.face.normal @ ahead) < 0.0:
        raise RigError(
            f"{place}.source_mm is {source_mm}, which is not behind the window as a target ahead "
            "sees it; correct source_mm, or the window's offset_mm, which is that of its outer face"
        )


def _plane(place: str, normal: Sequence[float], offset_mm: float) -> Plane:
    """Return the plane with the direction of `normal`; the offset belongs to the unit normal."""
    vector: FloatArray = np.array(normal, dtype=np.float64)
    length = math.hypot(*normal)
    if length == 0.0:
        raise RigError(
            f"{place}.normal is {list(normal)}, which has no direction; give the normal of the "
            f"{'window' if place.endswith('window') else 'laser'}'s plane"
        )
    # Normals this close to unit length are kept as they are, so that loading and saving settle.
    unit = 1e-14
    if abs(length - 1.0) > unit:
        vector = vector / length
    return Plane(vector, offset_mm / _MILLI)


def _check_whole(file: RigFile, need_lasers: bool) -> None:
    fault = range_fault(*file.working_range_mm)
    if fault:
        raise RigError(fault)
    position = _position_mm(file)
    distance = math.hypot(*position)
    if file.dome is not None and distance >= file.dome.inner_radius_mm:
        raise RigError(
            f"camera.position_mm is {position}, {distance:.1f} mm from the dome's "
            f"centre and outside its inner radius of {file.dome.inner_radius_mm:g} mm; give the "
            "lens's place relative to the centre of the sphere"
        )
    names = [laser.name for laser in file.lasers]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise RigError(
                f"lasers[{i}].name is {name!r}, as of lasers[{names.index(name)}]; give every "
                "laser a name of its own"
            )
    if need_lasers and not names:
        raise RigError(
            "lasers is empty: a rig without lasers measures nothing; run 'aqualvs calibrate "
            "lasers', or write one laser at least (two for pitch and yaw)"
        )


def _camera_mapping(rig: Rig) -> dict[str, Any]:
    lens, pose = rig.lens, rig.dome_from_cam
    turn = np.rad2deg(rotvec_from_rotation(pose.rotation @ DOME_FROM_CAM_NOMINAL.T))
    content: dict[str, Any] = {
        "model": LensModel(lens.model).value,
        "fx_px": float(lens.fx),
        "fy_px": float(lens.fy),
        "cx_px": float(lens.cx),
        "cy_px": float(lens.cy),
        "distortion": [float(value) for value in lens.distortion],
        "position_mm": _all_to_mm(pose.translation),
        # Adding zero turns -0.0 into 0.0.
        "rotation_deg": [round(float(value), _ROTATION_DECIMALS) + 0.0 for value in turn],
    }
    if rig.shutter != AT_ONCE:
        content["shutter"] = shutter_mapping(rig.shutter)
    return content


def shutter_mapping(shutter: Shutter) -> dict[str, Any]:
    """Return a file's `camera.shutter`, without those keys that say nothing about its kind."""
    keys: dict[str, Any] = {"kind": shutter.kind.value}
    if shutter.readout != 0.0:
        keys["readout_ms"] = _to_milli(shutter.readout)
    if shutter.exposure > 0.0:
        keys["exposure_ms"] = _to_milli(shutter.exposure)
    if shutter.is_interlaced:
        keys["first_field"] = shutter.first_field
    return keys


def _laser_mapping(laser: Laser) -> dict[str, Any]:
    content = {"name": laser.name, **_plane_mapping(laser.plane)}
    if laser.wavelength_nm is not None:
        content["wavelength_nm"] = float(laser.wavelength_nm)
    if laser.window is not None:
        face, source = laser.window.face, laser.window.source
        content["window"] = {**_plane_mapping(face), "source_mm": _all_to_mm(source)}
    return content


def _plane_mapping(plane: Plane) -> dict[str, Any]:
    return {
        "normal": [float(value) for value in plane.normal],
        "offset_mm": _to_milli(plane.offset),
    }


def _all_to_mm(values: FloatArray | Sequence[float]) -> list[float]:
    return [_to_milli(float(value)) for value in values]


def _to_milli(value_in_si: float) -> float:
    """Return milli-units with the fewest digits that load as the same number of metres or seconds.

    A few numbers are not a thousandth of any float; they come back off by one unit in the
    last place.
    """
    value = float(value_in_si) * _MILLI
    for digits in (15, 16, 17):
        short = float(f"{value:.{digits}g}")
        if short / _MILLI == value_in_si:
            return short
    neighbours = (math.nextafter(value, -math.inf), math.nextafter(value, math.inf))
    return next((near for near in neighbours if near / _MILLI == value_in_si), value)


def _plain(value: object, place: str) -> Any:
    """Convert NumPy values, tuples and paths to types that YAML can represent."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(item, f"{place}.{key}") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, f"{place}[{i}]") for i, item in enumerate(value)]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise RigError(f"{place} is of type {type(value).__name__}; keep numbers, words and lists")
