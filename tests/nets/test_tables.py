"""Tables, GeoJSON, map and the report's section: everything that tells the state of a net."""

import csv
import json
import re
from dataclasses import replace
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from aqualvs.nets.map import draw_map
from aqualvs.nets.places import place_net
from aqualvs.nets.tables import HOLE_COLUMNS, NET_COLUMNS, bands, net_dict, net_lines, unroll
from aqualvs.report.net import net_cards, net_view, read_net
from aqualvs.report.run_page import write_report
from aqualvs.results.folder import NET_FILES
from aqualvs.results.net_survey import write_net_files
from aqualvs.simulation.scenarios import example_rig
from aqualvs.vehicle_logs import VehiclePlaces
from net_app_cases import STRETCH_S, hole, leave_maps_blank, postures, stretch, vehicle_log
from report_cases import make_dive

N = 6
STEP = 0.5


def log(n=N, heading=1.0, turn=0.0):
    return VehiclePlaces(
        vehicle_log(
            n * STRETCH_S, depth=lambda t: 5.0 + 0 * t, heading=lambda t: heading + turn * t
        )
    )


def walled(stretches, holes=(), vehicle=None):
    dive = postures(len(stretches) * STRETCH_S)
    places = place_net(stretches, holes, dive, vehicle)
    return unroll(stretches, holes, places, example_rig(), dive)


@pytest.fixture(scope="module")
def wall():
    stretches = [
        stretch(i, (STEP * (i + 1), 0.0), seen=i != 2, solidity=None if i == 3 else 0.2 + 0.03 * i)
        for i in range(N)
    ]
    return walled(stretches, [hole(6.0, (1.2, 0.1), size=0.12), hole(11.0, (2.2, 0.0))], log())


@pytest.fixture(scope="module")
def folder(wall, tmp_path_factory):
    folder = tmp_path_factory.mktemp("net")
    facts = {"summary": net_dict(wall, 1.5, 200, 190), "log": None}
    write_net_files(folder, wall, facts)
    return folder


@pytest.fixture(autouse=True)
def blank_maps(folder, monkeypatch):
    """That of the folder is drawn, and those that a test draws itself."""
    leave_maps_blank(monkeypatch)


def rows(path):
    return list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))


def test_all_files_are_there(folder):
    assert sorted(path.name for path in folder.iterdir()) == sorted(NET_FILES)


def test_the_table_holds_what_was_measured_in_its_units(folder):
    found = rows(folder / "net.csv")
    assert tuple(found[0]) == NET_COLUMNS
    assert len(found) == N
    first = found[0]
    expected = {
        "stretch": 1,
        "first_frame": 0,
        "last_frame": 61,
        "begin_s": 0.0,
        "end_s": 2.5,
        "piece": 0,
        "right_m": STEP,
        "along_m": 0.5 * STEP,
        "depth_m": 5.0,
        "range_m": 0.5,
        "bar_mm": 25.0,
        "sigma_bar_mm": 0.2,
        "twine_mm": 2.5,
        "sigma_twine_mm": 0.4,
        "solidity": 0.2,
        # A square net of 2.5 mm twine at 25 mm: 0.1 + 0.1 - 0.01.
        "clean_solidity": 0.19,
        "fouling": 0.01,
        "seen_m": 40.0,
    }
    assert {name: float(first[name]) for name in expected} == pytest.approx(expected)
    assert float(first["bearing_deg"]) == pytest.approx(np.rad2deg(1.0), abs=0.06)
    assert (first["mesh"], first["placed_by"]) == ("four-sided", "track")


def test_what_was_not_measured_is_empty(folder):
    found = rows(folder / "net.csv")
    lattice = ("mesh", "bar_mm", "twine_mm", "solidity", "clean_solidity", "fouling", "n_strands")
    assert [found[2][name] for name in lattice] == [""] * len(lattice)
    assert found[3]["bar_mm"] == "25.0"
    assert found[3]["solidity"] == found[3]["fouling"] == ""


