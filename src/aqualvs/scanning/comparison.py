"""What ignoring the dome costs: the same stripe points, triangulated as if by a bare lens."""

import numpy as np

from aqualvs.optics.rig import Rig
from aqualvs.scanning.plane_fit import SOLID_ERROR, fit_robust
from aqualvs.scanning.posture import Posture, Reason, Refusal, posture_from_fit
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
        rows = np.flatnonzero(scan.points.used)[::_EVERY]
        laser = scan.points.laser[rows].astype(np.int64)
        pixels = scan.points.pixels[rows]
        found = self._triangulator.triangulate(pixels, self._along_x[laser], laser)
        if np.count_nonzero(found.valid) < _MIN_POINTS:
            return Refusal(Reason.TOO_FEW_POINTS, "a bare lens would see too few of the points")
        points, laser = found.points_in_dome[found.valid], laser[found.valid]
        sigma_px = np.ones(len(points))
        try:
            start = np.linalg.solve(points.T @ points, points.sum(axis=0))
        except np.linalg.LinAlgError:
            return Refusal(Reason.COLLINEAR, "the points do not fix a plane")
        fit = fit_robust(
            points,
            found.sensitivity[found.valid],
            sigma_px,
            laser,
            np.zeros(len(points)),
            start,
            SOLID_ERROR,
        )
        if fit is None:
            return Refusal(Reason.COLLINEAR, "the points do not fix a plane")
        return posture_from_fit(fit, points[fit.weights > 0.0], self._axis_in_dome)
