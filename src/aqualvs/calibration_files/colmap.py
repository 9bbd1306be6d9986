"""Cameras of COLMAP and of Refractive COLMAP (`cameras.txt`).

A line is `CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]` (COLMAP, "Output Format"); the order of the
parameters is that of src/colmap/sensor/models.h. The centre of the top-left pixel is (0.5, 0.5).

Refractive COLMAP (colmap_underwater, arXiv:2403.08640) appends `DOMEPORT Cx Cy Cz int_radius
int_thick na ng nw` or `FLATPORT Nx Ny Nz int_dist int_thick na ng nw`
(src/colmap/sensor/models_refrac.h, WriteCamerasText in reconstruction.cc): the dome's centre or the
port's unit normal in `cam`, inner radius or distance of the inner face from the lens, and
thickness, all in metres, and the refractive indices of air, housing and water. A later version
writes the word REFRAC before these; it is read as well.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from aqualvs.calibration_files.camera import (
    ForeignCamera,
    ForeignHousing,
    number,
    opencv_lens,
    padded,
    whole,
)
from aqualvs.calibration_files.kalibr import one_of
from aqualvs.errors import RigError
from aqualvs.optics.dome import Dome
from aqualvs.optics.flat_port import FlatPort
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.schema import shown

# Position of the centre of the top-left pixel.
_HALF = 0.5
_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}
_FISHEYE = "OPENCV_FISHEYE"
_ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_TOKEN = "REFRAC"
_DOME, _FLAT = "DOMEPORT", "FLATPORT"
_PORTS = {
    _DOME: ("Cx", "Cy", "Cz", "int_radius", "int_thick", "na", "ng", "nw"),
    _FLAT: ("Nx", "Ny", "Nz", "int_dist", "int_thick", "na", "ng", "nw"),
}


class _Row(NamedTuple):
    """Words of one camera's line."""

    model: str
    size: Sequence[str]
    params: Sequence[str]
    port: Sequence[str]


def read_colmap(text: str, source: str, *, name: str | None = None) -> ForeignCamera:
    """Return one camera of a `cameras.txt`.

    `name`: CAMERA_ID; required if there are several cameras. Raises `RigError` with one line,
    without the file's name.
    """
    rows: dict[str, _Row] = {}
    for n_line, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] in rows:
            raise RigError(f"line {n_line}: camera {shown(words[0])} appears twice; keep one")
        rows[words[0]] = _row(words, n_line)
    chosen = one_of([*rows], name)
    row, place = rows[chosen], f"camera {chosen}"
    width, height = (whole(number(one, f"{place}: size"), f"{place}: size") for one in row.size)
    return ForeignCamera(
        name=f"{Path(source).stem}_{chosen}" if len(rows) > 1 else Path(source).stem,
        size_px=(width, height),
        lens=_lens(row, place),
        port=_port(row.port, place) if row.port else None,
    )


def _row(words: Sequence[str], n_line: int) -> _Row:
    """Split one camera's line; a later version's word before the port is dropped."""
    if len(words) < 5:
        raise RigError(
            f"line {n_line}: has {len(words)} values; a camera is CAMERA_ID MODEL WIDTH HEIGHT and "
            "its parameters"
        )
    params = list(words[4:])
    first = next((i for i, word in enumerate(params) if word[0].isalpha()), len(params))
    port = params[first:]
    return _Row(words[1], words[2:4], params[:first], port[1:] if port[:1] == [_TOKEN] else port)


def _lens(row: _Row, place: str) -> Lens:
    """Return the lens of a camera's line."""
    if row.model not in _MODELS:
        raise RigError(
            f"{place} has the model {shown(row.model)}, which aqualvs lacks; use one of "
            f"{', '.join(_MODELS)}"
        )
    values = _named(row.params, _MODELS[row.model], f"{place}: {row.model}")
    f = values.get("f", 0.0)
    core = (values.get("fx", f), values.get("fy", f), values["cx"] - _HALF, values["cy"] - _HALF)
    if row.model == _FISHEYE:
        return opencv_lens(core, [values[key] for key in ("k1", "k2", "k3", "k4")], fisheye=True)
    known = [values.get(key, 0.0) for key in _ORDER]
    n = 0 if "k1" not in values else 8 if "k6" in values else 4
    return opencv_lens(core, known[:n], fisheye=False)


