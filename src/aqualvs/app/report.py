"""The report of a run: one page that opens anywhere, without a network."""

from pathlib import Path
from typing import Any

from plotly.offline import get_plotlyjs

from aqualvs.app import report_charts as charts
from aqualvs.app import report_html as html
from aqualvs.app.disk import replace_text
from aqualvs.app.net_report import net_cards, net_view
from aqualvs.app.report_findings import headline
from aqualvs.app.report_material import Material, gather
from aqualvs.app.report_rig import dome_radius_mm
from aqualvs.app.report_words import clock
from aqualvs.errors import OutputError


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
        "plotly": get_plotlyjs(),
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
