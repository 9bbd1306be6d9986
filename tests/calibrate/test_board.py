import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from aqualvs.calibrate.board import BoardRequest, print_board
from aqualvs.calibration.detection import detection
from aqualvs.calibration.detection.detection import detect_board, detect_markers
from aqualvs.calibration.targets.printed import PdfPage, Text, pdf_bytes
from aqualvs.calibration.targets.target_files import load_board, load_box, load_target
from aqualvs.calibration.targets.targets import View
from aqualvs.errors import CalibrationError, OptionError, OutputError

_POINTS_PER_MM = 72.0 / 25.4
_NUMBER = r"(-?[\d.]+)"


def _parsed(path):
    """Pages as (width mm, height mm, rectangles in mm from the top left), by reading the PDF."""
    text = path.read_bytes().decode("latin-1")
    boxes = re.findall(rf"/MediaBox \[0 0 {_NUMBER} {_NUMBER}\]", text)
    streams = re.findall(r"stream\n(.*?)\nendstream", text, re.DOTALL)
    pages = []
    for (width, height), stream in zip(boxes, streams, strict=True):
        a, d, f = re.match(rf"{_NUMBER} 0 0 {_NUMBER} 0 {_NUMBER} cm", stream).groups()
        assert float(f) == pytest.approx(float(height))
        assert float(a) == -float(d)
        rows = re.findall(rf"^{_NUMBER} {_NUMBER} {_NUMBER} {_NUMBER} re$", stream, re.MULTILINE)
        millimetres = float(a) / _POINTS_PER_MM * np.array(rows, dtype=float)
        size = float(width) / _POINTS_PER_MM, float(height) / _POINTS_PER_MM
        pages.append((*size, millimetres))
    return pages


def _rastered(page, px_per_mm):
    """Photograph a page square on; fine pixels are averaged."""
    width, height, rectangles = page
    fine = 4 * px_per_mm
    image = np.full((round(height * fine), round(width * fine)), 230, np.uint8)
    for x, y, w, h in np.rint(rectangles * fine).astype(int):
        image[y : y + h, x : x + w] = 20
    small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    return cv2.GaussianBlur(small, (0, 0), 0.7)


def _printed(tmp_path, **options):
    said = []
    print_board(BoardRequest(out=tmp_path / "t", **options), said.append)
    return said


def _ruler(rectangles):
    """The longest of the thin rectangles."""
    thin = rectangles[rectangles[:, 3] < 0.3]
    return thin[np.argmax(thin[:, 2])]


@pytest.mark.parametrize("kind", ["charuco", "chessboard"])
def test_a_printed_board_is_found_and_true_to_scale(tmp_path, kind):
    said = _printed(tmp_path, kind=kind, squares_x=7, squares_y=5)
    assert any("measure 7 squares" in line for line in said)
    (page,) = _parsed(tmp_path / "t.pdf")
    assert page[:2] == pytest.approx((297.0, 210.0), abs=1e-3)
    assert _ruler(page[2])[2] == pytest.approx(100.0, abs=1e-3)
    board = load_board(tmp_path / "t.yaml")
    view = detect_board(_rastered(page, 3), board, "page")
    assert isinstance(view, View)
    assert len(view) == board.n_corners
    # Pixels of the page against millimetres of the file: one scale of 3 px per mm, no rotation.
    by_file = 3e3 * view.points[:, :2]
    offset = (view.pixels - by_file).mean(axis=0)
    assert np.abs(view.pixels - by_file - offset).max() < 0.1


def test_nothing_printed_leaves_its_page_or_the_rulers_strip(tmp_path):
    _printed(tmp_path, kind="charuco")
    ((width, height, rectangles),) = _parsed(tmp_path / "t.pdf")
    ends = rectangles[:, :2] + rectangles[:, 2:]
    assert rectangles[:, :2].min() >= 7.9
    assert np.all(ends <= [width - 7.9, height - 7.9])
    ruler_top = height - 8.0 - 14.0
    board = rectangles[rectangles[:, 1] < ruler_top]
    assert (board[:, 1] + board[:, 3]).max() < ruler_top + 0.01


