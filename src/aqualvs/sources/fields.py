"""Pictures of interlaced cameras taken apart into their fields, each a frame at its own time.

No filter makes whole pictures of fields: the rows of a field are those of its picture, and the
scanner takes them as every other row of the camera (`Scanner`). Frames are numbered as
`Shutter.field_of` says. The odd last row of a picture, which one field has and the other has not,
is left out. `FieldEvidence` tells from pictures whether they are interlaced, `FieldWatch` from
those of a stream as they come.
"""

import contextlib
import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from aqualvs.closing import Closing
from aqualvs.errors import SourceError
from aqualvs.optics.rig import Rig
from aqualvs.optics.shutter import FIRST_ROW, Field, Shutter
from aqualvs.scanning.scan import Frame, ImagePlane
from aqualvs.sources.base import Feed, FrameSource, PartHealth, State
from aqualvs.sources.spans import Span


def frames_of(pictures: Iterable[Frame], shutter: Shutter) -> Iterator[Frame]:
    """Yield two frames for each picture of an interlaced camera, and those of others as they are.

    `shutter`: of the camera. The first field has the time of its picture, the second follows after
    `readout`.
    """
    if not shutter.is_interlaced:
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
    """Return one field of a whole picture: a view of its luma, with its index and time.

    Where the picture's stream does not say that it is interlaced, each row of its chroma is of both
    fields: a field's chroma is the mean of two such rows, which smears the colour of what moves,
    not its luma.
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


def whole_luma(frame: Frame) -> ImagePlane:
    """Return the luma of a frame at the size of its picture, for what stands still in it.

    The rows that a field lacks are interpolated.
    """
    height, width = frame.luma.shape
    if frame.field is None:
        return np.ascontiguousarray(frame.luma)
    rows_of_field = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, -0.5 * FIRST_ROW[frame.field]]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    edge = cv2.BORDER_REPLICATE
    luma = np.ascontiguousarray(frame.luma)
    whole = cv2.warpAffine(luma, rows_of_field, (width, 2 * height), flags=flags, borderMode=edge)
    return np.asarray(whole, np.uint8)


def size_of_frames(rig: Rig) -> tuple[int, int]:
    """Return width and height of a rig's frames: half the height if it is interlaced."""
    width, height = rig.size_px
    return (width, height // 2) if rig.shutter.is_interlaced else (width, height)


def frames_in(span: Span, shutter: Shutter) -> tuple[int, int]:
    """Return the first of a span's own frames, and the first after them."""
    n = 2 if shutter.is_interlaced else 1
    return n * (span.first + span.lead), n * (span.stop - span.trail)


class FieldSource(Closing):
    """Source of the fields of another source's pictures; satisfies `FrameSource`.

    `pictures`: closed with this one. `shutter`: interlaced.
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


class FrameFeed:
    """Feed of a camera's frames: another feed's pictures, or their fields; satisfies `Feed`.

    Its health warns where the pictures contradict the rig's shutter.
    """

    def __init__(self, pictures: Feed, shutter: Shutter) -> None:
        self.name = pictures.name
        self._pictures, self._shutter = pictures, shutter
        self._watch = FieldWatch(shutter)

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames, both fields of a picture as soon as it comes."""
        for picture in self._pictures:
            yield from frames_of([picture], self._shutter)
            # The frame is on its way: looking at it delays nothing.
            self._watch.look(picture)

    def health(self) -> PartHealth:
        """Return how the feed of the pictures is, with what contradicts the rig's shutter."""
        found, wrong = self._pictures.health(), self._watch.warning
        if not wrong or found.state is not State.OK:
            return found
        return dataclasses.replace(found, state=State.WARN, detail=wrong)

    def close(self) -> None:
        """End the iteration."""
        self._pictures.close()


def source_of_frames(pictures: FrameSource, shutter: Shutter) -> FrameSource:
    """Return the source of a camera's frames: fields where it is interlaced."""
    return FieldSource(pictures, shutter) if shutter.is_interlaced else pictures


def source_of_pictures(frames: FrameSource) -> FrameSource:
    """Return the source whose pictures the frames of another are, or are fields of."""
    return frames.pictures if isinstance(frames, FieldSource) else frames


# Rows are combed where they differ from both neighbours by this many grey levels, so many rows in
# turn to either side; neither thin lines nor noise do. On rendered nets and walls that move 0.8 to
# 2.7 % of the pixels were combed, of whole pictures none.
_COMBED_LEVELS, _COMBED_ROWS, _COMBED_COLUMNS = 8, 8, 5
_COMBED_SHARE = 1e-4
# Of what moves from picture to picture, the share that is combed: about a half in fields, none in
# whole pictures.
_MOVING_SHARE, _STILL_WHOLE = 2e-3, 0.02


def combed_share(luma: ImagePlane) -> float:
    """Return the share of pixels whose rows alternate as those of two fields of what moves."""
    # Along the rows, against the noise of uncompressed pictures; what is left of detail there does
    # without most of the columns.
    blurred = cv2.blur(luma, (_COMBED_COLUMNS, 1))[:, _COMBED_COLUMNS // 2 :: _COMBED_COLUMNS]
    rows = blurred.astype(np.int16)
    bend = 2 * rows[1:-1] - rows[:-2] - rows[2:]
    bend[1::2] *= -1
    column = np.ones((_COMBED_ROWS, 1), np.uint8)
    n = sum(np.count_nonzero(cv2.erode(one, column) > 2 * _COMBED_LEVELS) for one in (bend, -bend))
    return float(n / rows.size)


@dataclass(frozen=True, slots=True)
class FieldEvidence:
    """Signs of fields in whole pictures of a source."""

    is_marked: bool  # Whether the stream says that its pictures are interlaced.
    combed: float  # Mean share of combed pixels.
    # The same if the bottom rows came from the next picture: what fields would show at most.
    woven: float
    woven_top: float = 0.0  # The same if the top rows did.
    first_field: Field | None = None  # As the stream states it, if it does.

    @classmethod
    def of(
        cls, groups: Iterable[Sequence[Frame]], first_field: Field | None = None
    ) -> "FieldEvidence":
        """Look at groups of consecutive pictures, at least two each."""
        shares, is_marked = [], False
        for group in groups:
            is_marked = is_marked or any(picture.is_interlaced for picture in group)
            for one, following in itertools.pairwise(group):
                mixed = one.luma.copy(), following.luma.copy()
                mixed[0][1::2], mixed[1][1::2] = following.luma[1::2], one.luma[1::2]
                shares.append([combed_share(luma) for luma in (one.luma, *mixed)])
        if not shares:
            return cls(is_marked, 0.0, 0.0, first_field=first_field)
        combed, woven, woven_top = np.mean(shares, axis=0).tolist()
        return cls(is_marked, combed, woven, woven_top, first_field)

    @property
    def are_whole(self) -> bool:
        """Whether something moves, and is not combed, whatever the stream says."""
        return self.shows_motion and self.combed < _STILL_WHOLE * self.woven

    @property
    def shows_motion(self) -> bool:
        """Whether fields would be combed."""
        return self.woven > _MOVING_SHARE

    @property
    def are_fields(self) -> bool:
        """Whether the pictures are combed, or marked and nothing contradicts it."""
        return (self.is_marked or self.combed > _COMBED_SHARE) and not self.are_whole

    @property
    def first_by_motion(self) -> Field | None:
        """Field that comes first, as what moves shows it; None where too little does."""
        # The second field of a picture and the first of the next are one step of time apart; the
        # other two of both pictures, three steps, which combs more by at least this factor. On the
        # bundled dive, its pictures woven in either order, it was 1.9 or more for each of 74 pairs,
        # 3.3 in the middle.
        later_combs = 1.5
        early, late = sorted([self.woven, self.woven_top])
        if late < _MOVING_SHARE or late < later_combs * early:
            return None
        return "top" if self.woven > self.woven_top else "bottom"

    def contradiction(self, shutter: Shutter, fps: float | None) -> str:
        """Return what is wrong with the rig's shutter for these pictures; empty if nothing is.

        `fps`: pictures a second.
        """
        if not shutter.is_interlaced:
            if not self.are_fields:
                return ""
            sign = "the stream says so" if self.is_marked else "rows of what moves are combed"
            readout = f"{500.0 / fps:.5g}" if fps else "20"
            first = self.first_by_motion or self.first_field
            order = ", first_field: bottom" if first == "bottom" else ""
            return (
                f"the video is interlaced ({sign}), but the rig takes its pictures as whole; set "
                "in the rig file camera.shutter: "
                f"{{kind: interlaced, readout_ms: {readout}{order}}}"
            )
        if self.are_whole:
            return (
                "the rig says that the video is interlaced, but what moves in it is not combed; "
                "take camera.shutter out of the rig file, or record without deinterlacing"
            )
        return self._wrong_order(shutter.first_field)

    def _wrong_order(self, of_rig: Field) -> str:
        """Return what is wrong with the order of the rig's fields; motion knows it for certain."""
        first = self.first_by_motion
        if first is None and self.is_marked and self.first_field is not None:
            first = self.first_field
        if first in (None, of_rig):
            return ""
        if self.first_by_motion is None:
            return (
                f"the stream says that the {first} field comes first, the rig that the {of_rig} "
                f"one does; set camera.shutter.first_field: {first} in the rig file if the "
                "postures go to and fro"
            )
        return (
            f"the {first} field comes first, as what moves shows, but the rig says that the "
            f"{of_rig} one does; set camera.shutter.first_field: {first} in the rig file"
        )


def first_pairs(source: FrameSource) -> Iterator[list[Frame]]:
    """Yield some pairs of consecutive pictures from the beginning of a source, as far as it goes.

    `source`: that begins again when it is iterated again: images, or messages of a recording.
    """
    # Two seconds of video, in which a vehicle moves; reading them takes less than a second.
    n_pictures, every = 50, 5
    before = None
    with contextlib.suppress(SourceError):
        for n, picture in enumerate(itertools.islice(source, n_pictures)):
            if before is not None and n % every == 1 and picture.index == before.index + 1:
                yield [before, picture]
            before = picture


class FieldWatch:
    """Watch of a stream's pictures for what contradicts the rig's shutter."""

    def __init__(self, shutter: Shutter) -> None:
        self.warning = ""  # As from `FieldEvidence.contradiction`; empty if nothing is wrong.
        self._shutter = shutter
        self._first: Frame | None = None
        self._last: Frame | None = None
        self._next_s = 0.0
        self._pairs: list[FieldEvidence] = []

    def look(self, picture: Frame) -> None:
        """Look at the next picture, if it is time."""
        before, self._last = self._last, picture
        # A stream is looked at so often until so many pairs of pictures have shown motion: 2 ms
        # each of 720x576 px, 10 ms of 1920x1080.
        look_every_s, enough_pairs = 0.5, 10
        if before is None or self._first is None:
            self._first, self._next_s = picture, picture.time_s + look_every_s
            return
        if len(self._pairs) >= enough_pairs or picture.time_s < self._next_s:
            return
        if picture.index != before.index + 1 or picture.luma.shape != before.luma.shape:
            return
        self._next_s = picture.time_s + look_every_s
        found = FieldEvidence.of([(before, picture)])
        if found.shows_motion:
            self._pairs.append(found)
        elif self._pairs or not found.is_marked:
            return
        pairs = self._pairs or [found]
        mean = FieldEvidence(
            is_marked=any(one.is_marked for one in pairs),
            combed=float(np.mean([one.combed for one in pairs])),
            woven=float(np.mean([one.woven for one in pairs])),
            woven_top=float(np.mean([one.woven_top for one in pairs])),
        )
        # Standards have whole and half numbers of pictures a second, or nearly so.
        span_s = picture.time_s - self._first.time_s
        fps = round(2.0 * (picture.index - self._first.index) / span_s) / 2.0
        self.warning = mean.contradiction(self._shutter, fps)
