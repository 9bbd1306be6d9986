"""The benchmark set: its definition, and which stripe points count as visible."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import yaml

from aqualvs.experiments import benchmark_set
from aqualvs.optics.shutter import Shutter, ShutterKind
from aqualvs.simulation.benchmark import (
    BENCHMARK_NAME,
    LEVELS,
    N_FRAMES,
    TRUTH_COLUMNS,
    benchmark_checksum,
    benchmark_dives,
    benchmark_rig,
    render_benchmark_dive,
    render_with_visible,
    truth_cells,
)
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenario import dome_from_target
from aqualvs.simulation.scene import Net, Scene, Wall, WaterOptics
from aqualvs.sources import open_source

DIVES = {dive.name: dive for dive in benchmark_dives()}
_CLEAR = WaterOptics()


def test_the_set_is_the_one_that_scores_name():
    # Whoever changes a definition gives the set the next number, and writes its checksum here.
    assert (BENCHMARK_NAME, benchmark_checksum()) == ("aqualvs-bench-1", "9b0fb8777158")


def test_every_level_has_dives_and_every_dive_its_own_seed():
    assert {dive.level for dive in DIVES.values()} == set(LEVELS)
    assert len({dive.scenario.seed for dive in DIVES.values()}) == len(DIVES) == 22
    assert all(name.startswith(f"{dive.level}_") for name, dive in DIVES.items())
    assert all(dive.scenario.n_frames == N_FRAMES for dive in DIVES.values())


def test_targets_stay_where_the_rig_believes_them():
    low, high = benchmark_rig().working_range
    for dive in DIVES.values():
        for t in dive.scenario.times():
            assert low < dive.scenario.scene_at(t).target_plane().offset < high


@pytest.mark.parametrize("name", [n for n in DIVES if not n.startswith(("clear", "empty"))])
def test_a_difficulty_moves_as_its_clear_twin_before_the_same_mesh(name):
    dive = DIVES[name].scenario
    twin = DIVES[f"clear_{name.split('_')[1]}"].scenario
    assert dive.trajectory == twin.trajectory
    assert dive.target == twin.target
    assert [net.mesh for net in dive.nets] == [net.mesh for net in twin.nets]
    assert dive != replace(twin, name=name, seed=dive.seed)


def test_fewer_frames_cover_the_same_time():
    short = DIVES["sun_far"].shortened(5).scenario
    assert short.n_frames == 5
    assert max(short.times()) == pytest.approx(4.0)


@pytest.fixture(scope="module")
def renderer():
    """The set's rig with pictures a quarter as wide, for speed."""
    rig = benchmark_rig()
    lens = rig.lens
    small = replace(lens, fx=lens.fx / 4, fy=lens.fy / 4, cx=lens.cx / 4, cy=lens.cy / 4)
    return Renderer(replace(rig, size_px=(180, 144), lens=small))


def scene(water=_CLEAR, *, target="wall", **more):
    surface = {"walls": (Wall(),)} if target == "wall" else {"nets": (Net(),)}
    pose = dome_from_target(0.55, 0.1, -0.15)
    return Scene(dome_from_scene=pose, target=target, water=water, **{**surface, **more})


def n_visible(renderer, seen):
    return len(render_with_visible(renderer, lambda _: seen, 0.0, np.random.default_rng(1))[1])


def test_on_a_clear_wall_a_stripe_has_one_point_in_every_pixel_along_it(renderer):
    visible = render_with_visible(renderer, lambda _: scene(), 0.0, np.random.default_rng(1))[1]
    width, height = renderer.rig.size_px
    # The level stripe crosses every column, the upright one every row; the third runs across.
    level, upright, diagonal = np.bincount(visible.laser)
    assert level == width
    assert upright == height
    assert height / 2 < diagonal <= width
    found = dict(zip(TRUTH_COLUMNS[2:], truth_cells(scene(), visible), strict=True))
    assert found["n_visible"] == len(visible)
    assert found["n_visible_lasers"] == 3
    # Points on a wall lie on its plane, to rounding in the table.
    assert float(found["range_m"]) == pytest.approx(0.55, abs=2e-6)
    assert float(found["pitch_deg"]) == pytest.approx(np.rad2deg(0.1), abs=2e-5)
    assert float(found["yaw_deg"]) == pytest.approx(np.rad2deg(-0.15), abs=2e-5)
    assert found["plane_range_m"] == "0.550000"


