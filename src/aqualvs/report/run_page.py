"""Report of a run: one HTML page that opens anywhere, without a network.

`gather` reads everything that the page shows from the run's folder, once, into a `Material`;
`write_report` turns it into the page.
"""

import contextlib
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.errors import OutputError, SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.report import charts, html
from aqualvs.report.findings import errors_against, headline, warnings_of
from aqualvs.report.frames import (
    SampleFrame,
    choose_pictures,
    choose_samples,
    decode_frames,
    make_crop,
    make_picture,
)
from aqualvs.report.net import (
    HolePicture,
    NetTables,
    hole_pictures,
    net_cards,
    net_view,
    net_warnings,
    read_net,
)
from aqualvs.report.points import MAX_LASERS, PointSummary, summarize_points
from aqualvs.report.run_data import (
    LaserFacts,
    Track,
    dome_radius_mm,
    facts,
    housing_name,
    lasers_of,
    mapping,
    noted_truth,
    read_bare,
    read_run_file,
    read_track,
    read_truth,
    source_name,
    working_range_m,
)
from aqualvs.results.files import replace_text
from aqualvs.results.folder import check_run_files
from aqualvs.scanning.scan import ImagePlane, Label
from aqualvs.text import LABEL_COLOURS, LABEL_WORDS, clock, count_text, signed


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Content of a run's report."""

    title: str  # The dive's name.
    run: Mapping[str, Any]  # Content of `run.yaml`, empty where it is missing.
    track: Track
    # Shape (N, 3): on the frames of the track: range in metres, pitch and yaw in degrees.
    truth: FloatArray | None
    bare: FloatArray | None

    points: PointSummary | None
    lasers: list[LaserFacts]  # At least as many as have points.
    # Rows of the track with a picture, and in the laser-plane view.
    picture_rows: list[int]
    sample_rows: list[int]
    # Row to picture, where the source could be decoded again.
    pictures: dict[int, SampleFrame]
    # Why pictures are missing; "" where none is.
    no_pictures: str
    # The state of the net, where it was evaluated.
    net: NetTables | None
    # Number of a hole to its picture.
    crops: dict[str, SampleFrame]

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

    Raises `SourceError` if `posture.csv`, or the truth, cannot be read or holds no frame.
    """
    check_run_files(run_dir)
    run, fault = read_run_file(run_dir)
    track = read_track(run_dir / "posture.csv")
    source = _source(run_dir, run)
    picture_rows = choose_pictures(track, None if isinstance(source, str) else source)
    sample_rows = choose_samples(track, picture_rows)
    frames = track.frame[sample_rows].tolist()
    net, no_net = read_net(run_dir)
    holes = _rows_of_holes(net, track)
    with ThreadPoolExecutor(1) as beside:
        # FFmpeg works on the pictures while this thread counts points.
        wanted = sorted({*picture_rows, *holes.values()})
        images = None
        if not isinstance(source, str):
            images = beside.submit(decode_frames, source, track, wanted)
        points, no_points = summarize_points(run_dir, track, frames)
        decoded, no_pictures = _decoded_or_why(source, images)
    samples = {} if points is None else points.samples
    pictures = {
        row: make_picture(decoded[row], samples.get(int(track.frame[row])))
        for row in picture_rows
        if row in decoded
    }
    rig = mapping(run, "rig")
    lasers = lasers_of(rig)[:MAX_LASERS]
    seen = 0 if points is None else points.n_lasers
    lasers += [LaserFacts.unknown(i) for i in range(len(lasers), seen)]
    names = [laser.name for laser in lasers]
    bare, no_bare = read_bare(run_dir, track)
    true, no_truth = noted_truth(run, track) if truth is None else (read_truth(truth, track), "")
    missing = (fault, no_points, no_pictures, no_bare, no_truth, no_net)
    warnings = warnings_of(track, points, pictures, run, working_range_m(rig), names)
    return Material(
        title=Path(source_name(run)).stem or run_dir.resolve().name,
        run=run,
        track=track,
        truth=true if true is not None and np.isfinite(true).any() else None,
        bare=bare,
        points=points,
        lasers=lasers,
        picture_rows=picture_rows,
        sample_rows=sample_rows,
        pictures=pictures,
        no_pictures=no_pictures,
        net=net,
        crops={
            place.number: make_crop(decoded[row], place.middle, place.diameter)
            for place, row in holes.items()
            if row in decoded
        },
        warnings=[
            *filter(None, missing),
            *warnings,
            *(f"Net: {words}." for words in net_warnings(net.summary if net else {})),
        ],
    )


def _source(run_dir: Path, run: Mapping[str, Any]) -> Path | str:
    """Return the source to decode again, or why there is none."""
    path = source_name(run)
    if not path:
        return "run.yaml names no source: sample frames come without pictures."
    # A name that the file system refuses is no file of it.
    with contextlib.suppress(OSError):
        for place in (Path(path), run_dir / path):
            if place.is_file() or place.is_dir():
                return place
    return f"{path} is not there any more: sample frames come without pictures."


def _rows_of_holes(net: NetTables | None, track: Track) -> dict[HolePicture, int]:
    """Return the row of the track with the nearest look at each hole that is to be shown."""
    rows = {int(frame): row for row, frame in enumerate(track.frame)}
    places = [] if net is None else hole_pictures(net)
    return {place: rows[place.frame] for place in places if place.frame in rows}


def _decoded_or_why(
    source: Path | str, decoded: "Future[dict[int, ImagePlane]] | None"
) -> tuple[dict[int, ImagePlane], str]:
    if decoded is None:
        return {}, str(source)
    try:
        images = decoded.result()
    except SourceError as fault:
        return {}, f"{fault}: sample frames come without pictures."
    if not images:
        return {}, f"{source} cannot be decoded again: sample frames come without pictures."
    return images, ""


def write_report(run_dir: Path, *, truth: Path | None = None) -> Path:
    """Write the report of a finished or interrupted run.

    Parameters
    ----------
    run_dir : Path
        Folder with `posture.csv`; `points.parquet`, `run.yaml`, `posture_bare.csv`, `net.csv` with
        what belongs to it and the source that `run.yaml` names are used if they are there.
    truth : Path or None
        CSV with columns `frame,range_mm,pitch_deg,yaw_deg`, overlaid with the errors. None: the
        one that `run.yaml` names, where it is there and of this dive.

    Returns the path of the page, `report.html` in `run_dir`, which carries all it needs and asks no
    network. Raises `SourceError` if `posture.csv`, or the truth, cannot be read or holds no frame;
    `OutputError` if the page cannot be written.
    """
    material = gather(run_dir, truth)
    text = html.page("report.html", _content(material))
    path = run_dir / "report.html"
    try:
        replace_text(path, text)
    except OSError as fault:
        raise OutputError(
            f"{path}: cannot write the report ({fault.strerror}); free the disk or choose a "
            "folder that can be written"
        ) from fault
    return path


def _content(m: Material) -> dict[str, object]:
    """Return what the page shows, in its order, and the numbers that its script draws."""
    housing = housing_name(m.rig)
    # Of the rig's frame, roughly: the lens lies within its dome.
    origin = "dome" if housing == "dome" else "lens"
    known = [index for index, laser in enumerate(m.lasers) if laser.known]
    return {
        "title": m.title,
        "subtitle": _subtitle(m.run),
        "cards": html.cards([*headline(m.track), *net_cards(m.net)]),
        "warnings": html.notice(m.warnings),
        "has_refusals": not m.track.valid.all(),
        "truth": None if m.truth is None else _errors_table(m.track, m.truth),
        "net": html.Raw(net_view(m.net, m.crops)),
        "planes": known,
        "labels": [(LABEL_COLOURS[label], _MARKS[label], LABEL_WORDS[label]) for label in Label],
        "cloud_points": _cloud_amount(m.points),
        "cloud_of_frames": bool(known),
        "origin": origin,
        "shots": _shots(m),
        "no_pictures": m.no_pictures,
        "has_pictures": bool(m.pictures),
        "names": m.names,
        "frames": _frame_counts(m.track),
        "points": None if m.points is None else _laser_counts(m.points, m.names),
        "quality_charts": [] if m.points is None else _quality_places(m.points),
        "housing": housing,
        "bare": None if m.bare is None else _bare_ranges(m.track, m.bare, housing),
        "bare_errors": _both_errors(m, housing),
        "lasers": _laser_rows(m.lasers, "dome's centre" if origin == "dome" else "origin"),
        "facts": _fact_blocks(m.run),
        "footer": _footer(m.run, m.track),
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
        data["cloud"] = charts.cloud_chart(m.points, m.track, len(m.lasers), dome_radius_mm(m.rig))
        data["quality"] = charts.quality_charts(m.points, m.track, len(m.lasers))
    if m.bare is not None:
        data["bare"] = charts.bare_chart(m.track, m.bare, m.truth)
    return data


_MARKS = ("●", "■", "▲", "★", "□", "✕", "◆", "○")


def _subtitle(run: Mapping[str, Any]) -> str:
    """Return the rig's name, the source and its picture size, as far as they are known."""
    rig, source = mapping(run, "rig"), run.get("source")
    said = [f"Rig “{rig['name']}”"] if rig.get("name") else []
    if isinstance(source, dict):
        said.append(f"source {source.get('path') or source.get('name') or 'unknown'}")
        size = source.get("size_px") or [source.get("width_px"), source.get("height_px")]
        if isinstance(size, list) and all(size):
            said.append(f"{' × '.join(map(str, size))} px")
    return ", ".join(said)


