"""`posture.csv`: one row for every frame, on disk as soon as the frame is done."""

import math
from pathlib import Path

import numpy as np

from aqualvs.app.append_file import AppendFile
from aqualvs.closing import Closing
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.posture import Posture
from aqualvs.scanning.scan import Scan

POSTURE_COLUMNS = (
    "frame",
    "time_s",
    "valid",
    "reason",
    "range_m",
    "pitch_deg",
    "yaw_deg",
    "sigma_range_m",
    "sigma_pitch_deg",
    "sigma_yaw_deg",
    "slant_range_m",
    "nearest_m",
    "n_points",
    "n_water",
    "curvature_x_per_m",
    "curvature_z_per_m",
    "sigma_curvature_x_per_m",
    "sigma_curvature_z_per_m",
    "sigma_range_rig_m",
    "sigma_pitch_rig_deg",
    "sigma_yaw_rig_deg",
    "sigma_range_total_m",
    "sigma_pitch_total_deg",
    "sigma_yaw_total_deg",
)
"""Curvatures, horizontal and vertical, are empty unless the target is a curved net. `sigma_range_m`
and its like are what the frame's noise makes, `sigma_..._rig_...` what the uncertainty of the rig
does, which is common to all frames, and `sigma_..._total_...` the root of the sum of the squares of
both."""
_N_NUMBERS = len(POSTURE_COLUMNS) - POSTURE_COLUMNS.index("range_m")


class PostureCsv(Closing):
    """Writer of `posture.csv`, row by row as `AppendFile` does it.

    Parameters
    ----------
    path : Path
        Written anew.

    Raises
    ------
    OSError
        From the constructor and from `write`, as the system says it.
    """

    def __init__(self, path: Path) -> None:
        self._file = AppendFile(path)
        try:
            self._append(",".join(POSTURE_COLUMNS) + "\n")
        except OSError:
            self.close()
            raise

    def write(self, *scans: Scan) -> None:
        """Append the rows of frames, all or none."""
        self._append("".join(map(posture_row, scans)))

    def close(self) -> None:
        """Close the file; further calls do nothing."""
        self._file.close()

    def _append(self, row: str) -> None:
        self._file.append(row.encode("ascii"))


def posture_row(scan: Scan) -> str:
    """Return a frame's row with its line end; without a posture the numbers stay empty."""
    head = f"{scan.index},{scan.time_s:.6f}"
    posture = scan.posture
    if not isinstance(posture, Posture):
        return f"{head},0,{posture.reason.value},{',' * (_N_NUMBERS - 1)}\n"
    return (
        f"{head},1,,{_numbers(posture)},{scan.n_water:.6f},{_curvature(posture)},{_rig(posture)}\n"
    )


def _curvature(posture: Posture) -> str:
    if posture.curvature is None or posture.sigma_curvature is None:
        return ",,,"
    return ",".join(f"{value:.4g}" for value in (*posture.curvature, *posture.sigma_curvature))


def _rig(posture: Posture) -> str:
    return f"{_sigmas(posture.rig_covariance)},{_sigmas(posture.total_covariance)}"


def _sigmas(covariance: FloatArray) -> str:
    """Return standard deviations of range (m), pitch and yaw (deg)."""
    sigma_range, sigma_pitch, sigma_yaw = np.sqrt(covariance.diagonal()).tolist()
    return f"{sigma_range:.4g},{math.degrees(sigma_pitch):.4g},{math.degrees(sigma_yaw):.4g}"


def _numbers(posture: Posture) -> str:
    return (
        f"{posture.range:.6f},{math.degrees(posture.pitch):.5f},{math.degrees(posture.yaw):.5f},"
        f"{_sigmas(posture.covariance)},"
        f"{posture.slant_range:.6f},{posture.nearest:.6f},{posture.n_points}"
    )
