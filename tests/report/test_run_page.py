import errno
import json
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from jinja2 import UndefinedError
from numpy.typing import NDArray
from pyarrow import parquet

from aqualvs.errors import OutputError, SourceError
from aqualvs.report import html
from aqualvs.report.charts import breaks, merge_stretches, stretches, thin
from aqualvs.report.frames import choose_pictures, choose_samples, decode_frames
from aqualvs.report.html import Raw, embedded_json
from aqualvs.report.html import page as filled_page
from aqualvs.report.overlay import OverlayWriter
from aqualvs.report.points import summarize_points
from aqualvs.report.run_data import Track, lasers_of, read_track
from aqualvs.report.run_page import write_report
from aqualvs.scanning.posture import Reason
from aqualvs.scanning.scan import Label
from aqualvs.text import LABEL_COLOURS, LABEL_WORDS, REASON_WORDS, reason_text
from report_cases import COLUMNS, FPS, LASERS, NASTY, NASTY_LASER, Dive, make_dive, write_truth
from shell_cases import grey, write_video
from whole import WHOLE


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="report-data">(.*?)</script>', page)
    assert found is not None
    data: dict[str, Any] = json.loads(found.group(1))
    return data


def visible(page: str) -> str:
    """Return the page's text without scripts, styles and tags."""
    body = re.sub(r"<(script|style)\b.*?</\1>", "", page, flags=re.S)
    return unescape(re.sub(r"<[^>]+>", " ", body))


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> Dive:
    return make_dive(tmp_path_factory.mktemp("run"))


@pytest.fixture(scope="module")
def page(dive: Dive) -> str:
    return write_report(dive.folder).read_text()


