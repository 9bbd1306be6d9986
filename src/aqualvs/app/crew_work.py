"""What the processes of a crew do: each measures parts of a dive by themselves."""

import itertools
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import cv2

from aqualvs.app.blocks import block_length, in_blocks
from aqualvs.app.crew_messages import Ended, Message, packed
from aqualvs.app.measuring import Measured, Meter
from aqualvs.live.sources.span_frames import UnlikeSurveyError, image_frames, video_frames
from aqualvs.live.sources.spans import Span, SpanKind
from aqualvs.optics.rig import Rig
from aqualvs.scanning.pipeline import Scanner, ScannerOptions
from aqualvs.scanning.scan import Frame


@dataclass(frozen=True, slots=True)
class Part:
    """Frames of a span that are wanted.

    Attributes
    ----------
    span : Span
    first, stop : int
        Frames `first` to `stop` - 1, which lie in the span.
    """

    span: Span
    first: int
    stop: int


@dataclass(frozen=True, slots=True, kw_only=True)
class CrewWork:
    """What a crew measures.

    Attributes
    ----------
    path : Path
        A video, or a folder of images.
    parts : tuple of Part
        In the order of the dive.
    rig : Rig
    options : ScannerOptions
    fps : float
        Frame rate of images.
    """

    path: Path
    parts: tuple[Part, ...]
    rig: Rig
    options: ScannerOptions
    fps: float


def serve(work: CrewWork, pipe: Connection) -> None:
    """Measure the parts whose numbers come through a pipe, until None does, or nobody listens.

    What is found goes back block by block, and an `Ended` after each part.
    """
    # A terminal sends Ctrl-C to all processes; the one that has begun this one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    cv2.setNumThreads(1)
    try:
        meter = Meter(work.rig, Scanner(work.rig, work.options))
        while (number := pipe.recv()) is not None:
            for message in _messages(work, work.parts[number], meter):
                pipe.send_bytes(packed(message))
    except (EOFError, BrokenPipeError):
        # The other end has gone; whatever is buffered for it goes too.
        os._exit(1)


def _messages(work: CrewWork, part: Part, meter: Meter) -> Iterator[Message]:
    blocks = in_blocks(_frames(work, part), block_length(work.rig.size_px), UnlikeSurveyError)
    try:
        for block in blocks:
            yield [Measured(found.scan, found.bare) for found in meter.measure(block)]
    except UnlikeSurveyError:
        yield Ended.UNLIKE_SURVEY
    else:
        yield Ended.WHOLE


def _frames(work: CrewWork, part: Part) -> Iterator[Frame]:
    span = part.span
    if span.kind is SpanKind.VIDEO:
        frames = video_frames(work.path, span, work.rig.size_px)
    else:
        frames = image_frames(work.path, span, work.fps)
    if part.stop < span.stop:
        return itertools.islice(frames, part.first - span.first, part.stop - span.first)
    # To its very end, where the reader compares the span with what was promised.
    return itertools.islice(frames, part.first - span.first, None)
