"""`design.yaml`: values of a design known before purchase, in millimetres and degrees."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field

from aqualvs.design.settings import (
    Design,
    Goals,
    Mount,
    Noise,
    NominalNet,
    Tolerances,
    mount_of_laser,
    ring,
    tangential,
)
from aqualvs.errors import OptionError, RigError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig
from aqualvs.optics.rigfile import housing_of, load_rig, shutter_from_part, water_index
from aqualvs.optics.rigschema import ShutterPart, Tilt, WaterPart, range_fault
from aqualvs.optics.shutter import AT_ONCE, Shutter
from aqualvs.optics.water import N_AIR
from aqualvs.schema import (
    NUMBER,
    WORD,
    Index,
    NotNegative,
    Number,
    Positive,
    StrictPart,
    parse_settings,
    si_values,
    twine_fault,
)
from aqualvs.yamlfile import read_yaml

KEY, VERSION = "aqualvs_design", 1
FAN_DEG = 68.0
"""Default full opening of a fan: that of the simulator's lasers."""

EXAMPLE = """\
# A design for aqualvs design: lengths in mm, angles in degrees, frame 'dome' (docs/hardware.md).
aqualvs_design: 1
name: rov
camera: {width_px: 1920, height_px: 1080, fov_deg: 69}  # across, in air; or {rig: calibrated.yaml}
dome: {inner_radius_mm: 51, thickness_mm: 6, n_acrylic: 1.49}  # leave out for a bare lens
# or, in place of dome: flat: {distance_mm: 12, thickness_mm: 5, n_port: 1.49}
lens: {position_mm: [0, 6, 0], centring_mm: 1}
water: {temperature_c: 12, salinity_permille: 35}  # or {n: 1.3400}
lasers: {count: 3, baseline_mm: 150, back_mm: 0, fan_deg: 68}
# or, in place of lasers, one by one; tilts that are left out are optimised:
# mounts:
# - {name: lower, position_mm: [0, 0, -150], stripe_deg: 0}
# - {name: left, position_mm: [-160, 0, 0], stripe_deg: 90, tilt_deg: 12, fan_deg: 60}
working_range_mm: [300, 1200]
net: {bar_mm: 15, twine_mm: 2.5}
goals: {range_percent: 0.5, angle_deg: 0.5}  # errors that are equally bad
avoid_crossings: true
"""

_MM = 1e3

# Larger numbers are mistakes: 100 m, and the pictures of the largest cameras.
_MAX_MM, _MAX_PX = 1e5, 32_768
_Place = Annotated[float, Field(ge=-_MAX_MM, le=_MAX_MM, allow_inf_nan=False)]
_Length = Annotated[float, Field(gt=0.0, le=_MAX_MM, allow_inf_nan=False)]
_Triple = Annotated[list[_Place], Field(min_length=3, max_length=3)]
_Pixels = Annotated[int, Field(gt=0, le=_MAX_PX)]
_Fan = Annotated[float, Field(gt=0.0, lt=180.0, allow_inf_nan=False)]
_Tilt = Annotated[float, Field(gt=-80.0, lt=80.0, allow_inf_nan=False)]


def _stripe_kind(value: object) -> str | None:
    if value == "best":
        return WORD.tag
    return None if isinstance(value, str) else NUMBER.tag


_Stripe = Annotated[
    Annotated[Number, NUMBER] | Annotated[Literal["best"], WORD],
    Discriminator(
        _stripe_kind,
        custom_error_type="stripe",
        custom_error_message="write a plain number, or 'best'",
    ),
]


class CameraDesign(StrictPart):
    """Schema of `camera`: size and field of view, or a rig file with its intrinsics."""

    width_px: _Pixels | None = None
    height_px: _Pixels | None = None
    fov_deg: Annotated[float, Field(gt=0.0, lt=220.0, allow_inf_nan=False)] | None = None
    model: Literal["opencv", "fisheye"] = "opencv"
    rig: str | None = None
    shutter: ShutterPart | None = None


class DomeDesign(StrictPart):
    """Schema of `dome`."""

    inner_radius_mm: _Length
    thickness_mm: Annotated[float, Field(ge=0.0, le=_MAX_MM, allow_inf_nan=False)]
    n_acrylic: Index = 1.49


class FlatDesign(StrictPart):
    """Schema of `flat`."""

    distance_mm: _Length
    thickness_mm: Annotated[float, Field(ge=0.0, le=_MAX_MM, allow_inf_nan=False)]
    n_port: Index = 1.49
    tilt_deg: Annotated[list[Tilt], Field(min_length=2, max_length=2)] = Field(default=[0.0, 0.0])


class LensDesign(StrictPart):
    """Schema of `lens`: nominal projection centre, and its tolerance."""

    position_mm: _Triple = Field(default=[0.0, 0.0, 0.0])
    centring_mm: NotNegative = 1.0


