"""Simulated pictures for a whole calibration, in the folders of a user, with the truth."""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from aqualvs.errors import OptionError
from aqualvs.geometry.transforms import SE3
from aqualvs.optics.camera import Camera
from aqualvs.optics.rig import DOME_FROM_CAM_NOMINAL, Rig, common_wavelength
from aqualvs.optics.rigfile import save_rig, shutter_mapping
from aqualvs.optics.shutter import AT_ONCE
from aqualvs.optics.solved import with_exact_numbers
from aqualvs.optics.water import Dispersion
from aqualvs.simulation import calibration_targets as targets
from aqualvs.simulation.cameras import IDEAL, SimulatedCamera
from aqualvs.simulation.dive import check_dive, simulate_dive, writable
from aqualvs.simulation.panels import PanelRenderer, PanelScene, RoomLight, panel_sheets
from aqualvs.simulation.scenario import parse_scenario
from aqualvs.simulation.textures import CharucoPrint
from aqualvs.simulation.video import jpeg
from aqualvs.yamlfile import write_text, yaml_text

_ROOM = RoomLight(level=0.72)
_DIM = RoomLight(level=0.32)
_POOL = RoomLight(level=0.6, tint=(0.75, 1.0, 0.95), veil=(0.012, 0.035, 0.028))
_WATER = RoomLight(level=0.30, tint=(0.75, 1.0, 0.95), veil=(0.012, 0.035, 0.028))
# The nearest board stands this far before the dome.
_NEAREST = 0.15
_PLATE_FAR = 0.35
_DIVE_FPS = 25.0

_MATRIX = tuple(f"T{row}{column}" for row in range(3) for column in range(4))


@dataclass(frozen=True, slots=True, kw_only=True)
class SetSize:
    """Numbers of pictures of each kind, at least one of each.

    Attributes
    ----------
    camera, dome, box, index : int
        Of a board in air, of a board in water, of the box with stripes, of the index target.
    dive : int
        Frames of a dive before a wall; 0 leaves it out.
    """

    camera: int = 12
    dome: int = 10
    box: int = 4
    index: int = 5
    dive: int = 12

    @property
    def total(self) -> int:
        """Number of all pictures and frames."""
        return self.camera + self.dome + self.box + self.index + self.dive


@dataclass(frozen=True, slots=True)
class CalibrationFiles:
    """Files and folders written by `simulate_calibration`.

    Attributes
    ----------
    nominal : Path
        Nominal rig: name, size of the pictures, shutter, dome, number of lasers.
    camera, dome, box, index : Path
        Folders of pictures.
    board, rail_board, box_file, target : Path
        Files of their targets: two `board.yaml`, `box.yaml`, `target.yaml`.
    poses : Path or None
        `poses.csv` of the boards in water; None for a flat port.
    dive, dive_truth : Path or None
        Video of a wall and its truth.
    rig : Path
        The true rig.
    n_pictures : int
        Pictures and frames.
    """

    nominal: Path
    camera: Path
    dome: Path
    box: Path
    index: Path
    board: Path
    rail_board: Path
    poses: Path | None
    box_file: Path
    target: Path
    dive: Path | None
    dive_truth: Path | None
    rig: Path
    n_pictures: int


