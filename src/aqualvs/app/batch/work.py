"""What is to be done for one dive, as it travels to the processes that do it."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from aqualvs.app.measuring import ScansFrames
from aqualvs.app.run import following_for
from aqualvs.app.run_inputs import RunRequest, check_fits, prepared_rig
from aqualvs.app.run_replay import Replay, ReplayRequest, replay_of
from aqualvs.app.runfile import versions
from aqualvs.app.target_file import target_facts
from aqualvs.errors import OptionError
from aqualvs.live.sources import FrameSource, open_source
from aqualvs.optics.rig import Rig
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.scanning.pipeline import Scanner

PIECE_FRAMES = 1500
"""Frames that a piece has at least: a minute of video, seconds of work."""

_FORMAT = 1
"""Of what pieces hold; another one makes old pieces worthless."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DiveWork:
    """One dive of a batch.

    Attributes
    ----------
    name : str
        Of the dive in the batch.
    request : RunRequest
        The run that the result equals; its `out` is the dive's folder.
    home : Path
        Folder for what is finished of the dive, until it is whole.
    dataset : Path
        Folder of the batch's Parquet data set.
    piece_frames : int
        Frames that a piece has at least.
    """

    name: str
    request: RunRequest
    home: Path
    dataset: Path
    piece_frames: int = PIECE_FRAMES


@dataclass(slots=True)
class OpenDive:
    """A dive that is ready to be measured.

    Attributes
    ----------
    source : FrameSource or Replay
        A context manager.
    rig : Rig
    request : RunRequest
        With the options that count, which a recording may bring itself.
    replay : Replay or None
        The source, where it is a recording.
    """

    source: FrameSource
    rig: Rig
    request: RunRequest
    replay: Replay | None

    def scanner(self) -> ScansFrames:
        """Return what measures the frames.

        Raises
        ------
        AqualvsError
            If the target that tells the water's index cannot be used.
        """
        following = following_for(self.request, self.rig)
        return following or self.replay or Scanner(self.rig, self.request.scanner)


def open_dive(request: RunRequest) -> OpenDive:
    """Open a dive's source and load its rig, as `run` does it.

    Raises
    ------
    AqualvsError
        If one of them cannot be used, or they do not belong together.
    """
    replay = replay_of(
        request.source,
        ReplayRequest(
            rig=request.rig,
            water=request.water,
            no_dome=request.no_dome,
            scanner=request.scanner,
            chosen=request.chosen,
            index_target=request.index_target,
            pictures=False,
        ),
    )
    if replay is not None:
        return OpenDive(replay, replay.rig, replace(request, scanner=replay.options), replay)
    rig = prepared_rig(request.rig, request.water, no_dome=request.no_dome)
    source = open_source(request.source, fps=request.fps)
    try:
        check_fits(source, rig)
    except BaseException:
        source.__exit__(None, None, None)
        raise
    return OpenDive(source, rig, request, None)


def result_key(dive: OpenDive) -> str:
    """Return what a dive's numbers depend on besides its pictures, as a short text.

    Content counts, not the place: a rig file that says the same under another name changes nothing.
    """
    request = dive.request
    target_content = content_digest(request.index_target)
    facts = request.facts() | {"rig_file": None, "index_target": target_content}
    target = asdict(target_facts(request.target))
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

    Raises
    ------
    OptionError
        If the file cannot be read.
    """
    if path is None:
        return None
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as fault:
        raise OptionError(f"{path}: cannot be read ({fault.strerror}); check the path") from fault
