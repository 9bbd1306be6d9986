"""Camera files in OpenCV's model: ROS (`camera_info.yaml`), OpenCV (FileStorage), mrcal.

Those of ROS and OpenCV have OpenCV's camera matrix and distortion coefficients. The names of ROS's
distortion models are those of sensor_msgs/distortion_models.hpp: plumb_bob, rational_polynomial,
equidistant. A `.cameramodel` of mrcal is a Python literal; its models LENSMODEL_PINHOLE and
LENSMODEL_OPENCV4, 5, 8 and 12 are OpenCV's (mrcal, "Lens models"); the centre of the top-left pixel
is (0, 0).
"""

import ast
import re
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np

from aqualvs.calibration_files.camera import Entries, ForeignCamera, opencv_lens, padded
from aqualvs.errors import RigError
from aqualvs.optics.lens import Lens, LensModel
from aqualvs.schema import shown
from aqualvs.yamlfile import parse_yaml, yaml_text

# By distortion model of ROS: possible numbers of coefficients; image_geometry uses all of them.
_ROS_MODELS = {"plumb_bob": (0, 4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (0, 4)}
_FISHEYE = "equidistant"


def read_ros(text: str, source: str) -> ForeignCamera:
    """Return the camera of a `camera_info.yaml`, or of a printed sensor_msgs/CameraInfo.

    Raises `RigError` with one line, without the file's name except for errors of the YAML.
    """
    # `ros2 topic echo` ends each message with this line.
    content = parse_yaml(re.sub(r"(?:^---\s*)+\Z", "", text, flags=re.MULTILINE), source, RigError)
    entries = Entries.top(content)
    _check_whole_picture(entries)
    model = entries.word("distortion_model") or "plumb_bob"
    if model not in _ROS_MODELS:
        raise RigError(
            f"distortion_model is {shown(model)}, which aqualvs lacks; it knows "
            f"{', '.join(_ROS_MODELS)}"
        )
    keys = ("distortion_coefficients", "d", "D")
    distortion = entries.numbers(*keys) if entries.has(*keys) else []
    if len(distortion) not in _ROS_MODELS[model]:
        raise RigError(
            f"{entries.first(keys)} has {len(distortion)} values; {model} takes "
            f"{' or '.join(map(str, _ROS_MODELS[model]))}"
        )
    return ForeignCamera(
        name=entries.name("camera_name", Path(source).stem),
        size_px=(entries.whole("image_width", "width"), entries.whole("image_height", "height")),
        lens=opencv_lens(
            entries.core("camera_matrix", "k", "K"), distortion, fisheye=model == _FISHEYE
        ),
    )


def _check_whole_picture(entries: Entries) -> None:
    """Refuse a message of binned or cropped pictures, to which its intrinsics do not apply."""
    for key in ("binning_x", "binning_y"):
        if entries.has(key) and entries.whole(key) > 1:
            raise RigError(f"{key} is {entries.whole(key)}; calibrate the pictures that are used")
    if entries.has("roi"):
        roi = entries.part("roi")
        for key in ("x_offset", "y_offset"):
            if roi.has(key) and roi.whole(key) > 0:
                raise RigError(
                    f"roi.{key} is {roi.whole(key)}; calibrate the pictures that are used"
                )


def ros_text(camera: ForeignCamera) -> str:
    """Return the `camera_info.yaml` of a camera."""
    lens, (width, height) = camera.lens, camera.size_px or (0, 0)
    if lens.model is LensModel.FISHEYE:
        model, distortion = _FISHEYE, padded(lens, 4)
    elif len(lens.distortion) > 5:
        model, distortion = "rational_polynomial", padded(lens, 8)
    else:
        model, distortion = "plumb_bob", padded(lens, 5)
    matrix = _matrix(lens)
    content = {
        "image_width": width,
        "image_height": height,
        "camera_name": plain_name(camera.name),
        "camera_matrix": {"rows": 3, "cols": 3, "data": matrix.ravel().tolist()},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": [*distortion]},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {
            "rows": 3,
            "cols": 4,
            "data": np.column_stack([matrix, np.zeros(3)]).ravel().tolist(),
        },
    }
    return yaml_text(content)


def plain_name(name: str) -> str:
    """Return a name of letters, digits and underscores only, as ROS requires."""
    return re.sub(r"[^A-Za-z0-9_]+", "_", name) or "camera"


