"""Pictures of interlaced cameras taken apart into their fields, each a frame at its own time.

No filter makes whole pictures of fields: the rows of a field are those of its picture, and the
scanner takes them as every other row of the camera (`Scanner`). Frames are numbered as
`Shutter.field_of` says. The odd last row of a picture, which one field has and the other has not,
is left out.
"""

import dataclasses
from collections.abc import Iterable, Iterator

import cv2
import numpy as np

from aqualvs.closing import Closing
from aqualvs.optics.rig import Rig
from aqualvs.optics.shutter import FIRST_ROW, Field, Shutter, ShutterKind
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.sources.base import Feed, FrameSource, PartHealth
from aqualvs.sources.spans import Span


def frames_of(pictures: Iterable[Frame], shutter: Shutter) -> Iterator[Frame]:
    """Yield two frames for each picture of an interlaced camera, and those of others as they are.

    Parameters
    ----------
    pictures : iterable of Frame
    shutter : Shutter
        Of the camera. The first field has the time of its picture, the second follows after
        `readout`.
    """
    if shutter.kind is not ShutterKind.INTERLACED:
        yield from pictures
        return
    for picture in pictures:
        for index, delay in ((2 * picture.index, 0.0), (2 * picture.index + 1, shutter.readout)):
            field = shutter.field_of(index)
            assert field is not None
            yield dataclasses.replace(
                field_of(picture, field), index=index, time_s=picture.time_s + delay
            )


def field_of(picture: Frame, field: Field) -> Frame:
    """Return one field of a picture.

    Parameters
    ----------
    picture : Frame
        A whole one. Where its stream does not say that it is interlaced, each row of its chroma is
        of both fields: a field's chroma is the mean of two such rows, which smears the colour of
        what moves, not its luma.
    field : {"top", "bottom"}

    Returns
    -------
    Frame
        A view of the luma, with index and time of the picture.
    """
    luma = _rows(picture.luma, field, len(picture.luma) // 2)
    chroma = picture.chroma
    if chroma is not None:
        n_rows = (len(luma) + 1) // 2
        u, v = (
            _rows(plane, field, n_rows) if picture.is_interlaced else _halved(plane, n_rows)
            for plane in chroma
        )
        chroma = u, v
    return dataclasses.replace(picture, luma=luma, chroma=chroma, field=field, is_interlaced=False)


def _rows(plane: ImagePlane, field: Field, n_rows: int) -> ImagePlane:
    """Return the rows of a field; its last one twice where the plane has one too few."""
    rows = plane[FIRST_ROW[field] :: 2][:n_rows]
    return rows if len(rows) == n_rows else np.concatenate([rows, rows[-1:]])


def _halved(plane: ImagePlane, n_rows: int) -> ImagePlane:
    """Return the means of two rows each."""
    even = plane if len(plane) % 2 == 0 else np.concatenate([plane, plane[-1:]])
    size = (plane.shape[1], len(even) // 2)
    halved = cv2.resize(np.ascontiguousarray(even), size, interpolation=cv2.INTER_AREA)
    return np.asarray(halved[:n_rows], np.uint8)


def size_of_frames(rig: Rig) -> tuple[int, int]:
    """Return width and height of a rig's frames: half the height if it is interlaced."""
    width, height = rig.size_px
    return (width, height) if rig.shutter.field_of(0) is None else (width, height // 2)


def frames_in(span: Span, shutter: Shutter) -> tuple[int, int]:
    """Return the first frame of consecutive pictures, and the first after them."""
    n = 1 if shutter.kind is not ShutterKind.INTERLACED else 2
    return n * span.first, n * span.stop


class FieldSource(Closing):
    """Source of the fields of another source's pictures; satisfies `FrameSource`.

    Parameters
    ----------
    pictures : FrameSource
        Closed with this one.
    shutter : Shutter
        Interlaced.

    Attributes
    ----------
    pictures : FrameSource
    name : str
    size_px : (int, int)
        Of the pictures.
    fps : float or None
        Fields a second.
    n_frames : int or None
        Fields.
    """

    def __init__(self, pictures: FrameSource, shutter: Shutter) -> None:
        self.pictures, self._shutter = pictures, shutter
        self.name, self.size_px = pictures.name, pictures.size_px
        self.fps = None if pictures.fps is None else 2.0 * pictures.fps
        self.n_frames = None if pictures.n_frames is None else 2 * pictures.n_frames

    def __iter__(self) -> Iterator[Frame]:
        """Yield the fields; those of lost pictures leave a gap in the index."""
        return frames_of(self.pictures, self._shutter)

    def close(self) -> None:
        """Close the source of the pictures."""
        self.pictures.__exit__(None, None, None)


class FieldFeed:
    """Feed of the fields of another feed's pictures; satisfies `Feed`.

    Parameters
    ----------
    pictures : Feed
    shutter : Shutter
        Interlaced.
    """

    def __init__(self, pictures: Feed, shutter: Shutter) -> None:
        self._pictures, self._shutter = pictures, shutter

    @property
    def name(self) -> str:
        """Name of the feed of the pictures."""
        return self._pictures.name

    def __iter__(self) -> Iterator[Frame]:
        """Yield the fields, both of a picture as soon as it comes."""
        return frames_of(self._pictures, self._shutter)

    def health(self) -> PartHealth:
        """Return how the feed of the pictures is."""
        return self._pictures.health()

    def close(self) -> None:
        """End the iteration."""
        self._pictures.close()


def source_of_frames(pictures: FrameSource, shutter: Shutter) -> FrameSource:
    """Return the source of a camera's frames: fields where it is interlaced."""
    is_interlaced = shutter.kind is ShutterKind.INTERLACED
    return FieldSource(pictures, shutter) if is_interlaced else pictures


def feed_of_frames(pictures: Feed, shutter: Shutter) -> Feed:
    """Return the feed of a camera's frames: fields where it is interlaced."""
    is_interlaced = shutter.kind is ShutterKind.INTERLACED
    return FieldFeed(pictures, shutter) if is_interlaced else pictures


def source_of_pictures(frames: FrameSource) -> FrameSource:
    """Return the source whose pictures the frames of another are, or are fields of."""
    return frames.pictures if isinstance(frames, FieldSource) else frames
