"""A scanner that is run on rendered pictures: every frame goes through the real pipeline."""

import math
from collections import deque

import numpy as np

from aqualvs.geometry.transforms import SE3
from aqualvs.live.frozen import FrozenPicture
from aqualvs.optics.rig import Rig
from aqualvs.scanning.pipeline import Scanner, ScannerOptions
from aqualvs.scanning.posture import Posture, Reason, Refusal
from aqualvs.scanning.scan import Frame, Planes, Scan, planes_of_image
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.net_motion import NetWall
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scene import Net, Scene

# More than are under way from the exposure to the pilot.
_N_KEPT = 8


def net_scene(seed: int = 0) -> Scene:
    """Return a diamond net with a little growth, in clear water."""
    net = Net(bar=0.025, twine=0.0022, fouling=0.1, seed=seed)
    return Scene(dome_from_scene=SE3.identity(), nets=(net,), target="net")


class RenderedEye:
    """Renders what the camera sees from a vehicle, and measures in it.

    Parameters
    ----------
    net : NetWall
    rig : Rig
        That the pictures are taken with, and measured with.
    rng : Generator
        Source of the sensor's noise.
    scene : Scene, optional
        In the frame of the net at rest; `net_scene` if left out.
    options : ScannerOptions, optional
        Defaults if left out.
    samples : int
        Rays along each side of a pixel.
    camera : SimulatedCamera
        Takes the pictures; they are measured before it compresses them.
    freeze_s : float
        From then on the last picture comes again and again, with time stamps that run on.

    Attributes
    ----------
    shots : deque of (Frame, Scan)
        The last pictures, and what was measured in them.
    """

    def __init__(
        self,
        net: NetWall,
        rig: Rig,
        rng: np.random.Generator,
        scene: Scene | None = None,
        options: ScannerOptions | None = None,
        samples: int = 1,
        camera: SimulatedCamera = IDEAL,
        freeze_s: float = math.inf,
    ) -> None:
        self._net, self._rng = net, rng
        self._scene = net_scene() if scene is None else scene
        self._renderer = Renderer(rig, samples=samples, camera=camera)
        self._scanner = Scanner(rig, options)
        self._n_frames = 0
        self._freeze_s, self._frozen = freeze_s, FrozenPicture()
        self._planes: Planes | None = None
        self.shots: deque[tuple[Frame, Scan]] = deque(maxlen=_N_KEPT)

    def look(self, world_from_dome: SE3, time_s: float) -> Posture | Refusal:
        """Return what the frame exposed now gives."""
        if self._planes is None or time_s < self._freeze_s:
            self._planes = self._rendered(world_from_dome, time_s)
        frame = Frame(self._n_frames, time_s, *self._planes)
        self._n_frames += 1
        # As the live run does.
        still_s = self._frozen.update(time_s, frame.luma)
        if still_s > 0.0:
            return Refusal(Reason.FROZEN, f"the same picture for {still_s:.1f} s")
        scan = self._scanner.process(frame)
        self.shots.append((frame, scan))
        return scan.posture

    def _rendered(self, world_from_dome: SE3, time_s: float) -> Planes:
        scene = self._net.scene_at(world_from_dome, time_s, self._scene)
        image = self._renderer.render(scene, time_s, self._rng).image
        # OpenCV's order of colours.
        return planes_of_image(np.ascontiguousarray(image[:, :, ::-1]))