def _matrix(lens: Lens) -> Any:
    return np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])


# Keys that OpenCV's samples and applications, and users of FileStorage, use.
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "mtx", "intrinsic_matrix")
_DISTORTION = (
    *("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs"),
    *("distortion", "dist", "D"),
)
_SIZES = ("image_size", "imageSize", "cameraResolution", "resolution")


def read_opencv(text: str, source: str, *, model: str | None = None) -> ForeignCamera:
    """Return the camera of a FileStorage in YAML, XML or JSON.

    `model`: "opencv" or "fisheye", if the file does not state it (`fisheye_model`). Raises
    `RigError` with one line, without the file's name except for errors of the YAML.
    """
    entries = _storage(text, source)
    core = entries.core(*_MATRIX)
    distortion = entries.numbers(*_DISTORTION) if entries.has(*_DISTORTION) else []
    size_px = None
    if entries.has("image_width", "image_height"):
        size_px = (entries.whole("image_width"), entries.whole("image_height"))
    elif entries.has(*_SIZES):
        size_px = entries.size(*_SIZES)
    if entries.has("fisheye_model"):
        fisheye = entries.whole("fisheye_model") != 0
    elif model is None and len(distortion) == 4 and any(distortion):
        raise RigError(
            "has 4 distortion coefficients, and does not say whether they are of cv2 or of "
            "cv2.fisheye; add --model opencv or --model fisheye"
        )
    else:
        fisheye = model == "fisheye"
    name = entries.name("camera_name", Path(source).stem)
    lens = opencv_lens(core, distortion, fisheye=fisheye)
    return ForeignCamera(name=name, size_px=size_px, lens=lens)


def _storage(text: str, source: str) -> Entries:
    """Return the content of a FileStorage as plain values; matrices have rows, cols and data."""
    if "<opencv_storage>" in text:
        return Entries.top(_xml(text))
    # YAML 1.0 has a header that parsers of later versions refuse, and matrices have OpenCV's tag.
    plain = re.sub(r"\A%YAML[: ]1\.\d[^\n]*\n", "", text)
    return Entries.top(parse_yaml(plain.replace("!!opencv-matrix", ""), source, RigError))


def _xml(text: str) -> dict[str, Any]:
    if "<!" in re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL):
        raise RigError("is XML with declarations, which no FileStorage has; remove them")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as fault:
        raise RigError(f"is not XML: {fault}; fix it") from None
    # Levels that are read; a FileStorage of a camera has two.
    max_depth = 3
    return {node.tag: _xml_value(node, max_depth) for node in root}


def _xml_value(node: ElementTree.Element, depth: int) -> Any:
    if len(node) == 0 or depth == 0:
        return (node.text or "").strip().strip('"') or None
    return {one.tag: _xml_value(one, depth - 1) for one in node}


def opencv_text(camera: ForeignCamera, suffix: str) -> str:
    """Return the FileStorage of a camera: XML or JSON by the suffix of its file, else YAML."""
    ending = suffix.lower() if suffix.lower() in (".xml", ".json") else ".yml"
    storage = cv2.FileStorage(ending, cv2.FileStorage_WRITE | cv2.FileStorage_MEMORY)
    width, height = camera.size_px or (0, 0)
    storage.write("camera_name", plain_name(camera.name))
    storage.write("image_width", width)
    storage.write("image_height", height)
    storage.write("fisheye_model", int(camera.lens.model is LensModel.FISHEYE))
    storage.write("camera_matrix", _matrix(camera.lens))
    # Both models of OpenCV need at least four coefficients.
    n = max(4, len(camera.lens.distortion))
    storage.write("distortion_coefficients", np.array([padded(camera.lens, n)]))
    return storage.releaseAndGetString()


# By lens model of mrcal: number of distortion coefficients.
_COUNTS = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{n}": n for n in (4, 5, 8, 12)}


def read_mrcal(text: str, source: str) -> ForeignCamera:
    """Return the camera of a `.cameramodel`.

    Raises `RigError` with one line, without the file's name.
    """
    try:
        with warnings.catch_warnings():
            # The parser prints warnings on odd literals.
            warnings.simplefilter("ignore")
            content = ast.literal_eval(text.strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        raise RigError("is not a Python literal, as a cameramodel is; fix it") from None
    entries = Entries.top(content)
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

    Raises `RigError` if mrcal lacks the camera's model.
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
