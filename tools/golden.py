"""Tell whether a change of the code has changed what users get: files of runs, and messages.

    python tools/golden.py record golden.json [--samples ../shared/samples]
    python tools/golden.py compare golden.json [--samples ../shared/samples]

`record` measures dives through the commands, one by one and with two and four workers, gives the
commands wrong input, and stores digests of the files and the messages. `compare` does the same
and lists what differs. Digests depend on the processor and on NumPy's and OpenCV's versions:
record and compare on the same machine, in the same environment.
"""

import argparse
import csv
import hashlib
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow.parquet as pq

from aqualvs.optics.rigfile import save_rig
from rig_from_sample_truth import rig_from_truth

DEMO = Path(__file__).parents[1] / "src" / "aqualvs" / "data" / "demo"
SAMPLE_DIVES = ("wall_range", "net_diamond", "net_clutter")
# Durations, dates and sizes in messages differ from run to run.
_VOLATILE = re.compile(r"\d+(\.\d+)? s\b|\d{4}-\d\d-\d\dT[\d:]+Z?|\d+(\.\d+)? (GB|MB)")

WRONG: Mapping[str, Sequence[str]] = {
    "no rig": ("run", "{demo}/dive.mp4", "-o", "out"),
    "no dive": ("run", "missing.mp4", "--rig", "{demo}/rig.yaml", "-o", "out"),
    "no rig file": ("run", "{demo}/dive.mp4", "--rig", "missing.yaml", "-o", "out"),
    "rig is a video": ("run", "{demo}/dive.mp4", "--rig", "{demo}/dive.mp4", "-o", "out"),
    "frames": (
        "run",
        "{demo}/dive.mp4",
        "--rig",
        "{demo}/rig.yaml",
        "-o",
        "out",
        "--frames",
        "9:3",
    ),
    "water": ("run", "{demo}/dive.mp4", "--rig", "{demo}/rig.yaml", "-o", "out", "--water-n", "3"),
    "target": ("run", "{demo}/dive.mp4", "--rig", "{demo}/rig.yaml", "-o", "out", "--target", "x"),
    "check": ("check", "{demo}/truth.csv"),
    "report": ("report", "missing"),
    "net": ("net", "missing"),
    "net-change": ("net-change", "missing", "-o", "out"),
    "batch": ("batch", "missing", "-o", "out"),
    "live": ("live", "udp://[", "--rig", "{demo}/rig.yaml"),
    "follow": ("follow", "--sim", "--seconds", "-1", "-o", "out"),
    "tune": ("tune", "missing"),
    "design": ("design", "missing.yaml", "-o", "out"),
    "camera": ("calibrate", "camera", "missing", "--board", "missing.yaml", "-o", "rig.yaml"),
    "dome": ("calibrate", "dome", "missing", "--board", "missing.yaml", "-o", "rig.yaml"),
    "lasers": ("calibrate", "lasers", "missing", "--box", "missing.yaml", "-o", "rig.yaml"),
    "simulate": ("simulate", "missing", "-o", "out"),
    "score": ("score", "missing"),
    "reproduce": ("reproduce", "missing", "-o", "out"),
    "doctor": ("doctor", "--source", "missing.mp4"),
}


def aqualvs(arguments: Sequence[str], folder: Path) -> tuple[int, str]:
    """Return the exit code of a command and what it printed on standard error."""
    done = subprocess.run(
        [sys.executable, "-m", "aqualvs", *arguments], cwd=folder, capture_output=True, text=True
    )
    return done.returncode, done.stderr


def digest(path: Path) -> str:
    """Return the digest of a file's content, of a table's rows for Parquet."""
    if path.suffix != ".parquet":
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    table, sha = pq.read_table(path), hashlib.sha256()
    for name in table.column_names:
        sha.update(name.encode())
        sha.update(repr(table.column(name).combine_chunks().to_pylist()).encode())
    return sha.hexdigest()[:16]


def runs(samples: Path | None, folder: Path) -> dict[str, Sequence[str]]:
    """Return the commands that measure, by name."""
    demo = (str(DEMO / "dive.mp4"), "--rig", str(DEMO / "rig.yaml"), "--net", "--no-report")
    found: dict[str, Sequence[str]] = {f"demo, {n} workers": (*demo, "--workers", n) for n in "124"}
    found["demo, no dome"] = (*demo[:3], "--no-dome", "--no-report")
    found["demo, the paper's ways"] = (
        *(*demo[:3], "--no-report", "--detector", "threshold"),
        *("--mesh-filter", "paper", "--fit", "pseudo_inverse"),
    )
    lab = samples / "lab-paper" if samples else None
    if lab is not None and lab.is_dir():
        rig = folder / "rig.yaml"
        save_rig(rig_from_truth(json.loads((lab / "truth" / "rig_truth.json").read_text())), rig)
        for name in SAMPLE_DIVES:
            dive = lab / "dives" / f"{name}.mp4"
            for n in "12":
                command = (str(dive), "--rig", str(rig), "--no-report", "--workers", n)
                found[f"{name}, {n} workers"] = command
    return found


def golden(samples: Path | None) -> dict[str, str]:
    """Return digests of what runs write, and messages about wrong input."""
    found = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for label, command in runs(samples, folder).items():
            out = folder / re.sub(r"\W+", "-", label)
            code, told = aqualvs(("run", *command, "-o", str(out)), folder)
            found[f"{label}: exit code"] = str(code) if code == 0 else f"{code} {told}"
            for path in sorted(out.glob("*")):
                if path.suffix in (".csv", ".parquet", ".ply", ".geojson"):
                    found[f"{label}: {path.name}"] = digest(path)
            rows = list(csv.DictReader((out / "posture.csv").open()))
            found[f"{label}: frames"] = str(len(rows))
            print(f"{label}: {len(rows)} frames", file=sys.stderr)
        for label, command in WRONG.items():
            code, told = aqualvs([one.format(demo=DEMO) for one in command], folder)
            told = told.replace(str(folder), "FOLDER").replace(str(DEMO), "DEMO")
            found[f"wrong input, {label}"] = f"{code} {_VOLATILE.sub('#', told)}"
    return found


def main() -> None:
    """Record, or compare."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--samples", type=Path)
    asked = parser.parse_args()
    now = golden(asked.samples)
    if asked.what == "record":
        asked.file.write_text(json.dumps(now, indent=1))
        return
    before = json.loads(asked.file.read_text())
    differing = [key for key in sorted(before | now) if before.get(key) != now.get(key)]
    for key in differing:
        print(f"{key}\n  before: {before.get(key)}\n  now:    {now.get(key)}")
    print(f"{len(before)} facts, {len(differing)} differ")
    sys.exit(bool(differing))


if __name__ == "__main__":
    main()
