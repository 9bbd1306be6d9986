"""Malformed input for every file and every option, and a sandbox that judges what comes of it.

`python tests/helpers/fuzz_cases.py --cases 2000 --seed 1` runs cases and lists the failures.
"""

import argparse
import contextlib
import importlib
import io
import os
import pkgutil
import random
import re
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import typing
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import typer

import aqualvs
from aqualvs.cli import main as cli
from aqualvs.cli.main import main
from aqualvs.errors import SourceError
from complaints import complaints
from repository import ROOT

CPU_S = 20
WALL_S = 60
"""A hang at any load; on an idle machine the limit of the processor's time comes first."""
MEMORY_BYTES = 2 << 30
_ADDRESSES_BYTES = 8 << 30
_FILE_BYTES = 1 << 30


TIMES: list[tuple[float, str]] = []
"""Time of the processor that each case took, in seconds."""
PROCESSES: Counter[bool] = Counter()
"""Cases in copies of this process (False), and in processes of their own (True)."""
_WHOLE_EVERY = 50


@dataclass(frozen=True)
class Case:
    """A command line that should be refused, or do its work.

    Attributes
    ----------
    name : str
    arguments : list of str, or callable
        Of the command line; or what to call in its place, which raises what a command would.
    names : tuple of str
        One of them must be in the line that refuses.
    refused : bool
        Whether it must be refused.
    """

    name: str
    arguments: Sequence[object] | Callable[[], object]
    names: tuple[str, ...]
    refused: bool = False
    whole: bool = False
    """Whether the program is started anew; else a copy of this process, which has loaded all."""

    def begins(self, command: str) -> bool:
        """Return whether it runs a command."""
        return not callable(self.arguments) and str(self.arguments[0]) == command