class LasersDesign(StrictPart):
    """Schema of `lasers`: evenly spaced around the dome."""

    count: Annotated[int, Field(ge=1, le=8)] = 3
    baseline_mm: _Length
    back_mm: _Place = 0.0
    fan_deg: _Fan = FAN_DEG
    turn_stripes: bool = False


class MountPart(StrictPart):
    """Schema of one of `mounts`; missing angles are optimised."""

    name: str
    position_mm: _Triple
    stripe_deg: _Stripe | None = None
    tilt_deg: _Tilt | None = None
    fan_deg: _Fan = FAN_DEG


class NetPart(StrictPart):
    """Schema of `net`."""

    bar_mm: _Length = 15.0
    twine_mm: _Length = 2.5


class NoisePart(StrictPart):
    """Schema of `noise`: one sigma, see docs/hardware.md."""

    point_px: Positive = Noise().point
    strand_px: Positive = Noise().strand
    shared_px: NotNegative = Noise().shared
    stripe_mm: NotNegative = 1e3 * Noise().stripe
    twine_percent: NotNegative = 100.0 * Noise().twine


class TolerancesPart(StrictPart):
    """Schema of `tolerances`: one sigma of the errors after calibration."""

    lens_mm: NotNegative = 0.03
    rotation_deg: NotNegative = 0.01
    focal_percent: NotNegative = 0.01
    dome_mm: NotNegative = 0.05
    n_water: NotNegative = 0.0003
    laser_deg: NotNegative = 0.005
    laser_mm: NotNegative = 0.07


class GoalsPart(StrictPart):
    """Schema of `goals`."""

    range_percent: Positive = 0.5
    angle_deg: Positive = 0.5


class DesignFile(StrictPart):
    """Schema of a whole design file."""

    aqualvs_design: int
    name: str = "design"
    camera: CameraDesign
    dome: DomeDesign | None = None
    flat: FlatDesign | None = None
    lens: LensDesign = LensDesign()
    water: WaterPart = WaterPart(n=1.3345)
    lasers: LasersDesign | None = None
    mounts: Annotated[list[MountPart], Field(min_length=1)] | None = None
    working_range_mm: Annotated[list[_Length], Field(min_length=2, max_length=2)]
    net: NetPart = NetPart()
    noise: NoisePart = NoisePart()
    tolerances: TolerancesPart = TolerancesPart()
    goals: GoalsPart = GoalsPart()
    avoid_crossings: bool = True


def load_design(path: Path, given: Mapping[str, Any] | None = None) -> Design:
    """Read a design file.

    `given`: replacements of the file's values by the command line, see `merged_content`. Raises
    `OptionError` or `RigError` with one line: file, place, value, remedy.
    """
    content = read_yaml(path, "a design file", OptionError)
    if not isinstance(content, Mapping):
        raise OptionError(f"{path}: is not a design file, which begins with '{KEY}: {VERSION}'")
    merged = merged_content(content, given or {})
    return design_from(merged, name=str(path), folder=path.parent)


