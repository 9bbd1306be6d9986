"""Schema of the rig file: allowed keys and types, with one-line error messages.

`parse_rig` checks the shape of the file alone: keys, types, limits of single values. Conditions on
the rig as a whole (the lens inside the dome, say) are checked in `aqualvs.optics.rigfile`.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Field

from aqualvs.errors import RigError
from aqualvs.optics.lens import COEFFICIENT_COUNTS
from aqualvs.optics.water import N_AIR
from aqualvs.schema import (
    Index,
    NotNegative,
    Number,
    Positive,
    SchemaWords,
    StrictPart,
    Triple,
    shown,
    validated,
)

VERSION = 1
"""Version of the format that this package reads and writes."""

FocalLength = Annotated[float, Field(gt=0.0, le=1e7, allow_inf_nan=False)]
"""In pixels; a lens of 10 m before pixels of 1 micrometre has the greatest."""
Pixels = Annotated[int, Field(gt=0)]
Tilt = Annotated[float, Field(ge=-45.0, le=45.0, allow_inf_nan=False)]
Pair = Annotated[list[Positive], Field(min_length=2, max_length=2)]
Name = Annotated[str, Field(min_length=1)]
LASER_NM = (380.0, 780.0)
"""Least and greatest wavelength of a laser that a silicon camera sees well, in nanometres."""
LASER_NM_REMEDY = "write the wavelength in nanometres, 380 to 780, for example 532"
LaserWavelength = Annotated[float, Field(ge=LASER_NM[0], le=LASER_NM[1], allow_inf_nan=False)]


def _doc(text: str) -> Any:
    """Return the description of a key, for editors that complete rig files."""
    return Field(description=text)


class ImagePart(StrictPart):
    """`image`: size of the pictures."""

    width_px: Annotated[Pixels, _doc("Width of the pictures the camera was calibrated at.")]
    height_px: Annotated[Pixels, _doc("Height of the pictures the camera was calibrated at.")]


def _camera_conditions(schema: dict[str, Any]) -> None:
    """Add to the JSON Schema how many distortion coefficients each model takes."""
    schema["allOf"] = [
        {
            # A model that is left out is opencv.
            "if": {
                "properties": {"model": {"const": model.value}},
                **({} if model == "opencv" else {"required": ["model"]}),
            },
            "then": {
                "properties": {
                    "distortion": {"anyOf": [{"minItems": n, "maxItems": n} for n in counts]}
                }
            },
        }
        for model, counts in COEFFICIENT_COUNTS.items()
    ]


class ShutterPart(StrictPart):
    """`shutter` of the camera; global by default."""

    kind: Annotated[
        Literal["global", "rolling", "interlaced"], _doc("Order in which rows are exposed.")
    ] = "global"
    readout_ms: Annotated[
        Number,
        _doc(
            "From the first row to the last, negative if the last comes first, or from the first "
            "field to the second."
        ),
    ] = 0.0
    exposure_ms: Annotated[NotNegative, _doc("Exposure time of a row; 0 if unknown.")] = 0.0
    first_field: Annotated[
        Literal["top", "bottom"], _doc("Of interlaced video; top holds rows 0, 2, 4.")
    ] = "top"


class CameraPart(StrictPart):
    """`camera`: intrinsics, calibrated in air without the dome, and place in the dome."""

    model_config = ConfigDict(json_schema_extra=_camera_conditions)

    model: Annotated[
        Literal["opencv", "fisheye"], _doc("As cv2.projectPoints, or as cv2.fisheye.")
    ] = "opencv"
    fx_px: Annotated[FocalLength, _doc("Focal length along x, in air without the dome.")]
    fy_px: Annotated[FocalLength, _doc("Focal length along y, in air without the dome.")]
    cx_px: Annotated[Number, _doc("Principal point; the centre of the top-left pixel is (0, 0).")]
    cy_px: Annotated[Number, _doc("Principal point; the centre of the top-left pixel is (0, 0).")]
    distortion: Annotated[
        list[Number],
        _doc("opencv: none, or k1 k2 p1 p2 [k3 [k4 k5 k6]]; fisheye: none, or k1 k2 k3 k4."),
    ] = Field(default=[])
    position_mm: Annotated[
        Triple | None,
        _doc("Projection centre of the lens in the frame `dome`; needed behind a dome."),
    ] = None
    rotation_deg: Annotated[
        Triple, _doc("Rotation vector in `dome`, applied after the nominal mounting.")
    ] = Field(default=[0.0, 0.0, 0.0])
    shutter: Annotated[ShutterPart, _doc("When rows are exposed; global by default.")] = (
        ShutterPart()
    )


class DomePart(StrictPart):
    """`dome`: two concentric spheres and the material between them."""

    inner_radius_mm: Annotated[Positive, _doc("Inner radius.")]
    thickness_mm: Annotated[NotNegative, _doc("Thickness of the wall.")]
    n_acrylic: Annotated[Index, _doc("Refractive index of the wall.")]


class FlatPart(StrictPart):
    """`flat`: a plane window, fixed to the camera."""

    distance_mm: Annotated[Positive, _doc("From the lens's projection centre to the inner face.")]
    thickness_mm: Annotated[NotNegative, _doc("Thickness of the window.")]
    n_port: Annotated[Index, _doc("Refractive index of the window.")]
    tilt_deg: Annotated[
        list[Tilt],
        Field(min_length=2, max_length=2),
        _doc("Tilt of its normal from the optical axis, about the camera's x and y axes."),
    ] = Field(default=[0.0, 0.0])


class WaterPart(StrictPart):
    """`water`: its index, or the temperature and salinity that determine it."""

    model_config = ConfigDict(
        json_schema_extra={
            "oneOf": [
                {
                    "required": ["n"],
                    "properties": {
                        name: {"type": "null"}
                        for name in ("temperature_c", "salinity_permille", "wavelength_nm")
                    },
                },
                {
                    "required": ["temperature_c", "salinity_permille"],
                    "properties": {"n": {"type": "null"}},
                },
            ]
        }
    )

    n: Annotated[Index | None, _doc("Index outside, relative to vacuum.")] = None
    temperature_c: Annotated[Number | None, _doc("0 to 30; in place of n.")] = None
    salinity_permille: Annotated[Number | None, _doc("0 to 40; in place of n.")] = None
    wavelength_nm: Annotated[
        Number | None, _doc("Wavelength for the index; by default that of the lasers, or 532.")
    ] = None


class WindowPart(StrictPart):
    """`window` of a laser: its outer face in `dome`, and the light source."""

    normal: Annotated[Triple, _doc("Normal of the window's outer face.")]
    offset_mm: Annotated[
        Number, _doc("Distance of the outer face from the dome's centre along the unit normal.")
    ]
    source_mm: Annotated[Triple, _doc("Point from which the light fans out.")]


class LaserPart(StrictPart):
    """One of `lasers`: a plane in `dome`; `offset_mm` belongs to the unit normal."""

    name: Annotated[Name, _doc("Unique name.")]
    normal: Annotated[Triple, _doc("Normal of the laser's plane in `dome`, of any length.")]
    offset_mm: Annotated[Number, _doc("Distance from the dome's centre along the unit normal.")]
    wavelength_nm: Annotated[
        LaserWavelength | None, _doc("Wavelength of this laser; green by default.")
    ] = None
    window: WindowPart | None = None


def _dome_conditions(schema: dict[str, Any]) -> None:
    """Add to the JSON Schema what must be known where light is refracted."""
    given = {"not": {"type": "null"}}
    window = {"required": ["window"], "properties": {"window": given}}
    dome = {"required": ["dome"], "properties": {"dome": given}}
    flat = {"required": ["flat"], "properties": {"flat": given}}
    sections = (("dome", dome), ("flat", flat))
    lasers = {"required": ["lasers"], "properties": {"lasers": {"contains": window}}}
    water = {"required": ["water"], "properties": {"water": given}}
    lens = {"required": ["position_mm"], "properties": {"position_mm": given}}
    schema["allOf"] = [
        {"if": {"anyOf": [dome, flat, lasers]}, "then": water},
        {"if": dome, "then": {"properties": {"camera": lens}}},
        {"not": {"allOf": [dome, flat]}},
        *(
            {
                "if": {"required": ["housing"], "properties": {"housing": {"const": kind}}},
                "then": {"allOf": [one if own == kind else {"not": one} for own, one in sections]},
            }
            for kind in ("dome", "flat", "none")
        ),
    ]


class RigFile(StrictPart):
    """A whole rig file."""

    model_config = ConfigDict(json_schema_extra=_dome_conditions)

    aqualvs_rig: Annotated[
        int, Field(description="Version of the format.", json_schema_extra={"const": VERSION})
    ]
    name: Annotated[Name, _doc("Name of the rig in reports.")] = "rig"
    image: ImagePart
    camera: CameraPart
    housing: Annotated[
        Literal["dome", "flat", "none"] | None,
        _doc("Follows from the sections `dome` and `flat`, and must agree with them."),
    ] = None
    dome: Annotated[DomePart | None, _doc("Leave it out without a dome.")] = None
    flat: Annotated[FlatPart | None, _doc("Leave it out without a flat port.")] = None
    n_air: Annotated[Index, _doc("Index inside the housing, relative to vacuum.")] = N_AIR
    water: Annotated[
        WaterPart | None, _doc("Water outside; required behind a housing, else air.")
    ] = None
    lasers: Annotated[list[LaserPart], _doc("One laser for points, two for a posture.")] = Field(
        default=[]
    )
    working_range_mm: Annotated[
        Pair, _doc("Nearest and farthest target at which stripes are accepted.")
    ] = Field(default=[250.0, 1300.0])
    solved_from: Annotated[dict[str, Any], _doc("Written by calibrations; preserved.")] = Field(
        default={}
    )


def range_fault(near_mm: float, far_mm: float) -> str:
    """Return what is wrong with a working range in millimetres, "" if nothing is."""
    said = f"working_range_mm is [{near_mm:g}, {far_mm:g}]"
    if not near_mm < far_mm:
        return f"{said}; write the nearest range first, then a larger one"
    # No target is so near to a dome's centre; it is a range in metres.
    min_far_mm = 10.0
    if far_mm < min_far_mm:
        return (
            f"{said}, but these are millimetres; write [{1e3 * near_mm:g}, {1e3 * far_mm:g}] if "
            "metres are meant"
        )
    return ""


def rig_json_schema() -> dict[str, Any]:
    """Return the JSON Schema of the rig file (draft 2020-12), made of the reader's own model.

    It holds what can be said of keys one by one; that a lens is inside its dome, or that names of
    lasers differ, only the reader checks.
    """
    schema = RigFile.model_json_schema()
    title = "Rig file of aqualvs"
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": title}


def parse_rig(content: object, source_name: str) -> RigFile:
    """Check the content of a rig file, key by key.

    Parameters
    ----------
    content : object
        Content of the file as read from YAML.
    source_name : str
        Name of the file in messages.

    Raises
    ------
    RigError
        One line on the first fault: file, place, value, remedy.
    """
    if not isinstance(content, Mapping):
        raise RigError(
            f"{source_name}: is {shown(content)}, not a rig; a rig file is a list of keys that "
            f"begins with 'aqualvs_rig: {VERSION}' (docs/rig.md)"
        )
    if "aqualvs_rig" not in content:
        raise RigError(
            f"{source_name}: aqualvs_rig is missing, so this may not be a rig file; a rig file "
            f"begins with 'aqualvs_rig: {VERSION}' (docs/rig.md)"
        )
    version = content["aqualvs_rig"]
    if type(version) is not int or version != VERSION:
        raise RigError(
            f"{source_name}: aqualvs_rig is {shown(version)}, but this aqualvs reads version "
            f"{VERSION}; write the file again with this aqualvs, or install one that reads it"
        )
    return validated(RigFile, dict(content), source_name, RigError, _WORDS)


_EXAMPLES: dict[str, str] = {
    "image": "image: {width_px: 720, height_px: 576}",
    "width_px": "width_px: 720",
    "height_px": "height_px: 576",
    "camera": "camera: {fx_px: 817.5, ...}",
    "fx_px": "fx_px: 817.5",
    "fy_px": "fy_px: 878.0",
    "cx_px": "cx_px: 359.5",
    "cy_px": "cy_px: 287.5",
    "distortion": "distortion: [-0.126, 0.083, 0.0006, -0.0004]",
    "position_mm": "position_mm: [0.0, 0.0, 0.0]",
    "rotation_deg": "rotation_deg: [0.0, 0.0, 0.0]",
    "shutter": "shutter: {kind: rolling, readout_ms: 20, exposure_ms: 8}",
    "readout_ms": "readout_ms: 20",
    "exposure_ms": "exposure_ms: 8",
    "dome": "dome: {inner_radius_mm: 44.25, thickness_mm: 5.75, n_acrylic: 1.49}",
    "housing": "housing: flat",
    "flat": "flat: {distance_mm: 12.0, thickness_mm: 5.0, n_port: 1.49}",
    "distance_mm": "distance_mm: 12.0",
    "n_port": "n_port: 1.49",
    "tilt_deg": "tilt_deg: [0.0, 0.0]",
    "inner_radius_mm": "inner_radius_mm: 44.25",
    "thickness_mm": "thickness_mm: 5.75",
    "n_acrylic": "n_acrylic: 1.49",
    "n_air": "n_air: 1.0003",
    "water": "water: {n: 1.3333}",
    "n": "n: 1.3333",
    "temperature_c": "temperature_c: 15",
    "salinity_permille": "salinity_permille: 38",
    "wavelength_nm": "wavelength_nm: 532",
    "lasers": "lasers: [{name: left, normal: [1, 0, 0], offset_mm: -140}]",
    "name": "name: left",
    "normal": "normal: [1.0, 0.0, 0.0]",
    "offset_mm": "offset_mm: -140.0",
    "window": "window: {normal: [0, 1, 0], offset_mm: 40, source_mm: [-140, 20, 0]}",
    "source_mm": "source_mm: [-140, 20, 0]",
    "working_range_mm": "working_range_mm: [250, 1300]",
    "solved_from": "solved_from: {views: 14}",
}

_WORDS = SchemaWords(
    file="a rig file",
    examples=_EXAMPLES,
    first_line="aqualvs_rig: 1",
    a_list="a list in square brackets",
    remedies={("lasers", "wavelength_nm"): LASER_NM_REMEDY},
)


def missing_text(place: str) -> str:
    """Return the sentence on a key of a rig file that must be there, such as "camera.fx_px"."""
    return _WORDS.missing(place, tuple(place.split(".")))
