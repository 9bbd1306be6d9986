"""The page of `aqualvs reproduce`: complete, safe with any text, and without a network."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import pytest

from aqualvs.errors import OutputError
from aqualvs.experiments.experiment import Finding
from aqualvs.experiments.page import Record, Shown, duration, page_html, write_page

NASTY = '<script>alert("1")</script> & $css'


class Reader(HTMLParser):
    """Collects ids, links, pictures and the text."""

    def __init__(self, page):
        super().__init__()
        self.ids, self.links, self.pictures, self.tags, self.said = [], [], [], set(), []
        self.feed(page)

    def handle_starttag(self, tag, attributes):
        found = dict(attributes)
        self.tags.add(tag)
        self.ids += [found["id"]] if "id" in found else []
        self.links += [found["href"]] if tag == "a" else []
        self.pictures += [found["src"]] if tag == "img" else []

    def handle_data(self, data):
        self.said.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.said).split())


def record(name="rig", **changes):
    content = {"title": f"About {name}", "paper": "table 1", "about": "Here.", "sentence": "So."}
    return Record(name=name, **{**content, **changes})


def with_figure(folder, *, svg_bytes=100, caption="A chart."):
    (folder / "figures").mkdir()
    (folder / "figures" / "rig_chart.svg").write_bytes(b"<svg>" + b" " * svg_bytes)
    (folder / "figures" / "rig_chart.png").write_bytes(b"png")
    return record(pictures=(Shown(file="rig_chart", caption=caption, width_in=3.5),))


def test_every_bar_stands_in_the_table_at_the_top(tmp_path):
    good = Finding(what="range, %", paper="2.3", ours="0.04", bar="<= 0.5", met=True)
    bad = Finding(what="yaw, deg", paper="14 %", ours="0.71", bar="0.5", met=False)
    plain = Finding(what="frames", paper="", ours="731")
    one, two = record("rig", findings=(good, plain)), record("box", findings=(bad,))
    read = Reader(page_html([one, two], {"rig": 3.0, "box": 62.4}, tmp_path))
    summary = read.text.split("Contents")[0]
    assert "1 of 2" in summary
    assert "range, % 2.3 0.04 ≤ 0.5 ✓ yes" in summary
    assert "yaw, deg 14 % 0.71 0.5 ✗ no" in summary
    assert "731" not in summary
    assert "731" in read.text
    assert "65 s" in summary
    assert "62 s · aqualvs reproduce box" in read.text


def test_links_lead_to_parts_of_the_page_and_to_files(tmp_path):
    shown = with_figure(tmp_path)
    read = Reader(page_html([shown, record("box", series=("box_a.csv",))], {}, tmp_path))
    assert {link[1:] for link in read.links if link.startswith("#")} == {"rig", "box"}
    assert {"rig", "box"} <= set(read.ids)
    assert "figures/rig_chart.pdf" in read.links
    assert "series/box_a.csv" in read.links
    outside = [link for link in read.links if "://" in link]
    assert outside == ["https://doi.org/10.3390/robotics10040126"]


@pytest.mark.parametrize(("size", "kind"), [(100, "svg+xml"), (500_000, "png")])
def test_figures_are_inside_the_page(tmp_path, size, kind):
    page = page_html([with_figure(tmp_path, svg_bytes=size)], {}, tmp_path)
    assert Reader(page).pictures[0].startswith(f"data:image/{kind};base64,")
    assert "max-width: 438px" in page
    assert not re.search(r'src="(?!data:)', page)


def test_text_is_shown_as_it_is(tmp_path):
    nasty = replace(
        with_figure(tmp_path, caption=NASTY),
        title=NASTY,
        about=NASTY,
        sentence=NASTY,
        notes=(NASTY,),
        failure=NASTY,
        findings=(Finding(what=NASTY, paper=NASTY, ours=NASTY, bar=NASTY, met=False),),
    )
    read = Reader(page_html([nasty], {}, tmp_path))
    assert "script" not in read.tags
    # Title in bars, contents and section; ten more places, of which some are said twice.
    assert read.text.count(NASTY) >= 13


def test_failed_experiment_says_so_at_the_top_and_at_its_place(tmp_path):
    read = Reader(page_html([record(sentence="", failure="ValueError: none")], {}, tmp_path))
    assert "0 of 1" in read.text
    assert read.text.count("ValueError: none") == 3


def test_missing_figure_is_an_error_that_names_the_page(tmp_path):
    shown = record(pictures=(Shown(file="gone", caption="", width_in=7.2),))
    with pytest.raises(OutputError, match=r"reproduce\.html"):
        write_page([shown], {}, tmp_path)


def test_durations_as_one_would_say_them():
    assert [duration(s) for s in (0.32, 11.7, 184.6)] == ["0.3 s", "12 s", "3 min 05 s"]
