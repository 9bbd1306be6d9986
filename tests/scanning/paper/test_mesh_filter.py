"""The paper's mesh filter: the sparse form equals Algorithm 1, and it does what it is for."""

import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from aqualvs.errors import OptionError
from aqualvs.geometry import Plane
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.paper.mesh_filter import (
    MeshFilterOptions,
    laser_frame,
    laser_plane_image,
    mesh_filter,
    mesh_filter_dense,
    structuring_elements,
)

PLANE = Plane.from_normal([-0.02, -0.34, 0.94], -0.143)
SIDEWAYS = Plane.from_normal([0.0, 0.0, 1.0], 0.0)


def stripe(
    n_threads: int, period: float = 25e-3, size: float = 10e-3, step: float = 0.5e-3
) -> FloatArray:
    """Points (N, 2) where a laser plane cuts threads that lie side by side, 0.5 m ahead."""
    thread = np.arange(0.0, size, step)
    x = (np.arange(n_threads)[:, None] * period + thread[None, :]).ravel()
    return np.stack([x - n_threads * period / 2.0, np.full_like(x, 0.5)], axis=-1)


# Small windows keep the dense reference quick; ratios span B empty to B wide.
options = st.builds(
    lambda rd, dd, r_min, more: MeshFilterOptions(
        rd_theta=rd, dd=dd, r_min=r_min, r_max=max(r_min, rd) + more
    ),
    rd=st.floats(0.5e-3, 8e-3),
    dd=st.floats(1e-3, 4e-3),
    r_min=st.floats(1e-3, 12e-3),
    more=st.floats(1e-3, 10e-3),
)


