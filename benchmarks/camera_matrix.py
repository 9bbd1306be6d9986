"""Every simulated camera on the same dives, through the commands: is real light as good as ideal?

    python benchmarks/camera_matrix.py -o out/cameras [--frames 12] [--cameras webcam pal]

Each dive is rendered by `aqualvs simulate --camera`, measured by `aqualvs run` with the true rig,
and compared with the plane through the light that the camera saw. What must hold against the ideal
camera on the same dive: 95 % of its share of valid frames, 1.5 times its range error (medians; 0.02
% is granted), no answer more than 5 % off, and an rms of 0.7 to 1.3 for errors over their sigmas.
A row of a table in Markdown for every combination; `!` marks what falls short.
"""

import argparse
import csv
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from aqualvs.geometry.arrays import FloatArray
from aqualvs.simulation.cameras import CAMERAS

_NET: dict[str, Any] = {
    "range_mm": {"values": [350, 520, 430], "sway": 4, "period_s": 2.3},
    "pitch_deg": {"values": [5, -3, 2], "sway": 1.5, "period_s": 3.1},
    "yaw_deg": {"values": [-6, 8, 0], "sway": 1.5, "period_s": 2.7},
    "slide_x_mm": [0, 90, 200],
    "slide_z_mm": [0, -15, 20],
}
DIVES: dict[str, dict[str, Any]] = {
    "wall_range": {"motion": {"range_mm": [320, 1000]}, "walls": [{}]},
    "wall_turns": {
        "motion": {
            "range_mm": 550,
            "yaw_deg": {"values": [0], "sway": 18, "period_s": 4},
            "pitch_deg": {"values": [0], "sway": 12, "period_s": 3},
        },
        "walls": [{"tile_mm": 150}],
    },
    "net_diamond": {"motion": _NET, "net": {"twine_mm": 2.2, "roll_deg": 3}},
    "net_clutter": {
        "motion": {**_NET, "range_mm": [420, 600, 500]},
        "net": {"bar_mm": 30, "fouling": 0.1, "holes_mm": [[60, 40, 35]]},
        "walls": [{"behind_mm": 450, "yaw_deg": 4, "tile_mm": 150}],
        "boxes": [{"centre_mm": [330, 300, -60], "heading_deg": 12}],
        "fish": 3,
        "bubbles": 40,
    },
    "turbid": {
        "motion": _NET,
        "net": {"fouling": 0.1},
        "water": {
            "attenuation_per_m": [2.0, 1.25, 1.6],
            "veil": [0.115, 0.235, 0.165],
            "sheet_scatter_per_m": 1.5,
            "forward_scatter": 0.16,
            "halo_px": 12,
            "snow": 1500,
        },
    },
}
_DURATION_S = 4.0
# Valid share, range error, error over sigma, wrong range: see the top of the file.
_VALID, _WORSE, _GRANTED, _HONEST, _WRONG = 0.95, 1.5, 2e-4, (0.7, 1.3), 0.05
_TRUTH = ("visible_fit_range_mm", "visible_fit_pitch_deg", "visible_fit_yaw_deg")
_ANSWER = ("range_m", "pitch_deg", "yaw_deg")


@dataclass(frozen=True, slots=True)
class Result:
    """One camera on one dive.

    Attributes
    ----------
    valid : float
        Share of the frames with a posture.
    wrong : int
        Postures more than 5 % off in range.
    error : array, shape (3,)
        Median absolute errors: range as a share, pitch and yaw in degrees; NaN without postures.
    z : array, shape (3,)
        Rms of errors over sigmas.
    reasons : dict
        Why frames have no posture, with counts.
    """

    valid: float
    wrong: int
    error: FloatArray
    z: FloatArray
    reasons: dict[str, int]


