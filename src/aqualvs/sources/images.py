"""Frames from a folder or a list of images.

libpng, libjpeg and libtiff print their warnings to the standard error of the process;
`quiet_decoders` silences them while an image is read.
"""

import contextlib
import os
import re
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

import cv2

from aqualvs.closing import Closing
from aqualvs.errors import AqualvsError, SourceError
from aqualvs.scanning.scan import Frame, ImagePlane, planes_of_image

_lock = threading.Lock()
_n_inside = 0
_before: tuple[int, int] = (-1, 0)


@contextlib.contextmanager
def quiet_decoders() -> Iterator[None]:
    """Discard output of OpenCV and the libraries below it on standard error.

    They know nothing of Python's streams, so the file of the process itself is replaced meanwhile,
    for all of its threads.
    """
    global _n_inside, _before
    with _lock:
        if _n_inside == 0:
            _before = _discard_stderr(), cv2.utils.logging.setLogLevel(0)
        _n_inside += 1
    try:
        yield
    finally:
        with _lock:
            _n_inside -= 1
            if _n_inside == 0:
                kept, level = _before
                cv2.utils.logging.setLogLevel(level)
                if kept >= 0:
                    os.dup2(kept, 2)
                    os.close(kept)


def _discard_stderr() -> int:
    """Discard standard error; return a copy of its descriptor, -1 where it is closed."""
    try:
        kept = os.dup(2)
    except OSError:
        return -1
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    return kept


IMAGE_SUFFIXES = frozenset({".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp"})
VIDEO_SUFFIXES = frozenset(
    [
        *(".avi", ".h264", ".h265", ".m2ts", ".m4v", ".mkv", ".mov"),
        *(".mp4", ".mpeg", ".mpg", ".mts", ".ts", ".webm", ".wmv"),
    ]
)
"""Files that are videos by their names; what a user names as one may have any suffix."""


def is_image_name(path: Path) -> bool:
    """Return whether a file in a folder counts as an image, by its name.

    Hidden ones do not: macOS puts a `._NAME` beside each file on foreign disks.
    """
    return path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")


class ImageSource(Closing):
    """Source of images as frames, in natural order of their names (`img2` before `img10`).

    `paths`: a folder, or the images themselves (taken in the order given). `fps`: images have no
    clock; `Frame.time_s` is the index divided by this. Raises `SourceError` if there is no image,
    or the first one cannot be read.
    """

    def __init__(self, paths: Path | Sequence[Path], *, fps: float = 1.0) -> None:
        self.fps = fps
        self._paths = images_in(paths) if isinstance(paths, Path) else list(paths)
        one = paths if isinstance(paths, Path) else self._paths[0] if len(paths) == 1 else None
        self.name = f"{len(self._paths)} images" if one is None else str(one)
        if not self._paths:
            raise SourceError(f"{self.name}: no images; name at least one")
        first = read_image(self._paths[0])
        if first is None:
            raise SourceError(_unreadable(self._paths[0]))
        refuse_stack(self._paths[0], first, SourceError)
        self.size_px = (first.shape[1], first.shape[0])
        self.n_frames = len(self._paths)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the readable images; unreadable ones leave a gap in the index."""
        last = -1
        for index, path in enumerate(self._paths):
            image = read_image(path)
            if image is None:
                continue
            size = (image.shape[1], image.shape[0])
            if size != self.size_px:
                raise SourceError(
                    f"{path}: {size[0]}x{size[1]} px, but the first image has "
                    f"{self.size_px[0]}x{self.size_px[1]} px; keep one size a folder"
                )
            refuse_stack(path, image, SourceError)
            luma, chroma = planes_of_image(image)
            yield Frame(index, index / self.fps, luma, chroma)
            last = index
        if last + 1 < self.n_frames:
            raise SourceError(_unreadable(self._paths[-1]))


def _unreadable(path: Path) -> str:
    return f"{path}: not a readable image, cut short, or too large; remove or replace it"


def images_in(folder: Path) -> list[Path]:
    """Return the images in a folder, sorted naturally.

    Raises `SourceError` if the folder holds none, or cannot be listed.
    """
    try:
        found = [path for path in folder.iterdir() if is_image_name(path)]
    except OSError as fault:
        raise SourceError(f"{folder}: cannot be listed ({fault.strerror})") from fault
    if not found:
        kinds = ", ".join(sorted(IMAGE_SUFFIXES))
        raise SourceError(f"{folder}: no images in this folder; looked for {kinds}")
    return sorted(found, key=lambda path: natural_key(path.name))


def natural_key(path: Path | str) -> list[tuple[int, str]]:
    """Return a sort key in which runs of digits count by value."""
    return [(int(n or -1), text) for n, text in re.findall(r"(\d+)|(\D+)", str(path))]


def read_image(path: Path, how: int = cv2.IMREAD_ANYCOLOR) -> ImagePlane | None:
    """Return an image as the camera read it out, or None if it cannot be decoded.

    What a file says about how to turn it for a viewer (EXIF) is ignored, as decoders of video do: a
    camera model holds for the sensor. None is returned for pipes and devices too, for JPEG files
    that are cut short, and for images of more pixels than OpenCV is told to take
    (`aqualvs/__init__.py`). `how`: OpenCV's flag; the default returns grey images as grey.
    """
    try:
        if not path.is_file() or _is_cut_jpeg(path):
            return None
        with quiet_decoders():
            image = cv2.imread(str(path), how | cv2.IMREAD_IGNORE_ORIENTATION)
    except (cv2.error, OSError):
        return None
    return cast("ImagePlane | None", image)


def refuse_stack(path: Path, first: ImagePlane, error: type[AqualvsError]) -> None:
    """Raise `error` if a TIFF file holds several pictures, of which the first alone would be read.

    Thumbnails, which some cameras add, are of another size.
    """
    if path.suffix.lower() not in {".tif", ".tiff"}:
        return
    with quiet_decoders():
        n_pictures = cv2.imcount(str(path))
        more = cv2.imreadmulti(str(path), 1, 1)[1] if n_pictures > 1 else ()
    if more and more[0].shape[:2] == first.shape[:2]:
        raise error(
            f"{path}: holds {n_pictures} pictures, of which only the first would be read; save "
            "each in a file of its own"
        )


def _is_cut_jpeg(path: Path) -> bool:
    """Return whether a file is a JPEG whose picture does not end, which OpenCV fills with grey.

    Cameras append anything behind the end, and put a thumbnail with an end of its own before the
    picture. So the end is looked for from the first scan on (ITU-T T.81, annex B), whose coded data
    cannot contain it.
    """
    start_of_scan, end_of_image, prefix = 0xDA, b"\xff\xd9", 0xFF
    with path.open("rb") as file:
        if file.read(2) != b"\xff\xd8":
            return False
        data = file.read()
    at = 0
    while at + 4 <= len(data) and data[at] == prefix:
        if data[at + 1] == start_of_scan:
            return data.find(end_of_image, at) < 0
        # Bytes of 255 may fill the space before a marker.
        at += 1 if data[at + 1] == prefix else 2 + int.from_bytes(data[at + 2 : at + 4])
    return False
