"""Measure real photographs of laser lines on a wall through the commands, leaving one out.

    python tools/real_wall.py ../shared/samples/real-laser-on-wall --work /tmp/real-wall

For each photograph, `aqualvs calibrate lasers` gets the others and `aqualvs run` gets that one: as
PNG, as JPEG and as H.264. Its posture is compared with the plane of the chessboard in it, which
lies on the same wall. Rigs and clips are kept in the folder --work, so that a second call only
repeats `run`; --recalibrate repeats the calibrations too.

The camera has no dome and stands in air; the rig file is written as a user would by hand.
"""

import argparse
import csv
import json
import math
import shutil
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
from av.video.stream import VideoStream
from typer.testing import CliRunner

from aqualvs.cli.main import app
from aqualvs.errors import AqualvsError

K = np.array([[1407.86, 0.0, 1083.25], [0.0, 1407.12, 623.67], [0.0, 0.0, 1.0]])
SIZE_PX = (2208, 1242)
CORNERS = (6, 9)
SQUARE_MM = 29.09
FORMATS = ("png", "jpg80", "crf18", "crf23", "crf28")
# A video of one picture: some detectors learn from frame to frame.
N_FRAMES = 3
# The paper of the board is not flat: this much, over the standard deviation of its corners along
# an axis, is what the board's own plane may be off by.
FLATNESS_M = 1e-3
# Of a sheet: what part of a picture it shows (x, y, x, y), and how wide.
_TILE = (60, 320, 1500, 1130)
_TILE_PX = 480

RIG = """\
aqualvs_rig: 1
name: webcam
image: {{width_px: {width}, height_px: {height}}}
camera:
  fx_px: {fx}
  fy_px: {fy}
  cx_px: {cx}
  cy_px: {cy}
  position_mm: [0, 0, 0]
n_air: 1.0003
water: {{n: 1.0003}}
lasers: []
working_range_mm: [300, 1000]
"""
BOARD = """\
kind: chessboard
inner_corners_x: {x}
inner_corners_y: {y}
square_mm: {square}
"""


@dataclass(frozen=True)
class BoardPose:
    """The plane of the board in a picture, as `posture.csv` states postures."""

    range_m: float
    pitch_deg: float
    yaw_deg: float
    residual_px: float
    flat_range_m: float
    flat_pitch_deg: float
    flat_yaw_deg: float


@dataclass(frozen=True)
class FrameResult:
    """One picture in one format; errors are those of its worst frame."""

    picture: str
    format: str
    reason: str
    board_range_m: float
    range_error_mm: float = math.nan
    pitch_error_deg: float = math.nan
    yaw_error_deg: float = math.nan
    n_points: int = 0
    sigma_range_mm: float = math.nan
    sigma_pitch_deg: float = math.nan
    sigma_yaw_deg: float = math.nan
    range_score: float = math.nan
    pitch_score: float = math.nan
    yaw_score: float = math.nan
    range_score_at_board: float = math.nan

    @property
    def valid(self) -> bool:
        """Whether every frame has a posture."""
        return not self.reason


def rig_text(crop: tuple[int, int, int, int] = (0, 0, *SIZE_PX)) -> str:
    """Return the rig file without lasers, as written by hand; `crop` is x, y, width, height."""
    _, _, width, height = crop
    k = intrinsics(crop)
    cx, cy = round(k[0, 2], 2), round(k[1, 2], 2)
    return RIG.format(width=width, height=height, fx=k[0, 0], fy=k[1, 1], cx=cx, cy=cy)


def intrinsics(crop: tuple[int, int, int, int] = (0, 0, *SIZE_PX)) -> np.ndarray:
    """Return the camera matrix (3, 3) of pictures cropped to x, y, width, height."""
    return np.asarray(K - np.array([[0.0, 0.0, crop[0]], [0.0, 0.0, crop[1]], [0.0, 0.0, 0.0]]))


def board_text() -> str:
    """Return the board file."""
    return BOARD.format(x=CORNERS[0], y=CORNERS[1], square=SQUARE_MM)