@dataclass(slots=True)
class _Job:
    rig: Rig
    out: Path
    size: SetSize
    seed: int
    tick: Callable[[int, int], None] | None
    camera: SimulatedCamera
    done: int = 0

    def rng(self, part: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, part])

    def did_one(self) -> None:
        self.done += 1
        if self.tick is not None:
            self.tick(self.done, self.size.total)

    def folder(self, *names: str) -> Path:
        folder = self.out.joinpath(*names)
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def shoot(
        self,
        renderer: PanelRenderer,
        scenes: Sequence[PanelScene],
        folder: Path,
        rng: np.random.Generator,
        name: str = "view_{:02d}",
    ) -> list[str]:
        """Render scenes into a folder and return the names of the pictures."""
        quality = self.camera.still_quality
        suffix = ".png" if quality is None else ".jpg"
        names = [name.format(i) + suffix for i in range(len(scenes))]
        # A person needs this long from one picture to the next; drifts go on meanwhile.
        between_stills_s = 4.0
        for scene, file in zip(scenes, names, strict=True):
            image = renderer.render(scene, rng, between_stills_s * self.done)
            if quality is None:
                data = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
            else:
                data = jpeg(image, quality)
            (folder / file).write_bytes(data)
            # Pictures of an earlier set by another camera.
            (folder / file).with_suffix(".png" if quality else ".jpg").unlink(missing_ok=True)
            self.did_one()
        return names

    def shoot_board(
        self,
        camera: Camera,
        around: PanelScene,
        board: CharucoPrint,
        poses: Sequence[SE3],
        folder: Path,
        rng: np.random.Generator,
    ) -> tuple[list[str], Path]:
        """Render a board at some poses in a scene; return the pictures' names and its file."""
        scenes = [
            replace(around, panels=[targets.board_panel(board, pose), *around.panels])
            for pose in poses
        ]
        names = self.shoot(PanelRenderer(camera, eye=self.camera), scenes, folder, rng)
        _write_poses(self.folder("truth") / f"{folder.name}_poses.csv", names, poses)
        write_text(folder / "board.yaml", yaml_text(targets.board_mapping(board)))
        return names, folder / "board.yaml"

    def with_lasers(self, rig: Rig) -> PanelRenderer:
        """Return the renderer of panels for a rig with all lasers on."""
        sheets = panel_sheets(rig, filters=self.camera.filters)
        return PanelRenderer(rig.camera(), sheets, eye=self.camera)


def simulate_calibration(
    rig: Rig,
    out: Path | str,
    *,
    size: SetSize | None = None,
    progress: Callable[[int, int], None] | None = None,
    seed: int = 0,
    camera: SimulatedCamera = IDEAL,
) -> CalibrationFiles:
    """Render pictures for all steps of a calibration, and the files that go with them.

    `camera_air/` shows a board without the dome, `dome_air/` a larger one through the dome in air
    (`poses.csv` knows distances only, and half of the boards are not quite square), or
    `port_water/` one in water before a flat port, at unknown poses; `box/` is an open
    box of markers in air with all lasers on, the vehicle's pose unknown, and `index/clip_0/` a
    plate that is fixed on the vehicle, in the rig's water, seen in green light. `dive/` is a wall
    to measure afterwards. `truth/` holds what a user would not have: the rig, and the poses of
    boards (dome_from_board) and vehicle (box_from_dome).

    Parameters
    ----------
    rig : Rig
        The truth; with a housing and at least one laser.
    out : Path or str
        Made if it is missing; files of an earlier set in it are overwritten.
    size : SetSize, optional
        Numbers of pictures.
    progress : callable, optional
        Called after every picture with the number of pictures done and of all.
    seed : int
        The same rig, size, camera and seed give the same pictures.
    camera : SimulatedCamera
        Sensor and processing; one that keeps JPEGs writes `.jpg`, the others `.png`.

    Raises
    ------
    OptionError
        If the rig has no housing or no lasers, a camera behind a flat port that is not in the
        frame's origin and straight ahead, there are too few pictures, or the dive's video cannot
        hold the rig's.
    OutputError
        If the folder or a file cannot be written.
    """
    size, out = SetSize() if size is None else size, Path(out)
    check_set(rig, size, camera)
    job = _Job(rig, out, size, seed, progress, camera)
    with writable(out):
        return _simulate(job)


def check_set(
    rig: Rig, size: SetSize, camera: SimulatedCamera, rig_file: Path | None = None
) -> None:
    """Raise `OptionError` as `simulate_calibration` does, before anything is rendered.

    `rig_file`: that of the rig, which messages on its pictures name.
    """
    if rig.housing is None or not rig.lasers:
        missing = "housing" if rig.housing is None else "lasers"
        raise OptionError(
            f"rig {rig.name} has no {missing}; pictures for a whole calibration need a rig with "
            "housing and lasers"
        )
    pose = rig.dome_from_cam
    if rig.flat_port is not None and not (
        np.allclose(pose.rotation, DOME_FROM_CAM_NOMINAL, rtol=0.0, atol=1e-9)
        and not pose.translation.any()
    ):
        raise OptionError(
            f"rig {rig.name}: behind a flat port no picture determines where the camera is on the "
            "vehicle; leave camera.position_mm and camera.rotation_deg at zero"
        )
    if min(size.camera, size.dome, size.box, size.index) < 1 or size.dive < 0:
        raise OptionError(f"{size}: every kind needs one picture at least")
    if size.dive:
        check_dive(rig, _DIVE_FPS, camera.recording, rig_file)


