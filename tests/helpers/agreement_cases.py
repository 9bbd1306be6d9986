"""Scans of made-up targets, flat or curved, seen by one rig and read by another."""

import numpy as np

from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.geometry.transforms import rotation_from_rotvec
from aqualvs.optics.rig import Rig
from aqualvs.optics.sheet import Sheet, sheets_of
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.plane_fit import PlaneFit, fit_robust, shared_error
from aqualvs.scanning.posture import Posture, Reason, Refusal, posture_of
from aqualvs.scanning.scan import Scan, ScanPoints
from aqualvs.scanning.triangulate import Triangulator


class Target:
    """The surface y = range + (curvature_x x² + curvature_z z²) / 2 + twist x z, turned."""

    def __init__(
        self,
        range_m: float,
        *,
        pitch_deg: float = 0.0,
        yaw_deg: float = 0.0,
        curvature_x: float = 0.0,
        curvature_z: float = 0.0,
        twist: float = 0.0,
    ) -> None:
        self._turn = rotation_from_rotvec(np.deg2rad([pitch_deg, 0.0, -yaw_deg]))
        self._range = range_m
        self._form = np.array([curvature_x, curvature_z, twist])

    def height(self, points: FloatArray) -> FloatArray:
        """How far points (N, 3) lie behind the surface, along its own normal in the middle."""
        x, y, z = (points @ self._turn).T
        a, b, c = self._form
        return y - self._range - 0.5 * (a * x**2 + b * z**2) - c * x * z

    def stripe(self, sheet: Sheet) -> FloatArray:
        """Points on the surface and on a sheet, by Newton's method within the sheet."""
        n, forward = sheet.plane.normal, self._turn[:, 1]
        along = np.cross(n, forward)
        along /= np.linalg.norm(along)
        deeper = np.cross(along, n)
        foot = np.linalg.solve([n, forward, along], [sheet.plane.offset, self._range, 0.0])
        points = foot + np.linspace(-0.8, 0.8, 801)[:, None] * along
        for _ in range(8):
            ahead, behind = self.height(points + 1e-5 * deeper), self.height(points - 1e-5 * deeper)
            slope = (ahead - behind) / 2e-5
            points = points - (self.height(points) / slope)[:, None] * deeper
        return points


def posture_from_fit(fit: PlaneFit, points: np.ndarray, camera_axis_in_dome: np.ndarray) -> Posture:
    """The posture of a fit to points that all count (paper, Eq. 23-26), without validation."""
    nearest = float(np.linalg.norm(points, axis=1).min())
    return posture_of(fit, nearest, len(points), camera_axis_in_dome)


class Diver:
    """A rig that sees, and what is believed of it, which reads the pictures."""

    def __init__(self, seen_by: Rig, read_by: Rig) -> None:
        self._read_by = read_by
        self._camera, self._sheets = seen_by.camera(), sheets_of(seen_by)
        laser_bands = plan_bands(seen_by, self._camera)
        self.along_x = np.array([one.axis is SearchAxis.ALONG_X for one in laser_bands], np.int64)
        self._triangulator = Triangulator(read_by, read_by.camera())
        self._axis = read_by.dome_from_cam.rotate([0.0, 0.0, 1.0])

    def scan(self, target: Target, index: int = 0, noise_px: float = 0.1) -> Scan:
        """Scan of a target; nothing but the target's stripes is seen."""
        px, laser = self._peaks(target, np.random.default_rng([3, index]), noise_px)
        found = self._triangulator.triangulate(px, self.along_x[laser], laser)
        good = found.valid
        px, laser, points = px[good], laser[good], found.points_in_dome[good]
        n = len(px)
        read = ScanPoints(
            laser=laser.astype(np.int8),
            pixels=px,
            points_in_dome=points,
            sigma=np.full(n, 1e-3),
            intensity=np.full(n, 80.0),
            width=np.full(n, 5.0),
            quality=np.ones(n),
            label=np.zeros(n, np.uint8),
            used=np.ones(n, np.bool_),
        )
        fit = fit_robust(
            points,
            found.sensitivity[good],
            np.full(n, 0.1),
            laser,
            np.zeros(n),
            np.linalg.lstsq(points, np.ones(n))[0],
            shared_error(np.zeros(n)),
        )
        posture: Posture | Refusal = Refusal(Reason.COLLINEAR)
        if fit is not None:
            posture = posture_from_fit(fit, points, self._axis)
        return Scan(index, 0.04 * index, posture, read, self._read_by.n_water)

    def _peaks(
        self, target: Target, rng: np.random.Generator, noise_px: float
    ) -> tuple[FloatArray, IntArray]:
        pixels, lasers = [], []
        for i, sheet in enumerate(self._sheets):
            seen, valid = self._camera.project(target.stripe(sheet))
            seen = seen[valid & self._camera.inside_image(seen)]
            seen[:, 1 - self.along_x[i]] += rng.normal(0.0, noise_px, len(seen))
            pixels.append(seen)
            lasers.append(np.full(len(seen), i))
        return np.concatenate(pixels), np.concatenate(lasers)