def test_paper_that_fits_has_room_for_a_large_board(tmp_path):
    options = {"squares_x": 38, "squares_y": 30, "square_mm": 28.0, "border_mm": 15.0}
    _printed(tmp_path, kind="charuco", paper="fit", **options)
    ((width, height, _),) = _parsed(tmp_path / "t.pdf")
    assert width == pytest.approx(38 * 28 + 30 + 16, abs=1e-3)
    assert height == pytest.approx(30 * 28 + 30 + 16 + 14, abs=1e-3)
    assert load_board(tmp_path / "t.yaml").dictionary == "DICT_4X4_1000"


def test_box_sheets_and_their_file_agree(tmp_path, monkeypatch):
    # A sheet may have a single marker.
    monkeypatch.setattr(detection, "MIN_CORNERS", 4)
    _printed(tmp_path, kind="box", marker_mm=40.0, width_mm=230.0, height_mm=160.0, depth_mm=300.0)
    pages = _parsed(tmp_path / "t.pdf")
    box, _ = load_box(tmp_path / "t.yaml")
    assert set(box.planes) == {"forward", "left", "right", "down"}
    found = {}
    for i, page in enumerate(pages):
        view = detect_markers(_rastered(page, 3), box, f"page {i}")
        assert isinstance(view, View)
        # On one page all markers lie on one plane, and keep their distances.
        places = view.ids // 4
        assert len({box.plane_names[place] for place in places}) == 1
        by_page = np.linalg.norm(view.pixels - view.pixels[0], axis=1) / 3e3
        by_file = np.linalg.norm(view.points - view.points[0], axis=1)
        assert np.abs(by_page - by_file).max() < 1e-4
        found |= {int(place): i for place in places}
    assert set(found) == set(range(len(box)))


def test_box_sheets_lie_where_their_words_say(tmp_path):
    _printed(tmp_path, kind="box", marker_mm=40.0, width_mm=230.0, height_mm=160.0, depth_mm=300.0)
    text = (tmp_path / "t.pdf").read_bytes().decode("latin-1")
    words = re.findall(
        rf"plane (\w+); top-left corner {_NUMBER} mm from its left edge and {_NUMBER} mm", text
    )
    box, _ = load_box(tmp_path / "t.yaml")
    pages = _parsed(tmp_path / "t.pdf")
    # The forward plane: x right, z up, seen from inside; its top left is (-115, 300, 80) mm.
    name, left, top = words[0]
    assert name == "forward"
    # The four cuts come before the ruler, which is eleven ticks and a line.
    cut = pages[0][2][-16:-12]
    corner = cut[0, :2] + 0.1
    first = pages[0][2][0, :2] - corner + [float(left), float(top)]
    # Words are rounded to 0.1 mm.
    assert box.corners[0, 0] == pytest.approx(
        [1e-3 * (first[0] - 115.0), 0.3, 1e-3 * (80.0 - first[1])], abs=1e-4
    )


def test_a_plate_without_its_place_says_what_to_measure(tmp_path):
    said = _printed(tmp_path, kind="plate", first_id=300)
    assert any("print again with --position-mm" in line for line in said)
    with pytest.raises(CalibrationError, match="frame is plate"):
        load_target(tmp_path / "t.yaml")


