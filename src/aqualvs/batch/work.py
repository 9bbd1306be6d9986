"""Work on one dive of a batch, as it is sent to the processes, and the first look at the dive.

The first look (`probe`) finds whether the dive can be measured, what its source holds, and where
it is cut into pieces.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import av

from aqualvs.batch.dataset import read_valid_manifest, write_manifest
from aqualvs.errors import OptionError
from aqualvs.nets.target_file import target_dict
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.pipeline import OpenDive, open_dive
from aqualvs.results.files import writing
from aqualvs.results.run_request import RunRequest, source_dict, versions
from aqualvs.scanning.row_motion import REACH
from aqualvs.sources.fields import source_of_pictures
from aqualvs.sources.images import ImageSource, images_in
from aqualvs.sources.spans import Span, SpanKind, image_spans, video_spans
from aqualvs.sources.video import VideoSource

PIECE_FRAMES = 1500
"""Frames that a piece has at least: a minute of video, seconds of work."""

_FORMAT = 4
"""Of what pieces hold; another one makes old pieces worthless."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiveWork:
    """One dive of a batch."""

    name: str  # Of the dive in the batch.
    request: RunRequest  # The run that the result equals; its `out` is the dive's folder.
    home: Path  # Folder for what is finished of the dive, until it is whole.
    dataset: Path  # Folder of the batch's Parquet data set.
    piece_frames: int = PIECE_FRAMES  # Frames that a piece has at least.


def result_key(dive: OpenDive) -> str:
    """Return what a dive's numbers depend on besides its pictures, as a short text.

    Content counts, not the place: a rig file that says the same under another name changes nothing.
    """
    request = dive.request
    target_content = content_digest(request.index_target)
    facts = request.to_dict() | {"rig_file": None, "index_target": target_content}
    facts_of_target = target_dict(request.target)
    target = asdict(facts_of_target) | {"mesh_filter": asdict(facts_of_target.mesh_filter)}
    del target["filter_lengths"]
    found = {
        "format": _FORMAT,
        "rig": rig_to_mapping(dive.rig),
        "options": facts,
        "fps": request.fps,
        "target": target,
        "versions": versions(),
    }
    return digest(found)


def digest(facts: Mapping[str, Any]) -> str:
    """Return a short text that differs for different facts."""
    text = json.dumps(facts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def content_digest(path: Path | None) -> str | None:
    """Return a text that differs for files of different content; None for no file.

    Raises `OptionError` if the file cannot be read.
    """
    if path is None:
        return None
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as fault:
        raise OptionError(f"{path}: cannot be read ({fault.strerror}); check the path") from fault


_PROBE = "survey"


@dataclass(frozen=True, slots=True, kw_only=True)
class DiveProbe:
    """Result of the first look at a dive: its content, and where it is cut."""

    source_key: str  # Of the dive's content; other pictures give another key.
    result_key: str  # Of all else that the result depends on.
    spans: tuple[Span, ...]  # The pieces, at least one.
    # Why the dive is not cut, where it could be longer than a piece; empty if it is.
    why_whole: str
    # Size of the source.
    n_bytes: int
    # If known.
    n_frames: int | None
    # For `run.yaml`.
    source: Mapping[str, Any]

    @property
    def key(self) -> str:
        """Key of everything that the dive's result depends on."""
        return digest({"source": self.source_key, "result": self.result_key})

    @property
    def is_whole(self) -> bool:
        """True if the dive is not cut."""
        return [span.kind for span in self.spans] == [SpanKind.WHOLE]

    def only(self, number: int) -> "DiveProbe":
        """Return the survey with one of its pieces alone, as its process needs it."""
        return replace(self, spans=(self.spans[number],))

    def in_one_piece(self, why: str) -> "DiveProbe":
        """Return the survey of the same dive, not to be cut."""
        whole = (Span(kind=SpanKind.WHOLE, n_bytes=self.n_bytes),)
        return replace(self, spans=whole, why_whole=why)


def probe(work: DiveWork) -> DiveProbe:
    """Look at a dive.

    Reads the whole file once, unless an earlier look is still valid, but decodes nothing.

    Raises `AqualvsError` if the dive or its rig cannot be used.
    """
    with open_dive(work.request) as dive:
        key = result_key(dive)
        margin = REACH if dive.rig.shutter.needs_neighbours else 0
        stat = _stat_key(Path(work.request.source))
        stat |= {"frames": work.piece_frames, "margin": margin}
        folder = work.home / _PROBE
        content = read_valid_manifest(folder, digest(stat))
        if not content:
            content = _content(dive, work.piece_frames, margin)
            with writing(folder):
                folder.mkdir(parents=True, exist_ok=True)
                write_manifest(folder, digest(stat), content, [])
        spans = [Span(**{**span, "kind": SpanKind(span["kind"])}) for span in content["spans"]]
        found = DiveProbe(
            **content | {"spans": tuple(spans)},
            result_key=key,
            n_frames=dive.source.n_frames,
            source=source_dict(dive.source),
        )
    why = found.why_whole
    if work.request.index_target is not None:
        why = "the water's index is tracked from frame to frame"
    return found.in_one_piece(why) if why or not spans else found


def _content(dive: OpenDive, piece_frames: int, margin: int) -> dict[str, Any]:
    """Return what a `DiveProbe` holds of the source itself, ready for JSON."""
    path, pictures = Path(dive.request.source), source_of_pictures(dive.source)
    if isinstance(pictures, VideoSource):
        try:
            video = video_spans(path, piece_frames, margin)
        except (av.error.FFmpegError, OSError) as fault:
            return _uncut(path, f"cannot be scanned ({fault})")
        return {
            "source_key": digest({"packets": video.checksum, "n_bytes": video.n_bytes}),
            "spans": [asdict(span) for span in video.spans],
            "why_whole": video.why_whole,
            "n_bytes": video.n_bytes,
        }
    if isinstance(pictures, ImageSource) and path.is_dir():
        files = [(image.name, image.stat()) for image in images_in(path)]
        sizes = [stat.st_size for _, stat in files]
        return {
            "source_key": digest({"files": [(n, s.st_size, s.st_mtime_ns) for n, s in files]}),
            "spans": [asdict(span) for span in image_spans(sizes, piece_frames, margin)],
            "why_whole": "",
            "n_bytes": sum(sizes),
        }
    return _uncut(path, "recordings and bags are not split")


def _uncut(path: Path, why: str) -> dict[str, Any]:
    stat = _stat_key(path)
    return {"source_key": digest(stat), "spans": [], "why_whole": why, "n_bytes": size_of(path)}


def size_of(path: Path) -> int:
    """Return the size of a file, or of the files in a folder; 0 where there is nothing."""
    try:
        if path.is_dir():
            return sum(inner.stat().st_size for inner in path.iterdir() if inner.is_file())
        return path.stat().st_size
    except OSError:
        return 0


def _stat_key(path: Path) -> dict[str, Any]:
    """Return what changes when a file, or what is in a folder, is replaced."""
    found = [path, *(path.iterdir() if path.is_dir() else ())]
    latest = max(one.stat().st_mtime_ns for one in found)
    return {"path": str(path), "size": size_of(path), "n_files": len(found), "mtime_ns": latest}
