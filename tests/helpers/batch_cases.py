"""Dives for batches, and workers that are no processes."""

import re
from collections import deque
from fractions import Fraction
from pathlib import Path

import av

from aqualvs.batch.scheduler import FinishedTask
from aqualvs.batch.work import DiveWork
from aqualvs.demo import bundled_dive
from aqualvs.results.run_request import RunRequest

DEMO = Path(str(bundled_dive()))
"""A net with a hole among fish and bubbles, and its rig."""

_TIMES = re.compile(rb"20\d\d-\d\d-\d\d[T ][0-9:+]+")
RESULTS = ("posture.csv", "posture_bare.csv", "points.parquet", "points.ply", "run.yaml")


def demo_dive(path, n_frames=24, group=6):
    """Encode the first pictures of the bundled dive again, with a key frame in every group."""
    with av.open(str(DEMO / "dive.mp4")) as old, av.open(str(path), "w") as new:
        stream = new.add_stream("libx264", rate=25)
        stream.width, stream.height, stream.pix_fmt = 720, 576, "yuv420p"
        stream.options = {"preset": "ultrafast", "g": str(group), "sc_threshold": "0"}
        for i, picture in zip(range(n_frames), old.decode(video=0), strict=False):
            picture.pts, picture.time_base, picture.pict_type = i, Fraction(1, 25), 0
            new.mux(stream.encode(picture))
        new.mux(stream.encode(None))
    return path


def work_for(folder, source, name="dive", *, piece_frames=6, rig=None, **more):
    """The work for a dive, in the folders of a batch."""
    request = RunRequest(
        source=str(source),
        rig=DEMO / "rig.yaml" if rig is None else rig,
        out=folder / "dives" / name,
        **{"report": False, **more},
    )
    return DiveWork(
        name=name,
        request=request,
        home=folder / ".batch" / name,
        dataset=folder / "dataset",
        piece_frames=piece_frames,
    )


def without_times(path):
    """Content of a file, less the times at which it was made."""
    data = path.read_bytes()
    return data if path.suffix in (".parquet", ".ply") else _TIMES.sub(b"", data)


class InlineWorkers:
    """Does each task when it is asked for one that has ended; `fail` may raise in its place."""

    n_slots = 2

    def __init__(self, fail=None):
        self.waiting, self.done, self.fail = deque(), [], fail

    def submit(self, token, function, *arguments):
        self.waiting.append((token, function, arguments))

    def next_done(self, timeout_s):  # noqa: ARG002
        # The last is taken first: results come in any order.
        token, function, arguments = self.waiting.pop()
        self.done.append(function.__name__)
        try:
            if self.fail is not None:
                self.fail(function.__name__, len(self.done))
            return FinishedTask(token, value=function(*arguments))
        except Exception as error:
            return FinishedTask(token, error=error)


class Listener:
    """Remembers what a season tells."""

    def __init__(self):
        self.expected, self.measured_bytes, self.n_frames, self.lines = 0, 0, 0, []

    def expect(self, n_bytes):
        self.expected += n_bytes

    def measured(self, n_bytes, n_frames):
        self.measured_bytes += n_bytes
        self.n_frames += n_frames

    def ended(self, record):
        self.lines.append(record.line())
