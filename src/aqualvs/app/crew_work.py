"""What the processes of a crew do: each measures parts of a dive by themselves."""

import itertools
import os
import signal
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import cv2

from aqualvs.app.blocks import in_blocks
from aqualvs.app.crew_messages import Ended, Message
from aqualvs.app.crew_post import Sender, SharedMemory
from aqualvs.app.measuring import Meter
from aqualvs.live.sources.span_frames import UnlikeSurveyError, VideoParts, image_frames
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


def serve(
    work: CrewWork,
    pipe: Connection,
    memory: SharedMemory | None,
    others: Sequence[Connection],
) -> None:
    """Measure the parts whose numbers come through a pipe, until its other end is closed.

    What is found goes back block by block, and an `Ended` after each part. `others` are pipes that
    this process has inherited and that are not its own.
    """
    for other in others:
        other.close()
    # A terminal sends Ctrl-C to all processes; the one that has begun this one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    cv2.setNumThreads(1)
    sender = Sender(pipe, memory)
    try:
        meter = Meter(work.rig, Scanner(work.rig, work.options))
        with VideoParts(work.path, work.rig.size_px) as video:
            while True:
                part = work.parts[sender.next_part()]
                for message in _messages(part, _frames(work, part, video), meter):
                    sender.send(message)
    except (EOFError, ConnectionError):
        # The other end has gone; whatever is buffered for it goes too.
        os._exit(1)


def _messages(part: Part, frames: Iterator[Frame], meter: Meter) -> Iterator[Message]:
    wanted = itertools.islice(
        frames,
        part.first - part.span.first,
        # To its very end, where the reader compares the span with what was promised.
        None if part.stop == part.span.stop else part.stop - part.span.first,
    )
    try:
        for block in in_blocks(wanted, meter.block_length, UnlikeSurveyError):
            yield meter.measure(block)
    except UnlikeSurveyError:
        yield Ended.UNLIKE_SURVEY
    else:
        yield Ended.WHOLE


def _frames(work: CrewWork, part: Part, video: VideoParts) -> Iterator[Frame]:
    if part.span.kind is SpanKind.VIDEO:
        return video.frames(part.span)
    return image_frames(work.path, part.span, work.fps)
