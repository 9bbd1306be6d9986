"""Kills at random moments, and what must be left: readable rows, reports, identical results.

`python tests/helpers/kill_cases.py --kills 100 --seed 1` kills run, batch, live, follow by turns.
"""

import argparse
import contextlib
import csv
import io
import itertools
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

PROGRAM = (sys.executable, "-m", "aqualvs")
TIMEOUT_S = 600.0
TRIES = 5
"""How often a command that ended before its kill is begun again."""
KINDS = ("run", "batch", "live", "follow")
N_FRAMES = 40


@dataclass
class Kills:
    """Commands, what they give when nobody kills them, and how long that takes.

    Parameters
    ----------
    home : Path
    kinds : sequence of str
        Of `KINDS`.
    """

    home: Path
    kinds: Sequence[str] = KINDS
    whole: dict[str, dict[str, list[str]]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    caught: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        from aqualvs.simulation.scenarios import example_rig
        from shell_cases import rig_file, wall_picture, write_video

        self.home.mkdir(parents=True, exist_ok=True)
        self.rig = rig_file(self.home)
        walls = [wall_picture(example_rig(), 0.45 + 0.01 * i) for i in range(10)]
        dives = self.home / "dives"
        dives.mkdir()
        write_video(dives / "a.mp4", N_FRAMES, content=lambda i, _size: walls[i % len(walls)])
        shutil.copy(dives / "a.mp4", dives / "b.mp4")
        self.dives = dives
        for kind in self.kinds:
            begin = time.monotonic()
            done = self._call(*self.command(kind, self.home / kind))
            assert done.returncode == 0, done.stderr
            self.seconds[kind] = time.monotonic() - begin
            self.whole[kind] = rows_below(self.home / kind)

    def command(self, kind: str, out: Path) -> list[object]:
        """Return the arguments of a command that writes to a folder."""
        dive = self.dives / "a.mp4"
        return {
            "run": ["run", dive, "--rig", self.rig, "-o", out, "--workers", "2"],
            "batch": ["batch", self.dives, "--rig", self.rig, "-o", out, "--workers", "2"],
            "live": ["live", dive, "--rig", self.rig, "--fast", "--record", "--record-to", out],
            "follow": ["follow", "--sim", "--seconds", "20", "-o", out],
        }[kind]

    def fault_after(self, kind: str, moment: float, *, again: bool) -> str:
        """Kill a command at a share of its usual time; return what is wrong, "" if nothing is.

        Parameters
        ----------
        kind : str
        moment : float
            0 to 1.
        again : bool
            Whether to run the command again where it does not always have to be.
        """
        out = self.home / f"killed-{kind}"
        words = [*PROGRAM, *map(str, self.command(kind, out))]
        for _ in range(TRIES):
            shutil.rmtree(out, ignore_errors=True)
            begin = time.monotonic()
            process = subprocess.Popen(
                words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
            )
            try:
                process.wait(moment * self.seconds[kind])
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                self.caught[kind] = self.caught.get(kind, 0) + 1
                break
            # The first run compiled what later ones find ready.
            self.seconds[kind] = time.monotonic() - begin
        # The processes that it has begun see by themselves that it is gone.
        deadline = time.monotonic() + 60.0
        while _is_group(process.pid) and time.monotonic() < deadline:
            time.sleep(0.05)
        if _is_group(process.pid):
            os.killpg(process.pid, signal.SIGKILL)
            return "its processes live on for a minute"
        return self._fault(kind, out, again=again)

    def _fault(self, kind: str, out: Path, *, again: bool) -> str:
        found = rows_below(out)
        for name, rows in found.items():
            whole = self.whole[kind].get(name, [])
            if kind in ("run", "batch") and rows != whole[: len(rows)]:
                return f"{name}: {len(rows)} rows differ from those of the whole"
            if any(len(row.split(",")) != len(rows[0].split(",")) for row in rows):
                return f"{name}: a row is cut"
        if kind == "run":
            has_rows = len(found.get("posture.csv", [])) > 1
            said = _call_here("report", out)
            if said.returncode != (0 if has_rows else 2) or said.stderr.count("\n") != (
                not has_rows
            ):
                return f"report: exit code {said.returncode}: {said.stderr}"
        if kind == "live":
            return self._recording_fault(out)
        if kind == "batch" or again:
            if kind == "run":
                # However many processes, the results are the same.
                done = _call_here(*self.command(kind, out), "--overwrite", "--workers", "1")
            else:
                done = self._call(*self.command(kind, out))
            if done.returncode != 0:
                return f"again: exit code {done.returncode}: {done.stderr}"
            if kind != "follow" and rows_below(out) != self.whole[kind]:
                return "again: other results"
        return ""

    def _recording_fault(self, out: Path) -> str:
        """Return what is wrong with recordings: none may be unreadable."""
        for path in sorted(out.glob("*.mcap")):
            measured = self.home / "replayed"
            shutil.rmtree(measured, ignore_errors=True)
            done = self._call("run", path, "-o", measured, "--no-report")
            if "Traceback" in done.stderr or done.returncode not in (0, 2):
                return f"{path.name}: exit code {done.returncode}: {done.stderr}"
            if done.returncode == 2 and not any(
                words in done.stderr for words in ("holds no stripes", "no image", "torn")
            ):
                return f"{path.name}: {done.stderr}"
        return ""

    def _call(self, *arguments: object) -> subprocess.CompletedProcess[str]:
        words = [*PROGRAM, *map(str, arguments)]
        return subprocess.run(words, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)


def _call_here(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Run a command in this process: the start of another is most of the time of a short one."""
    from aqualvs.cli.main import main
    from complaints import complaints

    words = [str(one) for one in arguments]
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(words)
    errors = "".join(complaints(err.getvalue()))
    return subprocess.CompletedProcess(words, code, out.getvalue(), errors)


def rows_below(folder: Path) -> dict[str, list[str]]:
    """Return the rows of all tables of frames below a folder, by their paths in it."""
    found = {}
    for path in sorted(folder.rglob("*.csv")):
        inside = path.relative_to(folder)
        if path.name in ("posture.csv", "posture_bare.csv", "follow.csv") and not any(
            part.startswith(".") or part.endswith(".part") for part in inside.parts
        ):
            text = path.read_text("ascii")
            list(csv.reader(text.splitlines()))
            found[str(inside)] = text.splitlines()
    return found


def _is_group(number: int) -> bool:
    """Return whether processes of a group live that are no zombies."""
    for entry in filter(str.isdigit, os.listdir("/proc")):
        with contextlib.suppress(OSError, ValueError, IndexError):
            text = Path(f"/proc/{entry}/stat").read_text("ascii", "replace")
            state, _, group = text.rpartition(")")[2].split()[:3]
            if int(group) == number and state != "Z":
                return True
    return False


def run_kills() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=KINDS)
    asked = parser.parse_args()
    home = Path(tempfile.mkdtemp(prefix="aqualvs-kills-"))
    kills = Kills(home, asked.kinds)
    rng = random.Random(asked.seed)
    n_faults = 0
    for i, kind in zip(range(asked.kills), itertools.cycle(asked.kinds), strict=False):
        moment = rng.random()
        fault = kills.fault_after(kind, moment, again=i % 10 == 0)
        n_faults += bool(fault)
        print(f"{i + 1:4} {kind:6} at {moment:.2f}: {fault or 'sound'}", flush=True)
    print(f"{asked.kills} kills, {kills.caught} before the end: {n_faults} failed")
    if not n_faults:
        shutil.rmtree(home)
    return 1 if n_faults else 0


if __name__ == "__main__":
    sys.exit(run_kills())
