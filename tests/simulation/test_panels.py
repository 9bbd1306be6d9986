"""Rendered panels: edges are where the camera's model has them, light where it should be."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from aqualvs.calibration.detection.detection import detect_board, detect_markers
from aqualvs.calibration.targets.printed import board_rectangles
from aqualvs.calibration.targets.targets import Board, BoardKind, MarkerSet, View
from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.sheet import sheets_of
from aqualvs.simulation.calibration_targets import board_panel, squares_size
from aqualvs.simulation.lasers import default_sources
from aqualvs.simulation.panels import Panel, PanelRenderer, PanelScene, RoomLight, panel_sheets
from aqualvs.simulation.scene import CameraSensor
from aqualvs.simulation.textures import (
    INK,
    PAPER,
    CharucoPrint,
    MarkerPrint,
    Texture,
    charuco_texture,
    grid_corners,
    marker_texture,
    mottled,
)
from panel_cases import BOARD, facing, small_rig

TURNS = ((0.3, -0.25, 0.1), (-0.35, 0.2, -0.3))
FAMILY = "DICT_APRILTAG_36h11"


def camera_in(medium):
    rig = small_rig()
    if medium == "bare":
        return rig.bare_camera()
    return rig.in_water(rig.n_air if medium == "air" else rig.n_water).camera()


def grey(renderer, panels, seed=0):
    image = renderer.render(PanelScene(panels=panels), np.random.default_rng(seed))
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)


def as_board(board):
    return Board(
        kind=BoardKind.CHARUCO,
        squares=board.squares,
        square=board.square,
        marker=board.marker,
        dictionary=board.dictionary,
        border=board.border,
    )


def check_offsets(offsets):
    """Noise of 0.4 % moves a detected corner by about 0.01 px; a wrong convention by 0.5 px."""
    assert np.abs(offsets.mean(axis=0)).max() < 0.02
    assert np.sqrt((offsets**2).mean(axis=0)).max() < 0.1


@pytest.mark.parametrize("medium", ["bare", "air", "water"])
def test_the_corners_of_a_board_are_where_the_camera_projects_them(medium):
    camera, offsets = camera_in(medium), []
    renderer = PanelRenderer(camera)
    for turn in TURNS:
        pose = facing(0.30, turn, squares_size(BOARD))
        view = detect_board(grey(renderer, [board_panel(BOARD, pose)]), as_board(BOARD), "view")
        assert isinstance(view, View), view
        offsets.append(view.pixels - camera.project(pose.apply(view.points))[0])
    offsets = np.concatenate(offsets)
    assert len(offsets) > 30
    check_offsets(offsets)


@pytest.mark.parametrize("medium", ["bare", "water"])
def test_the_corners_of_markers_are_where_the_camera_projects_them(medium):
    camera, side = camera_in(medium), 40
    places = grid_corners([10, 66, 122], [10, 66])
    prints = MarkerPrint(
        dictionary=FAMILY, ids=np.arange(6, dtype=np.int64), corners=places, side=side, ring=8
    )
    texture = marker_texture(mottled((116, 172), 0.4, 0.2), 1e-3, prints)
    pose = facing(0.36, (0.2, 0.25, -0.1), texture.size)
    corners = (places[:, None] + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])) * 1e-3
    in_dome = pose.apply(np.concatenate([corners, np.zeros((6, 4, 1))], axis=-1))
    target = MarkerSet(
        frame="dome", family=FAMILY, ids=prints.ids, corners=in_dome, plane_names=(None,) * 6
    )
    view = detect_markers(grey(PanelRenderer(camera), [Panel(pose, texture)]), target, "view")
    assert isinstance(view, View), view
    assert len(view.ids) >= 20
    check_offsets(view.pixels - camera.project(view.points)[0])


def test_a_straight_edge_shares_its_pixels_exactly():
    """Before blur, a pixel that an upright edge crosses is as bright as its light part is wide."""
    camera = camera_in("bare")
    cell, dark = 5e-3, 0.0
    albedo = np.full((120, 120), 1.0)
    albedo[:, :60] = dark
    # A panel square to the camera, whose edge is far from the distorted rim.
    pose = camera.dome_from_cam @ SE3(np.eye(3), np.array([-0.3, -0.3, 0.5]))
    light = RoomLight(level=1.0, lamp_share=0.0, tint=(1.0, 1.0, 1.0))
    scene = PanelScene(panels=[Panel(pose, Texture(albedo, cell))], light=light)
    seen = PanelRenderer(camera).radiance(scene)[..., 0]
    rows = np.arange(40, 250)
    heights = (rows - camera.lens.cy) / camera.lens.fy * 0.5
    edge = camera.project(
        camera.dome_from_cam.apply(np.stack([0.0 * heights, heights, 0.5 + 0.0 * heights], -1))
    )[0][:, 0]
    light_to_the_right = seen[rows, 100:260].sum(axis=1)
    # The edge leaves its column of pixels by distortion; a tenth of that is what a row adds.
    assert light_to_the_right == pytest.approx(260 - 0.5 - edge, abs=5e-3)


def test_a_far_texture_is_its_mean_without_aliasing():
    """Cells much smaller than a pixel turn into even grey."""
    checks = (np.indices((3000, 3000)).sum(axis=0) % 2).astype(float)
    light = RoomLight(level=1.0, lamp_share=0.0)
    panel = Panel(facing(0.6, (0.3, 0.2, 0.4), (1.5, 1.5)), Texture(checks, 0.5e-3))
    seen = PanelRenderer(camera_in("air")).radiance(PanelScene(panels=[panel], light=light))
    middle = seen[80:200, 100:260, 0]
    # A pixel is 2 cells wide here; point samples would scatter by 0.25 (four of 0 or 1).
    assert middle.mean() == pytest.approx(0.5, abs=2e-3)
    assert middle.std() < 0.06


def test_the_nearest_panel_hides_the_others():
    near = Panel(facing(0.3, size=(0.1, 0.1)), Texture(np.full((10, 10), 0.2), 0.01))
    far = Panel(facing(0.6, size=(2.0, 2.0)), Texture(np.full((10, 10), 0.8), 0.2))
    light = RoomLight(level=1.0, lamp_share=0.0)
    for panels in ([near, far], [far, near]):
        seen = PanelRenderer(camera_in("air")).radiance(PanelScene(panels=panels, light=light))
        assert seen[144, 180, 0] == pytest.approx(0.2)
        assert seen[10, 10, 0] == pytest.approx(0.8)


def test_stripes_run_where_the_sheets_meet_the_panel():
    rig = small_rig()
    wall = Panel(facing(0.5, (0.1, 0.2, 0.0), (2.0, 2.0)), Texture(np.full((20, 20), 0.8), 0.1))
    scene = PanelScene(panels=[wall], light=RoomLight(level=0.0))
    camera = rig.camera()
    seen = PanelRenderer(camera, panel_sheets(rig, power=0.5)).radiance(scene)
    rays = camera.rays(np.stack(np.meshgrid(np.arange(360.0), np.arange(288.0)), axis=-1))
    pose = wall.dome_from_panel
    normal = pose.rotation[:, 2]
    t = ((pose.translation - rays.origins) @ normal) / (rays.directions @ normal)
    points = rays.origins + t[..., None] * rays.directions
    off = np.stack([np.abs(sheet.signed_distance(points)) for sheet in sheets_of(rig)])
    nearest = off.min(axis=0)
    # Pixels are 1 mm wide there and sheets 0.8 mm (sigma): 4 mm off it is dark.
    assert seen[nearest < 2e-4, 1].min() > 0.1
    assert seen[nearest > 5e-3, 1].max() < 1e-3
    # Peaks of a level row, against the place where the signed distance vanishes.
    row = seen[60, :, 1]
    for one in off[:, 60]:
        at = int(np.argmin(one))
        if 20 < at < 340 and np.sum(off[:, 60, at] < 0.02) == 1:
            window = np.arange(at - 8, at + 9)
            middle = np.sum(window * row[window]) / np.sum(row[window])
            slope = (one[at + 8] + one[at - 8]) / 16
            assert middle == pytest.approx(at + 0.5 * (one[at - 8] - one[at + 8]) / slope, abs=0.1)


def test_a_panel_casts_a_shadow():
    rig = small_rig()
    wall = Panel(facing(0.6, size=(2.0, 2.0)), Texture(np.full((20, 20), 0.8), 0.1))
    # Close before the second laser, far out of the camera's view.
    source = default_sources(rig)[1].position
    corner = np.array([source[0] - 0.05, 0.08, source[2] + 0.05])
    screen = Panel(
        SE3(wall.dome_from_panel.rotation, corner), Texture(np.full((10, 10), 0.8), 0.01)
    )
    renderer, dark = PanelRenderer(rig.camera(), panel_sheets(rig)), RoomLight(level=0.0)
    free = renderer.radiance(PanelScene(panels=[wall], light=dark))[..., 1]
    shadowed = renderer.radiance(PanelScene(panels=[wall, screen], light=dark))[..., 1]
    without = replace(rig, lasers=(rig.lasers[0], rig.lasers[2]))
    others = PanelRenderer(rig.camera(), panel_sheets(without)).radiance(
        PanelScene(panels=[wall], light=dark)
    )[..., 1]
    np.testing.assert_allclose(shadowed, others, atol=1e-6)
    assert free.sum() > 1.2 * others.sum()


def test_a_board_is_printed_as_calibration_expects_it():
    texture = charuco_texture(BOARD)
    edge = round(BOARD.border / texture.cell)
    dark = np.zeros_like(texture.albedo, dtype=bool)
    for x, y, w, h in np.rint(board_rectangles(as_board(BOARD)) / texture.cell).astype(int):
        dark[edge + y : edge + y + h, edge + x : edge + x + w] = True
    np.testing.assert_array_equal(texture.albedo, np.where(dark, INK, PAPER))


def test_without_a_source_of_chance_there_is_no_noise():
    scene = PanelScene(
        panels=[board_panel(BOARD, facing(0.3, size=squares_size(BOARD)))],
        sensor=CameraSensor(read_noise=0.02),
    )
    renderer = PanelRenderer(camera_in("bare"))
    first, second = renderer.render(scene), renderer.render(scene)
    noisy = renderer.render(scene, np.random.default_rng(0))
    np.testing.assert_array_equal(first, second)
    assert np.std(noisy.astype(float) - first) > 1.0


@pytest.mark.parametrize(
    "change", [{"border": 10e-3}, {"marker": 23.9e-3}, {"dictionary": "DICT_4X4_7"}]
)
def test_a_board_that_does_not_fit_its_cells_is_refused(change):
    options = {name: getattr(BOARD, name) for name in BOARD.__slots__} | change
    with pytest.raises(OptionError):
        charuco_texture(CharucoPrint(**options))


def test_a_picture_of_nothing_is_refused():
    with pytest.raises(OptionError, match="no panels"):
        PanelRenderer(camera_in("bare")).render(PanelScene(panels=[]))