@st.composite
def clouds(draw: st.DrawFn) -> FloatArray:
    """Draw points (N, 2): threads in a row with noise, strays, twins, and points on cell edges."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    threads = stripe(
        draw(st.integers(0, 6)),
        period=draw(st.floats(4e-3, 15e-3)),
        size=draw(st.floats(1e-3, 8e-3)),
        step=draw(st.floats(0.5e-3, 3e-3)),
    )
    threads = threads + rng.normal(size=threads.shape) * draw(st.sampled_from([0.0, 2e-4, 2e-3]))
    strays = rng.uniform(-0.04, 0.04, size=(draw(st.integers(0, 60)), 2)) + np.array([0.0, 0.5])
    on_edges = np.round(strays[: draw(st.integers(0, 10))], 3)
    twins = threads[: draw(st.integers(0, 5))]
    points = np.concatenate([threads, strays, on_edges, twins])
    return points[rng.permutation(len(points))]


@given(clouds(), options)
@settings(max_examples=80, deadline=None)
def test_sparse_equals_algorithm_1(points: FloatArray, chosen: MeshFilterOptions) -> None:
    sparse = mesh_filter(points, SIDEWAYS, chosen)
    np.testing.assert_array_equal(sparse, mesh_filter_dense(points, SIDEWAYS, chosen))


def test_the_comparison_meets_both_verdicts() -> None:
    """The test above would prove nothing if random clouds were never kept."""
    chosen = MeshFilterOptions(rd_theta=3e-3, dd=1e-3, r_min=6e-3, r_max=12e-3)
    points = stripe(8, period=9e-3, size=3e-3)
    keep = mesh_filter_dense(points, SIDEWAYS, chosen)
    assert 0.4 < keep.mean() < 1.0
    np.testing.assert_array_equal(mesh_filter(points, SIDEWAYS, chosen), keep)


@pytest.mark.parametrize(
    "points",
    [
        np.empty((0, 2)),
        np.empty((0, 3)),
        [],
        [[0.0, 0.5]],
        np.full((40, 2), 0.5),
        [[np.nan, 0.5], [np.inf, 0.5], [0.0, -np.inf]],
        [[0.0, 1e300], [0.0, 0.5]],
        stripe(1),
        stripe(4) * [1.0, -1.0],
    ],
    ids=["none2", "none3", "list", "one", "one cell", "not finite", "far", "a thread", "behind"],
)
def test_edge_cases_agree(points: FloatArray) -> None:
    sparse, dense = mesh_filter(points, PLANE), mesh_filter_dense(points, PLANE)
    assert sparse.shape == (len(points),)
    assert sparse.dtype == np.bool_
    np.testing.assert_array_equal(sparse, dense)


def test_cells_far_apart_agree() -> None:
    """Clusters metres apart leave strips between them empty."""
    chosen = MeshFilterOptions(rd_theta=10e-3, dd=5e-3, r_min=15e-3, r_max=35e-3)
    one = stripe(6, period=28e-3, size=10e-3)
    points = np.concatenate([one + np.array([2.0, 1.5]) * i for i in range(2)])
    keep = mesh_filter(points, SIDEWAYS, chosen)
    np.testing.assert_array_equal(keep, mesh_filter_dense(points, SIDEWAYS, chosen))
    np.testing.assert_array_equal(keep[: len(one)], keep[len(one) :])
    assert keep.any()


def test_net_is_kept_inside_and_lost_at_its_edge() -> None:
    points = stripe(8)
    keep = mesh_filter(points, SIDEWAYS).reshape(8, -1)
    assert keep[1:-1].mean() > 0.7
    # Algorithm 1 wants light on both sides, so the first and last thread go (docs/mesh-filter.md).
    assert not keep[[0, -1]].any()


def bright_pixels(x: FloatArray, columns: int) -> FloatArray:
    """Reflections at `x` as pixels see them: `columns` 1 mm apart in three rows 2.5 mm apart."""
    across = 1e-3 * (np.arange(columns) - (columns - 1) / 2)
    offsets = np.stack(np.meshgrid(across, [-2.5e-3, 0.0, 2.5e-3]), axis=-1).reshape(-1, 2)
    centres = np.stack([x, np.full(len(x), 0.643)], axis=-1)
    # Away from the edges of cells, where roundings decide.
    return (centres[:, None] + offsets).reshape(-1, 2)


EVEN = 0.025 * np.arange(9.0)
# A laser cuts a diamond of 35 mm twice in each diagonal.
DIAMOND = 0.035 * (np.arange(9.0)[:, None] + [0.0, 0.35]).ravel()


@pytest.mark.parametrize(
    ("x", "columns", "kept"),
    [(EVEN, 2, False), (EVEN, 3, True), (EVEN, 4, False), (DIAMOND, 2, False), (DIAMOND, 3, False)],
    ids=["6 cells", "9 cells", "12 cells", "diamond, 6 cells", "diamond, 9 cells"],
)
def test_which_reflections_pass_the_paper_s_limits(x: FloatArray, columns: int, kept: bool) -> None:
    """Section 5.2: 6 to 11 cells in A and 17 to 22 in C, so 9 to 11 with two neighbours in C.

    Of a diamond C holds four, because r_max is its diagonal: 17 to 22 are 5 each, too few for A.
    """
    points = bright_pixels(x, columns)
    keep = mesh_filter(points, SIDEWAYS).reshape(len(x), -1)
    np.testing.assert_array_equal(keep.ravel(), mesh_filter_dense(points, SIDEWAYS))
    assert (keep[2:-2].mean(axis=1) > 0.5).all() == kept
    assert keep[2:-2].any() == kept


def test_walls_bubbles_and_lonely_threads_are_not_kept() -> None:
    wall = np.stack([np.linspace(-0.2, 0.2, 800), np.full(800, 0.9)], axis=-1)
    angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
    bubble = 4e-3 * np.stack([np.cos(angle), np.sin(angle)], axis=-1) + [0.0, 0.6]
    for clutter in (wall, bubble, stripe(1), stripe(8, period=90e-3)):
        assert not mesh_filter(clutter, SIDEWAYS).any()


def test_clutter_elsewhere_leaves_the_net_alone() -> None:
    net = stripe(8)
    # A wall 0.4 m behind; its left end must not move the grid, which begins at the least x.
    wall = np.stack([np.linspace(net[0, 0], 0.2, 800), np.full(800, 0.9)], axis=-1)
    keep = mesh_filter(np.concatenate([net, wall]), SIDEWAYS)
    np.testing.assert_array_equal(keep[: len(net)], mesh_filter(net, SIDEWAYS))
    assert not keep[len(net) :].any()


def test_points_out_of_the_working_range_do_not_count() -> None:
    net = stripe(8)
    # A point this near the net, but out of range, would shift the grid and fill region B.
    near = net[40:60] - [0.0, 0.012]
    points = np.concatenate([net, near])
    keep = mesh_filter(points, SIDEWAYS, working_range=(0.4995, 1.0))
    np.testing.assert_array_equal(keep[: len(net)], mesh_filter(net, SIDEWAYS))
    assert not keep[len(net) :].any()
    assert not np.array_equal(mesh_filter(points, SIDEWAYS)[: len(net)], keep[: len(net)])
    assert not mesh_filter(net, SIDEWAYS, working_range=(0.6, 1.0)).any()


@given(
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3).filter(
        lambda n: np.linalg.norm(n) > 0.1
    ),
    st.floats(-0.5, 0.5),
)
@settings(max_examples=50, deadline=None)
def test_laser_frame(normal: list[float], offset: float) -> None:
    plane = Plane.from_normal(normal, offset)
    frame = laser_frame(plane)
    turn = frame.rotation
    # Roundings of a few numbers around one.
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(turn) == pytest.approx(1.0, abs=1e-14)
    np.testing.assert_array_equal(turn[2], plane.normal)
    np.testing.assert_allclose(frame.apply(plane.normal * plane.offset), 0.0, atol=1e-14)
    if abs(plane.normal[1]) < 0.999:
        assert turn[1] @ [0.0, 1.0, 0.0] > 0.0
        assert turn[0] @ [0.0, 1.0, 0.0] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("sign", "right"), [(1.0, -1.0), (-1.0, 1.0)])
def test_laser_frame_of_a_plane_square_to_the_axis(sign: float, right: float) -> None:
    frame = laser_frame(Plane.from_normal([0.0, sign, 0.0], 0.5))
    np.testing.assert_allclose(frame.rotation[1], [0.0, 0.0, 1.0], atol=1e-15)
    np.testing.assert_allclose(frame.rotation[0], [right, 0.0, 0.0], atol=1e-15)


def test_points_in_dome_and_in_laser_agree() -> None:
    rng = np.random.default_rng(5)
    in_laser = stripe(8)
    in_laser[:, 0] += rng.normal(size=len(in_laser)) * 1e-4
    in_dome = laser_frame(PLANE).inverse().apply(np.pad(in_laser, ((0, 0), (0, 1))))
    # Bit for bit: the least y, the one cell edge with many points on it, is where counting begins.
    keep = mesh_filter(in_laser, PLANE)
    assert keep.any()
    np.testing.assert_array_equal(mesh_filter(in_dome, PLANE), keep)


def test_laser_plane_image() -> None:
    image = laser_plane_image(np.array([[0.0, 0.0], [2.5e-3, 0.0], [2.9e-3, 3e-3]]), 1e-3)
    np.testing.assert_array_equal(image.cells, [[0, 0], [2, 0], [2, 3]])
    assert image.lit.shape == (3, 4)
    assert image.lit.sum() == 3


def test_structuring_elements_tile_the_disc() -> None:
    chosen = MeshFilterOptions()
    a, b, c = structuring_elements(chosen)
    assert a.shape == (81, 81)
    assert not (a & b).any()
    assert not (b & c).any()
    middle = 40
    # Radii of A, B and C: 5, 10 and 40 mm, in cells of 1 mm; edges belong to the inner region.
    row = a[middle].astype(int) + 2 * b[middle] + 3 * c[middle]
    assert row[middle:].tolist() == [1] * 6 + [2] * 5 + [3] * 30
    discs = [np.count_nonzero(x) for x in (a, a | b, a | b | c)]
    # Cells of a disc: its area to within half its circumference.
    for count, radius in zip(discs, (5.0, 10.0, 40.0), strict=True):
        assert abs(count - np.pi * radius**2) < np.pi * radius


def test_options_of_the_paper() -> None:
    chosen = MeshFilterOptions()
    assert (chosen.dg_theta, chosen.padding) == (11, 40)
    thread = MeshFilterOptions.from_thread(
        d_theta=2e-3, theta_lt=float(np.arccos(0.2)), dd=1e-3, r_min=15e-3, r_max=35e-3
    )
    assert thread.rd_theta == pytest.approx(10e-3, rel=1e-12)
    assert (thread.dg_theta, thread.padding, thread.squared_radii) == (11, 40, (25, 100, 1600))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"dd": 0.0}, "dd 0: must be positive"),
        ({"rd_theta": float("nan")}, "rd_theta nan: must be positive"),
        ({"r_max": 0.015}, "r_min is 15 mm and r_max 15 mm"),
        ({"rd_theta": 0.035}, "rd_theta is 35 mm, not below r_max of 35 mm"),
    ],
)
def test_options_that_make_no_sense(changes: dict[str, float], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        MeshFilterOptions(**changes)


def test_wrong_shape() -> None:
    with pytest.raises(ValueError, match=r"points has shape \(4,\)"):
        mesh_filter(np.zeros(4), PLANE)


def test_cost_grows_with_points_not_with_area() -> None:
    """Ten times as many points over a ten times longer net must not cost the square."""
    few, many = stripe(100), stripe(1000)
    mesh_filter(few, SIDEWAYS)
    # Linear growth is 10, quadratic 100. Processor time: what else the machine does is left out.
    assert _seconds(many) < 40.0 * _seconds(few)


def _seconds(points: FloatArray) -> float:
    times = []
    for _ in range(7):
        start = time.process_time()
        mesh_filter(points, SIDEWAYS)
        times.append(time.process_time() - start)
    return min(times)
