"""Models of the scanner for simulated loops: sampled postures, or the scanner on rendered pictures.

`SampledSensor` returns the true posture with noise and losses. `RenderedSensor` renders every frame
and runs the scanner on it.
"""

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.transforms import SE3, rotation_from_rotvec, rotvec_from_rotation
from aqualvs.live.health_monitor import FrozenPicture
from aqualvs.optics.rig import Rig
from aqualvs.optics.shutter import FIRST_ROW, Field
from aqualvs.scanner import Scanner
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.row_motion import REACH, RowMotion
from aqualvs.scanning.scan import Frame, Planes, Scan, planes_of_image
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.net_motion import NetPosture, NetWall
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scene import Net, Scene


class RenderedSensor:
    """Sensor that renders the camera's picture from a vehicle, and runs the scanner on it.

    Each row of a picture is rendered from the vehicle's pose during its exposure, interpolated
    between this frame and the previous one; the frame's time is the end of the readout. Frames of
    an interlaced camera are its single fields.

    `rig`: takes and measures the pictures. `scene`: in the frame of the net at rest; if left out, a
    diamond net with a little growth, in clear water. `camera`: its compression is left out.
    `freeze_s`: time from which on the last picture is repeated, with time stamps that advance.
    """

    def __init__(
        self,
        net: NetWall,
        rig: Rig,
        rng: np.random.Generator,
        scene: Scene | None = None,
        camera: SimulatedCamera = IDEAL,
        freeze_s: float = math.inf,
    ) -> None:
        n_kept = 8  # More than the pictures between exposure and pilot.
        self._net, self._rng = net, rng
        nets = (Net(bar=0.025, twine=0.0022, fouling=0.1),)
        self._scene = scene or Scene(dome_from_scene=SE3.identity(), nets=nets, target="net")
        self._renderer = Renderer(rig, camera=camera)
        self._scanner = Scanner(rig)
        self._row_motion = RowMotion(rig)
        self._before: deque[Scan] = deque(maxlen=REACH)
        self._n_frames = 0
        self._freeze_s = freeze_s
        self._frozen: dict[Field | None, FrozenPicture] = {}
        self._planes: dict[Field | None, Planes] = {}
        self._poses: deque[tuple[float, SE3]] = deque(maxlen=2)
        # The last pictures and their scans.
        self.shots: deque[tuple[Frame, Scan]] = deque(maxlen=n_kept)

    def look(self, world_from_dome: SE3, time_s: float) -> Posture | Refusal:
        """Return the result for the frame whose readout ends now."""
        self._poses.append((time_s, world_from_dome))
        field = self._scanner.rig.shutter.field_of(self._n_frames)
        if field not in self._planes or time_s < self._freeze_s:
            self._planes[field] = self._render(time_s, field)
        frame = Frame(self._n_frames, time_s, *self._planes[field], field=field)
        self._n_frames += 1
        # As the live run does.
        still_s = self._frozen.setdefault(field, FrozenPicture()).update(time_s, frame.luma)
        if still_s > 0.0:
            return Refusal(Reason.FROZEN, f"the same picture for {still_s:.1f} s", still_s)
        _, seen = self._scanner.scan(frame)
        scan = self._row_motion.correct(seen, self._before)
        self._before.append(seen)
        self.shots.append((frame, scan))
        return scan.posture

    def _render(self, time_s: float, field: Field | None) -> Planes:
        """Render the picture, or one field of it, whose readout ends at a time."""
        shutter = self._scanner.rig.shutter
        middle_s = time_s - 0.5 * shutter.exposure
        if field is not None:
            image = self._renderer.exposed_at(self._scene_at, middle_s, self._rng)
            image = image[FIRST_ROW[field] :: 2][: len(image) // 2]
        else:
            middle_s -= 0.5 * shutter.readout
            image = self._renderer.take(self._scene_at, middle_s, self._rng).image
        # OpenCV's order of colours.
        return planes_of_image(np.ascontiguousarray(image[:, :, ::-1]))

    def _scene_at(self, time_s: float) -> Scene:
        return self._net.scene_at(self._pose_at(time_s), time_s, self._scene)

    def _pose_at(self, time_s: float) -> SE3:
        """Return the vehicle's pose at a time, interpolated between the last two frames."""
        (early_s, early), (late_s, late) = self._poses[0], self._poses[-1]
        if time_s >= late_s or late_s == early_s:
            return late
        share = (time_s - early_s) / (late_s - early_s)
        turn = rotation_from_rotvec(share * rotvec_from_rotation(early.rotation.T @ late.rotation))
        shift = late.translation - early.translation
        return SE3(early.rotation @ turn, early.translation + share * shift)


# Typical number of inliers of a posture of the example rig.
_N_POINTS = 400
# Largest yaw or pitch of the net at which a posture is measured.
_MAX_ANGLE = math.radians(60.0)


class LossOfSight(StrEnum):
    """Kind of loss of sight."""

    TARGET = "target"
    """Frames arrive, but without a posture."""
    STREAM = "stream"
    """No frames arrive."""
    FROZEN = "frozen"
    """The last picture is repeated: its posture is the same to the last bit."""
    STUCK = "stuck"
    """Frames have new noise, but show the scene at the start of the period."""


@dataclass(frozen=True, slots=True)
class Blind:
    """Period without a valid posture."""

    # Times of exposure, in seconds.
    start_s: float
    end_s: float

    loss: LossOfSight = LossOfSight.TARGET


@dataclass(frozen=True, slots=True, kw_only=True)
class PostureNoise:
    """Standard deviations of the noise, independent from frame to frame."""

    range_share: float = 0.003  # Of the range.
    # In radians.
    pitch: float = math.radians(0.4)
    yaw: float = math.radians(0.4)
    outliers: float = 0.0  # Share of frames with ten times that noise, unknown to the scanner.


class SampledSensor:
    """Sensor that returns the true posture with noise.

    `blind`: periods without sight. `working_range`: range in metres outside which there is no
    posture.
    """

    def __init__(
        self,
        net: NetWall,
        rng: np.random.Generator,
        noise: PostureNoise | None = None,
        blind: Sequence[Blind] = (),
        working_range: tuple[float, float] = (0.3, 1.0),
    ) -> None:
        self._net, self._rng = net, rng
        self._noise = noise or PostureNoise()
        self._blind = tuple(blind)
        self._working_range = working_range
        self._stuck: tuple[Blind, NetPosture] | None = None
        self._last: Posture | Refusal | None = None

    def look(self, world_from_dome: SE3, time_s: float) -> Posture | Refusal | None:
        """Return the result for the frame exposed now; None for a lost frame."""
        self._last = self._look(self._net.posture_at(world_from_dome, time_s), time_s)
        return self._last

    def _look(self, truth: NetPosture, time_s: float) -> Posture | Refusal | None:
        """Return the result for a frame, by the period of blindness, the range and the noise."""
        # Always drawn: the noise of a frame does not depend on earlier frames.
        draws = self._rng.normal(size=3)
        wild = self._rng.uniform() < self._noise.outliers
        blind = next((one for one in self._blind if one.start_s <= time_s < one.end_s), None)
        if blind is not None:
            if blind.loss is LossOfSight.STREAM:
                return None
            if blind.loss is LossOfSight.TARGET:
                return Refusal(Reason.TOO_FEW_POINTS)
            if blind.loss is LossOfSight.FROZEN and self._last is not None:
                return self._last
            if self._stuck is None or self._stuck[0] is not blind:
                self._stuck = blind, truth
            truth = self._stuck[1]
        near, far = self._working_range
        if not near <= truth.range <= far:
            return Refusal(Reason.OUT_OF_RANGE, f"{truth.range:.2f} m")
        if max(abs(truth.yaw), abs(truth.pitch)) > _MAX_ANGLE:
            return Refusal(Reason.COLLINEAR, "the lasers leave the net")
        return self._sample(truth, (10.0 if wild else 1.0) * draws)

    def _sample(self, truth: NetPosture, draws: FloatArray) -> Posture:
        """Return the posture with standard normal `draws` (3,) times the noise."""
        noise = self._noise
        sigma = np.array([noise.range_share * truth.range, noise.pitch, noise.yaw])
        distance, pitch, yaw = (np.array(truth[:3]) + sigma * draws).tolist()
        normal = np.array([math.tan(yaw), 1.0, math.tan(pitch)])
        normal /= np.linalg.norm(normal)
        return Posture(
            range=distance,
            pitch=pitch,
            yaw=yaw,
            covariance=np.diag(sigma**2),
            normal_in_dome=normal,
            slant_range=distance / float(normal[1]),
            nearest=distance,
            n_points=_N_POINTS,
            rms=0.001,
        )
