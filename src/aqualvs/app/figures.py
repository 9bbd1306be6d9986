"""`aqualvs figures`: the paper's pictures of its mesh filter, made from a run of one's own."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from aqualvs.app.disk import writing
from aqualvs.app.net_figures import FIGURES, Reflections, draw_figures
from aqualvs.app.outputs import POINTS_PARQUET, check_run_files
from aqualvs.app.overwriting import Claim
from aqualvs.app.report_rig import LaserFacts, lasers_of, working_range_m
from aqualvs.app.report_run import read_run_file
from aqualvs.app.target_file import target_facts
from aqualvs.errors import OptionError, SourceError
from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.geometry.planes import Plane
from aqualvs.optics.rigfile import rig_from_mapping
from aqualvs.scanning.mesh import MeshFilterOptions, laser_frame, mesh_filter
from aqualvs.scanning.paper_filter import PaperFilter
from aqualvs.scanning.scan import Label
from aqualvs.scanning.search import plan_searches

_BATCH = 1 << 16
# Frames have numbers of 32 bits, lasers of 8.
_LASERS = 1 << 8
# So many of the fullest frames and lasers are looked at; pieces of net are this far apart, in m.
_CANDIDATES = 16
_STRAND_GAP = 4e-3
_NET = Label.NET.name.lower()
_COLUMNS = ("x_m", "y_m", "z_m", "label")
_PIXEL_COLUMNS = ("u_px", "v_px", "width_px", "label")


class _Counts(NamedTuple):
    """Reflections of every frame and laser that has any, K of them.

    Attributes
    ----------
    frame, laser : int array, shape (K,)
    n_net, n_other : int array, shape (K,)
        Labelled net, and anything else.
    """

    frame: IntArray
    laser: IntArray
    n_net: IntArray
    n_other: IntArray


def figures(
    folder: Path,
    out: Path,
    tell: Callable[[str], object],
    *,
    frame: int | None = None,
    laser: str | None = None,
    target: Path | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Draw figures 13 and 14 of the paper, and its laser-plane image, from a run's folder.

    A run with the threshold detector is shown by all its bright pixels, others by the centres of
    their returns.

    Parameters
    ----------
    folder : Path
        Of a finished run.
    out : Path
        Folder for the pictures; made if it is not there.
    tell : callable
        Takes lines for the user.
    frame : int, optional
        The frame; by default the one that shows most of both net and other reflections.
    laser : str, optional
        Name of the laser, likewise.
    target : Path, optional
        Target file with the parameters of the paper's filter; those of the run if left out.
    overwrite : bool
        Whether to replace pictures that this command wrote there before.

    Returns
    -------
    list of Path
        What was written.

    Raises
    ------
    SourceError
        If the folder holds no points, or the rig is not on record.
    OptionError
        If the frame or laser has no points, or the run has already dropped what its filter
        rejected.
    OutputError
        If the pictures cannot be written.
    """
    check_run_files(folder)
    run, trouble = read_run_file(folder)
    if trouble:
        raise SourceError(f"{folder}: {trouble} Give the folder of a run that has one.")
    facts = _lasers(folder, run)
    options = _paper_options(folder, run, target)
    points = folder / POINTS_PARQUET
    if not points.is_file():
        raise SourceError(
            f"{points}: is not there; give the folder of a run (aqualvs report completes one that "
            "was killed)"
        )
    try:
        names = [one.name for one in facts]
        chosen = _candidates(points, _count(points), names, frame, laser)
        shown = (_read(points, one, facts[one[1]], run, options) for one in chosen)
        reflections = max(shown, key=_worth)
    except (pa.ArrowInvalid, OSError, KeyError) as fault:
        raise SourceError(f"{points}: cannot be read ({_line(fault)}); run again") from fault
    files = [out / f"{name}.png" for name in FIGURES]
    with Claim("figures", files, overwrite=overwrite), writing(out):
        written = draw_figures(reflections, options, out)
    for line in _summary(reflections):
        tell(line)
    for path in written:
        tell(f"figure: {path}")
    return written


def _lasers(folder: Path, run: Mapping[str, Any]) -> list[LaserFacts]:
    rig = run.get("rig")
    known = lasers_of(rig) if isinstance(rig, dict) else []
    if not known or not all(np.isfinite(one.offset) for one in known):
        raise SourceError(f"{folder / 'run.yaml'}: holds no lasers; run again with a whole rig")
    return known


def _paper_options(folder: Path, run: Mapping[str, Any], target: Path | None) -> MeshFilterOptions:
    scanner = (run.get("options") or {}).get("scanner") or {}
    if scanner.get("mesh_filter"):
        raise OptionError(
            f"{folder}: the run used --mesh-filter paper, which drops what it rejects; run once "
            "more without it (the figures apply the filter themselves)"
        )
    return MeshFilterOptions() if target is None else target_facts(str(target)).mesh_filter