def _simulate(job: _Job) -> CalibrationFiles:
    # First, so that a set that is interrupted has them.
    nominal, rig = job.out / "nominal.yaml", job.folder("truth") / "rig.yaml"
    write_text(nominal, yaml_text(_nominal_mapping(job.rig)))
    save_rig(with_exact_numbers(job.rig), rig)
    camera, board = _camera_air(job)
    dome, rail_board, poses = (_dome_air if job.rig.flat_port is None else _port_water)(job)
    box, box_file = _box(job)
    index, target = _index(job)
    dive, dive_truth = _dive(job)
    return CalibrationFiles(
        nominal=nominal,
        camera=camera,
        dome=dome,
        box=box,
        index=index,
        board=board,
        rail_board=rail_board,
        poses=poses,
        box_file=box_file,
        target=target,
        dive=dive,
        dive_truth=dive_truth,
        rig=rig,
        n_pictures=job.done,
    )


def _camera_air(job: _Job) -> tuple[Path, Path]:
    rig, rng, folder = job.rig, job.rng(0), job.folder("camera_air")
    board = targets.hand_board(rig.size_px[0])
    poses = targets.board_across(rig, targets.squares_size(board), job.size.camera, rng)
    behind = targets.ground(rig.dome_from_cam @ SE3(np.eye(3), np.array([0.0, 0.0, 2.2])))
    around = PanelScene(panels=[behind], light=_ROOM)
    _, file = job.shoot_board(rig.bare_camera(), around, board, poses, folder, rng)
    return folder, file


def _in_green(rig: Rig) -> Rig:
    """Return the rig for green light, in which a camera sees boards, whatever its lasers."""
    light = Dispersion.of(common_wavelength(rig.lasers), rig.n_air)
    return rig.in_water(light.to_green(rig.n_water))


def port_folder(rig: Rig) -> str:
    """Return the name of the folder of boards before the housing."""
    return "dome_air" if rig.flat_port is None else "port_water"


def _port_water(job: _Job) -> tuple[Path, Path, None]:
    rig, rng, folder = _in_green(job.rig), job.rng(1), job.folder(port_folder(job.rig))
    board, lens = targets.hand_board(rig.size_px[0]), rig.lens
    # Water magnifies what a flat port shows.
    longer = replace(lens, fx=rig.n_water * lens.fx, fy=rig.n_water * lens.fy)
    boards = replace(rig, lens=longer, housing=None)
    poses = targets.board_across(boards, targets.squares_size(board), job.size.dome, rng)
    behind = targets.ground(
        rig.dome_from_cam @ SE3(np.eye(3), np.array([0.0, 0.0, 2.2])), shift=150
    )
    around = PanelScene(panels=[behind], light=_POOL)
    _, file = job.shoot_board(rig.camera(), around, board, poses, folder, rng)
    return folder, file, None


def _dome_air(job: _Job) -> tuple[Path, Path, Path]:
    rig, rng, folder = job.rig.in_water(job.rig.n_air), job.rng(1), job.folder(port_folder(job.rig))
    board = targets.rail_board()
    near = _NEAREST if rig.dome is None else rig.dome.inner_radius + rig.dome.thickness + _NEAREST
    # A square of the rail's board in the farthest picture, in pixels, and its farthest place.
    far_square_px, farthest = 19.0, 1.2
    far = max(1.5 * near, min(farthest, board.square * rig.focal_px / far_square_px))
    distances = np.linspace(near, far, job.size.dome)
    poses, measured = targets.board_on_rail(targets.squares_size(board), distances, rng)
    behind = targets.ground(SE3(DOME_FROM_CAM_NOMINAL, np.array([0.0, 2.2, 0.0])), shift=150)
    around = PanelScene(panels=[behind], light=_ROOM)
    names, file = job.shoot_board(rig.camera(), around, board, poses, folder, rng)
    rows = [(name, targets.to_mm(far)) for name, far in zip(names, measured, strict=True)]
    _write_table(folder / "poses.csv", ("file", "distance_mm"), rows)
    return folder, file, folder / "poses.csv"