def test_without_a_log_depth_and_bearing_are_empty(tmp_path):
    plain = walled([stretch(0, (STEP, 0.0))], [hole(1.0, (0.2, 0.0))])
    write_net_files(tmp_path, plain, {})
    for name in ("net.csv", "holes.csv"):
        assert rows(tmp_path / name)[0]["depth_m"] == rows(tmp_path / name)[0]["bearing_deg"] == ""
    assert json.loads((tmp_path / "net.geojson").read_text())["aqualvs_net"]["coordinates"][
        "y"
    ].startswith("metres above")


def test_holes_have_size_and_place(folder):
    found = rows(folder / "holes.csv")
    assert tuple(found[0]) == HOLE_COLUMNS
    expected = {
        "width_mm": 120.0,
        "height_mm": 96.0,
        "diameter_mm": 108.0,
        "sigma_diameter_mm": 12.0,
        "along_m": 1.2,
        "depth_m": 4.9,
        "frame": 150,
        "time_s": 6.0,
        "n_looks": 5,
    }
    assert {name: float(found[0][name]) for name in expected} == pytest.approx(expected)


def test_geojson_is_a_feature_collection_in_the_plane_of_the_net(folder):
    content = json.loads((folder / "net.geojson").read_text())
    assert content["type"] == "FeatureCollection"
    assert content["aqualvs_net"]["coordinates"]["system"].startswith("local")
    assert content["aqualvs_net"]["summary"]["n_holes"] == 2
    kinds = [one["properties"]["kind"] for one in content["features"]]
    assert kinds == ["stretch"] * N + ["hole"] * 2
    assert len({one["id"] for one in content["features"]}) == N + 2
    for one, row in zip(content["features"], rows(folder / "net.csv"), strict=False):
        ring = np.array(one["geometry"]["coordinates"][0])
        assert one["geometry"]["type"] == "Polygon"
        assert ring[0].tolist() == ring[-1].tolist()
        area = 0.5 * np.sum(ring[:-1, 0] * ring[1:, 1] - ring[1:, 0] * ring[:-1, 1])
        # RFC 7946, 3.1.6: outer rings are counter-clockwise. The picture is as high as it is.
        rig = example_rig()
        assert area == pytest.approx(STEP * 0.5 * rig.size_px[1] / rig.focal_px, rel=1e-3)
        assert ring[:-1, 0].mean() == pytest.approx(float(row["along_m"]))
        assert ring[:-1, 1].mean() == pytest.approx(-5.0)
        for name, cell in row.items():
            assert str("" if one["properties"][name] is None else one["properties"][name]) == cell
    assert content["features"][N]["geometry"] == {"type": "Point", "coordinates": [1.2, -4.9]}


def test_bands_meet_in_one_edge_and_a_still_vehicle_shows_its_picture():
    nodes = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.3], [2.0, 0.3]])
    first, second, still = bands(nodes, np.tile([0.4, 0.2], (3, 1)))
    assert first[1] == pytest.approx(second[0])
    assert first[2] == pytest.approx(second[3])
    assert first[0] == pytest.approx([0.0, -0.2])
    assert still.min(axis=0) == pytest.approx([1.6, 0.1])
    assert still.max(axis=0) == pytest.approx([2.4, 0.5])


def test_without_a_track_the_net_is_drawn_over_its_bearing():
    lost = [stretch(i, (0.0, 0.0), seen=False) for i in range(N)]
    wall = walled(lost, vehicle=log(heading=np.deg2rad(350.0), turn=0.1))
    assert wall.by_bearing
    across = np.array([outline[:, 0].mean() for outline in wall.outlines])
    # Bearings go on beyond north; they do not jump back. Where the dive ends, the mean over half
    # a second to either side is one over what there is.
    middle = 350.0 + np.rad2deg(0.1) * STRETCH_S * (np.arange(N) + 0.5)
    assert across == pytest.approx(middle, abs=1.5)


def test_map_shows_holes_and_what_was_not_measured(folder):
    picture = cv2.imread(str(folder / "net_map.png"))
    assert picture.shape[1] == 1760
    for colour in ("#d55e00", "#c4c9cd"):
        value = int(colour[1:], 16)
        bgr = np.array([value & 255, (value >> 8) & 255, value >> 16])
        assert np.count_nonzero(np.abs(picture.astype(int) - bgr).max(axis=2) < 6) > 100
    assert ElementTree.parse(folder / "net_map.svg").getroot().tag.endswith("svg")


