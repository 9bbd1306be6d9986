import base64
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.errors import OutputError
from aqualvs.optics.expected_error import ExpectedError
from aqualvs.report.calibration_material import (
    CalibrationPage,
    LaserRow,
    Overlay,
    ParameterRow,
    PictureShot,
    ResidualMap,
    Series,
    ViewRow,
)
from aqualvs.report.calibration_page import number, page_html, write_page
from aqualvs.report.html import Card

NASTY = "<script>alert(1)</script>&\"'<!-- $title ${css} 水"
NAN = float("nan")


def visible(page: str) -> str:
    """Return the page's text without styles and tags, blanks made single."""
    body = re.sub(r"<style\b.*?</style>", "", page, flags=re.S)
    return " ".join(unescape(re.sub(r"<[^>]+>", " ", body)).split())


def rows_of(page: str, name: str) -> list[list[str]]:
    """Return the cells of every table row in a section, head rows included."""
    section = re.search(rf'<section id="{name}">(.*?)</section>', page, flags=re.S)
    assert section is not None
    return [
        [visible(cell) for cell in re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row, flags=re.S)]
        for row in re.findall(r"<tr>(.*?)</tr>", section[1], flags=re.S)
    ]


class Tags(HTMLParser):
    """The elements of a page with their attributes, and whether they are closed in order."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.open: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]
        if tag not in ("meta", "br", "img"):
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.attributes += [(name, value or "") for name, value in attrs]

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def residual_map(n: int = 300, title: str = "in air") -> ResidualMap:
    rng = np.random.default_rng(7)
    return ResidualMap(
        title=title,
        size_px=(720, 576),
        pixels=rng.uniform(0.0, 570.0, (n, 2)),
        residuals=rng.normal(0.0, 0.1, (n, 2)),
        view_index=np.arange(n) % 3,
        inliers=np.arange(n) % 50 > 0,
    )


def laser(**changes: Any) -> LaserRow:
    row = LaserRow(
        name="horizontal",
        normal=np.array([-0.02, -0.34, 0.94]),
        offset_mm=-142.8,
        sigma_normal_deg=0.012,
        sigma_offset_mm=0.06,
        rms_px=0.21,
        rms_mm=0.14,
        n_points=12345,
        surfaces="left, floor",
    )
    return replace(row, **changes)


def expectation(
    range_m: float,
    sigma: tuple[float, float, float] = (0.3, 0.03, 0.06),
    noise: tuple[float, float, float] = (0.4, 0.04, 0.08),
) -> ExpectedError:
    """Return an error of `sigma` and `noise` of range, pitch and yaw, in mm and degrees."""
    units = np.array([1e-3, np.pi / 180.0, np.pi / 180.0])
    of_noise, of_rig = (np.diag((units * some) ** 2) for some in (noise, sigma))
    return ExpectedError(wall_range=range_m, per_pixel=(), noise=of_noise, calibration=of_rig)


def full_page(words: str = "plain") -> CalibrationPage:
    """Return a page with every part, `words` wherever there is text."""
    x = np.linspace(0.0, 9.0, 50)
    image = np.full((60, 80, 3), 90, np.uint8)
    dots = Overlay(pixels=np.array([[3.0, 4.0]]), colour="#E69F00", kind="dot", label=words)
    return CalibrationPage(
        title=words,
        subtitle=words,
        cards=(Card(words, words, words),),
        warnings=(words,),
        words=(words,),
        residual_maps=(residual_map(title=words),),
        views=tuple(
            ViewRow(name=words, n_points=54, rms_px=0.1, remark=words, used=used)
            for used in (True, True, False)
        ),
        parameters=(
            ParameterRow(name=words, value=1.0, sigma=0.1, unit=words, digits=2, before=1.2),
        ),
        expectations=(expectation(0.6),),
        lasers=(laser(name=words, surfaces=words, model=words, moved=words),),
        series=(
            Series(
                title=words,
                x_label=words,
                y_label=words,
                x=x,
                y=np.sin(x),
                sigma=np.full(50, 0.1),
                level=(words, 0.5),
                marks=((4.0, words),),
            ),
        ),
        pictures=(PictureShot(caption=words, image=image, points=(dots,)),),
        facts=((words, words),),
    )


def test_page_needs_no_network_and_no_script(tmp_path: Path) -> None:
    path = write_page(full_page(), tmp_path / "page.html")
    assert path == tmp_path / "page.html"
    tags = Tags(path.read_text(encoding="utf-8"))
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(tags.names)
    assert not [name for name, _ in tags.attributes if name.startswith("on")]
    places = [value for name, value in tags.attributes if name in ("src", "href", "srcset")]
    assert all(place.startswith(("data:image/jpeg;base64,", "#")) for place in places)
    policies = [value for name, value in tags.attributes if name == "content"]
    assert any(policy.startswith("default-src 'none'") for policy in policies)
    assert not any("script-src" in policy for policy in policies)


def test_every_word_is_escaped() -> None:
    plain, nasty = (Tags(page_html(full_page(words))) for words in ("plain", NASTY))
    assert nasty.names == plain.names
    assert not plain.open
    assert not nasty.open
    html = page_html(full_page(NASTY))
    for part in ("summary", "residuals", "views", "parameters", "lasers", "pictures", "facts"):
        section = html[html.index(f'<section id="{part}">') :].split("<section", 2)[1]
        assert NASTY in unescape(section), part


def test_identifiers_are_unique() -> None:
    page = replace(full_page(), pictures=full_page().pictures * 3)
    found = [value for name, value in Tags(page_html(page)).attributes if name == "id"]
    assert len(found) == len(set(found))


def test_pictures_have_words_for_those_who_cannot_see_them() -> None:
    html = page_html(full_page("plain"))
    pictures = re.findall(r"<svg\b[^>]*>", html)
    hidden = [svg for svg in pictures if 'aria-hidden="true"' in svg]
    inner = [svg for svg in pictures if svg.startswith("<svg x=")]
    told = [svg for svg in pictures if re.search(r'role="img" aria-label="[^"]+"', svg)]
    assert len(hidden) + len(inner) + len(told) == len(pictures)
    assert len(told) >= 8


def test_parts_that_are_empty_leave_no_heading() -> None:
    html = page_html(CalibrationPage(title="Camera"))
    assert "<h2>" not in html
    assert "<h3>" not in html
    assert "<table" not in html
    assert "No warnings" in html
    assert "<h1>Camera</h1>" in html


@pytest.mark.parametrize(
    ("part", "heading"),
    [
        ("words", "Findings"),
        ("residual_maps", "Residuals"),
        ("views", "Views"),
        ("parameters", "Parameters"),
        ("expectations", "Accuracy on a target"),
        ("lasers", "Lasers"),
        ("series", "Charts"),
        ("pictures", "Pictures"),
        ("facts", "Command, files and versions"),
    ],
)
def test_each_part_stands_alone(part: str, heading: str) -> None:
    html = page_html(CalibrationPage(title="t", **{part: getattr(full_page(), part)}))
    assert re.findall(r"<h2>(.*?)</h2>", html) == [heading]
    assert not Tags(html).open


def test_unknown_numbers_show_as_a_dash() -> None:
    unknown = np.full(20, np.nan)
    page = CalibrationPage(
        title="t",
        views=(
            ViewRow(name="a", n_points=0, rms_px=NAN, used=False),
            ViewRow(name="b", n_points=5, rms_px=0.0),
        ),
        parameters=(
            ParameterRow(name="p", value=NAN, sigma=NAN, before=1.0),
            ParameterRow(name="q", value=1.0, sigma=None, before=NAN),
            ParameterRow(name="r", value=float("inf"), sigma=0.0, before=2.0),
        ),
        expectations=(expectation(1.0, (0.3, 0.03, NAN)), expectation(NAN), expectation(0.0)),
        lasers=(laser(normal=np.full(3, NAN), offset_mm=NAN, rms_px=NAN, sigma_normal_deg=NAN),),
        series=(Series(title="s", x_label="x", y_label="y", x=np.arange(20.0), y=unknown),),
        residual_maps=(replace(residual_map(20), residuals=np.stack([unknown, unknown], axis=1)),),
        pictures=(
            PictureShot(
                caption="c",
                image=np.zeros((8, 8), np.uint8),
                points=(Overlay(pixels=np.full((3, 2), np.nan), colour="#E69F00", label="none"),),
            ),
        ),
    )
    html = page_html(page)
    drawn = re.sub(r"base64,[^\"]*", "", html[html.index("<body>") :])
    assert not re.search(r"\b(nan|NaN|inf|None)\b", drawn)
    assert rows_of(html, "parameters")[1][1:4] == ["–", "–", "–"]
    assert rows_of(html, "lasers")[1][1:5] == ["–", "–", "–", "–"]
    assert rows_of(html, "views")[1][2] == "–"


@given(st.floats(-1e9, 1e9), st.integers(0, 6), st.booleans())
def test_numbers_can_be_read_back(value: float, digits: int, plus: bool) -> None:
    text = number(value, digits, plus=plus)
    assert "-" not in text
    # Half a unit of the last decimal, and what floats of 1e9 resolve.
    assert abs(float(text.replace("−", "-")) - value) <= 0.5 * 10.0**-digits + 1e-6
    if float(text.replace("−", "-")) == 0.0:
        assert not text.startswith(("−", "+"))


@pytest.mark.parametrize("value", [None, NAN, float("inf"), float("-inf")])
def test_numbers_that_are_none_are_a_dash(value: float | None) -> None:
    assert number(value, 2) == "–"


def test_parameters_tell_what_moved_in_sigmas() -> None:
    rows = (
        ParameterRow(name="x", value=3.08, sigma=0.061, unit="mm", digits=2, before=3.1),
        ParameterRow(name="y", value=41.92, sigma=0.21, unit="mm", digits=2, before=40.2),
        ParameterRow(name="z", value=-3.0, sigma=0.00234, unit="mm", digits=1),
        ParameterRow(name="radius", value=44.25, sigma=None, unit="mm", digits=2),
    )
    html = page_html(CalibrationPage(title="t", parameters=rows))
    head, x, y, z, radius = rows_of(html, "parameters")
    assert head[4:7] == ["before", "change", "change in σ"]
    assert x == ["x", "3.08", "0.061", "mm", "3.10", "−0.02", "−0.3"]
    assert y == ["y", "41.92", "0.21", "mm", "40.20", "+1.72", "+8.2"]
    assert z == ["z", "−3.0", "0.0023", "mm", "–", "–", "–"]
    assert radius[2] == "held"
    assert re.findall(r'class="refused">(.*?)<', html) == ["+8.2"]


def test_columns_that_say_nothing_are_left_out() -> None:
    html = page_html(
        CalibrationPage(title="t", parameters=(ParameterRow(name="x", value=1.0, sigma=0.1),))
    )
    assert rows_of(html, "parameters")[0] == ["parameter", "value", "± σ", "unit"]


def test_expectation_adds_both_causes_and_is_fine_within_limits() -> None:
    html = page_html(CalibrationPage(title="t", expectations=(expectation(0.5), expectation(1.0))))
    rows = rows_of(html, "expectations")
    assert len(rows) == 1 + 3 * 2
    assert rows[1] == ["0.50 m", "calibration", "0.30", "0.060", "0.030", "0.060"]
    assert rows[2] == ["", "noise of one picture", "0.40", "0.080", "0.040", "0.080"]
    assert rows[3] == ["", "both", "0.50", "0.100", "0.050", "0.100"]
    assert "Good to 0.5 % of range and 0.5° at every distance." in html
    assert 'class="verdict good"' in html
    assert "refused" not in html[html.index("<body>") :]


@pytest.mark.parametrize(
    ("changes", "flagged"),
    [
        ({"noise": (5.1, 0.04, 0.08)}, {"0.510", "0.511"}),
        ({"sigma": (0.3, 0.51, 0.06)}, {"0.510", "0.512"}),
        ({"noise": (0.4, 0.04, 0.499), "sigma": (0.3, 0.03, 0.4)}, {"0.640"}),
    ],
)
def test_expectation_beyond_a_limit_is_flagged(
    changes: dict[str, tuple[float, float, float]], flagged: set[str]
) -> None:
    html = page_html(
        CalibrationPage(title="t", expectations=(expectation(0.5), expectation(1.0, **changes)))
    )
    assert "Not good to 0.5 % of range and 0.5°." in html
    assert 'class="verdict bad"' in html
    assert "On a target at 1.00 m" in html
    assert set(re.findall(r'class="refused">(.*?)<', html)) == flagged


def test_expectation_without_noise_speaks_for_the_calibration_alone() -> None:
    alone = expectation(1.0, noise=(NAN, NAN, NAN))
    html = page_html(CalibrationPage(title="t", expectations=(alone,)))
    assert "the calibration alone gives the range to 0.3 mm (0.03 %)" in html
    unknown = page_html(
        CalibrationPage(title="t", expectations=(expectation(1.0, (NAN, 0.03, 0.06)),))
    )
    assert "is not known" in unknown
    assert "Good to" not in unknown


def test_outlier_views_stand_out() -> None:
    good = [ViewRow(name=f"{i}.png", n_points=54, rms_px=0.1) for i in range(9)]
    views = (
        *good,
        ViewRow(name="high.png", n_points=54, rms_px=0.3),
        ViewRow(name="far.png", n_points=1054, rms_px=40.0, remark="moved", used=False),
    )
    html = page_html(CalibrationPage(title="t", views=views))
    rows = rows_of(html, "views")
    assert rows[-1] == ["far.png", "", "40.000", "1,054", "left out; moved"]
    marked = re.findall(r'class="refused">(.*?)<', html)
    assert {"high.png", "far.png", "40.000", "left out; moved"} <= set(marked)
    assert "0.png" not in marked
    widths = [float(w) for w in re.findall(r'<rect x="0" y="2" width="([\d.]+)"', html)]
    assert widths == [45.0] * 9 + [135.0, 180.0]
    assert html.count('fill="#D55E00"') == 2


def test_many_views_stand_in_two_columns() -> None:
    views = tuple(ViewRow(name=f"{i}", n_points=9, rms_px=0.1) for i in range(41))
    html = page_html(CalibrationPage(title="t", views=views))
    assert html.count("<table>") == 2
    assert [row[0] for row in rows_of(html, "views") if row[0] != "view"] == [
        f"{i}" for i in range(41)
    ]


def test_lasers_have_their_colours_in_the_rig_s_order() -> None:
    html = page_html(
        CalibrationPage(title="t", lasers=(laser(), laser(name="vertical", moved="0.4°")))
    )
    assert re.findall(r"swatch\" style=\"background:(#\w+)", html) == ["#E69F00", "#56B4E9"] * 2
    head, first, second = rows_of(html, "lasers")[:3]
    assert head[-1] == "moved"
    assert first == ["horizontal", "−0.02000", "−0.34000", "+0.94000", "−142.80", "plane", "–"]
    assert second[-1] == "0.4°"
    assert rows_of(html, "lasers")[4] == [
        *("horizontal", "0.012", "0.060", "0.21", "0.140", "12,345", "left, floor")
    ]


def embedded(html: str) -> list[np.ndarray[Any, Any]]:
    found = re.findall(r'href="data:image/jpeg;base64,([^"]+)"', html)
    return [
        np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(text), np.uint8), cv2.IMREAD_COLOR))
        for text in found
    ]


@pytest.mark.parametrize(
    ("shape", "expected"),
    [((300, 400, 3), (300, 400)), ((300, 400), (300, 400)), ((1080, 1920, 3), (540, 960))],
)
def test_pictures_are_embedded_at_most_960_wide(
    shape: tuple[int, ...], expected: tuple[int, int]
) -> None:
    image = np.zeros(shape, np.uint8)
    image[: shape[0] // 2] = 200
    shown = embedded(
        page_html(CalibrationPage(title="t", pictures=(PictureShot(caption="c", image=image),)))
    )
    assert shown[0].shape[:2] == expected
    # JPEG moves flat areas by a grey level or two.
    assert shown[0][10, 10].tolist() == pytest.approx([200] * 3, abs=3)
    assert shown[0][-10, -10].tolist() == pytest.approx([0] * 3, abs=3)


@pytest.mark.parametrize("kind", ["cross", "dot", "circle"])
def test_overlays_lie_on_their_pixels(kind: Any) -> None:
    pixels = np.array([[99.5, 199.5], [np.nan, 3.0], [1899.5, 999.5]])
    shot = PictureShot(
        caption="c",
        image=np.zeros((1080, 1920), np.uint8),
        points=(Overlay(pixels=pixels, colour="#56B4E9", kind=kind, label="corners"),),
    )
    html = page_html(CalibrationPage(title="t", pictures=(shot,)))
    path = re.search(r'<path id="marks-0-0" d="([^"]*)"', html)
    assert path is not None
    # A mark begins left of its centre by its size: 5 or 5.5 at 640 px, 1.5 times that at 960.
    aside = {"cross": 7.5, "dot": 0.0, "circle": 8.25}[kind]
    starts = [(float(x) + aside, float(y)) for x, y in re.findall(r"M([\d.-]+) ([\d.-]+)", path[1])]
    # The picture is halved; places are written to a tenth.
    assert starts == [pytest.approx(p, abs=0.06) for p in ((50.0, 100.0), (950.0, 500.0))]
    assert html.count('<use href="#marks-0-0"') == 2
    assert 'stroke="#56B4E9"' in html
    assert "corners" in visible(html)


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((8, 8, 3)),
        np.zeros((0, 8), np.uint8),
        np.zeros((8, 8, 4), np.uint8),
        np.zeros(8, np.uint8),
    ],
)
def test_pictures_that_are_none_are_refused(image: Any) -> None:
    with pytest.raises(ValueError, match="image has"):
        page_html(CalibrationPage(title="t", pictures=(PictureShot(caption="c", image=image),)))


def test_page_stays_below_a_megabyte(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    noise = rng.integers(0, 256, (720, 1280, 3), dtype=np.uint8)
    corners = Overlay(pixels=rng.uniform(0, 700, (3000, 2)), colour="#E69F00", label="corners")
    x = np.linspace(0.0, 2000.0, 50_000)
    long = Series(title="n", x_label="t", y_label="n", x=x, y=rng.normal(size=len(x)), sigma=x)
    page = CalibrationPage(
        title="t",
        residual_maps=tuple(residual_map(20_000) for _ in range(4)),
        views=tuple(ViewRow(name=f"{i}.png", n_points=54, rms_px=0.1) for i in range(80)),
        series=(long, long),
        pictures=tuple(
            PictureShot(caption="c", image=noise, points=(corners, corners)) for _ in range(6)
        ),
    )
    assert write_page(page, tmp_path / "page.html").stat().st_size < 1_000_000


def test_names_that_are_no_unicode_are_written(tmp_path: Path) -> None:
    name = b"caf\xe9.png".decode("utf-8", "surrogateescape")
    path = write_page(CalibrationPage(title=name, warnings=(name,)), tmp_path / "page.html")
    assert "caf?.png" in path.read_text(encoding="utf-8")


def test_page_that_cannot_be_written_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="absent"):
        write_page(CalibrationPage(title="t"), tmp_path / "absent" / "page.html")
    with pytest.raises(OutputError, match="choose another name"):
        write_page(CalibrationPage(title="t"), tmp_path)
