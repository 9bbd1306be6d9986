"""Samples for Rerun (https://rerun.io; extra `rerun`): to a file `.rrd` or to a viewer.

Entities: `target` is the frame of the target, with the foot of the perpendicular from the dome's
centre as origin, and x right, y away along the normal, z up: parallel to `dome` for a target square
ahead. The vehicle moves in this frame, and the target is at rest.

==========================================  ======================================================
`target/plane`, `target/plane/sigma`        the target, and one total sigma of its position, which
                                            at the edges includes that of its rotation
`target/vehicle`                            transform of `dome`
`target/vehicle/points`                     stripe points by label
`target/vehicle/camera`                     transform and pinhole; `picture` and its `points`
`posture/range_m`, `pitch_deg`, `yaw_deg`   value, value - sigma, value + sigma
`refusals`                                  reason for a missing posture, as text
==========================================  ======================================================

Timelines: `frame`, its number, and `dive`, the time since the start of the source. After a refusal,
entities without a value are cleared, so that viewers do not show old ones.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from aqualvs.closing import Closing
from aqualvs.errors import OptionError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import upright_axes
from aqualvs.optics.rig import Rig
from aqualvs.recording.encoding import jpeg_of
from aqualvs.recording.messages import RateLimit
from aqualvs.recording.sample import LiveSample
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Label
from aqualvs.text import LABEL_COLOURS, LABEL_WORDS, bgr, reason_text

RRD = ".rrd"
"""Suffix of Rerun's files."""

_TARGET, _VEHICLE, _CAMERA = "target", "target/vehicle", "target/vehicle/camera"
_PLANE, _PICTURE, _REFUSALS = "target/plane", "target/vehicle/camera/picture", "refusals"
_SERIES = ("posture/range_m", "posture/pitch_deg", "posture/yaw_deg")
_BLUE, _PALE, _AMBER = (51, 153, 255, 90), (51, 153, 255, 255), (240, 228, 66, 255)


class RerunLog(Closing):
    """Writer of samples to one destination: `save`, `connect` or `spawn`; a context manager.

    `picture_hz`, `points_hz`: largest rates of pictures, with the points in them, and of point
    clouds; 0 for none. Raises `OptionError` if rerun-sdk is not installed.
    """

    def __init__(self, *, picture_hz: float = 5.0, points_hz: float = 10.0) -> None:
        self._rr = rerun_sdk()
        self._stream: Any = self._rr.RecordingStream("aqualvs")
        self._picture_due, self._points_due = RateLimit(picture_hz), RateLimit(points_hz)
        self._rig: Rig | None = None
        self._silent = self._closed = False

    def save(self, path: Path) -> None:
        """Write to a file, which is replaced.

        Raises `OSError` if it cannot be written.
        """
        # Raises OSError; the SDK has errors of its own.
        path.open("wb").close()
        self._stream.save(path, default_blueprint=_blueprint())

    def connect(self, url: str) -> None:
        """Send to a viewer; may wait for seconds until it answers.

        Raises `RuntimeError` if the address is malformed.
        """
        self._stream.connect_grpc(url, default_blueprint=_blueprint())

    def spawn(self) -> None:
        """Open a viewer on this machine, which outlives this process, and send to it.

        Raises `RuntimeError` if there is no viewer.
        """
        self._stream.spawn(default_blueprint=_blueprint())

    def write(self, sample: LiveSample) -> None:
        """Log a sample."""
        if self._closed:
            return
        scan, posture = sample.scan, sample.scan.posture
        self._stream.set_time("frame", sequence=scan.index)
        self._stream.set_time("dive", duration=scan.time_s)
        if self._rig is not sample.rig:
            self._log_rig(sample.rig)
        if isinstance(posture, Posture):
            self._log_posture(posture)
        else:
            self._log_refusal(posture)
        stamp_ns = sample.instants.arrived_ns
        if self._points_due.at(stamp_ns):
            points = scan.points
            cloud = self._rr.Points3D(points.points_in_dome, class_ids=points.label, radii=-2.0)
            self._stream.log(f"{_VEHICLE}/points", cloud)
        jpeg_quality = 75
        if sample.frame is not None and self._picture_due.at(stamp_ns):
            jpeg = jpeg_of(sample.frame, jpeg_quality)
            picture = self._rr.EncodedImage(contents=jpeg, media_type="image/jpeg")
            self._stream.log(_PICTURE, picture)
            marks = self._rr.Points2D(scan.points.pixels, class_ids=scan.points.label, radii=-1.5)
            self._stream.log(f"{_PICTURE}/points", marks)

    def close(self) -> None:
        """Finish the file, or disconnect from the viewer; further calls do nothing."""
        if not self._closed:
            self._closed = True
            self._stream.disconnect()

    def _log_rig(self, rig: Rig) -> None:
        """Log camera pose and pinhole; on the first call also colours and axes."""
        rr, lens, first = self._rr, rig.lens, self._rig is None
        self._rig = rig
        camera = rig.dome_from_cam
        self._log_static(
            _CAMERA, rr.Transform3D(translation=camera.translation, mat3x3=camera.rotation)
        )
        # The lens in air, without its distortion and the dome.
        pinhole = rr.Pinhole(
            focal_length=(lens.fx, lens.fy),
            principal_point=(lens.cx + 0.5, lens.cy + 0.5),
            resolution=rig.size_px,
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.2,
        )
        self._log_static(_PICTURE, pinhole)
        if first:
            self._log_styles()

    def _log_styles(self) -> None:
        rr = self._rr
        labels = [
            rr.AnnotationInfo(int(one), LABEL_WORDS[one], bgr(LABEL_COLOURS[one])[::-1])
            for one in Label
        ]
        self._log_static(_TARGET, rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        self._log_static(_TARGET, rr.AnnotationContext(labels))
        for path in _SERIES:
            name = path.rpartition("/")[2]
            style = rr.SeriesLines(
                names=[name, "- sigma", "+ sigma"],
                colors=[_PALE, _BLUE, _BLUE],
                widths=[2.0, 1.0, 1.0],
            )
            self._log_static(path, style)

    def _log_static(self, path: str, entity: Any) -> None:
        self._stream.log(path, entity, static=True)

    def _log_posture(self, posture: Posture) -> None:
        """Log the posture: series, vehicle, target and its sigma."""
        rr, normal = self._rr, posture.normal_in_dome
        self._silent = False
        sigma = np.sqrt(posture.total_covariance.diagonal())
        scale = np.array([1.0, 180.0 / math.pi, 180.0 / math.pi])
        values = scale * (posture.range, posture.pitch, posture.yaw)
        for path, value, spread in zip(_SERIES, values, scale * sigma, strict=True):
            self._stream.log(path, rr.Scalars([value, value - spread, value + spread]))
        target_from_dome = upright_axes(normal).T
        foot = -posture.range * target_from_dome @ normal
        pose = rr.Transform3D(translation=foot, mat3x3=target_from_dome)
        self._stream.log(_VEHICLE, pose)
        # The square that represents the target is as wide as its range.
        side = posture.range
        plate = rr.Boxes3D(
            half_sizes=[(side / 2, 5e-4, side / 2)], colors=[_BLUE], fill_mode="solid"
        )
        self._stream.log(_PLANE, plate)
        edge = side / 2 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], np.float64)
        spread = plane_sigma(posture, edge)
        strips = [np.stack([edge[:, 0], s * spread, edge[:, 1]], axis=1) for s in (-1.0, 1.0)]
        self._stream.log(f"{_PLANE}/sigma", rr.LineStrips3D(strips, colors=[_AMBER, _AMBER]))

    def _log_refusal(self, refusal: Refusal) -> None:
        """Log the reason of a refusal and clear what has no value."""
        is_silence = refusal.reason is Reason.NO_FRAMES
        # A silent stream is reported ten times a second.
        if not (is_silence and self._silent):
            detail = refusal.detail or reason_text(refusal.reason)
            level = "WARN" if is_silence else "INFO"
            text = self._rr.TextLog(f"{refusal.reason.value}: {detail}", level=level)
            self._stream.log(_REFUSALS, text)
            self._stream.log(_PLANE, self._rr.Clear(recursive=True))
            for path in _SERIES:
                self._stream.log(path, self._rr.Clear(recursive=False))
        self._silent = is_silence