def test_holes_are_drawn_to_scale(tmp_path):
    """A hole of twice the size covers four times the white inside its rim."""
    inside = []
    for size in (0.1, 0.2):
        wall = walled(
            [stretch(i, (STEP * (i + 1), 0.0)) for i in range(3)],
            [hole(3.0, (0.7, 0.07), size=size)],
        )
        draw_map(wall, [tmp_path / "map.png"])
        picture = cv2.imread(str(tmp_path / "map.png"))
        band = picture[:, 200:1400]
        white = (band.min(axis=2) == 255).astype(np.uint8)
        _, _, stats, centres = cv2.connectedComponentsWithStats(white)
        high = slice(picture.shape[0] // 4, 3 * picture.shape[0] // 4)
        round_ones = [
            s[cv2.CC_STAT_AREA]
            for s, c in zip(stats[1:], centres[1:], strict=True)
            if high.start < c[1] < high.stop and 0.6 < s[3] / s[2] < 1.0 and s[2] > 20
        ]
        inside.append(max(round_ones))
    # The rim takes a share of the smaller one.
    assert 3.8 < inside[1] / inside[0] < 5.5


def test_no_marker_of_the_map_points_to_one_side(folder):
    """A vehicle may move left, and its start must not look like a direction."""
    root = ElementTree.parse(folder / "net_map.svg").getroot()
    # Matplotlib names markers by m and a number; ticks are open lines, dots have curves.
    defined = root.iterfind(".//{*}defs/{*}path")
    shapes = [one.get("d", "").strip() for one in defined if one.get("id", "").startswith("m")]
    closed = [d for d in shapes if d.endswith("z") and "C" not in d]
    assert closed
    for d in closed:
        corners = {(float(x), float(y)) for x, y in re.findall(r"[ML] (\S+) (\S+)", d)}
        assert corners == {(-x, y) for x, y in corners}


@pytest.mark.parametrize("diagonal", [False, True])
@pytest.mark.parametrize(("bars", "warned"), [(0.35, False), (0.45, True), (1.2, True)])
def test_a_motion_near_half_a_mesh_a_frame_is_warned_of(tmp_path, diagonal, bars, warned):
    """Along a family's normal, or between both: a net shifted by a bar looks the same."""
    one = stretch(0, (0.0, 0.0))
    first, second = one.lattice.normals[:2] * one.lattice.pitch[:2, None]
    step = (first + second) / np.sqrt(2.0) if diagonal else first
    way = bars * step * (one.last_frame - one.first_frame)
    wall, words = walled([stretch(0, way)]), "from frame to frame in 62 of 62 frames"
    assert (words in "\n".join(net_lines(wall, 1.0, 62))) == warned
    dive = make_dive(tmp_path / "run", video=False)
    write_net_files(dive.folder, wall, {"summary": net_dict(wall, 1.0, 62, 62)})
    assert (words in write_report(dive.folder).read_text(encoding="utf-8")) == warned


def test_equal_results_give_equal_maps(wall, folder, tmp_path):
    names = ("net_map.png", "net_map.svg")
    draw_map(wall, [tmp_path / name for name in names])
    for name in names:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.parametrize("n", [0, 1, 60])
def test_any_length_of_net_can_be_drawn(tmp_path, n):
    wall = walled([stretch(i, (STEP * (i + 1), 0.0)) for i in range(n)], vehicle=log(n))
    draw_map(wall, [tmp_path / "map.png"])
    height, width = cv2.imread(str(tmp_path / "map.png")).shape[:2]
    # A long net is cut into rows rather than drawn as a line.
    assert 0.1 < height / width < 1.2


def test_summary_in_words(wall):
    said = "\n".join(net_lines(wall, 1.5, 200))
    assert "four-sided meshes of 25.0 mm bar (50 mm stretched), twine 2.5 mm" in said
    assert "looked at 1.50 m² of net over 3.0 m: 2 holes" in said
    assert "108 mm (120 x 96 mm), 10 meshes: 1.20 m along, 4.90 m deep, bearing 57°" in said
    # The dirtiest stretch is the last one, 2.5 to 3 m along.
    assert "most at 2.75 m along" in said
    assert net_lines(walled([]), 0.0, 30) == ["no net was seen in 30 frames"]


def test_summary_of_a_net_whose_mesh_nobody_could_make_out(tmp_path):
    wall = walled([stretch(0, (0.0, 0.0), seen=False)])
    said = net_lines(wall, 0.0, 30)
    assert said[0] == "net: its mesh could not be determined"
    assert said[1] == "solidity: not measured in any stretch"
    # Nothing was looked at: that is no sound net.
    assert said[2] == "looked at 0.00 m² of net over 0.0 m: not searched for holes"
    dive = make_dive(tmp_path / "run", video=False)
    write_net_files(dive.folder, wall, {"summary": net_dict(wall, 0.0, 30, 30)})
    net, _ = read_net(dive.folder)
    assert net_cards(net)[0].value == "holes not known"
    assert "<p>Not searched for.</p>" in net_view(net)


def test_what_rounds_to_zero_has_no_sign(wall):
    one = replace(stretch(0, (STEP, -0.001)), solidity=0.1899)
    said = "\n".join(net_lines(walled([one], [hole(1.0, (0.2, -0.001))]), 1.0, 62))
    assert "-0.00" not in said
    assert "+0.00" not in said


def test_report_shows_the_net_of_its_folder(wall, tmp_path):
    dive = make_dive(tmp_path / "run", video=False)
    page = write_report(dive.folder).read_text(encoding="utf-8")
    assert '<section id="net">' not in page
    write_net_files(dive.folder, wall, {"summary": net_dict(wall, 1.5, 200, 190), "log": None})
    page = write_report(dive.folder).read_text(encoding="utf-8")
    assert '<section id="net">' in page
    assert '<div class="value">2 holes</div>' in page
    assert "120 × 96" in page
    assert "data:image/png;base64," in page
    assert "add <code>--log</code>" in page


def test_a_track_that_slipped_is_told(tmp_path):
    places = [(STEP * i, 0.3 * i) for i in range(N + 1)]
    climbing = [stretch(i, places[i + 1], begin=places[i]) for i in range(N)]
    wall = walled(climbing, vehicle=log())
    said = net_lines(wall, 1.0, 200)[-1]
    assert said.startswith("warning: the track and the log's depth differ by 1.8 m")
    dive = make_dive(tmp_path / "run", video=False)
    write_net_files(dive.folder, wall, {"summary": net_dict(wall, 1.0, 200, 190)})
    assert "differ by 1.8 m" in write_report(dive.folder).read_text(encoding="utf-8")


def test_a_track_that_always_breaks_is_told(tmp_path):
    """Frames too far apart: each piece of track finds the same hole again."""
    apart = [replace(stretch(i, (0.0, 0.0)), piece=10 * i, n_frames=10) for i in range(N)]
    wall = walled(apart)
    said = net_lines(wall, 1.0, 70)[-1]
    assert said.startswith("warning: the track along the net broke 50 times in 60 frames")
    assert "--fps" in said
    dive = make_dive(tmp_path / "run", video=False)
    write_net_files(dive.folder, wall, {"summary": net_dict(wall, 1.0, 70, 60)})
    assert "broke 50 times in 60 frames" in write_report(dive.folder).read_text(encoding="utf-8")
    mended = walled([replace(one, piece=i) for i, one in enumerate(apart)])
    assert not any("warning" in line for line in net_lines(mended, 1.0, 70))


def test_report_escapes_what_the_files_say(wall, tmp_path):
    nasty = "<script>alert(1)</script>"
    log_facts = {"file": nasty, "used": False, "refused": nasty}
    write_net_files(tmp_path, wall, {"summary": {}, "log": log_facts})
    text = (tmp_path / "holes.csv").read_text().replace("track", nasty)
    (tmp_path / "holes.csv").write_text(text.replace("150", nasty, 1))
    net, trouble = read_net(tmp_path)
    assert trouble == ""
    assert "<script>" not in net_view(net)
    # Name of the log and why it is not used, as text.
    assert net_view(net).count("&lt;script&gt;") == 2


def test_report_copes_with_what_is_missing_or_broken(wall, tmp_path):
    assert read_net(tmp_path) == (None, "")
    write_net_files(tmp_path, wall, {})
    for name in ("net.geojson", "net_map.png", "holes.csv"):
        (tmp_path / name).unlink()
    net, _ = read_net(tmp_path)
    assert "net_map.png is missing" in net_view(net)
    assert net_cards(net)[0].value == "holes not known"
    (tmp_path / "net.csv").write_bytes(b"\xff\xfe\x00stretch")
    found, trouble = read_net(tmp_path)
    assert found is None
    assert "not shown" in trouble


def test_holes_of_a_table_that_lost_some_are_not_known(wall, tmp_path):
    """Two holes were found: a table without them is damaged, and says nothing of a sound net."""
    write_net_files(tmp_path, wall, {"summary": net_dict(wall, 1.5, 200, 190)})
    table = tmp_path / "holes.csv"
    assert read_net(tmp_path)[1] == ""
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:2]))
    for _ in range(2):
        net, trouble = read_net(tmp_path)
        assert trouble.startswith("holes.csv is missing or cut short")
        assert "None was found" not in net_view(net)
        assert "Not known" in net_view(net)
        assert net_cards(net)[0].value == "holes not known"
        table.unlink(missing_ok=True)