def board_pose(image: np.ndarray, k: np.ndarray = K) -> BoardPose:
    """Return the posture of the chessboard's plane, by OpenCV alone."""
    corners = _corners(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    points = np.zeros((CORNERS[0] * CORNERS[1], 3))
    points[:, :2] = np.mgrid[: CORNERS[0], : CORNERS[1]].T.reshape(-1, 2) * SQUARE_MM * 1e-3
    _, rvec, tvec = cv2.solvePnP(points, corners, k, None, flags=cv2.SOLVEPNP_ITERATIVE)
    projected = cv2.projectPoints(points, rvec, tvec, k, None)[0]
    rotation = cv2.Rodrigues(rvec)[0]
    normal = rotation[:, 2]
    distance = float(normal @ tvec[:, 0])
    normal = normal * math.copysign(1.0, distance)
    # Camera to `dome`: x right, y forward, z up.
    n_x, n_y, n_z = normal[0], normal[2], -normal[1]
    placed = points @ rotation.T
    # The range is that of the plane where it comes nearest to the camera, beside the board: what
    # the plane may be tilted counts over the way there, along either side of the board.
    beside = (distance * rotation[:, 2] - tvec[:, 0]) @ rotation[:, :2] - points[:, :2].mean(axis=0)
    levers = beside / points[:, :2].std(axis=0)
    return BoardPose(
        range_m=abs(distance),
        pitch_deg=math.degrees(math.atan2(n_z, n_y)),
        yaw_deg=math.degrees(math.atan2(n_x, n_y)),
        residual_px=float(np.sqrt(((projected - corners.reshape(-1, 1, 2)) ** 2).sum(-1).mean())),
        flat_range_m=FLATNESS_M * math.hypot(1.0, *levers.tolist()),
        flat_pitch_deg=math.degrees(FLATNESS_M / placed[:, 1].std()),
        flat_yaw_deg=math.degrees(FLATNESS_M / placed[:, 0].std()),
    )


def _corners(grey: np.ndarray) -> np.ndarray:
    """Return the corners (N, 1, 2) of the chessboard in pixels, by OpenCV alone.

    They are searched for where a reduced picture shows them, which takes a quarter of the time of
    the whole picture and moves the board's plane by less than 0.02 mm and 0.01 degrees.
    """
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    first = np.zeros(2, np.int64)
    small = cv2.resize(grey, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    found, corners = cv2.findChessboardCornersSB(small, CORNERS)
    if found:
        seen = 4.0 * corners.reshape(-1, 2)
        # Of the farther side; a board's outer squares are a fifth of its shorter side.
        margin = 0.35 * np.ptp(seen, axis=0).max()
        first = np.maximum(seen.min(axis=0) - margin, 0.0).astype(np.int64)
        last = (seen.max(axis=0) + margin).astype(np.int64)
        grey = np.ascontiguousarray(grey[first[1] : last[1], first[0] : last[0]])
    found, corners = cv2.findChessboardCornersSB(grey, CORNERS, flags=flags)
    if not found:
        raise SystemExit("no chessboard found in a picture")
    return np.asarray(corners + first.astype(np.float32))


def write_video(image: np.ndarray, path: Path, fmt: str, n_frames: int = N_FRAMES) -> None:
    """Write a picture as a short video, 4:2:0; an odd last row or column is left out.

    `fmt`: H.264 (crf23) or Motion JPEG (mjpeg24, the scale of its quantiser).
    """
    codec, pixels, options = "libx264", "yuv420p", {"crf": fmt.removeprefix("crf")}
    if fmt.startswith("mjpeg"):
        scale = fmt.removeprefix("mjpeg")
        codec, pixels, options = "mjpeg", "yuvj420p", {"qmin": scale, "qmax": scale}
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(25))
        assert isinstance(stream, VideoStream)
        stream.width, stream.height, stream.pix_fmt = width, height, pixels
        stream.options = dict(options)
        picture = np.ascontiguousarray(image[:height, :width])
        for _ in range(n_frames):
            frame = av.VideoFrame.from_ndarray(picture, format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def make_source(image: np.ndarray, folder: Path, fmt: str) -> Path:
    """Write a picture in a format, once; return what `aqualvs run` is given."""
    if fmt.startswith(("crf", "mjpeg")):
        path = folder / f"{fmt}.{'avi' if fmt.startswith('mjpeg') else 'mp4'}"
        if not path.exists():
            write_video(image, path, fmt)
        return path
    path = folder / fmt
    path.mkdir(exist_ok=True)
    name, options = (
        ("picture.png", [])
        if fmt == "png"
        else ("picture.jpg", [cv2.IMWRITE_JPEG_QUALITY, int(fmt.removeprefix("jpg"))])
    )
    if not (path / name).exists():
        cv2.imwrite(str(path / name), image, options)
    return path


def call(arguments: Sequence[str | Path], log: Path) -> int:
    """Run `aqualvs ARGUMENTS` in this process; return its exit code, keep its words in `log`."""
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    text = result.output
    code = result.exit_code
    if isinstance(result.exception, AqualvsError):
        text, code = f"{text}error: {result.exception}\n", 2
    elif result.exception is not None and not isinstance(result.exception, SystemExit):
        text += "".join(traceback.format_exception(result.exception))
    log.write_text(f"$ aqualvs {' '.join(map(str, arguments))}\n{text}exit code {code}\n")
    return code


def calibrate(
    others: Iterable[Path], folder: Path, n_lasers: int | None = None, *, rig: str = ""
) -> Path | None:
    """Calibrate the lasers from pictures; return the rig file, None if the command refuses.

    `rig` is the text of the rig file without lasers, that of the whole pictures if left out.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig0.yaml").write_text(rig or rig_text())
    (folder / "board.yaml").write_text(board_text())
    made = folder / "rig.yaml"
    made.unlink(missing_ok=True)
    arguments: list[str | Path] = ["calibrate", "lasers", *others, "--board", folder / "board.yaml"]
    arguments += ["--rig", folder / "rig0.yaml", "-o", made, "--medium", "air"]
    arguments += [] if n_lasers is None else ["--lasers", str(n_lasers)]
    return made if call(arguments, folder / "calibrate.txt") == 0 else None


def measure(source: Path, rig: Path, out: Path, more: Sequence[str] = ()) -> list[dict[str, str]]:
    """Run a source; return the rows of its `posture.csv`."""
    shutil.rmtree(out, ignore_errors=True)
    arguments: list[str | Path] = ["run", source, "--rig", rig, "-o", out]
    arguments += ["--no-report", "--workers", "1", *more]
    code = call(arguments, out.with_suffix(".txt"))
    table = out / "posture.csv"
    if not table.exists():
        return [{"valid": "0", "reason": f"exit_code_{code}"}]
    with table.open() as file:
        return list(csv.DictReader(file))


def _sigma(row: dict[str, str], what: str) -> float:
    """Return the total sigma of a row: what the frame's noise and the rig make of it."""
    kind, unit = what.rsplit("_", 1)
    return float(row[f"sigma_{kind}_total_{unit}"])


def compare(picture: str, fmt: str, rows: list[dict[str, str]], board: BoardPose) -> FrameResult:
    """Return the worst of a source's frames against the board."""
    invalid = [row for row in rows if row["valid"] != "1"]
    if invalid or not rows:
        reason = invalid[0]["reason"] if rows else "no_frames"
        return FrameResult(picture, fmt, reason, board.range_m)
    row = max(rows, key=lambda r: abs(float(r["range_m"]) - board.range_m))
    errors = (
        float(row["range_m"]) - board.range_m,
        float(row["pitch_deg"]) - board.pitch_deg,
        float(row["yaw_deg"]) - board.yaw_deg,
    )
    sigmas = tuple(_sigma(row, what) for what in ("range_m", "pitch_deg", "yaw_deg"))
    flat = (board.flat_range_m, board.flat_pitch_deg, board.flat_yaw_deg)
    scores = [e / math.hypot(s, f) for e, s, f in zip(errors, sigmas, flat, strict=True)]
    return FrameResult(
        picture=picture,
        format=fmt,
        reason="",
        board_range_m=board.range_m,
        range_error_mm=1e3 * errors[0],
        pitch_error_deg=errors[1],
        yaw_error_deg=errors[2],
        n_points=int(row["n_points"]),
        sigma_range_mm=1e3 * sigmas[0],
        sigma_pitch_deg=sigmas[1],
        sigma_yaw_deg=sigmas[2],
        range_score=scores[0],
        pitch_score=scores[1],
        yaw_score=scores[2],
        range_score_at_board=errors[0] / math.hypot(sigmas[0], FLATNESS_M),
    )


def mode_name(n_lasers: int | None) -> str:
    """Return the folder of results for a number of lasers passed on."""
    return "auto" if n_lasers is None else f"lasers{n_lasers}"


def leave_one_out(
    samples: Path,
    work: Path,
    *,
    n_lasers: int | None = None,
    formats: Sequence[str] = FORMATS,
    pictures: Sequence[str] = (),
    recalibrate: bool = False,
    more: Sequence[str] = (),
    echo: Callable[[str], None] = print,
) -> list[FrameResult]:
    """Calibrate without each picture in turn and measure it; see the module.

    Parameters
    ----------
    samples : Path
        Folder of the photographs (PNG).
    work : Path
        Where rigs, clips and runs are kept.
    n_lasers : int, optional
        Passed on as --lasers.
    formats : sequence of str
        Of `FORMATS`, or others made alike: `jpg60`, `crf32`.
    pictures : sequence of str
        Stems of those to be held out; all if empty.
    recalibrate : bool
        Also where a rig is kept from before.
    more : sequence of str
        Further arguments of `aqualvs run`.
    echo : callable
        Called with a line for each result.
    """
    paths = sorted(samples.glob("*.png"))
    results = []
    for path in paths:
        if pictures and path.stem not in pictures:
            continue
        image = cv2.imread(str(path))
        assert image is not None, path
        folder = work / mode_name(n_lasers) / path.stem
        rig: Path | None = folder / "rig.yaml"
        if recalibrate or not (folder / "rig.yaml").exists():
            rig = calibrate([p for p in paths if p != path], folder, n_lasers)
        board = board_pose(image)
        sources = work / "sources" / path.stem
        sources.mkdir(parents=True, exist_ok=True)
        for fmt in formats:
            source = make_source(image, sources, fmt)
            if rig is None:
                result = FrameResult(path.stem, fmt, "calibration_refused", board.range_m)
            else:
                result = compare(path.stem, fmt, measure(source, rig, folder / fmt, more), board)
            results.append(result)
            echo(line(result))
    return results


def sheet(
    samples: Path, work: Path, results: Sequence[FrameResult], columns: int = 3
) -> np.ndarray:
    """Return the pictures with the points that `run` used, and what it measured."""
    tiles = []
    x0, y0, x1, y1 = _TILE
    for m in results:
        whole = cv2.imread(str(samples / f"{m.picture}.png"))
        assert whole is not None
        image = whole[y0:y1, x0:x1]
        scale = _TILE_PX / image.shape[1]
        tile = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        table = work / m.picture / m.format / "points.parquet"
        points = pq.read_table(table, filters=[("frame", "=", 0), ("used", "=", True)])
        pixels = np.stack([points[name].to_numpy() for name in ("u_px", "v_px")], axis=-1)
        for x, y in np.rint((pixels - (x0, y0) + 0.5) * scale - 0.5).astype(int):
            cv2.circle(tile, (int(x), int(y)), 0, (255, 0, 255), -1)
        errors = f"{m.range_error_mm:+.1f} mm, yaw {m.yaw_error_deg:+.2f}"
        words = f"{m.picture}, board at {1e3 * m.board_range_m:.0f} mm: "
        words += f"{errors}, pitch {m.pitch_error_deg:+.2f} deg" if m.valid else m.reason
        title = np.full((24, _TILE_PX, 3), 255, np.uint8)
        cv2.putText(title, words, (6, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1)
        tiles.append(np.vstack([title, tile]))
    rows = [tiles[i : i + columns] for i in range(0, len(tiles), columns)]
    missing = [np.zeros_like(tiles[0])] * (columns - len(rows[-1]))
    rows[-1] += missing
    made: np.ndarray = np.vstack([np.hstack(row) for row in rows])
    return made


def line(m: FrameResult) -> str:
    """Return one line of the table."""
    head = f"{m.picture:8} {m.format:6} {1e3 * m.board_range_m:6.1f} mm "
    if not m.valid:
        return f"{head} -- {m.reason}"
    return (
        f"{head}{m.range_error_mm:8.2f} mm {m.pitch_error_deg:7.3f}° {m.yaw_error_deg:7.3f}°  "
        f"{m.n_points:5}  sigma {m.sigma_range_mm:6.2f} mm {m.sigma_pitch_deg:6.3f}° "
        f"{m.sigma_yaw_deg:6.3f}°  error/sigma {m.range_score:6.2f} {m.pitch_score:6.2f} "
        f"{m.yaw_score:6.2f}"
    )


def summary(results: Sequence[FrameResult]) -> list[str]:
    """Return a Markdown table, one row for each format, as docs/real-light.md has it."""
    lines = [
        "| format | postures | range error | yaw error | pitch error | error / sigma, rms "
        "| range, at the board |",
        "|---|---|---|---|---|---|---|",
    ]
    for fmt in dict.fromkeys(m.format for m in results):
        of = [m for m in results if m.format == fmt]
        good = [m for m in of if m.valid]
        if not good:
            lines.append(f"| {fmt} | 0 of {len(of)} | | | | | |")
            continue
        errors = np.abs([(m.range_error_mm, m.yaw_error_deg, m.pitch_error_deg) for m in good])
        scores = np.array(
            [(m.range_score, m.yaw_score, m.pitch_score, m.range_score_at_board) for m in good]
        )
        share = max(abs(m.range_error_mm) / (1e3 * m.board_range_m) for m in good)
        median, worst = np.median(errors, axis=0), errors.max(axis=0)
        rms = np.sqrt((scores**2).mean(axis=0))
        lines.append(
            f"| {fmt} | {len(good)} of {len(of)} "
            f"| median {median[0]:.1f} mm, max {worst[0]:.1f} mm ({share:.1%}) "
            f"| median {median[1]:.2f}°, max {worst[1]:.2f}° "
            f"| median {median[2]:.2f}°, max {worst[2]:.2f}° "
            f"| {rms[0]:.2f}, {rms[1]:.2f}, {rms[2]:.2f} | {rms[3]:.2f} |"
        )
    return lines


def main() -> int:
    """Run the leave-one-out and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("samples", type=Path, help="folder of the photographs")
    parser.add_argument("--work", type=Path, required=True, help="folder for rigs, clips and runs")
    parser.add_argument("--lasers", type=int, help="passed on to calibrate lasers")
    parser.add_argument("--formats", default=",".join(FORMATS), help="such as png,jpg80,crf23")
    parser.add_argument("--pictures", default="", help="only these, such as image1,image4")
    parser.add_argument("--recalibrate", action="store_true", help="do not use rigs kept in --work")
    parser.add_argument("--json", type=Path, help="write the results to this file too")
    parser.add_argument("--sheet", type=Path, help="JPEG file of the pictures with their points")
    parser.add_argument("--sheet-format", default="crf23", help="which format the sheet shows")
    parser.add_argument("run", nargs="*", help="after --: further arguments of aqualvs run")
    given = parser.parse_args()
    print("picture  format  board        range      pitch      yaw  points")
    results = leave_one_out(
        given.samples,
        given.work,
        n_lasers=given.lasers,
        formats=given.formats.split(","),
        pictures=[p for p in given.pictures.split(",") if p],
        recalibrate=given.recalibrate,
        more=given.run,
        echo=lambda text: print(text, flush=True),
    )
    said = (
        "error/sigma: total sigma and 1 mm of flatness of the board, tilted over the way to where"
    )
    print(f"\n{said}\nthe range is counted to; last column: 1 mm of range whatever the way")
    print("\n".join(summary(results)))
    if given.sheet:
        shown = [m for m in results if m.format == given.sheet_format]
        mode = mode_name(given.lasers)
        picture = sheet(given.samples, given.work / mode, shown)
        cv2.imwrite(str(given.sheet), picture, [cv2.IMWRITE_JPEG_QUALITY, 75])
    if given.json:
        given.json.write_text(json.dumps([asdict(m) for m in results], indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
