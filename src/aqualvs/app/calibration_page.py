"""The report of a calibration: one page of plain HTML that opens anywhere and prints well.

The commands fill a `Page`; everything in it is escaped here. There are no scripts, and nothing is
asked of a network.
"""

from collections.abc import Iterator
from html import escape
from pathlib import Path

from aqualvs.app import report_html as html
from aqualvs.app.calibration_maps import N_VECTORS, residual_view
from aqualvs.app.calibration_material import (
    ExpectationRow,
    LaserRow,
    Overlay,
    Page,
    ParameterRow,
    PictureShot,
    ResidualMap,
    Series,
    ViewRow,
)
from aqualvs.app.calibration_pictures import picture_view
from aqualvs.app.calibration_svg import line_chart
from aqualvs.app.calibration_tables import (
    expectation_view,
    laser_tables,
    parameter_table,
    view_table,
)
from aqualvs.app.disk import writing

__all__ = [
    "ExpectationRow",
    "LaserRow",
    "Overlay",
    "Page",
    "ParameterRow",
    "PictureShot",
    "ResidualMap",
    "Series",
    "ViewRow",
    "page_html",
    "write_page",
]

# Vectors of all maps together; with them and the pictures' share a page stays below 1 MB.
_ALL_VECTORS = 7500


def write_page(page: Page, path: Path) -> Path:
    """Write the report of a calibration.

    Parameters
    ----------
    page : Page
    path : Path
        The file to write.

    Returns
    -------
    path : Path
        The page. It carries all it needs and asks no network.

    Raises
    ------
    OutputError
        If the page cannot be written.
    """
    # Names of files that are no Unicode reach Python as surrogates, which UTF-8 refuses.
    data = page_html(page).encode("utf-8", errors="replace")
    with writing(path):
        path.write_bytes(data)
    return path


def page_html(page: Page) -> str:
    """Return the report of a calibration as HTML."""
    return html.page(
        {
            "title": html.text(page.title),
            "subtitle": html.text(page.subtitle),
            "summary": _summary(page),
            "sections": "\n".join(
                f'<section id="{name}">\n<h2>{heading}</h2>\n{body}\n</section>'
                for name, heading, body in _sections(page)
            ),
            "css": html.asset("report.css") + html.asset("calibration.css"),
        },
        "calibration.html",
    )


def _summary(page: Page) -> str:
    parts = [html.notice(page.warnings)]
    if page.cards:
        parts.insert(0, f'<div class="cards">{html.cards(page.cards)}</div>')
    if page.words:
        items = "".join(f"<li>{escape(words)}</li>" for words in page.words)
        parts.append(
            f'<section id="findings"><h2>Findings</h2><ul class="findings">{items}</ul></section>'
        )
    return "\n".join(parts)


def _sections(page: Page) -> Iterator[tuple[str, str, str]]:
    """Yield name, heading and content of the parts that are not empty."""
    if page.expectations:
        body = expectation_view(page.expectations)
        yield "expectations", "What it means on a target", body
    if page.parameters:
        yield "parameters", "Parameters", parameter_table(page.parameters)
    if page.lasers:
        yield "lasers", "Lasers", laser_tables(page.lasers)
    if page.series:
        yield "series", "Charts", _series(page)
    if page.residual_maps:
        yield "residuals", "Residuals", _residuals(page)
    if page.views:
        yield "views", "Views", view_table(page.views)
    if page.pictures:
        yield "pictures", "Pictures", picture_view(page.pictures)
    if page.facts:
        yield "facts", "Command, files and versions", html.fact_table(page.facts)


def _series(page: Page) -> str:
    return "\n".join(
        f'<div class="whole"><h3>{escape(series.title)}</h3>{line_chart(series)}</div>'
        for series in page.series
    )


def _residuals(page: Page) -> str:
    names = [view.name for view in page.views]
    share = min(N_VECTORS, _ALL_VECTORS // len(page.residual_maps))
    return "\n".join(
        f'<div class="whole"><h3>{escape(found.title)}</h3>'
        f"{residual_view(found, names, n_vectors=share)}</div>"
        for found in page.residual_maps
    )
