"""The report in a real browser, without a window: it draws, it asks for nothing, it fits."""

import base64
import os
import re
import shutil
import subprocess
from html import unescape
from pathlib import Path

import cv2
import numpy as np
import pytest

from aqualvs.report.run_page import write_report
from aqualvs.text import LASER_COLOURS, bgr
from report_cases import NASTY_LASER, make_dive, write_truth

BROWSERS = (
    "chromium",
    "chromium-browser",
    "google-chrome",
    "google-chrome-stable",
    "chrome",
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
)
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--enable-logging=stderr",
    "--virtual-time-budget=12000",
    "--dump-dom",
)
# What the graphics driver and the canvas say about speed is no fault of the page.
HARMLESS = re.compile(r"GL Driver Message|willReadFrequently")
PROBE = """
<script>
const found = document.documentElement.dataset;
const probe = () => {
if (!found.ready) { setTimeout(probe, 50); return; }
found.fits = document.documentElement.scrollWidth <= window.innerWidth;
const words = document.getElementById("plane-words");
document.getElementById("plane-slider").value = 0;
document.getElementById("plane-slider").dispatchEvent(new Event("input"));
found.first = words.textContent;
found.name = document.querySelector("#chart-plane-1 .gtitle").textContent;
document.getElementById("plane-next").click();
found.second = words.textContent;
document.querySelector("[data-cloud=frame]").click();
found.points = document.getElementById("chart-cloud").data.slice(0, 2).map((t) => t.x.length);
window.dispatchEvent(new Event("beforeprint"));
const width = (id) => document.getElementById(id)._fullLayout.width;
found.paper = width("chart-posture");
window.dispatchEvent(new Event("afterprint"));
found.screen = width("chart-posture");
const chart = document.getElementById("chart-posture");
const drag = chart.querySelector(".nsewdrag[data-subplot=xy2]"), box = drag.getBoundingClientRect();
const at = { clientX: box.left + chart._fullLayout.xaxis.d2p(1.3), clientY: box.top + 20,
             bubbles: true };
drag.dispatchEvent(new MouseEvent("mouseover", at));
drag.dispatchEvent(new MouseEvent("mousemove", at));
setTimeout(() => {
  found.hover = [...chart.querySelectorAll(".hoverlayer text")].map((t) => t.textContent).join("|");
}, 1500);
};
probe();
</script>
"""


@pytest.fixture(scope="module")
def browser() -> str:
    for name in BROWSERS:
        path = shutil.which(name)
        if path is not None:
            return path
    if os.environ.get("CI"):
        pytest.fail("no Chromium: install the package chromium, CI must not skip this test")
    pytest.skip("no Chromium to open the report with (install the package chromium)")


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    dive = make_dive(tmp_path_factory.mktemp("run"), n=160)
    return write_report(dive.folder, truth=write_truth(dive, bias_mm=1.0))


@pytest.fixture(scope="module")
def shown(
    browser: str, page: Path, tmp_path_factory: pytest.TempPathFactory
) -> dict[int, tuple[str, list[str]]]:
    """By the window's width: the report after hands played with it."""
    probed = page.with_name("probed.html")
    probed.write_text(page.read_text(encoding="utf-8") + PROBE, encoding="utf-8")
    return {
        width: opened(browser, probed, tmp_path_factory.mktemp("profile"), width)
        for width in (820, 1280)
    }


def opened(browser: str, page: Path, profile: Path, width: int) -> tuple[str, list[str]]:
    """Open a page; returns its document after the scripts ran, and what the console said."""
    command = [browser, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},1000"]
    done = subprocess.run([*command, page.as_uri()], capture_output=True, timeout=300, check=True)
    log = done.stderr.decode("utf-8", "replace").splitlines()
    said = [line for line in log if ":CONSOLE" in line and not HARMLESS.search(line)]
    return done.stdout.decode("utf-8"), said


def attribute(document: str, name: str) -> str:
    found = re.search(rf'<html[^>]* data-{name}="([^"]*)"', document)
    assert found is not None, f"the page set no data-{name}"
    return found.group(1)


def chart(document: str, name: str) -> str:
    """Return the document from the start of a chart's place on to the next one."""
    start = document.index(f'id="{name}"')
    following = document.find(' id="chart-', start + 5)
    return document[start:following]


def test_report_draws_every_chart_and_complains_of_nothing(
    shown: dict[int, tuple[str, list[str]]],
) -> None:
    document, said = shown[1280]
    assert said == []
    assert attribute(document, "ready") == "true"
    assert "data-owned" not in document[: document.index("<head")]
    for name in (
        "chart-posture",
        "chart-error",
        "chart-plane-0",
        "chart-plane-1",
        "chart-counts",
        "chart-rms",
        "chart-residual",
        "chart-quality",
    ):
        assert 'class="main-svg"' in chart(document, name), name
        assert len(re.findall(r'<path class="(?:js-line|point)', chart(document, name))), name
    assert "<canvas" in chart(document, "chart-cloud")


def test_cloud_is_really_drawn(shown: dict[int, tuple[str, list[str]]]) -> None:
    document, _ = shown[1280]
    found = re.search(r'id="cloud-paper"[^>]*src="data:image/png;base64,([^"]+)"', document)
    found = found or re.search(
        r'src="data:image/png;base64,([^"]+)"[^>]*id="cloud-paper"', document
    )
    assert found is not None
    picture = cv2.imdecode(
        np.frombuffer(base64.b64decode(found.group(1)), np.uint8), cv2.IMREAD_COLOR
    )
    assert picture is not None
    # The legend alone has a few hundred pixels of a laser's colour above the scene.
    scene = picture[picture.shape[0] // 8 :].astype(int)
    for index in range(2):
        near = np.abs(scene - bgr(LASER_COLOURS[index])).max(axis=-1) < 12
        assert near.sum() > 500


@pytest.mark.parametrize("width", [820, 1280])
def test_report_fits_and_answers_to_hands(
    shown: dict[int, tuple[str, list[str]]], width: int
) -> None:
    document, said = shown[width]
    assert said == []
    assert attribute(document, "fits") == "true"
    assert attribute(document, "first").startswith("frame 0, 0.00 s: range 600.0 ± 0.8 mm")
    # A laser's name is drawn as text, tags and all.
    assert unescape(attribute(document, "name")) == NASTY_LASER
    assert attribute(document, "second") != attribute(document, "first")
    assert attribute(document, "points") == "30,30"
    assert attribute(document, "paper") == "690"
    assert int(attribute(document, "screen")) > 700
    # In a gap the pointer meets the reason, not the posture beside the gap.
    hover = attribute(document, "hover")
    assert "too few points on the target – 8 frames from 1.2 s" in hover
    assert "±" not in hover
