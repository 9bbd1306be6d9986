"""Figures of a run after the paper's 13 and 14."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pytest
import yaml
from matplotlib.figure import Figure
from pyarrow import parquet

from aqualvs.errors import OptionError, OutputError, SourceError
from aqualvs.geometry.arrays import FloatArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rigfile import rig_to_mapping
from aqualvs.report import mesh_figures
from aqualvs.report.figure_style import save_figures
from aqualvs.report.mesh_figures import Reflections, draw_figures, figures
from aqualvs.scanning.paper.mesh_filter import MeshFilterOptions, laser_frame
from aqualvs.simulation.scenarios import example_rig
from whole import part_of

LASERS = {"lower": Plane.from_normal([0.0, -0.3, 0.954], -0.143)}
LASERS["left"] = Plane.from_normal([0.96, -0.25, -0.12], -0.138)
NAMES = ["figure_13.png", "figure_14.png", "laser_plane_image.png"]


def strands(n: int) -> FloatArray:
    """Points in `laser` on strands that the paper's filter keeps: 10 mm long, 27 mm apart."""
    x = (0.027 * np.arange(n)[:, None] + 0.001 * np.arange(10)).ravel() - 0.0135 * n
    return np.stack([x, np.full_like(x, 0.55)], axis=-1)


def box(n: int) -> FloatArray:
    return np.stack([np.linspace(-0.05, 0.05, n), np.full(n, 0.40)], axis=-1)


def write_run(folder: Path, scanner: dict[str, object] | None = None) -> Path:
    """Frame 3 shows net and box to the laser left; the others show less."""
    rows = []
    for frame, laser, net, others in (
        (1, 0, strands(12), box(0)),
        (2, 0, strands(5), box(20)),
        (3, 1, strands(12), box(90)),
        (3, 0, strands(1), box(200)),
    ):
        dome_from_laser = laser_frame([*LASERS.values()][laser]).inverse()
        for points, label in ((net, "net"), (others, "solid")):
            in_laser = np.column_stack([points, np.zeros(len(points))])
            rows += [(frame, laser, *xyz, label) for xyz in dome_from_laser.apply(in_laser)]
    frame, laser, x, y, z, label = zip(*rows, strict=True)
    table = pa.table(
        {
            "frame": pa.array(frame, pa.int32()),
            "laser": pa.array(laser, pa.int8()),
            "x_m": pa.array(x, pa.float32()),
            "y_m": pa.array(y, pa.float32()),
            "z_m": pa.array(z, pa.float32()),
            "label": pa.array(label).dictionary_encode(),
        }
    )
    parquet.write_table(table, folder / "points.parquet")
    lasers = [
        {"name": name, "normal": plane.normal.tolist(), "offset_mm": 1e3 * plane.offset}
        for name, plane in LASERS.items()
    ]
    run = {"rig": {"lasers": lasers, "working_range_mm": [300, 1000]}}
    run["options"] = {"scanner": scanner or {"mesh_filter": None}}
    (folder / "run.yaml").write_text(yaml.safe_dump(run))
    return folder


def share_of(path: Path, rgb: tuple[int, int, int]) -> float:
    image = cv2.imread(str(path))[:, :, ::-1].astype(int)
    return float(np.mean(np.abs(image - rgb).max(axis=2) < 12))


PINK, BLUE = (240, 111, 174), (11, 92, 125)


