"""Common parts of all calibrations: nominal rig, target detection in pictures, result, output.

The nominal rig (`load_nominal`) is known before any calibration: name, picture size, dome, lasers.
`calibrate_camera`, `calibrate_dome`, `calibrate_lasers` and `calibrate_water` return a
`Calibration`; the commands of `aqualvs calibrate` write it to a rig file and a page.
"""

import contextlib
import glob
import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Generic, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from aqualvs.calibration.camera.calibrate import CameraCalibration
from aqualvs.calibration.detection.detection import detect_board
from aqualvs.calibration.solver.result import DomeCalibration, ViewFit, rms_px
from aqualvs.calibration.targets.target_files import load_board
from aqualvs.calibration.targets.targets import Board, View
from aqualvs.calibration.water_index.estimator import N_WATER
from aqualvs.calibration_formats import refuse_foreign
from aqualvs.errors import CalibrationError, OptionError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.camera import Housing
from aqualvs.optics.rig import Rig, RigUncertainty, common_wavelength
from aqualvs.optics.rigfile import housing_of, keep_dated, load_rig, save_rig, shutter_from_part
from aqualvs.optics.rigschema import LaserWavelength, ShutterPart, range_fault
from aqualvs.optics.shutter import AT_ONCE, Shutter
from aqualvs.optics.water import N_AIR, Dispersion
from aqualvs.report.calibration_material import (
    CalibrationPage,
    ResidualMap,
    ViewRow,
    missed_rows,
    residual_map,
)
from aqualvs.report.calibration_page import write_page
from aqualvs.results.files import writing
from aqualvs.results.run_request import checked_index
from aqualvs.schema import Index, NotNegative, Positive, SchemaWords, StrictPart, validated
from aqualvs.sources.images import (
    IMAGE_SUFFIXES,
    VIDEO_SUFFIXES,
    is_image_name,
    natural_key,
    read_image,
    refuse_stack,
)
from aqualvs.special_files import refuse_special
from aqualvs.terminal import Echo, progress
from aqualvs.text import count_text
from aqualvs.yamlfile import parse_yaml, read_text

WATER_N = 1.3340
"""Default index: fresh water in green light has 1.334 to 1.336, the sea 1.340 to 1.343."""
N_LASERS = "n_lasers"
"""Key of `Rig.solved_from`: planned number of lasers of a rig that has none yet."""
WAVELENGTH_NM = "wavelength_nm"
"""Key of `Rig.solved_from`: wavelength of these lasers, in nanometres."""