def test_report_says_that_no_net_was_seen(tmp_path):
    write_net_files(tmp_path, walled([]), {"summary": net_dict(walled([]), 0.0, 9, 0)})
    net, _ = read_net(tmp_path)
    assert "No net was seen" in net_view(net)
    assert net_cards(net) == []


def test_the_map_shows_a_hole_beyond_the_stretches(tmp_path):
    """A wall of half a metre with a hole a metre to its right, which is drawn whole."""
    beyond = walled([stretch(0, (STEP, 0.0))], [hole(1.0, (1.5, 0.0), size=0.3)])
    draw_map(beyond, [tmp_path / "map.svg"])
    assert "<!-- 1: 270 mm -->" in (tmp_path / "map.svg").read_text()
    draw_map(beyond, [tmp_path / "map.png"])
    picture = cv2.imread(str(tmp_path / "map.png")).astype(int)
    rim = np.abs(picture - [0x00, 0x5E, 0xD5]).max(axis=2) < 6
    # Both sides of the ring, larger than the one in the legend.
    _, _, stats, _ = cv2.connectedComponentsWithStats(rim.astype(np.uint8))
    width, height = stats[1:, cv2.CC_STAT_WIDTH], stats[1:, cv2.CC_STAT_HEIGHT]
    assert width.max() > 100
    assert height[width.argmax()] / width.max() == pytest.approx(0.8, abs=0.1)