class Tags(HTMLParser):
    """The elements of a page with their attributes, as a browser would see them."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.names: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.names.append(tag)
        self.attributes += attrs


def test_page_asks_no_network_and_forbids_it(page: str) -> None:
    tags = Tags(page)
    assert not {"link", "iframe", "object", "embed", "base"} & set(tags.names)
    named = [value or "" for name, value in tags.attributes if name in ("src", "href", "srcset")]
    # The contents lead to places of the page itself.
    contents = [place for place in named if place.startswith("#")]
    ids = [value for name, value in tags.attributes if name == "id"]
    assert set(contents) == {
        "#" + i for i in ("posture", "planes", "cloud", "pictures", "quality", "rig")
    }
    assert {place[1:] for place in contents} <= set(ids)
    places = [place for place in named if not place.startswith("#")]
    assert len(places) == 6
    assert all(place.startswith("data:image/jpeg;base64,") for place in places)
    policies = [value or "" for name, value in tags.attributes if name == "content"]
    assert any(policy.startswith("default-src 'none'") for policy in policies)
    assert "Plotly.newPlot" in page


def test_text_from_files_cannot_become_markup(page: str) -> None:
    tags = Tags(page)
    # The data, the chart library and our own script: not a fourth one.
    assert tags.names.count("script") == 3
    assert not [name for name, _ in tags.attributes if name.startswith("on")]
    assert NASTY not in page
    assert NASTY_LASER not in page
    assert "<b>bold</b>" not in page
    # They are still shown, as text.
    text = visible(page)
    assert NASTY in text
    assert NASTY_LASER in text
    assert "odd fault (<b>bold</b>)" in text
    assert data_of(page)["lasers"][1]["name"] == NASTY_LASER


def test_embedded_numbers_cannot_end_their_script() -> None:
    text = embedded_json({"name": "</script ><!-- &amp; \u2028", "value": 0.1})
    assert not set("<>&\u2028") & set(text)
    assert json.loads(text) == {"name": "</script ><!-- &amp; \u2028", "value": 0.1}
    with pytest.raises(ValueError, match="not JSON compliant"):
        embedded_json([float("nan")])


def test_headline_gives_the_numbers(dive: Dive, page: str) -> None:
    text = " ".join(visible(page).split())
    valid = [i for i in range(40) if i not in dive.refused]
    assert f"{1e3 * np.median(dive.range_m[valid]):.1f} mm" in text
    assert "31 of 40 frames" in text
    assert "77.5 %" in text
    assert "σ typically 0.8 mm by the frame's noise, 0.8 mm with the rig's uncertainty" in text
    assert "1.3400" in text
    assert "9.8.7" in text
    assert "filter.mode adaptive" in text


def test_charts_hold_the_posture_with_its_gaps(dive: Dive, page: str) -> None:
    chart = data_of(page)["posture"]
    strip = chart["strips"][0]
    valid = [i for i in range(40) if i not in dive.refused]
    assert strip["frame"] == valid
    assert strip["y"] == pytest.approx(1e3 * dive.range_m[valid], abs=0.006)
    assert strip["sigma"] == [0.8] * len(valid)
    assert strip["breaks"] == [valid.index(11), valid.index(29)]
    assert [(gap["from"], gap["to"]) for gap in chart["stretches"]] == [(1.2, 2.0), (3.0, 3.1)]
    assert chart["stretches"][0]["words"].startswith("too few points on the target – 8 frames")


def test_laser_plane_view_is_the_papers_frame(dive: Dive, page: str) -> None:
    planes = data_of(page)["planes"]
    frames = [i for i, frame in enumerate(planes["frames"]) if "range" in frame["words"]]
    laser = planes["frames"][frames[0]]["lasers"][0]
    basis = planes["basis"][0]
    e_x, e_y = np.array(basis["x"]), np.array(basis["y"])
    normal = np.array(LASERS[0]["normal"]) / np.linalg.norm(LASERS[0]["normal"])
    assert np.cross(e_y, normal) == pytest.approx(e_x, abs=1e-6)
    assert e_y @ [0.0, 1.0, 0.0] > 0.0
    assert laser["label"].count(Label.NET) == sum(laser["used"]) == 30
    # Points and basis lead back to the laser's plane, and the dotted line runs through the target.
    a, b, c = laser["line"]
    for x, y, label in zip(laser["x"], laser["y"], laser["label"], strict=True):
        point = np.array(basis["origin"]) + x * e_x + y * e_y
        assert normal @ point == pytest.approx(-143.0, abs=0.2)
        if label == Label.NET:
            # Coordinates are rounded to 0.1 mm.
            assert a * x + b * y == pytest.approx(c, abs=0.15)


def test_cloud_of_the_dive_lies_in_the_target(dive: Dive, page: str) -> None:
    """Exact points lie in the plane, wherever the vehicle was; the dome was before it."""
    cloud = data_of(page)["cloud"]
    beyond = np.concatenate([laser["y"] for laser in cloud["lasers"]])
    assert len(beyond) > 1000
    assert np.abs(beyond).max() == 0.0
    valid = [i for i in range(40) if i not in dive.refused]
    ranges = 1e3 * dive.range_m[valid]
    assert cloud["dome_mm"] == pytest.approx([ranges.min(), ranges.max()], abs=0.51)
    # Right and up of the foot: points keep their distance from it.
    track = read_track(dive.folder / "posture.csv")
    summary, _ = summarize_points(dive.folder, track, [0])
    assert summary is not None
    mine = summary.samples[0]
    off = np.linalg.norm(mine.points_in_dome[mine.used], axis=1) ** 2 - track.posture[0, 0] ** 2
    planar = (summary.cloud_in_target[:, [0, 2]] ** 2).sum(axis=1)
    assert np.abs(planar[:, None] - off).min(axis=0).max() < 1e-4


def test_report_of_the_demo_size_stays_small(page: str) -> None:
    """The chart library is packed: it was most of a report."""
    assert len(html.packed("plotly-gl3d.min.js")) < 800_000
    assert html.asset("plotly-gl3d.min.js")[:1000] not in page


def test_residuals_of_exact_points_vanish(dive: Dive) -> None:
    track = read_track(dive.folder / "posture.csv")
    summary, trouble = summarize_points(dive.folder, track, [])
    assert summary is not None
    assert trouble == ""
    # posture.csv rounds angles to 1e-5 degrees and range to a micrometre.
    assert np.nanmax(summary.rms_mm()) < 2e-3
    assert np.isnan(summary.rms_mm()[12:20]).all()
    assert summary.on_target[:, :2].tolist() == [[30, 30]] * 40
    assert summary.labels[:2, Label.CLUTTER].tolist() == [40, 40]


def test_truth_gives_the_errors(dive: Dive) -> None:
    page = write_report(dive.folder, truth=write_truth(dive, bias_mm=2.0)).read_text()
    text = " ".join(visible(page).split())
    assert "Error against truth, 31 frames" in text
    assert "range, mm 2.00 2.00" in text
    assert "pitch, ° 0.000 0.000" in text
    strip = data_of(page)["error"]["strips"][0]
    assert strip["y"] == pytest.approx([-2.0] * 31, abs=0.01)
    # Errors are to be compared with sigmas, which are drawn about zero.
    low, high = strip["axis"]
    assert low < -2.0
    assert high > 0.0
    # Truth is also drawn where there is no posture.
    assert len(data_of(page)["posture"]["strips"][0]["truth"]["x"]) == 40


def note_truth(dive: Dive, path: Path) -> None:
    run_yaml = dive.folder / "run.yaml"
    content = yaml.safe_load(run_yaml.read_text(encoding="utf-8"))
    content["options"] = {**content.get("options", {}), "truth": str(path)}
    run_yaml.write_text(yaml.safe_dump(content), encoding="utf-8")


def test_the_truth_of_the_run_is_used_again(tmp_path: Path) -> None:
    dive = make_dive(tmp_path / "run", video=False)
    path = write_truth(dive, bias_mm=2.0)
    note_truth(dive, path)
    assert "Error against truth, 31 frames" in visible(write_report(dive.folder).read_text())
    # A page does without a truth that is gone or has become another, and says so.
    path.write_text("frame,range_mm,pitch_deg,yaw_deg\n999,500,2,3\n")
    words = visible(write_report(dive.folder).read_text())
    assert "Error against truth" not in words
    assert "no frame in common with the run" in words
    path.unlink()
    words = visible(write_report(dive.folder).read_text())
    assert f"{path} is not there any more" in words


def test_a_truth_of_empty_water_is_of_all_dives(dive: Dive, tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("frame,range_mm,pitch_deg,yaw_deg\n0,,,\n1,,,\n")
    words = visible(write_report(dive.folder, truth=path).read_text())
    assert "Error against truth" not in words


def test_bare_lens_is_compared(tmp_path: Path) -> None:
    dive = make_dive(tmp_path / "run", video=False)
    frames = [i for i in range(40) if i not in dive.refused]
    text = (dive.folder / "posture.csv").read_text().splitlines()
    rows = [line.split(",") for line in text[1:]]
    for row in rows:
        row[4] = f"{0.8 * float(row[4]):.6f}" if row[4] else ""
    lines = [text[0], *(",".join(row) for row in rows)]
    (dive.folder / "posture_bare.csv").write_text("\n".join(lines) + "\n")
    page = write_report(dive.folder, truth=write_truth(dive, 0.0)).read_text()
    words = " ".join(visible(page).split())
    assert "range without the dome, relative to with it −20.00 % −20.00 % −20.00 %" in words
    worst = 200.0 * dive.range_m[frames].max()
    assert f"without it {200.0 * np.sqrt((dive.range_m[frames] ** 2).mean()):.2f} mm" in words
    assert f"{worst:.2f} mm" in words
    run_yaml = dive.folder / "run.yaml"
    run_yaml.write_text(run_yaml.read_text().replace(" dome:", " flat:"))
    words = " ".join(visible(write_report(dive.folder).read_text()).split())
    assert "range without the flat port, relative to with it" in words
    assert len(data_of(page)["bare"]["bare"]["x"]) == len(frames)


def test_no_comparison_no_section(page: str) -> None:
    assert "without the dome" not in visible(page)
    assert "bare" not in data_of(page)


def test_the_right_pictures_are_decoded(dive: Dive) -> None:
    track = read_track(dive.folder / "posture.csv")
    rows = [39, 0, 17, 25]
    path = Path(yaml.safe_load((dive.folder / "run.yaml").read_text())["source"]["path"])
    pictures = decode_frames(path, track, rows)
    assert sorted(pictures) == sorted(rows)
    for row, picture in pictures.items():
        assert int(picture.mean(axis=(0, 2)).argmax()) // 8 == row


def test_the_right_pictures_of_avi_are_decoded(dive: Dive, tmp_path: Path) -> None:
    """Its times are those of decoding, which B-frames change."""
    track = read_track(dive.folder / "posture.csv")
    path = write_video(tmp_path / "dive.avi", 40, size=(96, 64), options={"bf": "3", "g": "12"})
    rows = list(range(40))
    pictures = decode_frames(path, track, rows)
    assert sorted(pictures) == rows
    for row, image in pictures.items():
        # Less than half of the step between two pictures, which lossy encoders miss by a few.
        assert image.mean() == pytest.approx(grey(row), abs=5.0)


def test_pictures_show_refusals_and_the_worst_posture(dive: Dive) -> None:
    track = read_track(dive.folder / "posture.csv")
    sigma = track.sigma.copy()
    sigma[7, 0] = 0.1
    rows = choose_pictures(replaced(track, sigma=sigma))
    assert len(rows) == 6
    assert 7 in rows
    assert 15 in rows
    assert 30 in rows
    assert set(rows) <= set(choose_samples(track, rows))
    assert len(choose_samples(track, rows)) == 24


@pytest.mark.parametrize("options", [{"bf": "0"}, {"bf": "2"}])
def test_pictures_of_the_spread_are_at_key_frames(
    dive: Dive, tmp_path: Path, options: dict[str, str]
) -> None:
    track = read_track(dive.folder / "posture.csv")
    track = replaced(track, time_s=track.frame / 25.0)
    spread = set(choose_pictures(track))
    gop = {"g": "5", "keyint_min": "5", "sc_threshold": "0"}
    path = write_video(tmp_path / "dive.mp4", 40, options=gop | options)
    rows = set(choose_pictures(track, path))
    assert len(rows) == 6
    assert rows != spread
    moved = rows - spread
    assert {row % 5 for row in moved} == {0}
    # What is special about a frame is not special about its key frame.
    assert {15, 30} <= rows
    assert sorted(decode_frames(path, track, sorted(rows))) == sorted(rows)
    # With one key frame for all, the spread stays as it is.
    path = write_video(tmp_path / "long.mp4", 40, options={"g": "250", **options})
    assert set(choose_pictures(track, path)) == spread
    path.write_bytes(path.read_bytes()[:100])
    assert set(choose_pictures(track, path)) == spread


def replaced(track: Track, **changes: Any) -> Track:
    values = {name: getattr(track, name) for name in Track.__dataclass_fields__}
    return Track(**(values | changes))


def test_pictures_are_embedded_with_their_captions(page: str) -> None:
    assert page.count('src="data:image/jpeg;base64,') == 6
    assert "no posture: too few points on the target" in visible(page)


def test_missing_source_is_said(tmp_path: Path) -> None:
    dive = make_dive(tmp_path / "run", video=False, source={"path": "<i>dive.mp4"})
    page = write_report(dive.folder).read_text()
    words = "<i>dive.mp4 is not there any more: sample frames come without pictures."
    assert words in visible(page)
    assert "i" not in Tags(page).names
    assert "data:image/jpeg" not in page


def test_broken_source_is_said(tmp_path: Path) -> None:
    dive = make_dive(tmp_path / "run", video=False)
    path = Path(yaml.safe_load((dive.folder / "run.yaml").read_text())["source"]["path"])
    path.write_bytes(b"no video" * 100)
    page = write_report(dive.folder).read_text()
    assert "cannot be decoded again" in visible(page)


def test_interrupted_run_still_gives_a_report(tmp_path: Path) -> None:
    dive = make_dive(tmp_path / "run", video=False)
    csv = dive.folder / "posture.csv"
    csv.write_text(csv.read_text()[:-40])
    (dive.folder / "run.yaml").write_text("status: running\nrig: {lasers: [")
    table = parquet.read_table(dive.folder / "points.parquet")
    (dive.folder / "points.parquet").unlink()
    with pa.OSFile(str(dive.folder / "points.arrows"), "wb") as sink:
        with pa.ipc.new_stream(sink, table.schema) as writer:
            writer.write_table(table.combine_chunks(), max_chunksize=300)
        n_bytes = sink.tell()
    with (dive.folder / "points.arrows").open("r+b") as points_stream:
        points_stream.truncate(n_bytes - 2000)
    page = write_report(dive.folder).read_text()
    text = " ".join(visible(page).split())
    assert "run.yaml cannot be read" in text
    assert "30 of 39 frames" in text
    assert data_of(page)["quality"]["counts"][0]["y"][:5] == [30] * 5
    assert "laser 2" in text


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("points.parquet", b"PAR1 cut", "points.parquet cannot be read"),
        ("points.parquet", None, "points.parquet is missing"),
        ("run.yaml", None, "run.yaml is missing"),
        ("run.yaml", b"- a\n- list\n", "run.yaml cannot be read"),
        ("run.yaml", b"\xff\xfe\x00", "run.yaml cannot be read"),
    ],
)
def test_missing_and_broken_files_become_warnings(
    tmp_path: Path, name: str, content: bytes | None, words: str
) -> None:
    dive = make_dive(tmp_path / "run", video=False)
    (dive.folder / name).unlink()
    if content is not None:
        (dive.folder / name).write_bytes(content)
    assert words in visible(write_report(dive.folder).read_text())


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        ("", "cannot be read"),
        (COLUMNS + "\n", "holds no frame"),
        (COLUMNS.replace("frame,", "number,") + "\n1,0.0,1,,1,0,0,0,0,0,1,1,9,1.3\n", "no frame"),
        (COLUMNS + "\n0,0.0,1,,much,0,0,0,0,0,1,1,9,1.3\n", "cannot be read"),
    ],
)
def test_a_run_without_postures_is_refused_in_one_line(
    tmp_path: Path, content: str | None, words: str
) -> None:
    if content is not None:
        (tmp_path / "posture.csv").write_text(content)
    with pytest.raises(SourceError) as fault:
        write_report(tmp_path)
    assert str(tmp_path / "posture.csv") in str(fault.value)
    assert words in str(fault.value)
    assert "\n" not in str(fault.value)


def test_foreign_truth_is_refused(dive: Dive, tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    path.write_text("frame,range_mm,pitch_deg,yaw_deg\n999,500,2,3\n")
    with pytest.raises(SourceError, match=r"truth\.csv: no frame in common"):
        write_report(dive.folder, truth=path)


def test_unwritable_page_names_file_and_remedy(tmp_path: Path) -> None:
    folder = make_dive(tmp_path).folder
    (folder / "report.html").mkdir()
    with pytest.raises(OutputError, match=r"report\.html: cannot write the report"):
        write_report(folder)


def test_warnings_say_what_is_wrong(tmp_path: Path) -> None:
    dive = make_dive(
        tmp_path / "run",
        n=120,
        video=False,
        status="interrupted",
        error="stopped by hand",
        summary={"warnings": ["the disk was <i>slow</i>"]},
    )
    lines = (dive.folder / "posture.csv").read_text().splitlines()
    for i in range(60, 95):
        lines[i + 1] = f"{i},{i / FPS},0,one_laser,,,,,,,,,,"
    lines[101] = lines[101].replace("1.340000", "1.335000")
    (dive.folder / "posture.csv").write_text("\n".join(lines) + "\n")
    run = yaml.safe_load((dive.folder / "run.yaml").read_text())
    run["rig"]["working_range_mm"] = [300, 650]
    run["rig"]["lasers"].append({"name": "third", "normal": [0, 0, 1], "offset_mm": 90})
    (dive.folder / "run.yaml").write_text(yaml.safe_dump(run))
    page = write_report(dive.folder).read_text()
    assert "<i>slow" not in page
    text = visible(page)
    for words in (
        "The run did not finish (status: interrupted)",
        "The run ended with: stopped by hand",
        "% of the frames gave no posture; the commonest reason: only one laser on the target",
        "No posture for 3.5 s from 6.0 s on: only one laser on the target.",
        "outside the rig's working range of 300–650 mm",
        "Laser “third” gave only 0.0 % of the target points.",
        "The water's index changed by 0.0050",
        "The disk was <i>slow</i>.",
    ):
        assert words in text


def test_a_sound_run_has_no_warning(tmp_path: Path) -> None:
    dive = make_dive(tmp_path / "run")
    assert "No warnings." in visible(write_report(dive.folder).read_text())


def test_saturated_stripes_are_noticed(tmp_path: Path) -> None:
    dive = make_dive(tmp_path / "run", video=False)
    path = Path(yaml.safe_load((dive.folder / "run.yaml").read_text())["source"]["path"])
    with OverlayWriter(path, (320, 240), FPS) as writer:
        for _ in range(40):
            writer.write(np.full((240, 320, 3), 255, np.uint8))
    text = visible(write_report(dive.folder).read_text())
    assert "Stripes are saturated in the sample frames (100 % of their points)" in text


def test_rig_tolerates_what_is_missing() -> None:
    lasers = lasers_of(
        {
            "lasers": [
                {"name": "a", "normal": [0, 0, 2], "offset_mm": 100},
                {"normal": [0, 1, 0], "offset_mm": 5},
                {"name": "c", "normal": "up"},
                {"name": "d", "normal": [1, 0, 0], "offset_mm": None},
            ]
        }
    )
    assert [laser.name for laser in lasers] == ["a", "laser 2", "c", "d"]
    assert [laser.known for laser in lasers] == [True, False, False, False]
    assert lasers[0].offset == pytest.approx(0.1)
    assert lasers[0].normal.tolist() == [0.0, 0.0, 1.0]
    assert lasers_of({"lasers": "none"}) == []


def test_every_reason_and_label_has_words() -> None:
    assert set(REASON_WORDS) == set(Reason)
    assert set(LABEL_WORDS) == set(LABEL_COLOURS) == set(Label)
    assert reason_text("something_new") == "something new"
    assert reason_text("") == "no reason given"


@given(
    hnp.arrays(
        np.float64,
        st.integers(1, 400),
        elements=st.one_of(st.floats(-1e6, 1e6), st.just(float("nan"))),
    ),
    st.integers(4, 60),
)
@settings(max_examples=150 if WHOLE else 50, deadline=None)
def test_thinning_is_bounded_and_keeps_extremes(values: NDArray[np.float64], limit: int) -> None:
    rows = thin(values, limit)
    finite = np.flatnonzero(np.isfinite(values))
    assert len(rows) <= limit
    assert (np.diff(rows) > 0).all()
    assert set(rows) <= set(finite)
    if len(finite):
        assert values[rows].max() == values[finite].max()
        assert values[rows].min() == values[finite].min()
    gaps = breaks(rows, ~np.isfinite(values))
    for i in range(len(rows) - 1):
        assert (i in gaps) == bool(np.isnan(values[rows[i] : rows[i + 1]]).any())


def long_track(n: int, seed: int = 3) -> Track:
    rng = np.random.default_rng(seed)
    valid = rng.random(n) > 0.3
    posture = np.where(valid[:, None], rng.normal(5.0, 1.0, (n, 3)), np.nan)
    return Track(
        frame=np.arange(n),
        time_s=np.arange(n) / 25.0,
        valid=valid,
        reason=np.zeros(n, np.int64),
        reasons=("no_stripes",),
        posture=posture,
        sigma=np.where(valid[:, None], 1e-3, np.nan) * np.ones(3),
        sigma_total=np.where(valid[:, None], 2e-3, np.nan) * np.ones(3),
        n_points=np.full(n, 100.0),
        n_water=np.full(n, 1.34),
    )


def test_merged_stretches_are_bounded_and_shade_no_visible_gap() -> None:
    track = long_track(50_000)
    found = stretches(track)
    assert sum(s.last - s.first + 1 for s in found) == int((~track.valid).sum())
    joined = merge_stretches(found, track, 1000)
    assert len(found) > 5000 >= 2 * len(joined)
    covered = np.zeros(len(track), np.bool_)
    for stretch in joined:
        covered[stretch.first : stretch.last + 1] = True
    assert covered[~track.valid].all()
    # What is shaded although valid is shorter than a thousandth of the dive at a time.
    runs = np.diff(np.flatnonzero(np.diff((covered & track.valid).astype(int))))
    assert runs[::2].max() <= 50


def test_page_of_a_long_dive_stays_small(tmp_path: Path) -> None:
    n = 15_000
    rng = np.random.default_rng(7)
    k = np.arange(n)
    rows = [
        f"{i},{i / 25:.6f},0,no_stripes,,,,,,,,,,"
        if refused
        else f"{i},{i / 25:.6f},1,,{5 + s:.6f},{s:.5f},{-s:.5f},0.0008,0.1,0.1,0.6,0.6,99,1.34"
        for i, s, refused in zip(k, rng.normal(size=n), rng.random(n) < 0.1, strict=True)
    ]
    (tmp_path / "posture.csv").write_text("\n".join([COLUMNS, *rows]) + "\n")
    per_frame = 40
    frame = np.repeat(k, per_frame).astype(np.int32)
    count = len(frame)
    columns = {name: rng.normal(size=count).astype(np.float32) for name in ("u_px", "v_px")}
    columns |= {name: rng.normal(size=count).astype(np.float32) for name in ("x_m", "y_m", "z_m")}
    laser = (np.arange(count) % 3).astype(np.int8)
    label = pa.DictionaryArray.from_arrays(np.zeros(count, np.int8), ["net"])
    parquet.write_table(
        pa.table(
            {
                "frame": frame,
                "laser": laser,
                **columns,
                "label": label,
                "used": np.ones(count, np.bool_),
            }
        ),
        tmp_path / "points.parquet",
    )
    page = write_report(tmp_path)
    assert page.stat().st_size < 8e6
    data = data_of(page.read_text())
    assert sum(len(laser["x"]) for laser in data["cloud"]["lasers"]) == 15_000
    assert max(len(strip["x"]) for strip in data["posture"]["strips"]) <= 4000
    again = data_of(write_report(tmp_path).read_text())
    assert again["cloud"] == data["cloud"]


def test_a_run_killed_before_its_first_bare_row_is_reported(tmp_path: Path) -> None:
    run = make_dive(tmp_path).folder
    bare = run / "posture_bare.csv"
    for content in ("", (run / "posture.csv").read_text().splitlines()[0] + "\n"):
        bare.write_text(content)
        assert "bare lens." not in visible(write_report(run).read_text("utf-8"))
    bare.write_bytes(b"frame,time_s\nx,y\n\xff")
    assert "no comparison with a bare lens" in visible(write_report(run).read_text("utf-8"))


def test_a_report_that_cannot_be_written_leaves_the_old_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_dive(tmp_path).folder
    good = write_report(run).read_bytes()

    def full(path: Path, text: str, **_: Any) -> int:
        with path.open("w") as file:
            file.write(text[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(OutputError, match="No space left"):
        write_report(run)
    monkeypatch.undo()
    assert (run / "report.html").read_bytes() == good
    assert not list(run.glob("*.part"))


def test_a_page_escapes_its_texts_and_misses_none() -> None:
    texts = {"title": "<b>&", "subtitle": '"<i>"', "cards": "", "warnings": ""}
    content = {**texts, "facts": Raw("<table></table>")}
    html = filled_page("follow.html", {**content, "figures": []})
    assert "<title>&lt;b&gt;&amp; – aqualvs follow</title>" in html
    assert '<p class="sub">&#34;&lt;i&gt;&#34;</p>' in html
    assert "<table></table>" in html
    with pytest.raises(UndefinedError, match="figures"):
        filled_page("follow.html", content)