def _errors_table(track: Track, truth: FloatArray) -> tuple[int, str]:
    """Return the number of frames with both a posture and truth, and the table of the errors."""
    rms, worst, count = errors_against(truth, track.posture)
    if not count:
        return 0, ""
    names, scale = ("range, mm", "pitch, °", "yaw, °"), (1e3, 1.0, 1.0)
    rows = [
        (name, f"{s * r:.{digits}f}", f"{s * w:.{digits}f}")
        for name, digits, s, r, w in zip(names, (2, 3, 3), scale, rms, worst, strict=True)
    ]
    relative = np.abs(track.posture[:, 0] / truth[:, 0] - 1.0)
    relative = 100.0 * relative[np.isfinite(relative)]
    share = f"{np.sqrt((relative**2).mean()):.3f}", f"{relative.max():.3f}"
    rows.insert(1, ("range, %", *share))
    return count, html.table(("", "rms", "max"), rows)


def _cloud_amount(points: PointSummary | None) -> str:
    """Return how many points the cloud shows; empty without any."""
    if points is None or not len(points.cloud_in_target):
        return ""
    total, shown = int(points.on_target.sum()), len(points.cloud_in_target)
    return f"All {total:,}" if shown == total else f"A random {shown:,} of {total:,}"


def _shots(m: Material) -> list[tuple[str, str, bool, SampleFrame | None]]:
    """Return the sample frames: heading, posture or refusal in words, which of both, picture."""
    track = m.track
    return [
        (
            f"Frame {track.frame[row]}, {clock(float(track.time_s[row]))}",
            charts.posture_text(track, row),
            bool(track.valid[row]),
            m.pictures.get(row),
        )
        for row in m.picture_rows
    ]