_Count = Annotated[int, Field(gt=0)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Nominal:
    """Nominal rig, as known from its drawings."""

    name: str = "rig"
    size_px: tuple[int, int] | None = None  # Image width and height.
    housing: Housing | None = None
    n_air: float = N_AIR
    n_water: float = WATER_N
    n_lasers: int | None = None
    wavelength_nm: float | None = None  # Of all lasers; None if unknown or not the same for all.
    working_range: tuple[float, float] = (0.25, 1.3)  # Metres.
    shutter: Shutter = AT_ONCE  # Of the camera.


class _Section(StrictPart):
    model_config = ConfigDict(strict=False)


class _Image(_Section):
    width: _Count
    height: _Count


class _Camera(_Section):
    shutter: ShutterPart = ShutterPart()


class _Dome(_Section):
    inner_radius_mm: Positive
    thickness_mm: NotNegative
    n_acrylic: Index = 1.49


class _Flat(_Section):
    distance_mm: Positive
    thickness_mm: NotNegative
    n_port: Index = 1.49


class _Lasers(_Section):
    count: _Count
    wavelength_nm: LaserWavelength | None = None


class _NominalFile(_Section):
    name: str = "rig"
    image: _Image | None = None
    camera: _Camera = _Camera()
    dome: _Dome | None = None
    flat: _Flat | None = None
    n_air: Index = N_AIR
    lasers: _Lasers | None = None
    working_range_mm: Annotated[list[Positive], Field(min_length=2, max_length=2)] = Field(
        default=[250.0, 1300.0]
    )
    # No calibration reads it: files that describe the whole camera state it.
    fps: Positive | None = None


def load_nominal(path: Path) -> Nominal:
    """Read a nominal rig, or take the same values from a rig file.

    Raises `RigError` with one line that names the file, the place in it, the value and the remedy.
    """
    what = "a nominal rig or a rig file"
    text = read_text(path, what, RigError)
    if "aqualvs_rig" not in text:
        refuse_foreign(text, path, what, RigError)
    content = parse_yaml(text, str(path), RigError)
    if not isinstance(content, Mapping):
        raise RigError(f"{path}: is not a nominal rig; write keys such as 'dome: ...'")
    if "aqualvs_rig" not in content:
        return _from_mapping(content, path)
    rig = load_rig(path, need_lasers=False)
    return Nominal(
        name=rig.name,
        size_px=rig.size_px,
        housing=rig.housing,
        n_air=rig.n_air,
        n_water=rig.n_water,
        n_lasers=len(rig.lasers) or None,
        wavelength_nm=common_wavelength(rig.lasers),
        working_range=rig.working_range,
        shutter=rig.shutter,
    )


def lasers_wavelength(rig: Rig) -> float | None:
    """Return the common wavelength (nm) of a rig's lasers, or, before it has any, the planned one.

    None if they differ or it is unknown.
    """
    planned = rig.solved_from.get(WAVELENGTH_NM)
    if not rig.lasers and isinstance(planned, int | float):
        return float(planned)
    return common_wavelength(rig.lasers)


def in_lasers_light(
    rig: Rig, known: RigUncertainty, light: Dispersion
) -> tuple[Rig, RigUncertainty]:
    """Return a rig, and its uncertainty, whose index was found in green light, for its lasers'."""
    index, scale = known.names.index(N_WATER), np.ones(len(known.names))
    scale[index] = light.ratio
    covariance = known.covariance * np.outer(scale, scale)
    covariance[index, index] = light.sigma(rig.n_water, known.sigmas[N_WATER]) ** 2
    there = rig.in_water(light.from_green(rig.n_water))
    return there, RigUncertainty(known.names, covariance)


def _from_mapping(content: Mapping[str, Any], path: Path) -> Nominal:
    file = validated(_NominalFile, dict(content), path, RigError, SchemaWords(file="a nominal rig"))
    near_mm, far_mm = file.working_range_mm
    if said := range_fault(near_mm, far_mm):
        raise RigError(f"{path}: {said}")
    try:
        housing = housing_of(file.dome, file.flat)
        shutter = shutter_from_part(file.camera.shutter)
    except RigError as fault:
        raise RigError(f"{path}: {fault}") from None
    return Nominal(
        name=file.name,
        size_px=None if file.image is None else (file.image.width, file.image.height),
        housing=housing,
        n_air=file.n_air,
        n_lasers=None if file.lasers is None else file.lasers.count,
        wavelength_nm=None if file.lasers is None else file.lasers.wavelength_nm,
        working_range=(near_mm / 1e3, far_mm / 1e3),
        shutter=shutter,
    )


Image: TypeAlias = NDArray[np.uint8]
Picture: TypeAlias = str | Path | Image
"""A picture's file, or its pixels: grey, or blue, green, red."""
Pictures: TypeAlias = Iterable[Picture] | str | Path
"""Several pictures, or a folder or pattern of them."""
Detect: TypeAlias = Callable[[str, Image], View | str]
"""Detector: name and grey picture to the target's view, or a clause that says why there is none."""


@dataclass(frozen=True, slots=True)
class DetectedTargets:
    """Targets found in a set of pictures."""

    views: tuple[View, ...]  # Of the pictures in which the target was found.
    pictures: tuple[Picture, ...]  # Those pictures.
    size_px: tuple[int, int]  # Width and height of every picture.
    missed: dict[str, str]  # By name of each picture in which it was not found: the reason.
    pose_notes: tuple[str, ...] = ()  # Remarks on poses that the user gave for the pictures.
    target: str = "the target"  # Path of its file, or what it is.
    # By name of each picture that is a copy: the name of the first one. They are `missed`, too.
    copies: dict[str, str] = field(default_factory=dict)

    @property
    def first(self) -> str:
        """File or name of the first picture in which the target was found."""
        first = self.pictures[0]
        return str(first) if isinstance(first, str | Path) else self.views[0].name

    @property
    def remarks(self) -> list[str]:
        """Notes on the detection, pictures without a target, and notes on the poses."""
        return [
            *self._detection_notes(),
            *(f"{name}: left out, {why}" for name, why in self.missed.items()),
            *self.pose_notes,
        ]

    @property
    def notes(self) -> list[str]:
        """Notes on the detection, each with its pictures, and notes on the poses."""
        return [*self._detection_notes(), *self.pose_notes]

    def _detection_notes(self) -> list[str]:
        names: dict[str, list[str]] = {}
        for view in self.views:
            for note in view.notes:
                names.setdefault(note, []).append(view.name)
        notes, n_shown = [], 3
        for note, where in names.items():
            more = f" and {len(where) - n_shown} more" if len(where) > n_shown else ""
            notes.append(f"{', '.join(where[:n_shown])}{more}: {note}")
        return notes


SolutionT = TypeVar("SolutionT")


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration(Generic[SolutionT]):
    """Result of a calibration from pictures.

    Attributes
    ----------
    rig : Rig
        The rig with the solved parameters, their covariance and a note of this step. `save_rig`
        writes it; the next calibration takes it.
    uncertainty : RigUncertainty
        Names of the parameters that the calibration solved or relied on, and their joint
        covariance.
    residuals_px : dict
        By the name of each used picture: measured minus predicted pixels, shape (N, 2), of its
        corners.
    left_out : dict
        By the name of each picture that was not used: the reason.
    notes : tuple of str
        Remarks on the pictures and on the result, in plain words.
    solution : CameraCalibration, DomeCalibration, LaserCalibration or WaterCalibration
        Details of the solve.
    found : tuple of DetectedTargets
        Targets found, one for each set of pictures.
    """

    rig: Rig
    uncertainty: RigUncertainty
    residuals_px: dict[str, FloatArray]
    left_out: dict[str, str]
    notes: tuple[str, ...]
    solution: SolutionT
    found: tuple[DetectedTargets, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residuals."""
        return rms_px(np.concatenate(list(self.residuals_px.values())))


def summary(done: Calibration[CameraCalibration] | Calibration[DomeCalibration]) -> list[str]:
    """Return lines with the pictures used, the residual, remarks on pictures, and findings."""
    result = done.solution
    n_pictures = sum(len(one.views) + len(one.missed) for one in done.found)
    used = len(result.views)
    pictures = count_text(max(used, n_pictures), "picture")
    of = f"{used} of " if used < n_pictures else ""
    return [
        f"{of}{pictures}, {result.n_points} corners, residual {result.rms_px:.3f} px (rms)",
        *(line for one in done.found for line in one.remarks),
        *result.findings,
    ]


def picture_paths(arguments: Sequence[str | Path]) -> list[Path]:
    """Return the paths of the pictures given by files, folders and patterns, without repetition.

    `arguments`: pictures, folders of pictures, or patterns such as 'air/*.png'. The pictures of one
    argument are sorted naturally (`img2` before `img10`). Raises `CalibrationError` if an argument
    matches no picture, or two pictures have the same file name: poses and reports identify pictures
    by their names.
    """
    paths = [path for argument in arguments for path in _matching_paths(str(argument))]
    if not paths:
        raise CalibrationError("no pictures given; name pictures, a folder, or a pattern")
    unique = list(dict.fromkeys(paths))
    first: dict[str, Path] = {}
    for path in unique:
        other = first.setdefault(path.name, path)
        if other is not path:
            raise CalibrationError(
                f"{path}: has the same file name as {other}; rename one, pictures are known by name"
            )
    return unique


def _matching_paths(argument: str) -> list[Path]:
    """Return the pictures that one argument names: a file, a folder or a pattern."""
    path = Path(argument)
    if path.is_dir():
        found = [one for one in path.iterdir() if is_image_name(one)]
        if not found:
            raise CalibrationError(
                f"{path}: no pictures in this folder; looked for "
                f"{', '.join(sorted(IMAGE_SUFFIXES))}"
            )
        return sorted(found, key=natural_key)
    if path.exists():
        refuse_special(path, CalibrationError)
        return [path]
    if glob.has_magic(argument):
        matches = [Path(match) for match in glob.glob(argument, recursive=True)]
        if found := [p for p in matches if p.is_file()]:
            return sorted(found, key=natural_key)
        raise CalibrationError(f"{argument}: no file matches this pattern; check folder and ending")
    raise CalibrationError(f"{path}: no such picture or folder; check the path")


def _picture_list(pictures: Pictures) -> list[Picture]:
    """Return the pictures as a list; a single str or Path is one folder, pattern or file.

    Raises `CalibrationError` if an array is no picture of 8 bits.
    """
    if isinstance(pictures, str | Path):
        return list(picture_paths([pictures]))
    each: list[Any] = list(pictures)
    for i, one in enumerate(each):
        if one is None:
            remedy = "cv2.imread returns it for a file that it cannot read; check the path"
            raise CalibrationError(f"picture {i}: None; {remedy}")
        if isinstance(one, str | Path):
            continue
        shape, dtype = getattr(one, "shape", ()), getattr(one, "dtype", None)
        if dtype != np.uint8 or len(shape) not in (2, 3) or shape[2:] not in ((), (3,)):
            given = type(one).__name__ if dtype is None else f"{dtype} of shape {shape}"
            raise CalibrationError(
                f"picture {i}: {given}; give the path of a file, or 8 bits (numpy.uint8), grey "
                "(height, width) or blue, green, red (height, width, 3)"
            )
    return each


def detect_targets(pictures: Pictures, detect: Detect, target: str) -> DetectedTargets:
    """Find a target in every picture.

    Pictures without a file are named "picture 0", "picture 1", and so on. `detect` is called in
    several threads; `target` is the target in messages: the path of its file, or "the board".
    Raises `CalibrationError` if a picture cannot be read, the target is in none of them, or they
    differ in size.
    """
    # More threads do not detect faster in small pictures.
    threads = 4
    pictures = _picture_list(pictures)
    with (
        progress(f"looking for {Path(target).name}", len(pictures), unit="pictures") as tick,
        ThreadPoolExecutor(threads) as pool,
    ):

        def detect_in(name: str, picture: Picture) -> tuple[View | str, tuple[int, int]]:
            image = read_grey(picture)
            found = detect(name, image)
            tick(1)
            return found, (image.shape[1], image.shape[0])

        names = [named(picture, f"picture {i}") for i, picture in enumerate(pictures)]
        results = list(pool.map(detect_in, names, pictures))
    if not results:
        raise CalibrationError("no pictures given; name pictures, a folder, or a pattern")
    paths = [path_text(picture, name) for name, picture in zip(names, pictures, strict=True)]
    size_px = _common_size(paths, [size for _, size in results])
    views, used, missed, copies = [], [], {}, {}
    # Copies of a picture, whose views are equal to the bit, add no evidence, but would make the
    # sigmas smaller.
    first: dict[bytes, View] = {}
    for name, picture, (view, _) in zip(names, pictures, results, strict=True):
        if isinstance(view, str):
            missed[name] = view
            continue
        original = first.setdefault(view.ids.tobytes() + view.pixels.tobytes(), view)
        if original is view:
            views.append(view)
            used.append(picture)
        else:
            copies[name] = original.name
            missed[name] = f"it is a copy of {original.name}"
    if not views:
        name, why = next(iter(missed.items()))
        raise CalibrationError(
            f"{target}: found in none of {len(pictures)} pictures; {name}: {why}"
        )
    return DetectedTargets(tuple(views), tuple(used), size_px, missed, target=target, copies=copies)


def detect_boards(pictures: Pictures, board: Board | str | Path) -> DetectedTargets:
    """Find a board, given itself or by its file, in every picture; see `detect_targets`."""
    pattern = board if isinstance(board, Board) else load_board(board)
    return detect_targets(
        pictures,
        lambda name, image: detect_board(image, pattern, name),
        path_text(board, "the board"),
    )


@contextlib.contextmanager
def counting_missed(*sets: DetectedTargets) -> Iterator[None]:
    """Add to a refusal the number of pictures without a target, and the reason for the first."""
    try:
        yield
    except CalibrationError as fault:
        missed = [(found.target, *reason) for found in sets for reason in found.missed.items()]
        if not missed:
            raise
        n_pictures = len(missed) + sum(len(found.views) for found in sets)
        target, name, why = missed[0]
        raise CalibrationError(
            f"{fault}; {len(missed)} of {count_text(n_pictures, 'picture')} could not be used with "
            f"{target} ({name}: {why})"
        ) from fault


def named(target: object, what: str) -> str:
    """Return a file's name for messages, or `what` if its content was given instead of a path."""
    return Path(target).name if isinstance(target, str | Path) else what


def read_grey(picture: Picture) -> Image:
    """Read a picture as grey. Raises `CalibrationError` if it is no picture."""
    if isinstance(picture, str | Path):
        return _read(Path(picture), cv2.IMREAD_GRAYSCALE)
    return picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)


def read_colour(picture: Picture) -> Image:
    """Read a picture as blue, green, red. Raises `CalibrationError` if it is no picture."""
    if isinstance(picture, str | Path):
        return _read(Path(picture), cv2.IMREAD_COLOR)
    return picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)