def test_the_frame_and_laser_that_show_most_are_drawn(tmp_path: Path) -> None:
    told: list[str] = []
    written = figures(write_run(tmp_path), tmp_path / "out", told.append)
    assert [path.name for path in written] == NAMES
    assert told[0].startswith("frame 3, laser left: 210 reflections, 210 of them")
    # Algorithm 1 keeps most of the strands with a neighbour on both sides, and no box.
    assert told[1].startswith("net by the adaptive filter: 120; by the paper's: ")
    kept = int(told[1].split("paper's: ")[1].split(",")[0])
    assert 50 <= kept <= 100
    assert f"{kept} of them the same" in told[1]
    for path in written:
        image = cv2.imread(str(path))
        assert min(image.shape[:2]) > 700
        assert 0.5 < np.mean(image > 200) < 0.999
    figure_14 = tmp_path / "out" / "figure_14.png"
    assert share_of(figure_14, PINK) > 1e-3
    assert share_of(figure_14, BLUE) > 1e-3


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Files without pictures, for tests of what is said of them."""

    def save(drawn: Mapping[str, Figure], folder: Path, dpi: float) -> list[Path]:
        paths = [folder / f"{name}.png" for name in drawn]
        for path in paths:
            path.write_bytes(b"")
        return paths

    monkeypatch.setattr(mesh_figures, "save_figures", save)


@pytest.mark.usefixtures("blank_pictures")
def test_pictures_of_others_stay(tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "figure_14.png").write_text("precious")
    with pytest.raises(OutputError, match=r"figure_14\.png: exists, and 'aqualvs figures' did not"):
        figures(write_run(tmp_path), out, lambda _: None, overwrite=True)
    assert (out / "figure_14.png").read_text() == "precious"
    (out / "figure_14.png").unlink()
    figures(write_run(tmp_path), out, lambda _: None)
    with pytest.raises(OutputError, match="add --overwrite"):
        figures(write_run(tmp_path), out, lambda _: None)
    figures(write_run(tmp_path), out, lambda _: None, overwrite=True)


@pytest.mark.usefixtures("blank_pictures")
def test_a_chosen_frame_and_laser_are_drawn(tmp_path: Path) -> None:
    told: list[str] = []
    figures(write_run(tmp_path), tmp_path / "out", told.append, frame=3, laser="lower")
    assert told[0].startswith("frame 3, laser lower: 210 reflections")


@pytest.mark.usefixtures("blank_pictures")
def test_parameters_come_from_a_target_file(tmp_path: Path) -> None:
    target = tmp_path / "net.yaml"
    target.write_text("mesh_filter: {r_min_mm: 40, r_max_mm: 60}\n")
    told: list[str] = []
    figures(write_run(tmp_path), tmp_path / "out", told.append, target=target)
    assert "by the paper's: 0, 0 of them" in told[1]


@pytest.mark.parametrize(
    ("choice", "words"),
    [
        ({"frame": 9}, "--frame 9: no point there"),
        ({"laser": "right"}, "--laser right: no such laser; the rig has lower, left"),
        ({"frame": 2, "laser": "left"}, "--frame 2 --laser left: no point there"),
    ],
)
def test_what_is_not_there_is_named(tmp_path: Path, choice: dict[str, object], words: str) -> None:
    with pytest.raises(OptionError, match=words):
        figures(write_run(tmp_path), tmp_path / "out", print, **choice)


def test_a_run_that_has_dropped_points_is_refused(tmp_path: Path) -> None:
    folder = write_run(tmp_path, {"mesh_filter": {"dd": 0.001}})
    with pytest.raises(OptionError, match="run once more without it"):
        figures(folder, tmp_path / "out", print)


def test_folders_without_points_or_rig_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"run\.yaml is missing"):
        figures(tmp_path, tmp_path / "out", print)
    folder = write_run(tmp_path)
    (folder / "points.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(SourceError, match=r"points\.parquet: cannot be read"):
        figures(folder, tmp_path / "out", print)
    (folder / "points.parquet").unlink()
    with pytest.raises(SourceError, match="is not there"):
        figures(folder, tmp_path / "out", print)
    (folder / "run.yaml").write_text("rig: {lasers: []}\n")
    with pytest.raises(SourceError, match="holds no lasers"):
        figures(folder, tmp_path / "out", print)


def reflections(in_laser: FloatArray, net: bool) -> Reflections:
    n = len(in_laser)
    return Reflections(
        frame=0,
        laser="lower",
        in_laser=in_laser,
        offset=-0.143,
        working_range=(0.3, 1.0),
        usable=np.ones(n, np.bool_),
        adaptive=np.full(n, net),
        paper=np.zeros(n, np.bool_),
    )


@pytest.mark.parametrize("points", part_of([np.empty((0, 2)), strands(1)[:1], box(50)]))
def test_little_to_see_is_drawn_too(tmp_path: Path, points: FloatArray) -> None:
    written = save_figures(
        draw_figures(reflections(points, False), MeshFilterOptions()), tmp_path, dpi=100
    )
    assert all(path.stat().st_size > 5000 for path in written)


def threshold_run(folder: Path) -> Path:
    """A run with the threshold detector: reflections 5 x 3 pixels every 25 mm, one frame."""
    rig = example_rig()
    plane = rig.lasers[0].plane
    x = 0.025 * np.arange(-6, 7)
    z = (plane.offset - plane.normal[0] * x - plane.normal[1] * 0.643) / plane.normal[2]
    in_dome = np.column_stack([x, np.full(len(x), 0.643), z])
    centres = np.rint(rig.camera().project(in_dome)[0])
    pixels = (centres[:, None] + np.column_stack([np.arange(-2, 3), np.zeros(5)])).reshape(-1, 2)
    n = len(pixels)
    columns = {"u_px": pixels[:, 0], "v_px": pixels[:, 1], "width_px": np.full(n, 3.0)}
    table = pa.table(
        {name: pa.array(column, pa.float32()) for name, column in columns.items()}
        | {"frame": pa.array([0] * n, pa.int32()), "laser": pa.array([0] * n, pa.int8())}
        | dict.fromkeys(("x_m", "y_m", "z_m"), pa.array([0.5] * n, pa.float32()))
        | {"label": pa.array(["net"] * n).dictionary_encode()}
    )
    parquet.write_table(table, folder / "points.parquet")
    scanner = {"mesh_filter": None, "detector": {"kind": "threshold"}}
    run = {"rig": rig_to_mapping(rig), "options": {"scanner": scanner}}
    (folder / "run.yaml").write_text(yaml.safe_dump(run))
    return folder


@pytest.mark.usefixtures("blank_pictures")
def test_a_run_with_the_threshold_shows_every_bright_pixel(tmp_path: Path) -> None:
    told: list[str] = []
    figures(threshold_run(tmp_path), tmp_path / "out", told.append)
    assert told[0].startswith(f"frame 0, laser lower: {13 * 15} bright pixels, {13 * 15} of them")
    # All but the outermost reflections, as in test_paper_filter.
    kept = int(told[1].split("paper's: ")[1].split(",")[0])
    assert 0.7 * 13 * 15 < kept < 12 * 15
