"""Which surface of a box a stripe lies on."""

import numpy as np
import pytest

from aqualvs.calibration.lasers.stripes_on_planes import (
    StripePoints,
    TargetSurfaces,
    board_surface,
    box_surfaces,
    place_stripes,
    solve_on_surface,
)
from aqualvs.errors import CalibrationError
from aqualvs.geometry.planes import Plane, Rays
from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.scenarios import example_rig
from laser_cases import BOX_PLANES, box, box_corners, dome_from_box


def hits(surfaces: TargetSurfaces, *targets: tuple[float, float, float]) -> list[str | None]:
    """Aim rays from the mouth of the box at points, and say what they hit."""
    origin = np.array([0.0, -0.01, 0.03])
    directions = np.array(targets) - origin
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(origin, directions.shape)
    points, surface = surfaces.hits(Rays(origins, directions, np.ones(len(targets), np.bool_)))
    assert np.array_equal(np.isnan(points[:, 0]), surface < 0)
    return [surfaces.names[i] if i >= 0 else None for i in surface]


def test_rays_hit_what_is_before_them() -> None:
    aimed = hits(box(), (-0.2, 0.5, 0.0), (0.2, 0.3, 0.1), (0.05, 0.7, 0.05), (0.0, 0.5, -0.19))
    assert aimed == ["left", "right", "forward", "down"]


def test_what_lies_beyond_the_open_sides_is_no_surface() -> None:
    # Over the forward plane's upper edge; out of the open top; through the mouth.
    assert hits(box(), (0.0, 0.7, 0.3), (0.0, 0.4, 0.4), (-0.2, 0.05, 0.0)) == [None] * 3


def test_points_near_an_edge_between_surfaces_are_left_out() -> None:
    assert hits(box(), (-0.197, 0.7, 0.0), (-0.19, 0.7, 0.0)) == [None, "forward"]


def test_normals_may_point_either_way() -> None:
    turned = {name: Plane(-p.normal, -p.offset) for name, p in BOX_PLANES.items()}
    a, b = box(), box_surfaces(turned, box_corners())
    for one, other in zip(a.planes, b.planes, strict=True):
        np.testing.assert_array_equal(one.normal, other.normal)
        assert one.offset == other.offset


@pytest.mark.parametrize(("side", "hit"), [(-1.0, "right"), (1.0, "left")])
def test_a_surface_is_seen_from_inside_only(side: float, hit: str) -> None:
    """From beside the box, the near wall's outside does not count; the far wall's inside does."""
    origins, directions = np.array([[0.5 * side, 0.4, 0.0]]), np.array([[-side, 0.0, 0.0]])
    surfaces = box()
    _, surface = surfaces.hits(Rays(origins, directions, np.ones(1, np.bool_)))
    assert surfaces.names[surface[0]] == hit


def test_markers_on_both_sides_of_a_plane_are_refused() -> None:
    planes = BOX_PLANES | {"forward": Plane(np.array([0.0, 1.0, 0.0]), 0.5)}
    with pytest.raises(CalibrationError, match=r"'forward'.*200\.0 mm on one side"):
        box_surfaces(planes, box_corners())


def test_one_plane_is_no_box() -> None:
    with pytest.raises(CalibrationError, match="the box has 1 plane"):
        box_surfaces({"forward": BOX_PLANES["forward"]}, box_corners())


def test_stripes_are_placed_where_they_are() -> None:
    camera, pose = example_rig().camera(), dome_from_box(0)
    true = np.array([[-0.2, 0.45, 0.02], [0.0, 0.7, 0.1], [-0.1, 0.5, -0.19]])
    pixels, valid = camera.project(pose.apply(true))
    assert valid.all()
    across = np.tile([0.6, 0.8], (3, 1))
    stripes = StripePoints(pixels, across, np.zeros(3, np.int64), np.full(3, 0.1))
    placed = place_stripes(camera, stripes, pose, box())
    assert placed.surface.tolist() == [0, 2, 3]
    np.testing.assert_allclose(pose.inverse().apply(placed.points_in_dome), true, atol=1e-9)
    # A step of a hundredth of a pixel: derivative against difference.
    stepped = StripePoints(pixels + 0.01 * across, across, stripes.chain, stripes.sigma_px)
    there = place_stripes(camera, stepped, pose, box()).points_in_dome
    difference = (there - placed.points_in_dome) / 0.01
    np.testing.assert_allclose(placed.by_across, difference, rtol=1e-3, atol=1e-7)


def test_stripes_beside_a_thick_board_lie_behind_its_face() -> None:
    camera = example_rig().camera()
    pose = SE3(example_rig().dome_from_cam.rotation, np.array([0.0, 0.5, 0.0]))
    stripes = StripePoints(
        np.array([[300.0, 250.0]]), np.array([[1.0, 0.0]]), np.zeros(1, np.int64), np.ones(1)
    )
    placed = place_stripes(camera, stripes, pose, board_surface(thickness=0.005))
    assert pose.inverse().apply(placed.points_in_dome)[0, 2] == pytest.approx(0.005)


def test_points_without_a_projection_stay_nan() -> None:
    by_point = np.full((1, 2, 3), np.nan)
    moved = solve_on_surface(by_point, np.array([[0.0, 1.0, 0.0]]), np.zeros((3, 2)))
    assert np.isnan(moved).all()
