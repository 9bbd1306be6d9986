"""The arithmetic of `Readings`: chunks of stripe, and averages over groups of readings."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, inline_borrowing_kernel, kernel
from aqualvs.scanning.stretch_shape import StretchShapes, describe_stretches, is_curved, run_end

# Position noise of a chunk's centroid beyond that: a floor that neighbouring returns share, and a
# share of the spread, because a strand's light may be cut off on one side by a knot or the border.
_CHUNK_FLOOR_PX = 0.08
_SPREAD_SHARE = 0.12
# A stretch has at most this many times the typical voice when surfaces are sought, but a voice of
# at least so many search lines.
_LOUDEST_SHARE = 2.0
_LOUD_ENOUGH = 16.0
# What is left of the voice of a curved stretch: a fish is no plane, though it has tangent ones.
_CURVED_VOICE = 0.2
# Shorter stretches are specks; they do not say what is typical.
_SPECK_LINES = 3.0


@borrowing_kernel
def count_chunks(chunk: IntArray) -> int:
    """Count chunks whose numbers ascend."""
    n = 0
    for i in range(chunk.shape[0]):
        n += i == 0 or chunk[i] != chunk[i - 1]
    return n


@kernel
def chunk_readings(
    chunk: IntArray,
    line: IntArray,
    laser: IntArray,
    stretch: IntArray,
    trust: FloatArray,
    height: FloatArray,
    width: FloatArray,
    points: FloatArray,
    sensitivity: FloatArray,
    index: IntArray,
    table: FloatArray,
    light: FloatArray,
    facts: IntArray,
) -> FloatArray:
    """Summarise N readings in C chunks, whose numbers ascend.

    Parameters
    ----------
    chunk, line, laser, stretch, trust, height, width, points, sensitivity
        As in `Readings`.
    index : int array, shape (N,)
        Written: row of each reading's chunk.
    table : array, shape (7, C), light : array, shape (C,)
        Written, as in `Chunks`.
    facts : int array, shape (4, C)
        Written: (n_lines, first_line, last_line, laser).

    Returns
    -------
    array, shape (6, S)
        The stretches as `describe_stretches` tells them.
    """
    begin = 0
    for c in range(light.shape[0]):
        end = run_end(chunk, begin)
        for i in range(begin, end):
            index[i] = c
        facts[0, c], facts[1, c], facts[2, c] = end - begin, line[begin], line[end - 1]
        facts[3, c] = laser[begin]
        total = 0.0
        for i in range(begin, end):
            total += trust[i]
        light[c] = total
        _write_centroid(height, width, points, sensitivity, begin, end, table, c)
        begin = end
    shapes = describe_stretches(stretch, line, points, sensitivity, width, height)
    _write_voices(facts[0], stretch, light, shapes, table[6])
    return shapes


@inline_borrowing_kernel
def _write_centroid(
    height: FloatArray,
    width: FloatArray,
    points: FloatArray,
    sensitivity: FloatArray,
    begin: int,
    end: int,
    table: FloatArray,
    c: int,
) -> None:
    """Write the mean point and sensitivity of a chunk, weighted by the light in each return."""
    total, x, y, z, jx, jy, jz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(begin, end):
        light = height[i] * width[i]
        total += light
        x += light * points[i, 0]
        y += light * points[i, 1]
        z += light * points[i, 2]
        jx += light * sensitivity[i, 0]
        jy += light * sensitivity[i, 1]
        jz += light * sensitivity[i, 2]
    share = 1.0 / total
    table[0, c], table[1, c], table[2, c] = share * x, share * y, share * z
    table[3, c], table[4, c], table[5, c] = share * jx, share * jy, share * jz


@kernel
def _write_voices(
    n_lines: IntArray, stretch: IntArray, light: FloatArray, table: FloatArray, voice: FloatArray
) -> None:
    """Write the voice of each chunk: its light, less where its stretch is long or curved."""
    shapes = StretchShapes(table[0], table[1], table[2], table[3], table[4], table[5])
    strands = shapes.n_lines[shapes.n_lines >= _SPECK_LINES]
    typical = np.median(strands) if strands.shape[0] else 0.0
    loudest = max(_LOUDEST_SHARE * typical, _LOUD_ENOUGH)
    begin = 0
    for c in range(n_lines.shape[0]):
        s = stretch[begin]
        voice[c] = light[c] * min(1.0, loudest / shapes.n_lines[s])
        if is_curved(shapes, s):
            voice[c] *= _CURVED_VOICE
        begin += n_lines[c]


@kernel
def summarise(
    index: IntArray,
    laser: IntArray,
    line: IntArray,
    height: FloatArray,
    width: FloatArray,
    points: FloatArray,
    sensitivity: FloatArray,
    sigma_px: FloatArray,
    normal: FloatArray,
    centroid: FloatArray,
    mean_sensitivity: FloatArray,
    group_sigma_px: FloatArray,
    group_line: FloatArray,
    group_laser: IntArray,
) -> None:
    """Write the centroids, mean sensitivities, position errors and lasers of groups."""
    n = group_sigma_px.shape[0]
    total, spread = np.zeros(n), np.zeros(n)
    for i in range(index.shape[0]):
        c = index[i]
        if c < 0:
            continue
        light = height[i] * width[i]
        total[c] += light
        for k in range(3):
            centroid[c, k] += light * points[i, k]
            mean_sensitivity[c, k] += light * sensitivity[i, k]
        # Error of a weighted mean of independent positions.
        group_sigma_px[c] += (light * sigma_px[i]) ** 2
        group_line[c] += light * line[i]
        group_laser[c] = laser[i]
    middle = np.empty(n)
    for c in range(n):
        share = 1.0 / total[c]
        middle[c] = 0.0
        for k in range(3):
            centroid[c, k] *= share
            mean_sensitivity[c, k] *= share
            middle[c] += normal[k] * centroid[c, k]
        group_sigma_px[c] *= share * share
        group_line[c] *= share
    for i in range(index.shape[0]):
        c = index[i]
        if c >= 0:
            off = -middle[c]
            for k in range(3):
                off += normal[k] * points[i, k]
            spread[c] += height[i] * width[i] * off * off
    for c in range(n):
        per_px = 0.0
        for k in range(3):
            per_px += normal[k] * mean_sensitivity[c, k]
        scatter = spread[c] / (total[c] * per_px * per_px)
        variance = group_sigma_px[c] + _SPREAD_SHARE**2 * scatter
        group_sigma_px[c] = np.sqrt(variance + _CHUNK_FLOOR_PX**2)
