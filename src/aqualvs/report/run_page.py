"""Report of a run: one HTML page that opens anywhere, without a network.

`gather` reads everything that the page shows from the run's folder, once, into a `Material`;
`write_report` turns it into the page.
"""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aqualvs.errors import OutputError, SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.report import charts, html
from aqualvs.report.findings import headline, warnings_of
from aqualvs.report.frames import (
    SampleFrame,
    choose_pictures,
    choose_samples,
    decode_frames,
    make_picture,
)
from aqualvs.report.net import NetTables, net_cards, net_view, net_warnings, read_net
from aqualvs.report.points import MAX_LASERS, PointSummary, summarize_points
from aqualvs.report.run_data import (
    LaserFacts,
    Track,
    dome_radius_mm,
    lasers_of,
    read_bare,
    read_run_file,
    read_track,
    read_truth,
    working_range_m,
)
from aqualvs.results.files import replace_text
from aqualvs.results.folder import check_run_files
from aqualvs.scanning.scan import ImagePlane
from aqualvs.text import clock


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Content of a run's report.

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
    pictures: dict[int, SampleFrame]
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
) -> tuple[dict[int, SampleFrame], str]:
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


def write_report(run_dir: Path, *, truth: Path | None = None, out: Path | None = None) -> Path:
    """Write the report of a finished or interrupted run.

    Parameters
    ----------
    run_dir : Path
        Folder with `posture.csv`; `points.parquet`, `run.yaml`, `posture_bare.csv`, `net.csv` with
        what belongs to it and the source that `run.yaml` names are used if they are there.
    truth : Path or None
        CSV with columns `frame,range_mm,pitch_deg,yaw_deg`, overlaid with the errors.
    out : Path or None
        The file to write; `report.html` in `run_dir` if None.

    Returns
    -------
    path : Path
        The page. It carries all it needs and asks no network.

    Raises
    ------
    SourceError
        If `posture.csv`, or the truth, cannot be read or holds no frame.
    OutputError
        If the page cannot be written.
    """
    material = gather(run_dir, truth)
    text = html.page(_parts(material) | _machinery(material))
    path = out or run_dir / "report.html"
    try:
        replace_text(path, text)
    except OSError as fault:
        raise OutputError(
            f"{path}: cannot write the report ({fault.strerror}); free the disk or choose a "
            "folder that can be written"
        ) from fault
    return path


def _parts(m: Material) -> dict[str, str]:
    """Return the visible parts of the page, in its order."""
    planes_known = any(laser.known for laser in m.lasers)
    return {
        "title": html.text(m.title),
        "subtitle": html.subtitle(m.run),
        "cards": html.cards([*headline(m.track), *net_cards(m.net)]),
        "warnings": html.notice(m.warnings),
        "posture_lead": html.posture_lead(m.track, m.truth),
        "truth": html.truth_view(m.track, m.truth),
        "net": net_view(m.net),
        "planes": html.plane_view(m.lasers, m.points is not None),
        "cloud": html.cloud_view(m.points, planes_known),
        "pictures": html.picture_view(_captions(m), m.pictures, m.no_pictures, m.names),
        "quality": html.quality_view(m.track, m.points, m.names),
        "bare": html.bare_view(m.track, m.bare, m.truth),
        "rig": html.rig_view(m.run, m.lasers),
        "footer": html.footer(m.run, m.track),
    }


def _machinery(m: Material) -> dict[str, str]:
    """Return style, scripts and the numbers that they draw."""
    return {
        "css": html.asset("report.css"),
        "plotly": html.asset("plotly-gl3d.min.js"),
        "script": html.asset("report.js"),
        "data": html.embedded_json(_data(m)),
    }


def _data(m: Material) -> dict[str, Any]:
    data: dict[str, Any] = {
        "lasers": charts.laser_list(m.names),
        "labels": charts.label_list(),
        "posture": charts.posture_chart(m.track, m.truth),
    }
    if m.truth is not None:
        data["error"] = charts.error_chart(m.track, m.truth)
    if m.points is not None:
        data["planes"] = charts.plane_charts(m.points, m.track, m.sample_rows, m.lasers)
        data["cloud"] = charts.cloud_chart(m.points, len(m.lasers), dome_radius_mm(m.rig))
        data["quality"] = charts.quality_charts(m.points, m.track, len(m.lasers))
    if m.bare is not None:
        data["bare"] = charts.bare_chart(m.track, m.bare, m.truth)
    return data


def _captions(m: Material) -> dict[int, tuple[str, str, bool]]:
    track = m.track
    return {
        row: (
            f"Frame {track.frame[row]}, {clock(float(track.time_s[row]))}",
            charts.posture_words(track, row),
            bool(track.valid[row]),
        )
        for row in m.picture_rows
    }