def plane_sigma(posture: Posture, places: FloatArray) -> FloatArray:
    """Return the standard deviation (N,) of points of the target along its normal, in metres.

    `places`, shape (N, 2): points on the target, in metres to the right and up from the foot of the
    perpendicular. The covariance is the posture's total one.
    """
    normal, axes = posture.normal_in_dome, upright_axes(posture.normal_in_dome)
    steep = np.array([math.tan(posture.yaw), 1.0, math.tan(posture.pitch)])
    slopes = np.zeros((3, 2))
    # The normal is that of (tan yaw, 1, tan pitch).
    slopes[2, 0], slopes[0, 1] = 1.0 + steep[2] ** 2, 1.0 + steep[0] ** 2
    across = (np.eye(3) - np.outer(normal, normal)) @ slopes / np.linalg.norm(steep)
    on_plane = places @ axes[:, [0, 2]].T
    by_posture = np.column_stack([np.ones(len(places)), -on_plane @ across])
    variance = np.einsum("ni,ij,nj->n", by_posture, posture.total_covariance, by_posture)
    sigma: FloatArray = np.sqrt(variance)
    return sigma


def rerun_sdk() -> Any:
    """Return the module `rerun`.

    Raises `OptionError` if it is not installed.
    """
    try:
        import rerun
        import rerun.blueprint
    except ImportError:
        raise OptionError(
            "--rerun: needs rerun-sdk; install it by pip install 'aqualvs[rerun]'"
        ) from None
    return rerun


def _blueprint() -> Any:
    """Return the initial layout of a viewer."""
    rrb = rerun_sdk().blueprint
    picture = rrb.Spatial2DView(origin=_PICTURE, name="picture")
    series = [rrb.TimeSeriesView(origin=path, name=path.rpartition("/")[2]) for path in _SERIES]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(picture, rrb.Spatial3DView(origin=_TARGET, name="target")),
            rrb.Vertical(*series, rrb.TextLogView(origin=_REFUSALS, name="refusals")),
        ),
        collapse_panels=True,
    )