def _box(job: _Job) -> tuple[Path, Path]:
    rig, rng, folder = job.rig.in_water(job.rig.n_air), job.rng(2), job.folder("box")
    walls = targets.marker_box(rig.size_px[0])
    behind = targets.ground(SE3(DOME_FROM_CAM_NOMINAL, np.array([0.0, 1.9, 0.0])), shift=300)
    poses = targets.vehicle_in_box(job.size.box, rng)
    scenes = []
    for pose in poses:
        inside = [targets.moved(wall, pose.inverse()).panel for wall in walls]
        scenes.append(PanelScene(panels=[*inside, behind], light=_DIM))
    names = job.shoot(job.with_lasers(rig), scenes, folder, rng)
    _write_poses(job.folder("truth") / "box_poses.csv", names, poses)
    write_text(folder / "box.yaml", yaml_text(targets.box_mapping(walls, rig.n_water)))
    return folder, folder / "box.yaml"


def _index(job: _Job) -> tuple[Path, Path]:
    rig, rng, folder = _in_green(job.rig), job.rng(3), job.folder("index", "clip_0")
    plate = targets.plate_before(rig, _PLATE_FAR)
    scenes = [targets.plate_scene(plate, i, _WATER) for i in range(job.size.index)]
    job.shoot(job.with_lasers(rig), scenes, folder, rng, "frame_{:03d}")
    target = folder.parent / "target.yaml"
    write_text(target, yaml_text(targets.target_mapping(plate)))
    return folder, target


def _dive(job: _Job) -> tuple[Path | None, Path | None]:
    if not job.size.dive:
        return None, None
    content = {
        "duration_s": job.size.dive / _DIVE_FPS,
        "fps": _DIVE_FPS,
        "seed": job.seed,
        "motion": {"range_mm": [420, 700], "pitch_deg": [-4, 3], "yaw_deg": [6, -5]},
        "walls": [{}],
    }
    files = simulate_dive(
        parse_scenario(content, "calibration", "calibration"),
        job.rig,
        job.folder("dive"),
        progress=lambda _done, _all: job.did_one(),
        camera=job.camera,
    )
    return files.video, files.truth


def _nominal_mapping(rig: Rig) -> dict[str, Any]:
    content: dict[str, Any] = {
        "name": rig.name,
        "image": {"width": int(rig.size_px[0]), "height": int(rig.size_px[1])},
    }
    if rig.shutter != AT_ONCE:
        content["camera"] = {"shutter": shutter_mapping(rig.shutter)}
    if rig.dome is not None:
        content["dome"] = {
            "inner_radius_mm": targets.to_mm(rig.dome.inner_radius),
            "thickness_mm": targets.to_mm(rig.dome.thickness),
            "n_acrylic": float(rig.dome.n_acrylic),
        }
    if rig.flat_port is not None:
        content["flat"] = {
            "distance_mm": targets.to_mm(rig.flat_port.distance),
            "thickness_mm": targets.to_mm(rig.flat_port.thickness),
            "n_port": float(rig.flat_port.n_port),
        }
    lasers: dict[str, Any] = {"count": len(rig.lasers)}
    if (light_nm := common_wavelength(rig.lasers)) is not None:
        lasers["wavelength_nm"] = float(light_nm)
    content |= {"n_air": float(rig.n_air), "lasers": lasers}
    return {**content, "working_range_mm": [targets.to_mm(far) for far in rig.working_range]}


def _write_poses(path: Path, names: Sequence[str], poses: Sequence[SE3]) -> None:
    """Write whole poses in the form of a `poses.csv`, translations in millimetres."""
    rows = []
    for name, pose in zip(names, poses, strict=True):
        matrix = np.column_stack([pose.rotation, 1e3 * pose.translation])
        rows.append((name, *matrix.ravel().tolist()))
    _write_table(path, ("file", *_MATRIX), rows)


def _write_table(path: Path, columns: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(columns)
        table.writerows(rows)
