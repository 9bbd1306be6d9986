"""What is known of a rig before any calibration: its name, pictures, dome and lasers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from aqualvs.errors import RigError
from aqualvs.optics.camera import Dome
from aqualvs.optics.rig import Laser
from aqualvs.optics.rigfile import load_rig
from aqualvs.optics.rigschema import LaserWavelength
from aqualvs.yamlfile import read_yaml

WATER_N = 1.3340
"""Index assumed until something better is known: fresh water of 15 °C under green light."""
N_LASERS = "n_lasers"
"""Key of `Rig.solved_from` under which a rig without lasers keeps how many it will have."""
WAVELENGTH_NM = "wavelength_nm"
"""Likewise for their wavelength, in nanometres."""

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Index = Annotated[float, Field(ge=1.0, le=2.0, allow_inf_nan=False)]
_Count = Annotated[int, Field(gt=0)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Nominal:
    """A rig as its drawings tell it.

    Attributes
    ----------
    name : str
    size_px : (int, int) or None
        Image width and height.
    dome : Dome or None
    n_air, n_water : float
    n_lasers : int or None
    wavelength_nm : float or None
        Of the lasers; None if nothing is said, or if they differ.
    working_range : (float, float)
        Metres.
    """

    name: str = "rig"
    size_px: tuple[int, int] | None = None
    dome: Dome | None = None
    n_air: float = 1.0003
    n_water: float = WATER_N
    n_lasers: int | None = None
    wavelength_nm: float | None = None
    working_range: tuple[float, float] = (0.25, 1.3)


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class _Image(_Part):
    width: _Count
    height: _Count


class _Dome(_Part):
    inner_radius_mm: _Positive
    thickness_mm: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    n_acrylic: _Index = 1.49


class _Lasers(_Part):
    count: _Count
    wavelength_nm: LaserWavelength | None = None


class _File(_Part):
    name: str = "rig"
    image: _Image | None = None
    dome: _Dome | None = None
    n_air: _Index = 1.0003
    lasers: _Lasers | None = None
    fps: _Positive | None = None


def load_nominal(path: Path) -> Nominal:
    """Read a nominal rig, or take over what a rig file knows.

    Raises
    ------
    RigError
        One line that names the file, the place in it, the value and the remedy.
    """
    content = read_yaml(path, "a nominal rig or a rig file", RigError)
    if not isinstance(content, Mapping):
        raise RigError(f"{path}: is not a nominal rig; write keys such as 'dome: ...'")
    return _of_rig_file(path) if "aqualvs_rig" in content else _of_mapping(content, path)


def common_wavelength(lasers: Sequence[Laser]) -> float | None:
    """Return the wavelength of lasers (nm); None if they differ, or nothing is said of it."""
    found = {laser.wavelength_nm for laser in lasers}
    return found.pop() if len(found) == 1 else None


def _of_rig_file(path: Path) -> Nominal:
    rig = load_rig(path, need_lasers=False)
    return Nominal(
        name=rig.name,
        size_px=rig.size_px,
        dome=rig.dome,
        n_air=rig.n_air,
        n_water=rig.n_water,
        n_lasers=len(rig.lasers) or None,
        wavelength_nm=common_wavelength(rig.lasers),
        working_range=rig.working_range,
    )


def _of_mapping(content: Mapping[str, Any], path: Path) -> Nominal:
    try:
        file = _File.model_validate(dict(content))
    except ValidationError as error:
        fault = error.errors(include_url=False)[0]
        place = ".".join(map(str, fault["loc"]))
        raise RigError(
            f"{path}: {place} is {fault['input']!r}: {fault['msg'].lower()}; a nominal rig has "
            f"{', '.join(_File.model_fields)}"
        ) from None
    part = file.dome
    return Nominal(
        name=file.name,
        size_px=None if file.image is None else (file.image.width, file.image.height),
        dome=None
        if part is None
        else Dome(part.inner_radius_mm / 1e3, part.thickness_mm / 1e3, part.n_acrylic),
        n_air=file.n_air,
        n_lasers=None if file.lasers is None else file.lasers.count,
        wavelength_nm=None if file.lasers is None else file.lasers.wavelength_nm,
    )
