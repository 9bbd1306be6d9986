"""What all calibrations share: finding targets in pictures, keeping and writing the rig."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.app.calibration_page import Page, write_page
from aqualvs.app.disk import writing
from aqualvs.app.progress import progress
from aqualvs.app.run_inputs import checked_index
from aqualvs.calibration.view import View
from aqualvs.errors import CalibrationError, OptionError
from aqualvs.live.sources.images import read_image
from aqualvs.optics.rig import Rig
from aqualvs.optics.rig_copies import keep_dated
from aqualvs.optics.rigfile import save_rig

Tell: TypeAlias = Callable[[str], object]
Image: TypeAlias = NDArray[np.uint8]
Detect: TypeAlias = Callable[[Path, Image], View | str]
"""Finds a target in a grey picture; a clause says why there is none."""

# More threads than this gain nothing on small pictures.
_THREADS = 4
# Names of pictures that a note lists.
_NAMES_SHOWN = 3


@dataclass(frozen=True, slots=True)
class Found:
    """What was found in a set of pictures.

    Attributes
    ----------
    views : tuple of View
        Of the pictures in which the target was found.
    paths : tuple of Path
        Theirs.
    size_px : (int, int)
        Width and height of every picture.
    missed : dict
        Name of a picture in which it was not found, and why.
    """

    views: tuple[View, ...]
    paths: tuple[Path, ...]
    size_px: tuple[int, int]
    missed: dict[str, str]

    @property
    def remarks(self) -> list[str]:
        """What to warn of."""
        return [
            *self.notes,
            *(f"{name}: left out, {why}" for name, why in self.missed.items()),
        ]

    @property
    def notes(self) -> list[str]:
        """What is worth knowing of how targets were found, each with its pictures."""
        names: dict[str, list[str]] = {}
        for view in self.views:
            for note in view.notes:
                names.setdefault(note, []).append(view.name)
        return [f"{_listed(where)}: {note}" for note, where in names.items()]


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMES_SHOWN
    return ", ".join(names[:_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def find_targets(paths: Sequence[Path], detect: Detect, target: str) -> Found:
    """Look for a target in every picture.

    Parameters
    ----------
    paths : sequence of Path
        Pictures.
    detect : callable
        Finds the target in one.
    target : str
        What is looked for, for messages: "board.yaml", say.

    Raises
    ------
    CalibrationError
        If the target is in none of the pictures, or they differ in size.
    """
    with (
        progress(f"looking for {target}", len(paths), unit="pictures") as tick,
        ThreadPoolExecutor(_THREADS) as pool,
    ):

        def look(path: Path) -> tuple[View | str, tuple[int, int]]:
            image = read_grey(path)
            found = detect(path, image)
            tick(1)
            return found, (image.shape[1], image.shape[0])

        results = list(pool.map(look, paths))
    size_px = _common_size(paths, [size for _, size in results])
    views = [(path, view) for path, (view, _) in zip(paths, results, strict=True)]
    missed = {path.name: why for path, why in views if isinstance(why, str)}
    found = [(path, view) for path, view in views if isinstance(view, View)]
    if not found:
        name, why = next(iter(missed.items()))
        raise CalibrationError(f"{target}: found in none of {len(paths)} pictures; {name}: {why}")
    return Found(
        tuple(view for _, view in found), tuple(path for path, _ in found), size_px, missed
    )


def read_grey(path: Path) -> Image:
    """Read a picture as grey.

    Raises
    ------
    CalibrationError
        If it is no picture.
    """
    return _read(path, cv2.IMREAD_GRAYSCALE)


def read_colour(path: Path) -> Image:
    """Read a picture as blue, green, red.

    Raises
    ------
    CalibrationError
        If it is no picture.
    """
    return _read(path, cv2.IMREAD_COLOR)


def medium_index(word: str | None, rig: Rig, default: float) -> float:
    """Return the index that `--medium` means: "air", "water" (the rig's), or a number.

    Raises
    ------
    OptionError
        If it is none of these.
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


def finish(
    rig: Rig, page: Page, out: Path, step: str, tell: Tell, *, comments_of: Path | None = None
) -> None:
    """Write the rig and the page of a calibration, and tell where they are.

    A rig and a page that are there already are kept under dated names.

    Raises
    ------
    OutputError
        If one cannot be written, or `out` is a file but no rig.
    """
    with writing(out):
        out.parent.mkdir(parents=True, exist_ok=True)
    copy = save_rig(rig, out, comments_of=comments_of)
    if copy is not None:
        tell(f"kept: {copy}")
    tell(f"rig: {out}")
    report = out.with_suffix(f".{step}.html")
    if report.exists():
        keep_dated(report)
    tell(f"report: {write_page(page, report)}")


def check_same_size(rig: Rig, found: Found) -> None:
    """Refuse pictures of another size than the rig's.

    Raises
    ------
    CalibrationError
        With both sizes.
    """
    if found.size_px != rig.size_px:
        (w, h), (rw, rh) = found.size_px, rig.size_px
        raise CalibrationError(
            f"{found.paths[0]}: {w}x{h} px, but the rig's camera was calibrated at {rw}x{rh} px; "
            "take the pictures at that size, or calibrate the camera again"
        )


def _read(path: Path, how: int) -> Image:
    image = read_image(path, how)
    if image is None:
        raise CalibrationError(
            f"{path}: not a readable picture, or too large; remove or replace it"
        )
    return image


def _common_size(paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    usual = max(set(sizes), key=sizes.count)
    for path, size in zip(paths, sizes, strict=True):
        if size != usual:
            raise CalibrationError(
                f"{path}: {size[0]}x{size[1]} px, but the other pictures have "
                f"{usual[0]}x{usual[1]} px; one calibration takes pictures of one size"
            )
    return usual
