"""Shapes of single components, on exact stripes in one laser plane."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.segments import (
    ComponentShapes,
    describe_components,
    is_bent,
    is_curved,
    is_round,
    is_straight,
)

_PX = 0.7e-3  # a pixel on the target, in metres


def shapes_of(*depths: FloatArray, width: float = 5.0, height: float = 100.0) -> ComponentShapes:
    """Describe components that run to the right and are so deep, in pixels of stripe."""
    component = np.repeat(np.arange(len(depths)), [len(one) for one in depths])
    line = np.concatenate([np.arange(len(one)) for one in depths])
    depth = np.concatenate(depths)
    n = len(line)
    points = np.stack([_PX * line, 0.5 + _PX * depth, np.zeros(n)], axis=-1)
    sensitivity = np.tile([0.0, _PX, 0.0], (n, 1))
    table = describe_components(
        component, line, points, sensitivity, np.full(n, width), np.full(n, height)
    )
    return ComponentShapes(*table)


def test_a_straight_component_is_straight_however_it_slants() -> None:
    rng = np.random.default_rng(1)
    shapes = shapes_of(0.3 * np.arange(80.0) + rng.normal(0.0, 0.2, 80))
    assert is_straight(shapes, 0)
    assert not is_bent(shapes, 0)
    assert not is_curved(shapes, 0)
    assert shapes.n_lines.tolist() == [80.0]
    # The chord of 79 lines, slanted by 0.3.
    np.testing.assert_allclose(shapes.size, 79 * _PX * np.hypot(1.0, 0.3), rtol=0.01)


def test_a_flank_is_bent_and_a_corner_is_curved_but_not_bent() -> None:
    x = np.arange(60.0)
    flank = 6.0 * (1.0 - ((x - 29.5) / 29.5) ** 2)
    corner = 24.0 - 0.8 * np.abs(x - 29.5)
    shapes = shapes_of(flank, corner)
    # The sagitta of the parabola is its height.
    assert abs(shapes.sagitta_px[0] - 6.0) < 0.3
    assert [is_bent(shapes, s) for s in range(2)] == [True, False]
    assert [is_curved(shapes, s) for s in range(2)] == [True, True]
    assert not any(is_straight(shapes, s) for s in range(2))


def test_short_components_have_no_shape() -> None:
    shapes = shapes_of(np.array([0.0, 2.0, 3.0, 2.0, 0.0]))
    assert not any(has_shape(shapes, 0) for has_shape in (is_bent, is_straight, is_curved))


def test_a_bright_spot_is_round_and_a_dim_or_long_one_is_not() -> None:
    spot, long = np.zeros(8), np.zeros(30)
    shapes = shapes_of(spot, long)
    assert [is_round(shapes, s, 110.0) for s in range(2)] == [True, False]
    assert not is_round(shapes, 0, 200.0)


def test_nothing_has_no_shapes() -> None:
    nothing, vectors = np.empty(0), np.empty((0, 3))
    index = np.empty(0, np.int64)
    assert describe_components(index, index, vectors, vectors, nothing, nothing).shape[1] == 0