def measured(folder: Path) -> Result:
    """Compare a run in `folder/run` with the truth beside it."""
    with (folder / "truth.csv").open(encoding="utf-8") as file:
        truth = list(csv.DictReader(file))
    with (folder / "run" / "posture.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    valid = np.array([row["valid"] in {"1", "True", "true"} for row in rows])
    reasons: dict[str, int] = {}
    for row in (row for row, good in zip(rows, valid, strict=True) if not good):
        reasons[row["reason"]] = reasons.get(row["reason"], 0) + 1
    pairs = [(t, r) for t, r, good in zip(truth, rows, valid, strict=True) if good]
    true = np.array([[float(t[c]) for c in _TRUTH] for t, _ in pairs]).reshape(-1, 3)
    answer = np.array([[float(r[c]) for c in _ANSWER] for _, r in pairs]).reshape(-1, 3)
    sigma = np.array([[float(r[_sigma(c)]) for c in _ANSWER] for _, r in pairs]).reshape(-1, 3)
    true[:, 0] *= 1e-3
    error = answer - true
    share = error / np.column_stack([true[:, 0], np.ones((len(true), 2))])
    none = np.full(3, np.nan)
    return Result(
        valid=float(valid.mean()),
        wrong=int((np.abs(share[:, 0]) > _WRONG).sum()),
        error=np.median(np.abs(share), axis=0) if pairs else none,
        z=np.sqrt(np.mean((error / sigma) ** 2, axis=0)) if pairs else none,
        reasons=reasons,
    )


def _sigma(column: str) -> str:
    """Return the column of the sigma that counts all errors."""
    name, unit = column.rsplit("_", 1)
    return f"sigma_{name}_total_{unit}"


def faults(result: Result, ideal: Result) -> list[str]:
    """Return what falls short, in words."""
    found = []
    if result.valid < _VALID * ideal.valid:
        found.append(f"valid {100 * result.valid:.0f} % of {100 * ideal.valid:.0f} %")
    if not result.error[0] <= _WORSE * max(ideal.error[0], _GRANTED):
        found.append(f"range {100 * result.error[0]:.3f} % of {100 * ideal.error[0]:.3f} %")
    if result.wrong:
        found.append(f"{result.wrong} wrong")
    z = float(np.sqrt(np.mean(result.z**2)))
    if not _HONEST[0] <= z <= _HONEST[1]:
        found.append(f"z {z:.2f}")
    return found


def _aqualvs(*arguments: str) -> None:
    """Run a command; a run that finds nothing to compare is no error here."""
    done = subprocess.run(
        [sys.executable, "-m", "aqualvs", *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode and not (arguments[0] == "run" and "has a posture" in done.stderr):
        raise SystemExit(f"aqualvs {' '.join(arguments)}: {done.stderr.strip()}")


def one(dive: str, camera: str, frames: int, out: Path) -> Result:
    """Render a dive unless it is there, run it, and compare."""
    folder = out / f"{dive}_{camera}"
    if not (folder / "truth.csv").exists():
        folder.mkdir(parents=True, exist_ok=True)
        scenario = folder / "scenario.yaml"
        timing = {"duration_s": _DURATION_S, "fps": frames / _DURATION_S}
        scenario.write_text(yaml.safe_dump({**timing, **DIVES[dive]}), encoding="utf-8")
        _aqualvs("simulate", str(scenario), "--camera", camera, "-o", str(folder), "--overwrite")
    video, rig = str(folder / "dive.mp4"), str(folder / "rig.yaml")
    result = ["-o", str(folder / "run"), "--overwrite", "--no-report"]
    _aqualvs("run", video, "--rig", rig, *result)
    return measured(folder)


def main() -> None:
    """Measure the matrix and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--out", type=Path, required=True)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--cameras", nargs="+", default=[c for c in CAMERAS if c != "ideal"])
    parser.add_argument("--dives", nargs="+", default=list(DIVES), choices=list(DIVES))
    options = parser.parse_args()
    print("| dive | camera | valid % | wrong | range % | pitch deg | yaw deg | z | reasons | |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for dive in options.dives:
        ideal = one(dive, "ideal", options.frames, options.out)
        for camera in ("ideal", *options.cameras):
            result = ideal
            if camera != "ideal":
                result = one(dive, camera, options.frames, options.out)
            short = faults(result, ideal)
            errors = f"{100 * result.error[0]:.3f} | {result.error[1]:.3f} | {result.error[2]:.3f}"
            z = ", ".join(f"{value:.2f}" for value in result.z)
            reasons = ", ".join(f"{n} {why}" for why, n in result.reasons.items())
            print(
                f"| {dive} | {camera} | {100 * result.valid:.0f} | {result.wrong} | {errors} | {z} "
                f"| {reasons} | {'! ' + '; '.join(short) if short else ''} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
