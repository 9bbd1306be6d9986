"""Files of Kalibr: `camchain.yaml`, and targets.

The keys are those of Kalibr's wiki, "Yaml formats" and "Calibration targets". Pixels are OpenCV's.
"""

from collections.abc import Mapping

from aqualvs.calibration.targets.targets import Board, BoardKind
from aqualvs.calibration_files.camera import Entries, ForeignCamera, opencv_lens, padded
from aqualvs.calibration_files.opencv import plain_name
from aqualvs.errors import CalibrationError, RigError
from aqualvs.optics.lens import LensModel
from aqualvs.schema import shown
from aqualvs.yamlfile import parse_yaml, yaml_text

# By distortion model: whether it is a fisheye, and its number of coefficients.
_DISTORTIONS = {
    "radtan": (False, 4),
    "equi": (True, 4),
    "equidistant": (True, 4),
    "none": (False, 0),
}


def read_kalibr(text: str, source: str, *, name: str | None = None) -> ForeignCamera:
    """Return one camera of a `camchain.yaml`.

    `name`: key of the camera, such as "cam0"; required if there are several. Raises `RigError` with
    one line, without the file's name except for errors of the YAML.
    """
    top = Entries.top(parse_yaml(text, source, RigError))
    cameras = [
        str(key)
        for key, value in top.content.items()
        if isinstance(value, Mapping) and "camera_model" in value
    ]
    chosen = one_of(cameras, name)
    camera = top.part(chosen)
    model = camera.word("camera_model")
    if model != "pinhole":
        raise RigError(
            f"{chosen}.camera_model is {shown(model)}, which aqualvs lacks; calibrate with "
            "pinhole-radtan or pinhole-equi"
        )
    distortion = camera.word("distortion_model") if camera.has("distortion_model") else "none"
    if distortion not in _DISTORTIONS:
        raise RigError(
            f"{chosen}.distortion_model is {shown(distortion)}, which aqualvs lacks; calibrate "
            "with pinhole-radtan or pinhole-equi"
        )
    fisheye, n = _DISTORTIONS[distortion]
    return ForeignCamera(
        name=chosen,
        size_px=camera.size("resolution"),
        lens=opencv_lens(
            camera.listed(4, "intrinsics"),
            camera.listed(n, "distortion_coeffs") if n else (),
            fisheye=fisheye,
        ),
    )


def one_of(cameras: list[str], name: str | None) -> str:
    """Return the name of the requested camera, or of the only one.

    Raises `RigError` if there is no camera of that name, or several and no name.
    """
    listed = ", ".join(cameras[:20])
    if not cameras:
        raise RigError("holds no camera; give the whole file")
    if name is None and len(cameras) > 1:
        raise RigError(f"holds the cameras {listed}; say which, such as --camera {cameras[0]}")
    if name is not None and name not in cameras:
        raise RigError(f"holds no camera {name!r}; give one of {listed} with --camera")
    return name or cameras[0]


def kalibr_text(camera: ForeignCamera) -> str:
    """Return the `camchain.yaml` of one camera.

    Raises `RigError` if Kalibr lacks the camera's model.
    """
    lens = camera.lens
    if lens.model is LensModel.FISHEYE:
        model = "equidistant"
    else:
        model = "radtan" if lens.distortion else "none"
    content = {
        "cam0": {
            "cam_overlaps": [],
            "camera_model": "pinhole",
            "distortion_coeffs": [*padded(lens, 0 if model == "none" else 4)],
            "distortion_model": model,
            "intrinsics": [lens.fx, lens.fy, lens.cx, lens.cy],
            "resolution": [*(camera.size_px or (0, 0))],
            "rostopic": f"/{plain_name(camera.name)}/image_raw",
        }
    }
    return yaml_text(content)


def read_kalibr_target(text: str, source: str) -> Board:
    """Return the board of a target file.

    Raises `RigError` with one line, without the file's name except for errors of the YAML; also for
    targets that aqualvs cannot detect.
    """
    target = Entries.top(parse_yaml(text, source, RigError))
    kind = target.word("target_type")
    if kind == "aprilgrid":
        raise RigError(
            "is an aprilgrid, whose tags with borders of two bits aqualvs does not find; print a "
            "board with 'aqualvs board charuco', or give a checkerboard"
        )
    if kind != "checkerboard":
        raise RigError(f"target_type is {shown(kind)}, which aqualvs lacks; give a checkerboard")
    across, down = target.number("colSpacingMeters"), target.number("rowSpacingMeters")
    if across != down:
        raise RigError(
            f"colSpacingMeters is {across:g} and rowSpacingMeters {down:g}; aqualvs takes squares"
        )
    try:
        return Board(
            kind=BoardKind.CHESSBOARD,
            squares=(target.whole("targetCols") + 1, target.whole("targetRows") + 1),
            square=across,
        )
    except CalibrationError as fault:
        raise RigError(f"is {fault}") from None
