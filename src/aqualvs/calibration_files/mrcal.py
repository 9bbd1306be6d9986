"""Camera models of mrcal (`.cameramodel`).

A file is a Python literal. The models LENSMODEL_PINHOLE and LENSMODEL_OPENCV4, 5, 8 and 12 are
OpenCV's (mrcal, "Lens models"); the centre of the top-left pixel is (0, 0).
"""

import ast
import warnings
from collections.abc import Mapping
from pathlib import Path

from aqualvs.calibration_files.camera import ForeignCamera, opencv_lens, padded
from aqualvs.calibration_files.entries import Entries, shown
from aqualvs.errors import RigError
from aqualvs.optics.lens import LensModel

_COUNTS = {
    "LENSMODEL_PINHOLE": 0,
    "LENSMODEL_OPENCV4": 4,
    "LENSMODEL_OPENCV5": 5,
    "LENSMODEL_OPENCV8": 8,
    "LENSMODEL_OPENCV12": 12,
}


def read_mrcal(text: str, source: str) -> ForeignCamera:
    """Return the camera of a `.cameramodel`.

    Raises
    ------
    RigError
        One line without the file's name.
    """
    try:
        with warnings.catch_warnings():
            # Of odd literals the parser warns on standard error.
            warnings.simplefilter("ignore")
            content = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        raise RigError("is no Python literal, as a cameramodel is; mend it") from None
    if not isinstance(content, Mapping):
        raise RigError("holds no keys and values; give the whole file")
    entries = Entries(content)
    model = entries.word("lensmodel", "lens_model")
    if model not in _COUNTS:
        raise RigError(
            f"lensmodel is {shown(model)}, which aqualvs lacks; fit another with "
            "'mrcal-convert-lensmodel LENSMODEL_OPENCV8'"
        )
    core = entries.listed(4 + _COUNTS[model], "intrinsics")
    return ForeignCamera(
        name=Path(source).stem,
        size_px=entries.size("imagersize"),
        lens=opencv_lens(core[:4], core[4:], fisheye=False),
    )


def mrcal_text(camera: ForeignCamera) -> str:
    """Return the `.cameramodel` of a camera.

    Raises
    ------
    RigError
        If mrcal lacks the camera's model.
    """
    lens = camera.lens
    if lens.model is LensModel.FISHEYE:
        raise RigError("the lens is a fisheye, whose model mrcal lacks; choose another format")
    n = len(lens.distortion)
    name = f"LENSMODEL_OPENCV{n}" if n else "LENSMODEL_PINHOLE"
    values = [float(one) for one in (lens.fx, lens.fy, lens.cx, lens.cy, *padded(lens, n))]
    return (
        "{\n"
        f"    'lensmodel':  '{name}',\n\n"
        "    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
        f"    'intrinsics': {values},\n\n"
        "    # extrinsics are rt_fromref\n"
        "    'extrinsics': [ 0, 0, 0, 0, 0, 0 ],\n\n"
        f"    'imagersize': {[*(camera.size_px or (0, 0))]}\n"
        "}\n"
    )
