"""Everything the page is made of, gathered from the run folder once."""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aqualvs.app.net_report import NetTables, net_warnings, read_net
from aqualvs.app.outputs import check_run_files
from aqualvs.app.report_findings import warnings_of
from aqualvs.app.report_frames import (
    Picture,
    choose_pictures,
    choose_samples,
    decode_frames,
    make_picture,
)
from aqualvs.app.report_points import MAX_LASERS, PointSummary, summarize_points
from aqualvs.app.report_rig import LaserFacts, lasers_of, working_range_m
from aqualvs.app.report_run import Track, read_bare, read_run_file, read_track, read_truth
from aqualvs.errors import SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.scan import ImagePlane


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """What a report shows.

    Attributes
    ----------
    title : str
        The dive's name.
    run : mapping
        Content of `run.yaml`, empty where it is missing.
    track : Track
    truth, bare : array, shape (N, 3), or None
        On the frames of the track: range in metres, pitch and yaw in degrees.
    points : PointSummary or None
    lasers : list of LaserFacts
        At least as many as have points.
    picture_rows, sample_rows : list of int
        Rows of the track with a picture, and in the laser-plane view.
    pictures : dict
        Row to picture, where the source could be decoded again.
    no_pictures : str
        Why pictures are missing; "" where none is.
    net : NetTables or None
        The state of the net, where it was evaluated.
    warnings : list of str
    """

    title: str
    run: Mapping[str, Any]
    track: Track
    truth: FloatArray | None
    bare: FloatArray | None
    points: PointSummary | None
    lasers: list[LaserFacts]
    picture_rows: list[int]
    sample_rows: list[int]
    pictures: dict[int, Picture]
    no_pictures: str
    net: NetTables | None
    warnings: list[str]

    @property
    def rig(self) -> Mapping[str, Any]:
        """Return the rig file's content, empty where it is unknown."""
        return mapping(self.run, "rig")

    @property
    def names(self) -> list[str]:
        """Return the lasers' names."""
        return [laser.name for laser in self.lasers]


def gather(run_dir: Path, truth: Path | None) -> Material:
    """Read a run folder; only `posture.csv` must be there.

    Raises
    ------
    SourceError
        If `posture.csv`, or the truth, cannot be read or holds no frame.
    """
    check_run_files(run_dir)
    run, trouble = read_run_file(run_dir)
    track = read_track(run_dir / "posture.csv")
    source = _source(run_dir, run)
    picture_rows = choose_pictures(track, None if isinstance(source, str) else source)
    sample_rows = choose_samples(track, picture_rows)
    frames = track.frame[sample_rows].tolist()
    with ThreadPoolExecutor(1) as beside:
        # FFmpeg works on the pictures while this thread counts points.
        images = beside.submit(_decoded, source, track, picture_rows)
        points, no_points = summarize_points(run_dir, track, frames)
        pictures, no_pictures = _pictures(source, images, track, points)
    rig = mapping(run, "rig")
    lasers = _lasers(rig, points)
    names = [laser.name for laser in lasers]
    net, no_net = read_net(run_dir)
    bare, no_bare = read_bare(run_dir, track)
    told = warnings_of(track, points, pictures, run, working_range_m(rig), names)
    return Material(
        title=_title(run_dir, run),
        run=run,
        track=track,
        truth=None if truth is None else read_truth(truth, track),
        bare=bare,
        points=points,
        lasers=lasers,
        picture_rows=picture_rows,
        sample_rows=sample_rows,
        pictures=pictures,
        no_pictures=no_pictures,
        net=net,
        warnings=[
            text
            for text in (
                trouble,
                no_points,
                no_pictures,
                no_bare,
                no_net,
                *told,
                *net_warnings(net),
            )
            if text
        ],
    )


def mapping(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the mapping below a key, empty if there is none."""
    found = content.get(key)
    return found if isinstance(found, dict) else {}


def _lasers(rig: Mapping[str, Any], points: PointSummary | None) -> list[LaserFacts]:
    known = lasers_of(rig)[:MAX_LASERS]
    seen = points.n_lasers if points is not None else 0
    return known + [LaserFacts.unknown(i) for i in range(len(known), seen)]


def _title(run_dir: Path, run: Mapping[str, Any]) -> str:
    path = _source_name(run)
    return Path(path).stem if path else run_dir.resolve().name


def _source_name(run: Mapping[str, Any]) -> str:
    """Return the path of the source as the run has it; a folder of images has only a name."""
    source = mapping(run, "source")
    return str(source.get("path") or source.get("name") or "")


def _source(run_dir: Path, run: Mapping[str, Any]) -> Path | str:
    """Return the source to decode again, or why there is none."""
    path = _source_name(run)
    if not path:
        return "run.yaml names no source: sample frames come without pictures."
    try:
        for place in (Path(path), run_dir / path):
            if place.is_file() or place.is_dir():
                return place
    except OSError:
        # A name that the file system refuses is no file of it.
        pass
    return f"{path} is not there any more: sample frames come without pictures."


def _decoded(source: Path | str, track: Track, rows: list[int]) -> dict[int, ImagePlane]:
    return {} if isinstance(source, str) else decode_frames(source, track, rows)


def _pictures(
    source: Path | str,
    decoded: "Future[dict[int, ImagePlane]]",
    track: Track,
    points: PointSummary | None,
) -> tuple[dict[int, Picture], str]:
    if isinstance(source, str):
        return {}, source
    try:
        images = decoded.result()
    except SourceError as fault:
        return {}, f"{fault}: sample frames come without pictures."
    if not images:
        return {}, f"{source} cannot be decoded again: sample frames come without pictures."
    samples = {} if points is None else points.samples
    pictures = {
        row: make_picture(image, samples.get(int(track.frame[row])))
        for row, image in images.items()
    }
    return pictures, ""
