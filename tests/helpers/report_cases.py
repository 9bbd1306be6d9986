"""Run folders for the report, written by hand: no writer of the project is trusted."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import yaml
from pyarrow import parquet

from aqualvs.geometry.arrays import FloatArray
from aqualvs.report.overlay import OverlayWriter

COLUMNS = (
    "frame,time_s,valid,reason,range_m,pitch_deg,yaw_deg,sigma_range_m,sigma_pitch_deg,"
    "sigma_yaw_deg,slant_range_m,nearest_m,n_points,n_water"
)
FPS = 10.0
NASTY = "</script><script>document.documentElement.dataset.owned=1</script>"
NASTY_LASER = '"><img src=x onerror=document.documentElement.dataset.owned=1><b>bold</b>&amp;'
LASERS = [
    {"name": "lower", "normal": [0.0, -0.3, 0.954], "offset_mm": -143.0},
    {"name": NASTY_LASER, "normal": [0.96, -0.25, -0.12], "offset_mm": -138.0},
]


@dataclass(frozen=True)
class Dive:
    """A run folder and what is true of it."""

    folder: Path
    range_m: FloatArray
    pitch_deg: FloatArray
    yaw_deg: FloatArray
    refused: dict[int, str]


def make_dive(folder: Path, n: int = 40, *, video: bool = True, **run: Any) -> Dive:
    """Write a run folder; frames 12 to 19 and frame 30 are refused."""
    folder.mkdir(exist_ok=True)
    k = np.arange(n)
    dive = Dive(
        folder,
        0.6 + 0.1 * np.sin(k / 7.0),
        2.0 * np.cos(k / 5.0),
        -1.0 + 0.05 * k,
        dict.fromkeys(range(12, 20), "too_few_points") | {30: "odd_fault: <b>bold</b>"},
    )
    rows = [COLUMNS, *(posture_row(dive, i) for i in range(n))]
    (folder / "posture.csv").write_text("\n".join(rows) + "\n")
    parquet.write_table(points_table(dive, n), folder / "points.parquet", row_group_size=500)
    source: dict[str, Any] = {"path": str(folder / f"{NASTY[2:8]} dive.mp4"), "size_px": [320, 240]}
    if video:
        write_video(Path(source["path"]), n)
    content = {
        "status": "finished",
        "source": source,
        "rig": {
            "name": NASTY,
            "lasers": LASERS,
            "working_range_mm": [300, 1000],
            "dome": {"inner_radius_mm": 44.25, "thickness_mm": 5.75},
        },
        "options": {"target": NASTY, "filter": {"mode": "adaptive"}},
        "versions": {"aqualvs": "9.8.7"},
    } | run
    (folder / "run.yaml").write_text(yaml.safe_dump(content))
    return dive


def posture_row(dive: Dive, i: int) -> str:
    head = f"{i},{i / FPS:.6f}"
    if i in dive.refused:
        return f"{head},0,{dive.refused[i]},,,,,,,,,,"
    r, p, y = dive.range_m[i], dive.pitch_deg[i], dive.yaw_deg[i]
    return f"{head},1,,{r:.6f},{p:.5f},{y:.5f},0.0008,0.12,0.2,{r:.6f},{r:.6f},120,1.340000"


def points_table(dive: Dive, n: int) -> pa.Table:
    """Return points where the target plane meets each laser's plane, and some clutter."""
    rows = []
    for i in range(n):
        yaw, pitch = np.deg2rad([dive.yaw_deg[i], dive.pitch_deg[i]])
        tangents = np.array([np.tan(yaw), 1.0, np.tan(pitch)])
        target = tangents / np.linalg.norm(tangents)
        for index, laser in enumerate(LASERS):
            normal = np.array(laser["normal"], dtype=float)
            length = np.linalg.norm(normal)
            along = np.cross(target, normal / length)
            start = np.linalg.solve(
                np.stack([target, normal / length, along]),
                [dive.range_m[i], float(str(laser["offset_mm"])) / 1e3, 0.0],
            )
            for step in np.linspace(-0.2, 0.2, 30):
                rows.append((i, index, start + step * along, "net"))
            rows.append((i, index, start * 0.7, "clutter"))
    xyz = np.array([row[2] for row in rows])
    frame = np.array([row[0] for row in rows])
    pixels = 160.0 + 400.0 * xyz[:, [0, 2]] / xyz[:, 1:2]
    return pa.table(
        {
            "frame": pa.array(frame, pa.int32()),
            "time_s": frame / FPS,
            "laser": pa.array([row[1] for row in rows], pa.int8()),
            **{
                name: pa.array(pixels[:, j], pa.float32())
                for j, name in enumerate(("u_px", "v_px"))
            },
            **{name: xyz[:, j] for j, name in enumerate(("x_m", "y_m", "z_m"))},
            "sigma_m": np.full(len(rows), 1e-3),
            "quality": np.full(len(rows), 0.8),
            "label": pa.array([row[3] for row in rows]).dictionary_encode(),
            "used": [row[3] == "net" for row in rows],
        }
    )


def write_video(path: Path, n: int) -> None:
    """Write frames with a bar whose place tells their number, up to 40."""
    with OverlayWriter(path, (320, 240), FPS) as writer:
        for i in range(n):
            image = np.full((240, 320, 3), 60, np.uint8)
            image[:, 8 * i : 8 * i + 8] = 200
            writer.write(image)


def write_truth(dive: Dive, bias_mm: float) -> Path:
    rows = [
        f"{i},{1e3 * r + bias_mm},{p},{y}"
        for i, (r, p, y) in enumerate(zip(dive.range_m, dive.pitch_deg, dive.yaw_deg, strict=True))
    ]
    path = dive.folder / "truth.csv"
    path.write_text("\n".join(["frame,range_mm,pitch_deg,yaw_deg", *rows]) + "\n")
    return path