def test_a_hole_is_found_again_in_the_picture_of_its_look(wall, folder, tmp_path):
    first, _ = rows(folder / "holes.csv")
    # The vehicle looks square to the net at the hole, half a metre away.
    camera = example_rig().camera()
    (u, v), _ = camera.project(np.array([0.0, 0.5, 0.0]))
    assert [float(first["u_px"]), float(first["v_px"])] == pytest.approx([u, v], abs=0.1)
    (rim, _), _ = camera.project(np.array([0.5 * 0.108, 0.5, 0.0]))
    assert float(first["diameter_px"]) == pytest.approx(2.0 * (rim - u), rel=0.02)
    assert first["picture_frame"] == first["frame"] == "150"
    unseen = walled([stretch(0, (STEP, 0.0))], [hole(1.0, (0.9, 0.0), from_foot=(0.9, 0.0))])
    write_net_files(tmp_path, unseen, {})
    assert rows(tmp_path / "holes.csv")[0]["u_px"] == ""


def test_report_shows_each_hole_and_the_way_back(wall, tmp_path):
    dive = make_dive(tmp_path / "run", n=300)
    write_net_files(dive.folder, wall, {})
    page = write_report(dive.folder).read_text(encoding="utf-8")
    assert page.count('alt="Hole 1 with its surroundings"') == 1
    way = "depth 4.90 m, heading 57°, 1.20 m along the net, nearest at 6.0 s"
    assert f"<b>Hole 1: 108 ± 12 mm</b><br>{way}" in page
