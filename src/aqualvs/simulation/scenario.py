"""A scenario: what is before the vehicle and how the vehicle moves, over the time of a dive."""

from collections.abc import Iterator
from dataclasses import dataclass, field

from aqualvs.geometry.transforms import SE3
from aqualvs.simulation.scene import (
    Box,
    Bubble,
    Fish,
    Net,
    Scene,
    Sensor,
    Target,
    Wall,
    WaterOptics,
)
from aqualvs.simulation.trajectory import Trajectory


@dataclass(frozen=True, slots=True, kw_only=True)
class Scenario:
    """A dive before it is rendered.

    Attributes
    ----------
    name : str
        How reports call it.
    duration : float
        In seconds.
    fps : float
        Frames a second.
    seed : int
        Chooses noise and everything else that is random.
    trajectory : Trajectory
        Posture of the vehicle over time.
    target : {"net", "wall", "none"}
        What the target plane is; "none" where nothing stands in it.
    walls, nets, fish, bubbles, boxes, water, sensor, lasers_on
        As in `Scene`; they move with the target.
    """

    name: str
    duration: float
    fps: float = 25.0
    seed: int = 0
    trajectory: Trajectory = field(default_factory=Trajectory)
    target: Target = "none"
    walls: tuple[Wall, ...] = ()
    nets: tuple[Net, ...] = ()
    fish: tuple[Fish, ...] = ()
    bubbles: tuple[Bubble, ...] = ()
    boxes: tuple[Box, ...] = ()
    water: WaterOptics = field(default_factory=WaterOptics)
    sensor: Sensor = field(default_factory=Sensor)
    lasers_on: bool = True

    @property
    def n_frames(self) -> int:
        """Number of frames; at least one."""
        return max(round(self.duration * self.fps), 1)

    def times(self) -> Iterator[float]:
        """Yield the time of every frame in seconds."""
        return (i / self.fps for i in range(self.n_frames))

    def scene_at(self, t: float) -> Scene:
        """Return the scene as the vehicle sees it at time `t`; render it at the same `t`."""
        return self._scene(self.trajectory.pose_at(t, self.duration))

    def _scene(self, pose: SE3) -> Scene:
        return Scene(
            dome_from_scene=pose,
            walls=self.walls,
            nets=self.nets,
            fish=self.fish,
            bubbles=self.bubbles,
            boxes=self.boxes,
            target=self.target,
            water=self.water,
            sensor=self.sensor,
            lasers_on=self.lasers_on,
        )