def path_text(target: object, what: str) -> str:
    """Return a file's path for messages, or `what` if its content was given instead of a path."""
    return str(target) if isinstance(target, str | Path) else what


def medium_index(word: str | float | None, rig: Rig, default: float) -> float:
    """Return the refractive index of `--medium`: "air", "water" (the rig's), or a number.

    Returns `default` for None. Raises `OptionError` for any other word.
    """
    if word is None:
        return default
    if word == "air":
        return rig.n_air
    if word == "water":
        return rig.n_water
    try:
        return checked_index(float(word), "--medium")
    except ValueError:
        raise OptionError(
            f"--medium {word}: not understood; say air, water, or an index such as 1.3333"
        ) from None


def corner_residuals(views: Sequence[ViewFit], size_px: tuple[int, int]) -> ResidualMap:
    """Return the map of the residuals of all views' corners over the picture."""
    return residual_map(
        "Corners of all views",
        size_px,
        [fit.view for fit in views],
        [fit.residuals for fit in views],
        [fit.inliers for fit in views],
    )


def corner_rows(views: Sequence[ViewFit], missed: Mapping[str, str]) -> tuple[ViewRow, ...]:
    """Return a row for each view that was used, and for each `missed` one with its reason."""
    used = (ViewRow(name=fit.label, n_points=len(fit.view), rms_px=fit.rms_px) for fit in views)
    return (*used, *missed_rows(missed))