def test_a_plate_is_written_where_it_was_measured(tmp_path):
    _printed(
        tmp_path,
        kind="plate",
        first_id=300,
        position_mm=(-60.0, 250.0, -5.0),
        rotation_deg=(0.0, 0.0, 90.0),
    )
    target = load_target(tmp_path / "t.yaml")
    assert target.ids.tolist() == [300, 301, 302, 303, 304, 305]
    # Facing straight back its right is x; turned by 90 degrees about z it is y. Down stays down.
    expected = np.array([[-60, 250, -5], [-60, 262, -5], [-60, 262, -17], [-60, 250, -17]])
    assert np.allclose(target.corners[0], 1e-3 * expected)
    view = detect_markers(_rastered(_parsed(tmp_path / "t.pdf")[0], 4), target, "page")
    assert isinstance(view, View)
    assert len(view) == 24


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "charuco", "square_mm": 60.0}, "does not fit with its ruler; take larger paper"),
        ({"kind": "charuco", "paper": "a9"}, "--paper a9: not known; use a4"),
        ({"kind": "charuco", "paper": "50x50"}, "too small for the ruler"),
        ({"kind": "charuco", "paper": "fit"}, "needs --square-mm"),
        ({"kind": "charuco", "marker_mm": 90.0}, "a marker is smaller than its square"),
        ({"kind": "charuco", "squares_x": 100, "squares_y": 80}, "would be smaller than 4 mm"),
        ({"kind": "charuco", "squares_x": 60, "squares_y": 60, "square_mm": 9.0}, "1800 markers"),
        ({"kind": "charuco", "dictionary": "DICT_X"}, "'DICT_X' is unknown"),
        ({"kind": "box", "marker_mm": 300.0}, "take smaller markers"),
        ({"kind": "box", "marker_mm": 12.0}, "take larger markers or a smaller box"),
        ({"kind": "box", "marker_mm": 150.0, "width_mm": 900.0}, "take larger paper or smaller"),
        ({"kind": "plate", "first_id": 585}, "--first-id 585: 6 markers from there"),
    ],
)
def test_what_cannot_be_printed_is_refused(tmp_path, options, words):
    with pytest.raises(OptionError) as fault:
        _printed(tmp_path, **options)
    assert words in str(fault.value)
    assert not (tmp_path / "t.pdf").exists()


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file"):
        print_board(BoardRequest(kind="charuco", out=tmp_path / "file" / "t"), print)


@pytest.mark.parametrize("out", ["/", ".", ".."])
def test_a_place_without_a_name_is_refused(out):
    with pytest.raises(OptionError, match="names no file; give one"):
        print_board(BoardRequest(kind="charuco", out=Path(out)), print)


def test_words_are_escaped_and_bytes_repeat():
    page = PdfPage(100.0, 50.0, np.array([[1.0, 2.0, 3.0, 4.0]]), (Text(1, 2, 3, r"a (b) \ 5 µm"),))
    data = pdf_bytes([page], "t")
    assert rb"(a \(b\) \\ 5 " + "µ".encode("cp1252") + b"m) Tj" in data
    assert data == pdf_bytes([page], "t")
    # Every entry of the table points at its object.
    start = int(re.search(rb"startxref\n(\d+)", data)[1])
    places = re.findall(rb"(\d{10}) 00000 n", data[start:])
    for i, place in enumerate(places):
        assert data[int(place) :].startswith(b"%d 0 obj" % (i + 1))


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="needs pdftoppm (poppler)")
def test_a_viewer_shows_what_was_written(tmp_path):
    _printed(tmp_path, kind="charuco", squares_x=7, squares_y=5)
    # 76.2 dots per inch are 3 per millimetre.
    command = ["pdftoppm", "-r", "76.2", "-gray", "-png", "-singlefile", "t.pdf", "seen"]
    subprocess.run(command, cwd=tmp_path, check=True, timeout=300)
    image = cv2.imread(str(tmp_path / "seen.png"), cv2.IMREAD_GRAYSCALE)
    board = load_board(tmp_path / "t.yaml")
    view = detect_board(cv2.GaussianBlur(image, (0, 0), 0.7), board, "seen")
    assert isinstance(view, View)
    assert len(view) == board.n_corners
    width = np.ptp(view.pixels[:, 0]) / np.ptp(view.points[:, 0])
    assert width == pytest.approx(3e3, rel=1e-3)
