"""Common parts of all calibrations: nominal rig, target detection in pictures, result, output.

The nominal rig (`load_nominal`) is known before any calibration: name, picture size, dome, lasers.
`Calibration` is what the functions `calibrate_camera`, `calibrate_dome`, `calibrate_lasers` and
`calibrate_water` return; the commands of `aqualvs calibrate` write it down.
"""

import contextlib
import glob
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, TypeAlias, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from aqualvs.calibration.camera.calibrate import CameraCalibration
from aqualvs.calibration.detection.detection import detect_board
from aqualvs.calibration.solver.result import DomeCalibration, ViewFit
from aqualvs.calibration.targets.target_files import load_board
from aqualvs.calibration.targets.targets import Board, View
from aqualvs.calibration_formats import refuse_foreign
from aqualvs.errors import CalibrationError, OptionError, RigError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.optics.camera import Housing
from aqualvs.optics.rig import Rig, RigUncertainty, common_wavelength
from aqualvs.optics.rigfile import housing_of, keep_dated, load_rig, save_rig
from aqualvs.optics.rigschema import LaserWavelength
from aqualvs.optics.shutter import AT_ONCE, Shutter
from aqualvs.optics.water import N_AIR
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
    is_image_name,
    natural_key,
    read_image,
    refuse_stack,
)
from aqualvs.special_files import refuse_special
from aqualvs.terminal import progress
from aqualvs.text import count_text
from aqualvs.yamlfile import parse_yaml, read_text

WATER_N = 1.3340
"""Default index: fresh water of 15 °C in green light."""
N_LASERS = "n_lasers"
"""Key of `Rig.solved_from` for the planned number of lasers of a rig without any."""
WAVELENGTH_NM = "wavelength_nm"
"""The same for their wavelength, in nanometres."""

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
    wavelength_nm: float | None = None  # Of the lasers; None if unknown, or if they differ.
    working_range: tuple[float, float] = (0.25, 1.3)  # Metres.
    shutter: Shutter = AT_ONCE  # Of the camera.


class _Part(StrictPart):
    model_config = ConfigDict(strict=False)


class _Image(_Part):
    width: _Count
    height: _Count


class _Dome(_Part):
    inner_radius_mm: Positive
    thickness_mm: NotNegative
    n_acrylic: Index = 1.49


class _Flat(_Part):
    distance_mm: Positive
    thickness_mm: NotNegative
    n_port: Index = 1.49


class _Lasers(_Part):
    count: _Count
    wavelength_nm: LaserWavelength | None = None


class _File(_Part):
    name: str = "rig"
    image: _Image | None = None
    dome: _Dome | None = None
    flat: _Flat | None = None
    n_air: Index = N_AIR
    lasers: _Lasers | None = None
    fps: Positive | None = None


def load_nominal(path: Path) -> Nominal:
    """Read a nominal rig, or take over what a rig file knows.

    Raises `RigError` with one line that names the file, the place in it, the value and the remedy.
    """
    what = "a nominal rig or a rig file"
    text = read_text(path, what, RigError)
    if "aqualvs_rig" not in text:
        refuse_foreign(text, path, what, RigError)
    content = parse_yaml(text, str(path), RigError)
    if not isinstance(content, Mapping):
        raise RigError(f"{path}: is not a nominal rig; write keys such as 'dome: ...'")
    return _of_rig_file(path) if "aqualvs_rig" in content else _of_mapping(content, path)


def _of_rig_file(path: Path) -> Nominal:
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


def _of_mapping(content: Mapping[str, Any], path: Path) -> Nominal:
    file = validated(_File, dict(content), path, RigError, SchemaWords(file="a nominal rig"))
    try:
        housing = housing_of(file.dome, file.flat)
    except RigError as fault:
        raise RigError(f"{path}: {fault}") from None
    return Nominal(
        name=file.name,
        size_px=None if file.image is None else (file.image.width, file.image.height),
        housing=housing,
        n_air=file.n_air,
        n_lasers=None if file.lasers is None else file.lasers.count,
        wavelength_nm=None if file.lasers is None else file.lasers.wavelength_nm,
    )


Echo: TypeAlias = Callable[[str], object]
Image: TypeAlias = NDArray[np.uint8]
Picture: TypeAlias = str | Path | Image
"""A picture's file, or its pixels: grey, or blue, green, red."""
Pictures: TypeAlias = Iterable[Picture] | str | Path
"""Several pictures, or a folder or pattern of them."""
Detect: TypeAlias = Callable[[str, Image], View | str]
"""Finder of a target in a named grey picture; returns a clause if there is none."""


