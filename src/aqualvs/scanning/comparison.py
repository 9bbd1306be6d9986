"""What ignoring the dome costs: the same stripe points, triangulated as if by a bare lens."""

import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.compiled import borrowing_kernel
from aqualvs.optics.rig import Rig
from aqualvs.scanning.plane_fit import SOLID_ERROR, PlaneFit, fit_robust, plane_of_all
from aqualvs.scanning.posture import Posture, Reason, Refusal, posture_of, rested_on
from aqualvs.scanning.scan import Scan
from aqualvs.scanning.search import plan_searches
from aqualvs.scanning.triangulate import Triangulator

# Neighbouring points say the same; a few hundred are plenty for a comparison.
_EVERY = 4
_MIN_POINTS = 6


class BareLensComparison:
    """Measures a scan's posture again with the rig's camera out of its dome.

    Detection, classification and the choice of the target are taken over from the scan, so that
    the difference is that of the ray model alone (paper, section 5.4).

    Parameters
    ----------
    rig : Rig
        A rig with a dome.
    """

    def __init__(self, rig: Rig) -> None:
        camera = rig.bare_camera()
        self._triangulator = Triangulator(rig, camera)
        self._along_x = np.array(
            [search.axis.value == "x" for search in plan_searches(rig, rig.camera())], np.int64
        )
        self._axis_in_dome = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])

    def measure(self, scan: Scan) -> Posture | Refusal:
        """Return the bare-lens posture to the target of a scan, or the refusal in its place.

        However unlikely it looks, it is returned: what the bare lens makes of the target is what
        the comparison is about.
        """
        if not scan.posture:
            return scan.posture
        points = scan.points
        most = -(-len(points) // _EVERY)
        numbers, pixels = np.empty((3, most), np.int64), np.empty((most, 2))
        n = _pick(points.used, points.laser, points.pixels, self._along_x, numbers, pixels)
        found, sensitivity, valid = np.empty((n, 3)), np.empty((n, 3)), np.empty(n, np.bool_)
        rows, laser, along_x = numbers[:, :n]
        # Every point is a group of its own: they are not neighbours.
        all_valid = self._triangulator.triangulate_into(
            pixels[:n], along_x, laser, rows, found, sensitivity, valid
        )
        if not all_valid:
            found, sensitivity, laser = found[valid], sensitivity[valid], laser[valid]
        if len(found) < _MIN_POINTS:
            return Refusal(Reason.TOO_FEW_POINTS, "a bare lens would see too few of the points")
        fit = self._fit(found, sensitivity, laser)
        if fit is None:
            return Refusal(Reason.COLLINEAR, "the points do not fix a plane")
        n_points, nearest = rested_on(found, fit.weights)
        return posture_of(fit, nearest, n_points, self._axis_in_dome)

    @staticmethod
    def _fit(points: FloatArray, sensitivity: FloatArray, laser: IntArray) -> PlaneFit | None:
        n, start = len(points), np.empty(3)
        if not plane_of_all(points, start):
            return None
        return fit_robust(points, sensitivity, np.ones(n), laser, np.zeros(n), start, SOLID_ERROR)


@borrowing_kernel
def _pick(
    used: BoolArray,
    laser: NDArray[np.int8],
    pixels: FloatArray,
    along_x_of: IntArray,
    numbers: IntArray,
    out_pixels: FloatArray,
) -> int:
    """Write row, laser and direction of search of some of the points used; how many there are."""
    n, n_used = 0, 0
    for i in range(used.shape[0]):
        if not used[i]:
            continue
        if n_used % _EVERY == 0:
            numbers[0, n], numbers[1, n], numbers[2, n] = i, laser[i], along_x_of[laser[i]]
            out_pixels[n, 0], out_pixels[n, 1] = pixels[i, 0], pixels[i, 1]
            n += 1
        n_used += 1
    return n
