"""Views from which nothing good can come, and the words that say what to do about it."""

from collections.abc import Sequence

import numpy as np

from aqualvs.geometry.arrays import FloatArray

# Boards less than this apart in direction (radians) and in distance (share) are all the same.
_SAME_DIRECTION, _SAME_DISTANCE = np.deg2rad(3.0), 0.05
# Ratios of found to given lengths that a mistaken unit explains, to within the last.
_UNITS = {
    1e3: "distances written in metres, or square_mm in micrometres",
    1e-3: "distances written in micrometres, or square_mm in metres",
    1e2: "distances off by a factor of 100",
    1e-2: "distances off by a factor of 100",
    25.4: "distances in inches",
    1 / 25.4: "square_mm in inches",
    10.0: "distances in centimetres",
    0.1: "square_mm in centimetres",
}
_UNIT_TOLERANCE = 0.12


def spread_of(normals: FloatArray, distances: FloatArray) -> tuple[float, float]:
    """Return how much boards differ in direction (radians, largest) and distance (share).

    Parameters
    ----------
    normals : array, shape (V, 3)
        Unit normals of the boards, in any common frame.
    distances : array, shape (V,)
    """
    cosines = np.clip(np.abs(normals @ normals.T), 0.0, 1.0)
    return float(np.arccos(cosines.min())), float(np.ptp(distances) / np.median(distances))


def all_alike(normals: FloatArray, distances: FloatArray) -> bool:
    """Return whether all boards are parallel and at one distance."""
    direction, distance = spread_of(normals, distances)
    return direction < _SAME_DIRECTION and distance < _SAME_DISTANCE


def length_ratio(given: FloatArray, found: FloatArray) -> float:
    """Return how many times longer distances found in pictures are than those given.

    From the differences between views where they differ enough (a median, so that a few wrong ones
    do not count): an offset, such as of a lens that is not yet known, plays no part then.
    """
    i, j = np.triu_indices(len(given), 1)
    apart = np.abs(given[i] - given[j]) > 0.1 * np.median(np.abs(given))
    if np.count_nonzero(apart) >= len(given):
        return float(np.median((found[i] - found[j])[apart] / (given[i] - given[j])[apart]))
    return float(np.median(found / given))


def scale_fault(ratio: float, tolerance: float) -> str | None:
    """Return what a ratio of found to given distances means; None where all is well."""
    if abs(ratio - 1.0) <= tolerance:
        return None
    for unit, meaning in _UNITS.items():
        if abs(ratio / unit - 1.0) < _UNIT_TOLERANCE:
            return (
                f"the pictures put the boards {ratio:.4g} times as far away as the given distances "
                f"do: {meaning}? Distances and square_mm are in millimetres"
            )
    if ratio < 0.0:
        return (
            "the given distances grow where the pictures show the board coming nearer; measure "
            "them from the dome's centre forward, along its y axis"
        )
    return (
        f"the pictures put the boards {ratio:.4g} times as far apart as the given distances do; "
        f"measure the board's squares: square_mm would have to be {1.0 / ratio:.4g} times what "
        "its file says, if the distances are right"
    )


def unbelievable_distance(distances: FloatArray, labels: Sequence[str]) -> str | None:
    """Return what is wrong with boards at distances (metres) at which nobody holds them."""
    median = float(np.median(distances))
    label = labels[int(np.argsort(distances)[len(distances) // 2])]
    if 0.03 < median < 30.0:
        return None
    return (
        f"{label}: the board would stand {1e3 * median:.4g} mm away; is square_mm in its file in "
        "millimetres?"
    )
