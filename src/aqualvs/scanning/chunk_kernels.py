"""The arithmetic of `Readings`: chunks of stripe, and averages over groups of readings."""

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel, kernel

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
def number_chunks(chunk: IntArray, index: IntArray) -> int:
    """Renumber ascending chunks without gaps, and count them."""
    n = 0
    for i in range(chunk.shape[0]):
        if i > 0 and chunk[i] != chunk[i - 1]:
            n += 1
        index[i] = n
    return n + 1 if chunk.shape[0] else 0


@kernel
def chunk_facts(
    index: IntArray,
    line: IntArray,
    laser: IntArray,
    stretch: IntArray,
    trust: FloatArray,
    facts: IntArray,
    voice: FloatArray,
    light: FloatArray,
) -> None:
    """Write (n_lines, first_line, last_line, laser), voice and light of each chunk."""
    n_stretches = 0
    for i in range(stretch.shape[0]):
        n_stretches = max(n_stretches, stretch[i] + 1)
    lines_of_stretch = np.zeros(n_stretches)
    facts[0] = 0
    for i in range(index.shape[0]):
        c = index[i]
        if facts[0, c] == 0:
            facts[1, c] = line[i]
            facts[3, c] = laser[i]
        facts[0, c] += 1
        light[c] += trust[i]
        facts[2, c] = line[i]
        lines_of_stretch[stretch[i]] += 1.0
    stretches = lines_of_stretch[lines_of_stretch >= _SPECK_LINES]
    typical = np.median(stretches) if stretches.shape[0] else 0.0
    loudest = max(_LOUDEST_SHARE * typical, _LOUD_ENOUGH)
    for i in range(index.shape[0]):
        voice[index[i]] = light[index[i]] * min(1.0, loudest / lines_of_stretch[stretch[i]])


@kernel
def hush(index: IntArray, stretch: IntArray, curved: BoolArray, voice: FloatArray) -> None:
    """Lower the voice of chunks of curved stretches, in place."""
    hushed = np.zeros(voice.shape[0], np.bool_)
    for i in range(index.shape[0]):
        c = index[i]
        if curved[stretch[i]] and not hushed[c]:
            voice[c] *= _CURVED_VOICE
            hushed[c] = True


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
    for c in range(n):
        for k in range(3):
            centroid[c, k] /= total[c]
            mean_sensitivity[c, k] /= total[c]
        group_sigma_px[c] /= total[c] * total[c]
        group_line[c] /= total[c]
    for i in range(index.shape[0]):
        c = index[i]
        if c < 0:
            continue
        offset = 0.0
        per_px = 0.0
        for k in range(3):
            offset += normal[k] * (points[i, k] - centroid[c, k])
            per_px += normal[k] * mean_sensitivity[c, k]
        spread[c] += height[i] * width[i] * (offset / per_px) ** 2
    for c in range(n):
        variance = group_sigma_px[c] + _SPREAD_SHARE**2 * spread[c] / total[c]
        group_sigma_px[c] = np.sqrt(variance + _CHUNK_FLOOR_PX**2)