@dataclass(frozen=True, slots=True)
class DetectedTargets:
    """Targets found in a set of pictures."""

    views: tuple[View, ...]  # Of the pictures in which the target was found.
    pictures: tuple[Picture, ...]  # Those pictures.
    size_px: tuple[int, int]  # Width and height of every picture.
    missed: dict[str, str]  # Names of pictures in which it was not found, with the reason.
    pose_notes: tuple[str, ...] = ()  # Remarks on the poses that were given for them.

    @property
    def first(self) -> str:
        """File or name of the first picture in which the target was found."""
        first = self.pictures[0]
        return str(first) if isinstance(first, str | Path) else self.views[0].name

    @property
    def remarks(self) -> list[str]:
        """Warnings."""
        return [
            *self._detection_notes(),
            *(f"{name}: left out, {why}" for name, why in self.missed.items()),
            *self.pose_notes,
        ]

    @property
    def notes(self) -> list[str]:
        """Notes on the detection, each with its pictures, and on the poses."""
        return [*self._detection_notes(), *self.pose_notes]

    def _detection_notes(self) -> list[str]:
        names: dict[str, list[str]] = {}
        for view in self.views:
            for note in view.notes:
                names.setdefault(note, []).append(view.name)
        return [f"{_listed(where)}: {note}" for note, where in names.items()]


def _listed(names: Sequence[str]) -> str:
    # Names of pictures that a note lists.
    names_shown = 3
    more = len(names) - names_shown
    return ", ".join(names[:names_shown]) + (f" and {more} more" if more > 0 else "")


SolutionT = TypeVar("SolutionT")