@pytest.mark.parametrize(
    "water",
    [replace(_CLEAR, attenuation=(20.0, 20.0, 20.0)), replace(_CLEAR, ambient=(60.0, 60.0, 60.0))],
    ids=["swallowed by the water", "drowned in daylight"],
)
def test_what_no_picture_shows_is_not_visible(renderer, water):
    assert n_visible(renderer, scene(water)) == 0


def test_glow_in_the_water_makes_no_point_visible(renderer):
    # So much attenuation that the wall gets no light, but the sheets glow before it.
    water = replace(_CLEAR, attenuation=(9.0, 9.0, 9.0), sheet_scatter=6.0)
    assert n_visible(renderer, scene(water)) == 0


def test_only_the_target_counts(renderer):
    alone = n_visible(renderer, scene(target="net"))
    before_wall = n_visible(renderer, scene(target="net", walls=(Wall(depth=0.3),)))
    assert alone > 30
    # What the wall adds to pixels beside strands may tip a few points over the limit.
    assert abs(before_wall - alone) <= 0.1 * alone
    assert n_visible(renderer, scene(lasers_on=False)) == 0


def test_dimmer_stripes_are_visible_in_fewer_places(renderer):
    counts = []
    for attenuation in (0.3, 3.0, 3.4, 3.8):
        water = replace(_CLEAR, attenuation=(attenuation,) * 3)
        counts.append(n_visible(renderer, scene(water)))
    assert counts == sorted(counts, reverse=True)
    assert counts[-1] < counts[0] / 2


def test_pixels_that_are_asked_for_are_traced_as_in_the_whole_picture(renderer):
    where = np.zeros((144, 180), dtype=np.bool_)
    where[40:60, 100:130] = True
    where[0, 0] = where[-1, -1] = True
    whole = renderer.radiance(scene())
    part = renderer.radiance(scene(), 0.0, where)
    np.testing.assert_array_equal(part[where], whole[where])
    assert (part[100:140, 10:90] == 0.0).all()


def test_a_set_with_fields_has_a_truth_for_each(renderer, tmp_path):
    shutter = Shutter(kind=ShutterKind.INTERLACED, readout=0.02)
    fields = Renderer(replace(renderer.rig, shutter=shutter))
    dive = next(one for one in benchmark_dives() if one.name == "clear_wall").shortened(2)
    render_benchmark_dive(dive, fields, tmp_path, tick=lambda _: None)
    with (tmp_path / "truth.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    starts = list(dive.scenario.times())
    assert [row["frame"] for row in rows] == ["0", "1", "2", "3"]
    times = [at for start in starts for at in (start, start + 0.02)]
    assert [float(row["time_s"]) for row in rows] == pytest.approx(times, abs=1e-4)
    for row, at in zip(rows, times, strict=True):
        plane = dive.scenario.scene_at(at).target_plane()
        assert float(row["plane_range_m"]) == pytest.approx(plane.offset, abs=1e-6)
    with open_source(tmp_path / "dive.mp4") as source:
        assert [frame.is_interlaced for frame in source] == [True, True]


def test_a_set_with_a_shutter_stands_for_itself(tmp_path, monkeypatch):
    shutters = []

    def rendered(_, renderer, folder, **__):
        folder.mkdir(parents=True)
        shutters.append(renderer.rig.shutter)

    monkeypatch.setattr(benchmark_set, "render_benchmark_dive", rendered)
    benchmark_set.make_set(
        tmp_path, [], lambda _: None, n_frames=None, shutter="rolling:20:8", overwrite=False
    )
    content = yaml.safe_load((tmp_path / "benchmark.yaml").read_text())
    assert (content["whole"], content["shutter"]) == (False, "rolling:20:8")
    assert {(one.kind, one.readout) for one in shutters} == {(ShutterKind.ROLLING, 0.02)}