def merged_content(content: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a file with some values replaced; `given` maps a part to its keys.

    A flat port replaces the dome and the lens's position in it; a dome replaces a flat port.
    """
    merged = dict(content)
    if "flat" in given and "dome" not in given and "dome" in merged:
        del merged["dome"]
        merged["lens"] = {
            key: v for key, v in merged.get("lens", {}).items() if key != "position_mm"
        }
    elif "dome" in given and "flat" not in given:
        merged.pop("flat", None)
    for part, values in given.items():
        if part == "lasers" and "mounts" in merged:
            raise OptionError("the file has mounts one by one; change them there, not by options")
        here = merged.get(part)
        if isinstance(here, Mapping) and isinstance(values, Mapping):
            merged[part] = {**here, **values}
        else:
            merged[part] = values
    return merged


def design_from(content: object, *, name: str, folder: Path) -> Design:
    """Return the design that the content of a design file, as read from YAML, describes.

    `name` stands in messages; the path of a rig file in it is relative to `folder`. Raises
    `OptionError` or `RigError` with one line: file, place, value, remedy.
    """
    file = parse_settings(content, DesignFile, KEY, VERSION, name)
    try:
        return _design(file, folder)
    except (OptionError, RigError) as fault:
        raise type(fault)(f"{name}: {fault}") from None


def design_of_rig(rig: Rig, fan_deg: float = FAN_DEG) -> Design:
    """Return the design of an existing rig: its lasers keep their positions, but may be tilted.

    `fan_deg`: full fan angle of the lasers. Raises `RigError` if a laser draws no stripe.
    """
    fan = math.radians(fan_deg)
    mounts = tuple(mount_of_laser(laser, rig, fan) for laser in rig.lasers)
    return Design(rig=rig, mounts=mounts)


def _design(file: DesignFile, folder: Path) -> Design:
    """Return the design of a checked file; `folder` is that of rig files it names."""
    near, far = (value / _MM for value in file.working_range_mm)
    fault = range_fault(*file.working_range_mm) or twine_fault(file.net.twine_mm, file.net.bar_mm)
    if fault:
        raise OptionError(fault)
    lens, size_px, shutter = _camera(file.camera, folder)
    position = np.array(file.lens.position_mm) / _MM
    rig = Rig(
        name=file.name,
        size_px=size_px,
        lens=lens,
        dome_from_cam=SE3(DOME_FROM_CAM_NOMINAL, position),
        housing=housing_of(file.dome, file.flat),
        n_air=N_AIR,
        n_water=water_index(file.water, N_AIR, ()),
        lasers=(),
        working_range=(near, far),
        shutter=shutter,
    )
    rig.camera()
    tolerances = file.tolerances
    return Design(
        rig=rig,
        mounts=_mounts(file),
        centring=file.lens.centring_mm / _MM,
        noise=Noise(**si_values(file.noise)),
        tolerances=Tolerances(
            lens=tolerances.lens_mm / _MM,
            rotation=math.radians(tolerances.rotation_deg),
            focal=tolerances.focal_percent / 100.0,
            dome=tolerances.dome_mm / _MM,
            n_water=tolerances.n_water,
            laser_angle=math.radians(tolerances.laser_deg),
            laser_offset=tolerances.laser_mm / _MM,
        ),
        net=NominalNet(**si_values(file.net)),
        goals=Goals(
            range_share=file.goals.range_percent / 100.0, angle=math.radians(file.goals.angle_deg)
        ),
        avoid_crossings=file.avoid_crossings,
    )


def _camera(camera: CameraDesign, folder: Path) -> tuple[Lens, tuple[int, int], Shutter]:
    """Return lens, picture size and shutter, of a rig file or for a field of view."""
    given = AT_ONCE if camera.shutter is None else shutter_from_part(camera.shutter)
    if camera.rig is not None:
        if camera.width_px or camera.height_px or camera.fov_deg:
            raise OptionError(
                "camera names a rig and numbers of its own; keep either 'rig', or width_px, "
                "height_px and fov_deg"
            )
        rig = load_rig(folder / camera.rig, need_lasers=False)
        return rig.lens, rig.size_px, rig.shutter if camera.shutter is None else given
    width, height, fov_deg = camera.width_px, camera.height_px, camera.fov_deg
    if width is None or height is None or fov_deg is None:
        raise OptionError(
            "camera lacks a number; write width_px, height_px and fov_deg, or 'rig: FILE' of a "
            "calibrated camera"
        )
    half = math.radians(fov_deg) / 2.0
    fisheye = camera.model == "fisheye"
    if not fisheye and fov_deg >= 150.0:
        raise OptionError(
            f"camera.fov_deg is {fov_deg:g}, too wide for the opencv model; add 'model: fisheye'"
        )
    focal = 0.5 * width / (half if fisheye else math.tan(half))
    middle = (width - 1) / 2.0, (height - 1) / 2.0
    model = LensModel(camera.model)
    lens = Lens(model=model, fx=focal, fy=focal, cx=middle[0], cy=middle[1])
    return lens, (width, height), given


def _mounts(file: DesignFile) -> tuple[Mount, ...]:
    """Return the mounts: evenly spaced around the dome, or one by one."""
    lasers, mounts = file.lasers, file.mounts
    if (lasers is None) == (mounts is None):
        raise OptionError("write either 'lasers' (evenly round the dome) or 'mounts' (one by one)")
    if lasers is not None:
        values = si_values(lasers)
        turn = values.pop("turn_stripes")
        return tuple(replace(mount, free_stripe=turn) for mount in ring(**values))
    assert mounts is not None
    names = [part.name for part in mounts]
    if len(set(names)) < len(names):
        raise OptionError("two mounts have one name; give each a name of its own")
    return tuple(_mount(part) for part in mounts)


def _mount(part: MountPart) -> Mount:
    """Return one mount; a missing tilt is free, a missing stripe direction tangential."""
    x, y, z = (value / _MM for value in part.position_mm)
    given = part.stripe_deg
    stripe = math.radians(given) % math.pi if isinstance(given, float | int) else None
    return Mount(
        name=part.name,
        position=(x, y, z),
        stripe=tangential((x, y, z)) if stripe is None else stripe,
        tilt=math.radians(part.tilt_deg or 0.0),
        fan=math.radians(part.fan_deg),
        free_tilt=part.tilt_deg is None,
        free_stripe=given == "best",
    )