def _count(points: Path) -> _Counts:
    """Count net and other reflections, batch by batch, so that memory stays flat."""
    totals: dict[int, list[int]] = {}
    with parquet.ParquetFile(points) as file:
        for batch in file.iter_batches(batch_size=_BATCH, columns=["frame", "laser", "label"]):
            key = batch["frame"].to_numpy().astype(np.int64) * _LASERS + batch["laser"].to_numpy()
            is_net = _is_net(batch["label"])
            keys, place = np.unique(key, return_inverse=True)
            net = np.bincount(place, is_net, len(keys)).astype(np.int64)
            both = np.bincount(place, minlength=len(keys))
            for k, n, m in zip(keys.tolist(), net.tolist(), both.tolist(), strict=True):
                total = totals.setdefault(k, [0, 0])
                total[0] += n
                total[1] += m - n
    keys = np.array([*totals], dtype=np.int64)
    counts = np.array([*totals.values()], dtype=np.int64).reshape(-1, 2)
    return _Counts(keys // _LASERS, keys % _LASERS, counts[:, 0], counts[:, 1])


def _is_net(label: Any) -> Any:
    return np.array([name == _NET for name in label.to_pylist()], np.bool_)


def _candidates(
    points: Path, counts: _Counts, names: list[str], frame: int | None, laser: str | None
) -> list[tuple[int, int]]:
    """Return frames and lasers that show most of both, the best first, among those asked for."""
    if laser is not None and laser not in names:
        raise OptionError(f"--laser {laser}: no such laser; the rig has {', '.join(names)}")
    asked = counts.laser < len(names)
    if laser is not None:
        asked &= counts.laser == names.index(laser)
    if frame is not None:
        asked &= counts.frame == frame
    if not asked.any():
        wanted = [f"--frame {frame}"] * (frame is not None) + [f"--laser {laser}"] * bool(laser)
        raise OptionError(f"{' '.join(wanted) or points}: no point there; choose another")
    rows = np.flatnonzero(asked)
    # What shows only one of both shows nothing; of equals the fullest.
    worth = np.minimum(counts.n_net[rows], counts.n_other[rows])
    best = rows[np.lexsort((counts.n_net[rows] + counts.n_other[rows], worth))[::-1]]
    found = [(int(counts.frame[row]), int(counts.laser[row])) for row in best]
    return found[:_CANDIDATES]


def _worth(r: Reflections) -> float:
    """Return how much a picture would show: pieces of net, and what else is in the zone.

    A stripe along one strand shows no mesh, however long it is.
    """
    x = np.sort(r.in_laser[r.adaptive & r.usable, 0])
    pieces = np.count_nonzero(np.diff(x) > _STRAND_GAP)
    return float(pieces * np.sqrt(1.0 + np.count_nonzero(r.usable & ~r.adaptive)))


class _Judged(NamedTuple):
    """Points of one laser in `dome`, shape (N, 3), and which of them each filter takes for net."""

    in_dome: FloatArray
    adaptive: BoolArray
    paper: BoolArray


def _read(
    points: Path,
    chosen: tuple[int, int],
    laser: LaserFacts,
    run: Mapping[str, Any],
    options: MeshFilterOptions,
) -> Reflections:
    plane = Plane(laser.normal, laser.offset)
    near, far = working_range_m(run["rig"]) or (0.0, np.inf)
    every_pixel = _every_pixel(run)
    table = parquet.read_table(
        points,
        columns=list(_PIXEL_COLUMNS if every_pixel else _COLUMNS),
        filters=[("frame", "==", chosen[0]), ("laser", "==", chosen[1])],
    )
    if every_pixel:
        judged = _pixels(table, chosen[1], run, options)
    else:
        in_dome = _columns(table, "x_m", "y_m", "z_m")
        kept = mesh_filter(in_dome, plane, options, working_range=(near, far))
        judged = _Judged(in_dome, _is_net(table["label"]), kept)
    distance = np.linalg.norm(judged.in_dome, axis=1)
    return Reflections(
        frame=chosen[0],
        laser=laser.name,
        in_laser=np.ascontiguousarray(laser_frame(plane).apply(judged.in_dome)[:, :2]),
        offset=laser.offset,
        working_range=(near, far),
        usable=(distance >= near) & (distance <= far),
        adaptive=judged.adaptive,
        paper=judged.paper,
        every_pixel=every_pixel,
    )


def _every_pixel(run: Mapping[str, Any]) -> bool:
    detector = ((run.get("options") or {}).get("scanner") or {}).get("detector") or {}
    return bool(detector.get("kind") == "threshold")


def _pixels(table: Any, laser: int, run: Mapping[str, Any], options: MeshFilterOptions) -> _Judged:
    """Return every bright pixel of a run with the threshold detector."""
    rig = rig_from_mapping(run["rig"], source_name="run.yaml")
    camera = rig.camera()
    papers = PaperFilter(rig, camera, plan_searches(rig, camera), options, every_pixel=True)
    centres, width = _columns(table, "u_px", "v_px"), _columns(table, "width_px")[:, 0]
    found = papers.apply(centres, width, np.full(len(width), laser))
    return _Judged(found.points_in_dome, _is_net(table["label"])[found.source], found.on_mesh)


def _columns(table: Any, *names: str) -> FloatArray:
    return np.stack([table[name].to_numpy() for name in names], axis=-1).astype(np.float64)


def _summary(r: Reflections) -> list[str]:
    both = int(np.count_nonzero(r.adaptive & r.paper))
    return [
        f"frame {r.frame}, laser {r.laser}: {len(r.in_laser)} {r.noun}, "
        f"{int(r.usable.sum())} of them in the working range",
        f"net by the adaptive filter: {int(r.adaptive.sum())}; by the paper's: "
        f"{int(r.paper.sum())}, {both} of them the same",
    ]


def _line(fault: BaseException) -> str:
    return " ".join(str(fault).split())