@dataclass(frozen=True, slots=True, kw_only=True)
class Calibration(Generic[SolutionT]):
    """Result of a calibration from pictures.

    Attributes
    ----------
    rig : Rig
        The rig with the solved numbers, their covariance and a note of the step. `save_rig` writes
        it; the next calibration takes it.
    uncertainty : RigUncertainty
        Names of the numbers that the calibration solved or relied on, and their joint covariance.
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
        stacked = np.concatenate(list(self.residuals_px.values()))
        return float(np.sqrt(np.mean(np.sum(stacked**2, axis=1))))


def summary(done: Calibration[CameraCalibration] | Calibration[DomeCalibration]) -> list[str]:
    """Return the numbers of pictures used and left out, the residual and the reasons."""
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
    """Return the pictures given by files, folders and patterns, each once.

    `arguments`: pictures, folders of them, or patterns such as 'air/*.png'. The pictures of one
    argument are sorted naturally (`img2` before `img10`). Raises `CalibrationError` if an argument
    matches no picture, or two of the pictures have the same file name: poses and reports identify
    pictures by their names.
    """
    paths = [path for argument in arguments for path in _meant(str(argument))]
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


def _meant(argument: str) -> list[Path]:
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
        found = [p for p in matches if p.is_file()]
        if found:
            return sorted(found, key=natural_key)
        raise CalibrationError(f"{argument}: no file matches this pattern; check folder and ending")
    raise CalibrationError(f"{path}: no such picture or folder; check the path")


def _each_picture(pictures: Pictures) -> list[Picture]:
    """Return the pictures; of text, those of the folder or pattern, as a command takes it.

    Raises `CalibrationError` if an array is no picture of 8 bits.
    """
    if isinstance(pictures, str | Path):
        return list(picture_paths([pictures]))
    each: list[Any] = list(pictures)
    for i, one in enumerate(each):
        if one is None:
            remedy = "cv2.imread returns it for a file that it cannot read; check the path"
            raise CalibrationError(f"picture {i}: None; {remedy}")
        if not isinstance(one, str | Path) and (
            one.dtype != np.uint8 or (one.ndim != 2 and (one.ndim != 3 or one.shape[2] != 3))
        ):
            raise CalibrationError(
                f"picture {i}: {one.dtype} of shape {one.shape}; give 8 bits (numpy.uint8), grey "
                "(height, width) or blue, green, red (height, width, 3)"
            )
    return each


def detect_targets(pictures: Pictures, detect: Detect, target: str) -> DetectedTargets:
    """Find a target in every picture.

    Parameters
    ----------
    pictures : iterable of Picture, str or Path
        Files or pixels; pixels are named by their number. A folder or a pattern for all of it.
    target : str
        Name of the target in messages, such as "board.yaml".

    Raises
    ------
    CalibrationError
        If the target is in none of the pictures, or they differ in size.
    """
    # Greatest useful number of threads on small pictures.
    threads = 4
    pictures = _each_picture(pictures)
    with (
        progress(f"looking for {target}", len(pictures), unit="pictures") as tick,
        ThreadPoolExecutor(threads) as pool,
    ):

        def look(name: str, picture: Picture) -> tuple[View | str, tuple[int, int]]:
            image = read_grey(picture)
            found = detect(name, image)
            tick(1)
            return found, (image.shape[1], image.shape[0])

        names = [named(picture, f"picture {i}") for i, picture in enumerate(pictures)]
        results = list(pool.map(look, names, pictures))
    if not results:
        raise CalibrationError("no pictures given; name pictures, a folder, or a pattern")
    size_px = _common_size(
        [
            picture if isinstance(picture, str | Path) else name
            for name, picture in zip(names, pictures, strict=True)
        ],
        [size for _, size in results],
    )
    views = [view for view, _ in results]
    missed = {name: why for name, why in zip(names, views, strict=True) if isinstance(why, str)}
    found = [
        (one, view) for one, view in zip(pictures, views, strict=True) if isinstance(view, View)
    ]
    if not found:
        name, why = next(iter(missed.items()))
        raise CalibrationError(
            f"{target}: found in none of {len(pictures)} pictures; {name}: {why}"
        )
    return DetectedTargets(
        tuple(view for _, view in found), tuple(one for one, _ in found), size_px, missed
    )


def detect_boards(pictures: Pictures, board: Board | str | Path) -> DetectedTargets:
    """Find a board, or that of a file, in every picture; see `detect_targets`."""
    pattern = board if isinstance(board, Board) else load_board(board)
    return detect_targets(
        pictures, lambda name, image: detect_board(image, pattern, name), named(board, "the board")
    )


@contextlib.contextmanager
def counting_missed(*sets: DetectedTargets) -> Iterator[None]:
    """Add to a refusal how many pictures the solve did without, with the reason for one of them."""
    try:
        yield
    except CalibrationError as fault:
        missed = [reason for found in sets for reason in found.missed.items()]
        if not missed:
            raise
        n_pictures = len(missed) + sum(len(found.views) for found in sets)
        name, why = missed[0]
        raise CalibrationError(
            f"{fault}; {len(missed)} of {count_text(n_pictures, 'picture')} could not be used "
            f"({name}: {why})"
        ) from fault


def named(target: object, what: str) -> str:
    """Return the name of a file for messages; `what` it is if its content was given itself."""
    return Path(target).name if isinstance(target, str | Path) else what


def read_grey(picture: Picture) -> Image:
    """Read a picture as grey.

    Raises `CalibrationError` if it is no picture.
    """
    if isinstance(picture, str | Path):
        return _read(Path(picture), cv2.IMREAD_GRAYSCALE)
    return picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)


def read_colour(picture: Picture) -> Image:
    """Read a picture as blue, green, red.

    Raises `CalibrationError` if it is no picture.
    """
    if isinstance(picture, str | Path):
        return _read(Path(picture), cv2.IMREAD_COLOR)
    return picture if picture.ndim == 3 else cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR)


def medium_index(word: str | float | None, rig: Rig, default: float) -> float:
    """Return the index of `--medium`: "air", "water" (the rig's), or a number.

    Raises `OptionError` if it is none of these.
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
    """Return the residuals of a target's corners over the picture."""
    return residual_map(
        "Corners of all views",
        size_px,
        [fit.view for fit in views],
        [fit.residuals for fit in views],
        [fit.inliers for fit in views],
    )


def corner_rows(views: Sequence[ViewFit], missed: Mapping[str, str]) -> tuple[ViewRow, ...]:
    """Return the rows of the views that were used, and of those that were not, with the reason."""
    used = (ViewRow(name=fit.label, n_points=len(fit.view), rms_px=fit.rms_px) for fit in views)
    return (*used, *missed_rows(missed))


def finish(
    rig: Rig,
    page: CalibrationPage,
    out: Path,
    step: str,
    echo: Echo,
    *,
    comments_of: Path | None = None,
) -> None:
    """Write the rig and the page of a calibration, and print their paths.

    A rig and a page that are there already are kept under dated names.

    Raises `OutputError` if one cannot be written, or `out` is a file but no rig.
    """
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    copy = save_rig(rig, out, comments_of=comments_of)
    if copy is not None:
        echo(f"kept: {copy}")
    echo(f"rig: {out}")
    report = out.with_suffix(f".{step}.html")
    if report.exists():
        keep_dated(report)
    echo(f"report: {write_page(page, report)}")


def check_same_size(rig: Rig, found: DetectedTargets) -> None:
    """Refuse pictures of another size than the rig's.

    Raises `CalibrationError` with both sizes.
    """
    if found.size_px != rig.size_px:
        (w, h), (rw, rh) = found.size_px, rig.size_px
        raise CalibrationError(
            f"{found.first}: {w}x{h} px, but the rig's camera was calibrated at {rw}x{rh} px; "
            "take the pictures at that size, or calibrate the camera again"
        )


def _read(path: Path, how: int) -> Image:
    image = read_image(path, how)
    if image is None:
        raise CalibrationError(
            f"{path}: not a readable picture, cut short, or too large; remove or replace it"
        )
    refuse_stack(path, image, CalibrationError)
    return image


def _common_size(names: Sequence[object], sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    usual = max(set(sizes), key=sizes.count)
    for name, size in zip(names, sizes, strict=True):
        if size != usual:
            raise CalibrationError(
                f"{name}: {size[0]}x{size[1]} px, but the other pictures have "
                f"{usual[0]}x{usual[1]} px; one calibration takes pictures of one size"
            )
    return usual