def _port(words: Sequence[str], place: str) -> ForeignHousing:
    """Return the housing by the words after the lens's parameters."""
    model = words[0]
    if model not in _PORTS:
        raise RigError(
            f"{place} is behind {shown(model)}; of refractive models aqualvs knows "
            f"{' and '.join(_PORTS)}"
        )
    values = _named(words[1:], _PORTS[model], f"{place}: {model}")
    x, y, z, size, thickness, n_air, n_port, n_water = values.values()
    if model == _DOME:
        return ForeignHousing(Dome(size, thickness, n_port), n_air, n_water, np.array([x, y, z]))
    length = math.hypot(x, y, z)
    # The normal may be written with few digits.
    tolerance = 1e-3
    if not abs(length - 1.0) <= tolerance:
        raise RigError(
            f"{place}: {model}: the normal Nx Ny Nz has the length {length:g}; write a unit vector"
        )
    tilts = math.atan2(-y, z), math.asin(x / length)
    return ForeignHousing(FlatPort(size, thickness, n_port, *tilts), n_air, n_water)


def _named(words: Sequence[str], names: Sequence[str], place: str) -> Mapping[str, float]:
    if len(words) != len(names):
        raise RigError(f"{place} has {len(words)} values; write {len(names)}: {', '.join(names)}")
    return {name: number(word, f"{place}: {name}") for name, word in zip(names, words, strict=True)}


def colmap_text(camera: ForeignCamera, *, refractive: bool) -> str:
    """Return the `cameras.txt` of one camera.

    `refractive`: whether to write the housing, for Refractive COLMAP. Raises `RigError` if there is
    no housing to write.
    """
    if refractive and camera.port is None:
        raise RigError(
            "the rig has no housing, which Refractive COLMAP is for; write it with colmap"
        )
    lens, (width, height) = camera.lens, camera.size_px or (0, 0)
    n = len(lens.distortion)
    if lens.model is LensModel.FISHEYE:
        model, distortion = _FISHEYE, padded(lens, 4)
    elif n == 0:
        model, distortion = "PINHOLE", ()
    else:
        model, n = ("FULL_OPENCV", 8) if n > 4 else ("OPENCV", 4)
        distortion = padded(lens, n)
    core = (lens.fx, lens.fy, lens.cx + _HALF, lens.cy + _HALF)
    params = [repr(float(one)) for one in (*core, *distortion)]
    head = "# Camera list with one line of data per camera:\n"
    line = f"1 {model} {width} {height} {' '.join(params)}"
    if not refractive or camera.port is None:
        return f"{head}#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n{line}\n"
    port, housing = camera.port, camera.port.housing
    if isinstance(housing, Dome):
        of_housing = (*port.centre, housing.inner_radius, housing.thickness)
        refraction, n_port = _DOME, housing.n_acrylic
    else:
        of_housing = (*housing.normal_in_cam, housing.distance, housing.thickness)
        refraction, n_port = _FLAT, housing.n_port
    values = [repr(float(one)) for one in (*of_housing, port.n_air, n_port, port.n_water)]
    return (
        f"{head}#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] OPTIONAL[REFRAC_MODEL "
        "REFRAC_PARAMS[]]\n"
        "# For colmap feature_extractor:\n"
        f"#   --ImageReader.camera_model {model} --ImageReader.camera_params {','.join(params)}\n"
        f"#   --ImageReader.camera_refrac_model {refraction} "
        f"--ImageReader.camera_refrac_params {','.join(values)}\n"
        f"{line} {refraction} {' '.join(values)}\n"
    )