def fault_of(case: Case, folder: Path) -> str:
    """Run a case in a process of its own; return what is wrong, "" if nothing is."""
    folder.mkdir(parents=True, exist_ok=True)
    # Beside the folder: a pattern such as `*` finds no file in it.
    out, err = (folder.with_name(f"{folder.name} {one}") for one in ("stdout", "stderr"))
    sys.stdout.flush()
    sys.stderr.flush()
    with warnings.catch_warnings():
        # Python 3.12 warns of threads, as a test runner has them; the copy does not meet them.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if child == 0:
        _run_and_leave(case, folder, out, err)
    PROCESSES[case.whole] += 1
    deadline = time.monotonic() + WALL_S
    while True:
        done, status, used = os.wait4(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > deadline:
            os.killpg(child, signal.SIGKILL)
            os.wait4(child, 0)
            return f"hangs for {WALL_S} s"
        time.sleep(0.002)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    TIMES.append((used.ru_utime + used.ru_stime, case.name))
    return _judged(case, status, used.ru_maxrss * 1024, err.read_text("utf-8", "replace"))


def _run_and_leave(case: Case, folder: Path, out: Path, err: Path) -> None:
    code = 70
    try:
        os.setsid()
        os.chdir(folder)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        # As in the program; a test runner makes errors of warnings.
        warnings.resetwarnings()
        warnings.simplefilter("ignore", DeprecationWarning)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S))
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESSES_BYTES, _ADDRESSES_BYTES))
        resource.setrlimit(resource.RLIMIT_FSIZE, (_FILE_BYTES, _FILE_BYTES))
        nowhere = os.open(os.devnull, os.O_RDONLY)
        os.dup2(nowhere, 0)
        for number, path in ((1, out), (2, err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        if case.whole and not callable(case.arguments):
            words = [os.fsencode(str(one)) for one in case.arguments]
            os.environ["PYTHONPATH"] = str(Path(aqualvs.__file__).parents[1])
            os.execv(sys.executable, [sys.executable, "-m", "aqualvs", *words])
        sys.stdout = os.fdopen(1, "w", encoding="utf-8", closefd=False)
        sys.stderr = os.fdopen(2, "w", encoding="utf-8", closefd=False)
        code = _exit_code(case)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _exit_code(case: Case) -> int:
    arguments = case.arguments
    if not callable(arguments):
        return main([str(one) for one in arguments])

    def body(**_: object) -> int:
        arguments()
        return 0

    cli.program = lambda: body
    return main([])


def _judged(case: Case, status: int, n_bytes: int, err: str) -> str:
    if os.WIFSIGNALED(status):
        return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    code = os.WEXITSTATUS(status)
    lines = [line for line in complaints(err) if line.strip()]
    if "Traceback" in err or "Exception ignored" in err or code == 70:
        return f"traceback: {lines[-1] if lines else ''}"
    if n_bytes > MEMORY_BYTES:
        return f"takes {n_bytes >> 20} MB"
    if code not in (0, 1, 2):
        return f"exit code {code}"
    if code == 0 and case.refused:
        return "silent success"
    if code != 2:
        return ""
    if len(lines) != 1 or not lines[0].startswith("aqualvs: error: "):
        return f"{len(lines)} lines: {lines[:3]}"
    if not any(name in lines[0] for name in case.names):
        return f"names none of {case.names}: {lines[0]}"
    return ""


# What is done to a file. --------------------------------------------------------------------------

_NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
_ODD_NUMBERS = (
    b"nan", b".nan", b".inf", b"-.inf", b"inf", b"1e999", b"-1", b"0", b"1e-300", b"1e300",
    b"abc", b"", b"99999999999999999999", b"9" * 5000, b"0x_", b"1__0", b"2024-02-31",
    b"!!float abc", b"[1, 2]", b"{}", b"null", b"true", b"'1'", b"1:30", b"0o17", b"\xd9\xa1",
    b"1,5", b"-0.0", b"1e-5", b"0.5", b"1000",
)  # fmt: skip
_CERTAIN = (
    b"",
    b"\n",
    b"\0" * 100,
    b"[" * 2000,
    b"\xff\xfe\x00\x01" * 50,
    b"- " * 3000 + b"1",
    b"{" * 2000,
)


def _odd_text(rng: random.Random, data: bytes) -> tuple[bytes, bool]:
    """Return a text with a fault, and whether nothing sound is left of it."""
    lines = data.splitlines(keepends=True)
    at = rng.randrange(len(lines)) if lines else 0
    kind = rng.randrange(14)
    if kind == 0:
        return rng.choice(_CERTAIN), True
    if kind <= 5:
        found = list(_NUMBER.finditer(data))
        if found:
            place = rng.choice(found)
            return data[: place.start()] + rng.choice(_ODD_NUMBERS) + data[place.end() :], False
    if kind == 6:
        return b"".join(lines[:at] + lines[at + 1 :]), False
    if kind == 7:
        return b"".join(lines[: at + 1] + lines[at:]), False
    if kind == 8:
        rng.shuffle(lines)
        return b"".join(lines), False
    if kind == 9:
        return data[: rng.randrange(len(data) + 1)], False
    if kind == 10:
        odd = rng.choice(
            [
                b"\0",
                b"\xff",
                b"\t",
                b"\r",
                b"\x1b[2J",
                "\u2028".encode(),
                b"*a",
                b"&a [*a]",
                b"\xef\xbb\xbf",
            ]
        )
        place = rng.randrange(len(data) + 1)
        return data[:place] + odd + data[place:], False
    if kind == 11:
        return lines[0] + b"x" * 2_000_000 + b"\n" + b"".join(lines[1:]) if lines else b"x", False
    if kind == 12:
        return data.replace(b",", b";").replace(b":", b": :", rng.randrange(1, 4)), False
    return _odd_bytes(rng, data)[0], False


def _odd_bytes(rng: random.Random, data: bytes) -> tuple[bytes, bool]:
    """Return binary data with a fault, and whether nothing sound is left of it."""
    kind = rng.randrange(8)
    if kind == 0:
        return rng.choice((b"", b"\0" * 64, b"text\n", rng.randbytes(5000))), True
    if kind == 1:
        return data[: rng.randrange(len(data))], False
    changed = bytearray(data)
    if kind == 2:
        for _ in range(rng.choice((1, 3, 30))):
            changed[rng.randrange(len(changed))] ^= 1 << rng.randrange(8)
    elif kind == 3:
        # Near the beginning and the end are the heads, and the lengths in them.
        place = rng.choice(
            (rng.randrange(min(400, len(data))), max(0, len(data) - rng.randrange(1, 400)))
        )
        changed[place : place + 8] = struct.pack(
            rng.choice(("<Q", ">Q")), rng.choice((2**31 - 1, 2**32 - 1, 2**40, 2**63, 2**64 - 1))
        )
    elif kind == 4:
        place, n = rng.randrange(len(data)), rng.choice((1, 16, 4096))
        changed[place : place + n] = bytes(len(changed[place : place + n]))
    elif kind == 5:
        place, n = rng.randrange(len(data)), rng.choice((1, 16, 4096))
        del changed[place : place + n]
    elif kind == 6:
        place = rng.randrange(len(data))
        changed[place:place] = rng.randbytes(rng.choice((1, 16, 4096)))
    else:
        place, other = rng.randrange(len(data)), rng.randrange(len(data))
        changed[place : place + 512] = changed[other : other + 512]
    return bytes(changed), False


def _odd_path(rng: random.Random, path: Path) -> None:
    """Put something else than a file at a path."""
    kind = rng.randrange(5)
    if kind == 0:
        os.mkfifo(path)
    elif kind == 1:
        path.symlink_to(path)
    elif kind == 2:
        path.symlink_to("/dev/zero")
    elif kind == 3:
        path.mkdir()
    # Else nothing is there.


# The files that there are. ------------------------------------------------------------------------


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Attributes
    ----------
    name : str
        Of the file, with its suffix.
    base : bytes
        A sound one.
    calls : sequence of callable
        From the path of the file to the arguments of commands that read it.
    binary : bool
    optional : bool
        Whether commands may do without a sound one.
    inside : Path or None
        Folder whose copy the file is part of; it keeps its name then.
    """

    name: str
    base: bytes
    calls: Sequence[Callable[[Path], Sequence[object] | Callable[[], object]]]
    binary: bool = False
    optional: bool = False
    inside: Path | None = None


def look_at(path: Path) -> None:
    """Look at a source as `aqualvs doctor` does, without looking at the machine each time."""
    from aqualvs.check import doctor

    broken = [
        one.sentence for one in doctor._stream(str(path), None) if one.severity.value == "bad"
    ]
    if broken:
        raise SourceError(f"not ready: {broken[0]}")


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _below(path: Path, name: str) -> Path:
    """Return the folder of a name that a path lies in."""
    return next(one for one in path.parents if one.name == name)


@dataclass
class Bench:
    """Sound input of all kinds, made once."""

    home: Path
    formats: list[Format] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._make()

    def _make(self) -> None:
        from aqualvs.batch.dives import read_list
        from aqualvs.calibration.targets.pose_files import load_poses
        from aqualvs.design.file import EXAMPLE
        from aqualvs.simulation.render import Renderer
        from aqualvs.simulation.scenario import read_scenario
        from aqualvs.simulation.scenarios import example_rig, load_scenario
        from aqualvs.sources import open_source
        from aqualvs.sources.udp import read_sdp
        from aqualvs.vehicle_logs import read_vehicle_log
        from panel_cases import small_rig
        from shell_cases import rig_file, wall_picture, write_video

        home = self.home
        # A thread of OpenCV would not be in the copies of this process.
        cv2.setNumThreads(1)
        # A case that had to compile the renderer would be taken for one that hangs.
        scene = load_scenario("net_clutter").scene_at(0.0)
        Renderer(small_rig(), samples=1).render(scene, 0.0, np.random.default_rng(0))
        home.mkdir(parents=True, exist_ok=True)
        rig = rig_file(home)
        wall = wall_picture(example_rig())
        dive = write_video(home / "dive.mp4", 3, content=lambda _i, _size: wall)
        pictures = home / "pictures"
        pictures.mkdir()
        for i in range(2):
            cv2.imwrite(str(pictures / f"img{i}.png"), wall)
        small = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
        small_pictures = home / "small"
        small_pictures.mkdir()
        cv2.imwrite(str(small_pictures / "img0.png"), small)
        run = home / "run"
        assert (
            main(
                [
                    "run",
                    str(dive),
                    "--rig",
                    str(rig),
                    "-o",
                    str(run),
                    "--workers",
                    "1",
                    "--mcap",
                    "--net",
                ]
            )
            == 0
        )
        table = "time_s,depth_m,heading_deg\n" + "".join(
            f"{t},{1 + t},{80 + t}\n" for t in range(20)
        )
        truth = "frame,range_mm,pitch_deg,yaw_deg\n" + "".join(f"{i},500,0,0\n" for i in range(3))
        poses = "image,distance_mm\nimg0.png,500\n"
        lists = f"dive,rig,name,water_n\n{dive},{rig},a,1.34\n"
        chess = b"kind: chessboard\nsquares_x: 9\nsquares_y: 6\nsquare_mm: 30\n"
        package = Path(cli.__file__).parents[1]
        gains = (package / "data" / "gains" / "bluerov2.yaml").read_bytes()
        plan = (ROOT / "examples" / "plan_survey.yaml").read_bytes()
        for kind in ("charuco", "box", "plate"):
            assert (
                main(
                    ["board", kind, "-o", str(home / kind)]
                    + (["--position-mm", "0", "500", "0"] if kind == "plate" else [])
                )
                == 0
            )

        def sim(*more: object) -> list[object]:
            return ["follow", "--sim", "--seconds", "1", "-o", "out", *more]

        def measure(path: Path) -> list[object]:
            return ["run", path, "--rig", rig, "-o", "out", "--workers", "1", "--no-report"]

        lasers = ["calibrate", "lasers", small_pictures, "--rig", rig, "-o", "new.yaml"]
        add = self.formats.append
        add(
            Format(
                "rig.yaml",
                rig.read_bytes(),
                [
                    lambda p: ["check", p],
                    lambda p: ["check", rig, "--against", p],
                    lambda p: [
                        "run",
                        dive,
                        "--rig",
                        p,
                        "-o",
                        "out",
                        "--workers",
                        "1",
                        "--no-report",
                    ],
                ],
            )
        )
        add(Format("gains.yaml", gains, [lambda p: sim("--gains", p)]))
        add(Format("plan.yaml", plan, [lambda p: sim("--plan", p)]))
        add(
            Format(
                "design.yaml",
                EXAMPLE.encode(),
                [lambda p: ["design", p, "--no-tilt", "--no-changes"]],
            )
        )
        add(
            Format(
                "scenario.yaml",
                b"duration_s: 1\nfps: 25\nseed: 3\nmotion: {range_mm: 600, yaw_deg: [0, 10]}\n"
                b"net: {}\nfish: 3\n",
                [lambda p: lambda: read_scenario(p)],
            )
        )
        add(
            Format(
                "board.yaml",
                chess,
                [lambda p: ["calibrate", "camera", small_pictures, "--board", p, "-o", "new.yaml"]],
            )
        )
        add(
            Format(
                "charuco.yaml",
                (home / "charuco.yaml").read_bytes(),
                [lambda p: [*lasers, "--board", p]],
            )
        )
        add(Format("box.yaml", (home / "box.yaml").read_bytes(), [lambda p: [*lasers, "--box", p]]))
        add(
            Format(
                "target.yaml",
                (home / "plate.yaml").read_bytes(),
                [
                    lambda p: [
                        "calibrate",
                        "water",
                        small_pictures,
                        "--target",
                        p,
                        "--rig",
                        rig,
                        "-o",
                        "new.yaml",
                    ]
                ],
            )
        )
        add(Format("poses.csv", poses.encode(), [lambda p: lambda: load_poses(p)]))
        add(
            Format(
                "net.yaml",
                b"kind: net\nbar_mm: 15\ntwine_mm: 2.5\n",
                [lambda p: ["figures", run, "-o", "out", "--target", p]],
            )
        )
        add(
            Format(
                "nominal.yaml",
                b"name: rov\ndome: {inner_radius_mm: 51, thickness_mm: 6}\n",
                [
                    lambda p: [
                        "calibrate",
                        "camera",
                        small_pictures,
                        "--board",
                        home / "charuco.yaml",
                        "--nominal",
                        p,
                        "-o",
                        "new.yaml",
                    ]
                ],
            )
        )
        add(Format("list.csv", lists.encode(), [lambda p: lambda: read_list(p)]))
        add(
            Format(
                "list.yaml",
                f"- {{dive: {dive}, rig: {rig}, water_n: 1.34}}\n".encode(),
                [lambda p: lambda: read_list(p)],
            )
        )
        add(Format("truth.csv", truth.encode(), [lambda p: ["report", run, "--truth", p]]))
        add(
            Format(
                "log.csv",
                table.encode(),
                [
                    lambda p: lambda: read_vehicle_log(p),
                    lambda p: ["net", run, "--log", p, "--log-offset-s", "0", "--overwrite"],
                ],
            )
        )
        add(
            Format(
                "dive.sdp",
                b"v=0\nm=video 5600 RTP/AVP 96\nc=IN IP4 127.0.0.1\na=rtpmap:96 H264/90000\n",
                [lambda p: lambda: read_sdp(p)],
            )
        )
        add(
            Format(
                "dive.mp4",
                dive.read_bytes(),
                [
                    measure,
                    lambda p: ["live", p, "--rig", rig, "--fast"],
                    lambda p: lambda: look_at(p),
                ],
                binary=True,
            )
        )
        add(
            Format(
                "dive.mcap",
                (run / "dive.mcap").read_bytes(),
                [measure, lambda p: lambda: list(open_source(p))],
                binary=True,
            )
        )
        add(
            Format(
                "img.png",
                (pictures / "img0.png").read_bytes(),
                [
                    measure,
                    lambda p: [
                        "calibrate",
                        "camera",
                        p,
                        "--board",
                        home / "charuco.yaml",
                        "-o",
                        "new.yaml",
                    ],
                ],
                binary=True,
            )
        )
        report = [lambda p: ["report", p.parent]]
        change = [
            *report,
            lambda p: [
                "net-change",
                run,
                p.parent,
                "--date",
                "2026-01-01",
                "--date",
                "2026-02-01",
                "-o",
                "out",
            ],
        ]
        stored = [
            *report,
            lambda p: ["net", p.parent, "--overwrite"],
            lambda p: ["figures", p.parent, "-o", "out"],
        ]
        add(
            Format(
                "run.yaml",
                (run / "run.yaml").read_bytes(),
                [*stored, change[1]],
                optional=True,
                inside=run,
            )
        )
        add(
            Format(
                "posture.csv", (run / "posture.csv").read_bytes(), stored, inside=run, optional=True
            )
        )
        add(
            Format(
                "posture_bare.csv",
                (run / "posture_bare.csv").read_bytes(),
                report,
                optional=True,
                inside=run,
            )
        )
        add(
            Format(
                "points.parquet",
                (run / "points.parquet").read_bytes(),
                stored,
                binary=True,
                optional=True,
                inside=run,
            )
        )
        for name in ("net.csv", "holes.csv", "net.geojson", "net_map.png"):
            add(
                Format(
                    name,
                    (run / name).read_bytes(),
                    change,
                    binary=name.endswith("png"),
                    optional=True,
                    inside=run,
                )
            )
        self.run, self.rig, self.dive, self.small = run, rig, dive, small_pictures
        self._make_foreign()
        self._make_settings()
        self._make_calibrations()
        self._load_all()

    def _make_settings(self) -> None:
        """Add files that say who is there, what was before, and what is true."""
        from aqualvs.live.mavlink.peers import load_key
        from aqualvs.live.options import vehicle_setup

        vehicle = (
            b"aqualvs_vehicle: 1\nsystem: 2\nground_station: 250\nstation_timeout_s: 3.5\n"
            b"command: guided\nmodes: [ALT_HOLD]\nspeed_m_s: 0.3\npeers: [192.168.2.2]\n"
            b"key: secret.key\n"
        )
        key = b"7" * 64 + b"\n"
        copies, marks = self.home / "copies", self.home / "set"
        for folder in (copies, marks / "a"):
            folder.mkdir(parents=True)
        (copies / "rig.yaml").write_bytes(self.rig.read_bytes())
        (copies / "rig.2026-01-01T000000.yaml").write_bytes(self.rig.read_bytes())
        named = b"aqualvs_benchmark: 1\nname: x\nchecksum: '0'\nwhole: true\n"
        (marks / "benchmark.yaml").write_bytes(named + b"dives: {a: {level: easy}}\n")
        rows = "".join(f"{i},{0.5 + 0.01 * i},1,2,300\n" for i in range(3))
        (marks / "a" / "truth.csv").write_text(f"frame,range_m,pitch_deg,yaw_deg,n_visible\n{rows}")
        answers = self.home / "answers.csv"
        answers.write_text(
            "dive,frame,range_m,pitch_deg,yaw_deg,sigma_range_m\n"
            + "".join(f"a,{i},{0.5 + 0.01 * i},1,2,0.001\n" for i in range(3))
        )
        secret = self.home / "secret.key"
        secret.write_bytes(key)
        secret.chmod(0o600)

        def setup(path: Path) -> Callable[[], object]:
            return lambda: vehicle_setup(path, ["192.168.2.0/24"], secret)

        def score(path: Path) -> list[object]:
            return ["score", f"mine={path}", "--truth", marks, "-o", "out"]

        def against_last(path: Path) -> list[object]:
            return ["check", path.parent / "rig.yaml", "--against", "last"]

        add = self.formats.append
        add(Format("vehicle.yaml", vehicle, [setup]))
        add(Format("secret.key", key, [lambda p: lambda: load_key(p)], optional=True))
        for name in ("rig.yaml", "rig.2026-01-01T000000.yaml"):
            base = self.rig.read_bytes()
            add(Format(name, base, [against_last], inside=copies, optional=True))
        add(Format("answers.csv", answers.read_bytes(), [score]))
        for name in ("benchmark.yaml", "a/truth.csv"):
            add(
                Format(
                    name,
                    (marks / name).read_bytes(),
                    [lambda p: ["score", f"mine={answers}", "--truth", _below(p, "odd")]],
                    inside=marks,
                )
            )
        for name in (".aqualvs.json", "points.ply", "net_map.svg"):
            calls = [lambda p: ["report", p.parent], lambda p: ["net", p.parent, "--overwrite"]]
            path = self.run / name
            add(Format(name, path.read_bytes(), calls, binary=True, optional=True, inside=self.run))

    def _make_calibrations(self) -> None:
        """Add calibrations of other programs, as `aqualvs export` writes them, and a target."""
        from aqualvs.calibration_files import EXPORTS, camera_of_rig, camera_text
        from aqualvs.calibration_formats import CalibrationFormat
        from aqualvs.optics.rigfile import load_rig

        camera = camera_of_rig(load_rig(self.rig))
        texts = {f"{to}.txt": camera_text(camera, to) for to in EXPORTS}
        texts["opencv.xml"] = camera_text(camera, "opencv", suffix=".xml")
        texts["opencv.json"] = camera_text(camera, "opencv", suffix=".json")
        texts[f"{CalibrationFormat.KALIBR_TARGET}.txt"] = (
            "target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n"
            "rowSpacingMeters: 0.06\ncolSpacingMeters: 0.06\n"
        )
        calls = [
            lambda p: ["import", p, "-o", "out.yaml"],
            lambda p: ["import", p, "-o", "out.yaml", "--image", "720x576", "--model", "opencv"],
            lambda p: ["check", p],
        ]
        for name, text in texts.items():
            self.formats.append(Format(name, text.encode(), calls))

    def _load_all(self) -> None:
        """Load every module and the compiled functions, so that no copy has to."""
        for found in pkgutil.walk_packages(aqualvs.__path__, "aqualvs."):
            if not found.name.endswith("__main__"):
                importlib.import_module(found.name)
        work = self.home / "loading"
        work.mkdir()
        said = io.StringIO()
        with (
            contextlib.chdir(work),
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
        ):
            for name in ("rig.yaml", "board.yaml", "charuco.yaml", "gains.yaml", "truth.csv"):
                kind = next(one for one in self.formats if one.name == name)
                path = work / name
                path.write_bytes(kind.base)
                call = kind.calls[0](path)
                assert not callable(call)
                main([str(one) for one in call])
            main(["doctor"])
            dates = ["--date", "2026-01-01", "--date", "2026-02-01"]
            again = shutil.copytree(self.run, work / "run")
            main(["net-change", str(self.run), str(again), *dates, "-o", "change"])

    def _make_foreign(self) -> None:
        """Add logs and recordings that other programs write, as their own tests make them."""
        from tests.sources import test_message_source as messages
        from tests.vehicle_logs import test_mavlink_frames as logs

        from aqualvs.sources import open_source
        from aqualvs.vehicle_logs import read_vehicle_log

        text = (
            b"FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns\nATT, 60000000, 1, 2, 3\n"
        )
        found = {
            "dive.tlog": b"".join(logs.telemetry()),
            "dive.bin": b"".join(logs.dataflash()),
            "dive.log": text,
        }
        for name, data in found.items():
            call = [lambda p: lambda: read_vehicle_log(p)]
            self.formats.append(Format(name, data, call, binary=name != "dive.log"))
        foreign = messages.write_mcap(self.home / "foreign.mcap", [messages.compressed_image()])
        video = messages.write_mcap(self.home / "video.mcap", [messages.compressed_video()])
        call = [lambda p: lambda: list(open_source(p))]
        bags = {kind: make(_made(self.home / kind)) for kind, make in messages.PACKED.items()}
        lone = (foreign, video, messages.bag1(self.home / "foreign.bag"))
        for path in (*lone, *(one for one in bags.values() if one.is_file())):
            self.formats.append(Format(path.name, path.read_bytes(), call, binary=True))
        read = [lambda p: lambda: list(open_source(p.parent))]
        for bag in (one for one in bags.values() if one.is_dir()):
            for path in sorted(bag.iterdir()):
                form = Format(path.name, path.read_bytes(), read, inside=bag, optional=True)
                self.formats.append(replace(form, binary=path.suffix != ".yaml"))

    def file_cases(self, rng: random.Random, n: int, folder: Path) -> Iterator[Case]:
        """Yield cases of malformed files, each written to a folder of its own."""
        for i in range(n):
            yield self._file_case(rng, self.formats[i % len(self.formats)], folder / f"f{i}")

    def _file_case(self, rng: random.Random, kind: Format, folder: Path) -> Case:
        folder.mkdir(parents=True)
        if kind.inside is None:
            path = folder / f"odd {kind.name}"
        else:
            shutil.copytree(kind.inside, folder / "odd")
            path = folder / "odd" / kind.name
            path.unlink()
        certain = True
        if rng.random() < 0.1:
            _odd_path(rng, path)
        else:
            data, certain = (_odd_bytes if kind.binary else _odd_text)(rng, kind.base)
            path.write_bytes(data)
        call = rng.choice(kind.calls)(path)
        # A CSV of a run without rows, or garbage beside sound files, is told as a warning.
        given = () if callable(call) else (one.name for one in call if isinstance(one, Path))
        names = ("odd", "answers.csv", "RUN", "--out", *given)
        return Case(
            f"file {kind.name} in {folder.name}", call, names, certain and not kind.optional
        )

    # What is done to options. ---------------------------------------------------------------------

    def option_cases(self, rng: random.Random, n: int, folder: Path) -> Iterator[Case]:
        """Yield cases of impossible values, option by option."""
        options = [
            (words, option)
            for words, command in commands(typer.main.get_command(cli.app))
            for option in command.params
            if option.name not in ("help", "list_", "example")
            and not getattr(option, "is_flag", False)
        ]
        for i in range(n):
            words, option = options[i % len(options)]
            yield self._option_case(rng, words, option, folder / f"o{i}")

    def _option_case(
        self, rng: random.Random, words: tuple[str, ...], option, folder: Path
    ) -> Case:
        folder.mkdir(parents=True)
        known = {
            "rig": self.rig,
            "out": "out",
            "output": "out.yaml",
            "source": self.small,
            "images": self.small,
            "board": self.home / "charuco.yaml",
            "truth": self.home / "set",
            "results": self.home / "answers.csv",
            "target": self.home / "plate.yaml",
            "folder": self.run,
            "runs": self.run,
            "model": "bluerov2",
            "kind": "charuco",
        }
        arguments: list[object] = [*words]
        for other in option_holder(words).params:
            if other is option or not other.required:
                continue
            value = known.get(other.name, self.home / "none")
            arguments += [other.opts[0], value] if other.param_type_name == "option" else [value]
        if words == ("follow",):
            arguments += ["--sim", "--seconds", "1"] if option.name != "seconds" else ["--sim"]
        if words == ("run",):
            arguments += ["--workers", "1"] if option.name != "workers" else []
        # By themselves these work for minutes to hours.
        least = {
            "benchmark": {"names": ["empty_dark"], "frames": ["--frames=2"], "out": ["--out=out"]},
            "reproduce": {"experiments": ["control"], "out": ["--out=out"]},
        }
        for name, given in least.get(words[-1], {}).items():
            arguments += given if name != option.name else []
        value, refused = rng.choice(_VALUES)
        certain = refused and _takes_float(words, option.name)
        if option.param_type_name == "option":
            name = max(option.opts, key=len)
            arguments += (
                [name, *[value] * max(1, option.nargs)] if option.nargs > 1 else [f"{name}={value}"]
            )
        else:
            name = option.name.upper()
            arguments.append(value)
        shown = repr(value)[1:-1]
        return Case(
            f"option {' '.join(words)} {name} {value[:40]!r}",
            arguments,
            (
                name,
                name.lower().lstrip("-").replace("-", "_"),
                shown[:30] or name,
                # Paths have no doubled slashes, and numbers are shown shortened.
                str(Path(value))[:30],
                _shortened(value),
                # Another option may be missing, or contradict it.
                "--",
                "No such option",
                str(self.home),
                "charuco.yaml",
                *words,
            ),
            certain,
        )


# No number; what follows, some option takes.
_NO_NUMBERS = (
    "nan", "inf", "-inf", "abc", "", " ", "two\nlines", "a" * 5000, "../../none", "/dev/zero",
    "/dev/null", "\u202eevil", "1,2,3", "1:2", "1x1", "0x0", "%s%n", "[", "udp://[", "http://[::1",
    "*", "\udcff", "=",
)  # fmt: skip
_VALUES = [(value, True) for value in _NO_NUMBERS] + [
    (value, False)
    for value in (
        "-1", "0", "1e308", "-1e308", "1e-308", "99999999999", "-99999999999999999999", "-", "/",
        "host:99999", "1e5x1e5", "-1:-5",
    )
]  # fmt: skip


def commands(group, name=()) -> Iterator[tuple[tuple[str, ...], typer.core.TyperCommand]]:
    """Yield every command with the words that call it."""
    for word, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, (*name, word))
        else:
            yield (*name, word), command


def _shortened(value: str) -> str:
    try:
        return f"{float(value):g}"
    except ValueError:
        return value


def _takes_float(words: tuple[str, ...], name: str) -> bool:
    hint = typing.get_type_hints(option_holder(words).callback).get(name)
    return hint is float or float in typing.get_args(hint)


def option_holder(words: tuple[str, ...]):
    """Return the command of these words."""
    return dict(commands(typer.main.get_command(cli.app)))[words]


def failures(bench: Bench, seed: int, n_cases: int, folder: Path, echo=None) -> list[str]:
    """Run cases and return what is wrong with which."""
    rng = random.Random(seed)
    n_options = n_cases // 3
    found = []
    streams = (
        bench.file_cases(rng, n_cases - n_options, folder),
        bench.option_cases(rng, n_options, folder),
    )
    for cases in streams:
        for i, case in enumerate(cases):
            # One in each few goes the whole way, through a process that begins with nothing. So do
            # batches: in a copy, the server that makes their workers is another process's child.
            if i % _WHOLE_EVERY == _WHOLE_EVERY - 1 or case.begins("batch"):
                case = replace(case, whole=not callable(case.arguments))
            where = folder / "here"
            fault = fault_of(case, where)
            shutil.rmtree(where, ignore_errors=True)
            if fault.startswith("hangs") and not case.whole:
                # A copy can inherit a lock that a thread of this process held at that moment.
                fault = fault_of(replace(case, whole=not callable(case.arguments)), where)
                shutil.rmtree(where, ignore_errors=True)
            if fault:
                found.append(f"{case.name}: {fault}")
                if echo is not None:
                    echo(
                        f"{found[-1]}   {case.arguments if not callable(case.arguments) else ''}"[
                            :600
                        ]
                    )
            elif case.name.startswith("file"):
                shutil.rmtree(folder / case.name.split()[-1], ignore_errors=True)
    return found


def run_cases() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args()
    folder = asked.keep or Path(tempfile.mkdtemp(prefix="aqualvs-fuzz-"))
    begin = time.monotonic()
    bench = Bench(folder / "bench")
    found = failures(
        bench, asked.seed, asked.cases, folder / "cases", lambda line: print(line, flush=True)
    )
    kinds = Counter(line.split(": ")[1].split()[0] for line in found)
    taken_s = time.monotonic() - begin
    print(
        f"{asked.cases} cases of seed {asked.seed} in {taken_s:.0f} s: {len(found)} failed", kinds
    )
    print(f"{PROCESSES[True]} of them through a process of their own")
    print(f"{sum(taken for taken, _ in TIMES):.0f} s of the processor, of which most:")
    for taken, name in sorted(TIMES, reverse=True)[:8]:
        print(f"{taken:6.1f} s of the processor: {name}")
    if asked.keep is None and not found:
        shutil.rmtree(folder)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(run_cases())