def _frame_counts(track: Track) -> str:
    """Return the table of the frames with a posture, and of the refusals by reason."""
    counted = [("with a posture", int(track.valid.sum())), *charts.reason_counts(track)]
    rows = [(words, f"{count:,}", f"{100 * count / len(track):.1f} %") for words, count in counted]
    return html.table(("", "frames", "share"), rows)


def _quality_places(points: PointSummary) -> list[tuple[str, str]]:
    """Return the charts on the quality of the points that there are: identifier and title."""
    places = (
        ("counts", "Target points per frame and laser", points.on_target),
        ("rms", "Residuals over time", points.n_squares),
        ("residual", "Residuals by laser", points.residual),
        ("quality", "Stripe quality of target points", points.quality),
    )
    return [(f"chart-{name}", title) for name, title, counts in places if counts.any()]


def _bare_ranges(track: Track, bare: FloatArray, housing: str) -> tuple[int, str]:
    """Return the number of frames with a posture both ways, and the table of their ranges."""
    percent = 100.0 * (bare[:, 0] / track.posture[:, 0] - 1.0)
    percent = percent[np.isfinite(percent)]
    if not len(percent):
        return 0, ""
    cells = (signed(f"{v:+.2f} %") for v in (percent.min(), np.median(percent), percent.max()))
    row = (f"range without the {housing}, relative to with it", *cells)
    return len(percent), html.table(("", "min", "median", "max"), [row])


def _laser_rows(lasers: list[LaserFacts], centre: str) -> str:
    if not lasers:
        return ""
    head = ("laser", "normal x", "normal y", "normal z", f"offset from the {centre}, mm")
    rows = []
    for index, laser in enumerate(lasers):
        bent = " (bent sheet; the plane that fits it)" if laser.bent else ""
        cells = [*(f"{v:+.5f}" for v in laser.normal), f"{1e3 * laser.offset:.2f}"]
        cells = [signed(cell) if np.isfinite(laser.offset) else "–" for cell in cells]
        rows.append((html.Raw(html.swatch(index) + escape(laser.name + bent)), *cells))
    return html.table(head, rows)


def _fact_blocks(run: Mapping[str, Any]) -> list[tuple[str, html.Raw]]:
    """Return rig, options and versions as tables with their titles."""
    left_out = {"rig": ("lasers", "solved_from", "points", "history"), "summary": ("warnings",)}
    return [
        (key.capitalize(), html.fact_table(facts(content, left_out.get(key, ()))))
        for key in ("rig", "source", "options", "versions", "summary")
        if (content := mapping(run, key))
    ]


def _laser_counts(points: PointSummary, names: list[str]) -> str:
    head = ("laser", "in the posture", *(LABEL_WORDS[label] for label in Label))
    used = points.on_target.sum(axis=0)
    counts = np.column_stack([used, points.labels])
    rows = [
        (html.Raw(html.swatch(index) + escape(name)), *(f"{count:,}" for count in counts[index]))
        for index, name in enumerate(names)
    ]
    return html.table(head, rows)


def _both_errors(m: Material, housing: str) -> str:
    if m.bare is None or m.truth is None:
        return ""
    rows = []
    for name, posture in ((f"with the {housing}", m.track.posture), ("without it", m.bare)):
        rms, worst, count = errors_against(m.truth, posture)
        if count:
            rows.append((name, f"{1e3 * rms[0]:.2f} mm", f"{1e3 * worst[0]:.2f} mm", f"{count}"))
    return html.table(("range error against truth", "rms", "max", "frames"), rows)


def _footer(run: Mapping[str, Any], track: Track) -> str:
    """Return when the run took place and what made the page."""
    when = " to ".join(html.moment(run[key]) for key in ("started", "ended") if run.get(key))
    said = f"Run from {when}. " if when else ""
    frames = count_text(len(track), "frame", commas=True)
    return f"{said}{frames} over {clock(float(np.ptp(track.time_s)))}."