def finish(
    rig: Rig, page: CalibrationPage, out: Path, step: str, echo: Echo, before: Path | None = None
) -> None:
    """Write the rig and the page of a calibration, and print their paths.

    Existing files of these names are kept under dated names; comments of the rig file `before` are
    copied. Raises `OutputError` if a file cannot be written, or `out` exists and is no rig.
    """
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    copy = save_rig(rig, out, comments_of=before)
    if copy is not None:
        echo(f"kept: {copy}")
    echo(f"rig: {out}")
    report = out.with_suffix(f".{step}.html")
    if report.exists():
        keep_dated(report)
    echo(f"report: {write_page(page, report)}")


def check_same_size(rig: Rig, found: DetectedTargets) -> None:
    """Raise `CalibrationError` with both sizes if the pictures' size is not the rig's."""
    if found.size_px != rig.size_px:
        (w, h), (rw, rh) = found.size_px, rig.size_px
        raise CalibrationError(
            f"{found.first}: {w}x{h} px, but the rig's camera was calibrated at {rw}x{rh} px; "
            "take the pictures at that size, or calibrate the camera again"
        )


def _read(path: Path, flags: int) -> Image:
    image = read_image(path, flags)
    if image is None and path.suffix.lower() in VIDEO_SUFFIXES:
        pictures = path.with_name(f"{path.stem}_%03d.png")
        command = ["ffmpeg", "-noautorotate", "-i", str(path), "-r", "1", str(pictures)]
        raise CalibrationError(
            f"{path}: is a video, but this step takes pictures; photograph the target, or take a "
            f"picture of each second of the video: {shlex.join(command)}"
        )
    if image is None:
        raise CalibrationError(
            f"{path}: not a readable picture, cut short, or too large; remove or replace it"
        )
    refuse_stack(path, image, CalibrationError)
    return image


def _common_size(names: Sequence[str], sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Return the size of all pictures; refuse the first one of another size than most."""
    usual = max(set(sizes), key=sizes.count)
    for name, size in zip(names, sizes, strict=True):
        if size != usual:
            raise CalibrationError(
                f"{name}: {size[0]}x{size[1]} px, but the other pictures have "
                f"{usual[0]}x{usual[1]} px; one calibration takes pictures of one size"
            )
    return usual
