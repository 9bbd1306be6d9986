"""Score the stripes that are found in real photographs of laser lines, when no rig is known.

    python tools/real_lines.py ../shared/samples/real-laser-lines --page /tmp/lines.html

Each picture is read as it is, as JPEG (quality 80) and as H.264 (crf 23), by `find_stripes`, the
way `aqualvs calibrate lasers` finds stripes. Four questions are asked:

- pictures with lines: the share of each line's length that has a point nearby. The lines are those
  of real_lines.csv, which says how they were traced;
- pictures without laser: the number of points, which should be 0;
- pairs without and with a red line: the share of the line's columns with a point within 1 px of
  the line that the difference of the pair shows;
- everywhere: the share of points far from any line.

--page writes the pictures with their points as one HTML file, --sheets one JPEG file for each set.
"""

import argparse
import base64
import csv
import dataclasses
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from aqualvs.calibrate.uncalibrated_stripes import find_stripes
from aqualvs.scanning.scan import Frame
from aqualvs.sources import open_source

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

TRACED = Path(__file__).with_name("real_lines.csv")
FORMATS = ("png", "jpg80", "crf23")
# A point belongs to a traced line within this distance; lines in the dark pictures are up to 15 px
# wide, and the trace of such a line is good to a third of that.
NEAR_PX = {"green15-bright": 2.0, "green15-dark": 5.0, "red-charuco": 2.0}
PAIR_PX = 1.0
RED_NM, GREEN_NM = 650.0, 532.0
# Luma and V of B, G, R. Difference of a pair: smoothing along the line; size of the surroundings
# and what counts there at most; least of red, luma, and luma compared with the surroundings.
_LUMA, _V = (0.114, 0.587, 0.299), (-0.081, -0.419, 0.5)
_BLUR_ALONG_PX, _AROUND_PX, _MAX_NOISE = 2.0, (21, 61), 8.0
_MIN_RED, _MIN_LUMA, _MIN_CLEAR = 1.0, 3.0, 4.0
# Blur of a picture out of focus, and the way of a moved one, as shares of its width.
_SOFT_SIGMA, _WAY = 1.0 / 900.0, 1.0 / 245.0
# Drawing: pictures darker than this on average are brightened; space around lines, in widths;
# width of a sheet in pixels.
_DARK, _MARGIN, _SHEET_WIDTH = 40.0, 0.02, 1440
_ON_GREEN_BGR, _ON_RED_BGR, _WHITE = (255, 0, 255), (255, 255, 0), (255, 255, 255)


@dataclass(frozen=True)
class Score:
    """One picture in one format.

    Attributes
    ----------
    picture, format, group : str
        `group` is that of the traced lines, `pair`, or `off532` and `off650` for pictures without
        laser, searched for light of that wavelength.
    n_points : int
        Points found in the picture.
    found : float
        Share of the line's length (columns, for pairs) that was found; NaN without lines.
    weakest : float
        The same of the line that was found least.
    elsewhere : int
        Points far from every line.
    """

    picture: str
    format: str
    group: str
    n_points: int
    found: float
    weakest: float
    elsewhere: int


def read_image(path: Path) -> Image:
    """Return a picture (height, width, 3) as BGR."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    assert image is not None, path
    return np.asarray(image, np.uint8)


def encoded(image: Image, fmt: str) -> Image | Frame:
    """Return a picture as it is after JPEG (BGR) or H.264 (a decoded frame).

    Before a format, `soft-` puts the picture out of focus, and `moved-` moves the camera sideways.
    """
    state, _, fmt = fmt.rpartition("-")
    image = _worsened(image, state)
    if fmt == "png":
        return image
    if fmt.startswith("jpg"):
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(fmt.removeprefix("jpg"))]
        read = cv2.imdecode(cv2.imencode(".jpg", image, quality)[1], cv2.IMREAD_COLOR)
        assert read is not None
        return np.asarray(read, np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.mp4"
        _write_video(image, path, int(fmt.removeprefix("crf")))
        with open_source(str(path)) as source:
            return next(iter(source))


def _worsened(image: Image, state: str) -> Image:
    """Return a picture out of focus (`soft`), moved while it was taken (`moved`), or as it is."""
    width = image.shape[1]
    if state == "soft":
        return np.asarray(cv2.GaussianBlur(image, (0, 0), _SOFT_SIGMA * width), np.uint8)
    if state == "moved":
        return np.asarray(cv2.blur(image, (round(_WAY * width) | 1, 1)), np.uint8)
    return image


def _write_video(image: Image, path: Path, crf: int) -> None:
    """Write one frame, 4:2:0; an odd last row or column is left out."""
    height, width = image.shape[0] // 2 * 2, image.shape[1] // 2 * 2
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(25))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": str(crf)}
        picture = np.ascontiguousarray(image[:height, :width])
        container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")))
        container.mux(stream.encode(None))


def traced_lines(path: Path = TRACED) -> dict[str, list[tuple[str, Array]]]:
    """Return (group, polyline (N, 2)) of every traced line, by picture."""
    points: dict[tuple[str, str, str], list[tuple[float, float]]] = defaultdict(list)
    with path.open() as file:
        for row in csv.DictReader(line for line in file if not line.startswith("#")):
            key = row["picture"], row["group"], row["line"]
            points[key].append((float(row["x_px"]), float(row["y_px"])))
    lines: dict[str, list[tuple[str, Array]]] = defaultdict(list)
    for (picture, group, _), polyline in points.items():
        lines[picture].append((group, np.array(polyline)))
    return lines


def walk(polyline: Array) -> Array:
    """Return points (N, 2) every pixel along a polyline."""
    step = np.hypot(*np.diff(polyline, axis=0).T)
    way = np.concatenate([[0.0], np.cumsum(step)])
    at = np.arange(0.0, way[-1], 1.0)
    return np.stack([np.interp(at, way, polyline[:, i]) for i in (0, 1)], axis=-1)


def near(points: Array, others: Array, distance_px: float) -> NDArray[np.bool_]:
    """Return which points (N,) have one of the others within a distance."""
    if len(others) == 0 or len(points) == 0:
        return np.zeros(len(points), bool)
    distance, _ = cKDTree(others).query(points, distance_upper_bound=distance_px)
    return np.asarray(np.isfinite(distance))


def score_lines(
    name: str, fmt: str, found: Array, lines: Sequence[tuple[str, Array]]
) -> list[Score]:
    """Return a score for each group of a picture's lines."""
    reach = NEAR_PX[name.split("/")[0]]
    everything = np.concatenate([walk(polyline) for _, polyline in lines])
    elsewhere = int((~near(found, everything, 2.0 * reach)).sum())
    scores = []
    for group in dict.fromkeys(group for group, _ in lines):
        walks = [walk(polyline) for of, polyline in lines if of == group]
        # Along the line a point counts for its neighbours too: fast lines have one every row.
        seen = near(np.concatenate(walks), found, reach)
        parts = np.split(seen, np.cumsum([len(w) for w in walks])[:-1])
        weakest = min(float(part.mean()) for part in parts)
        scores.append(Score(name, fmt, group, len(found), float(seen.mean()), weakest, elsewhere))
    return scores


def pair_line(off: Image, on: Image) -> Array:
    """Return the row (width,) of a near-horizontal line in each column, NaN where unseen.

    The line is where luma rises by most, compared with what differs around it. Colour only rules
    out what turns less red: the pictures are JPEG files, whose chroma is half as fine and spreads
    over blocks of 16 pixels, so that red reaches beyond where a line ends. Nor does a line turn
    more red where its own light saturates the camera.
    """
    difference = on.astype(np.float32) - off
    luma, red = (_high(difference @ np.array(weights, np.float32)) for weights in (_LUMA, _V))
    luma = cv2.GaussianBlur(luma, (0, 0), _BLUR_ALONG_PX, sigmaY=0.6)
    red = cv2.GaussianBlur(red, (0, 0), _BLUR_ALONG_PX)
    around = cv2.boxFilter(np.minimum(np.abs(luma), _MAX_NOISE), -1, _AROUND_PX)
    clear = np.where(red > -_MIN_RED, luma / (1.5 * around + 0.5), 0.0)
    row = clear.argmax(axis=0)
    columns = np.arange(len(row))
    strong = (clear[row, columns] > _MIN_CLEAR) & (luma[row, columns] > _MIN_LUMA)
    line = np.full(len(row), np.nan)
    for x in np.flatnonzero(strong):
        beside = slice(max(0, x - 6), x + 7)
        if (strong[beside] & (np.abs(row[beside] - row[x]) <= 2)).sum() < 7:
            continue
        first, last = max(0, row[x] - 3), min(len(luma), row[x] + 4)
        weight = np.clip(luma[first:last, x] - 0.3 * luma[first:last, x].max(), 0.0, None)
        line[x] = (weight * np.arange(first, last)).sum() / weight.sum()
    return line


def _high(difference: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return a difference (height, width) without what is wider than a line."""
    padded = np.pad(difference, ((15, 15), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 31, axis=0)
    return np.asarray(difference - np.median(windows, axis=-1))


def score_pair(name: str, fmt: str, found: Array, line: Array) -> Score:
    """Return the share of a pair's columns with a point within `PAIR_PX` of its line."""
    columns = np.flatnonzero(np.isfinite(line))
    hit = np.zeros(len(columns), bool)
    for i, x in enumerate(columns):
        here = np.abs(found[:, 0] - x) <= 0.5
        hit[i] = bool((np.abs(found[here, 1] - line[x]) <= PAIR_PX).any())
    at = np.clip(np.rint(found[:, 0]), 0, len(line) - 1).astype(int)
    off_line = ~(np.abs(found[:, 1] - line[at]) <= 2.0 * PAIR_PX)
    share = float(hit.mean()) if len(hit) else float("nan")
    return Score(name, fmt, "pair", len(found), share, share, int(off_line.sum()))


@dataclass(frozen=True)
class Shot:
    """A picture in a format, its points, and what they are worth."""

    image: Image
    points: Array
    scores: list[Score]


def pictures_of(samples: Path) -> dict[str, Path]:
    """Return every picture by its name, the folder's and its own."""
    paths = [path for path in sorted(samples.glob("*/*")) if path.suffix in (".png", ".jpg")]
    return {f"{path.parent.name}/{path.name}": path for path in paths}


def shows_laser(name: str, traced: Container[str]) -> bool:
    """Return whether a picture shows a laser: its lines are traced, or it is the lit of a pair."""
    return name in traced or "-b-" in name


def shots(
    samples: Path, formats: Sequence[str], wanted: Callable[[str], bool] = lambda _: True
) -> Iterator[Shot]:
    """Read, search and score every picture of which the name is wanted, in every format."""
    traced = traced_lines()
    for name, path in pictures_of(samples).items():
        if not wanted(name):
            continue
        image = read_image(path)
        red = path.parent.name.startswith("red")
        is_on = shows_laser(name, traced)
        line = None
        if "-b-" in path.name:
            off = read_image(Path(str(path).replace("-b-", "-a-")))
            line = pair_line(off, image)
        for fmt in formats:
            given = encoded(image, fmt)
            # Without a laser, nothing may be found whatever the colour of the rig's lasers.
            for nm in [RED_NM if red else GREEN_NM] if is_on else [GREEN_NM, RED_NM]:
                points = find_stripes(given, nm).pixels
                if line is not None:
                    scores = [score_pair(name, fmt, points, line)]
                elif name in traced:
                    scores = score_lines(name, fmt, points, traced[name])
                else:
                    n, none = len(points), float("nan")
                    scores = [Score(name, fmt, f"off{nm:.0f}", n, none, none, n)]
                yield Shot(image, points, scores)


def text_line(score: Score) -> str:
    """Return one line of the table."""
    name = score.picture.split("/")[1].rsplit(".", 1)[0].removeprefix("docs_images_")
    share = "" if np.isnan(score.found) else f"{score.found:7.1%} weakest {score.weakest:6.1%}"
    return (
        f"{name[-28:]:28} {score.format:5} {score.group:6} {share:23} points {score.n_points:6} "
        f"elsewhere {score.elsewhere:5}"
    )


def summary(scores: Sequence[Score]) -> list[str]:
    """Return a Markdown table, one row for each set and group, as docs/real-light.md has it."""
    formats = list(dict.fromkeys(s.format for s in scores))
    lines = [f"| pictures | lines | {' | '.join(formats)} |", "|---|---|" + "---|" * len(formats)]
    for folder, group in sorted({(s.picture.split("/")[0], s.group) for s in scores}):
        of = [s for s in scores if s.picture.startswith(f"{folder}/") and s.group == group]
        cells = [_cell(group, [s for s in of if s.format == fmt]) for fmt in formats]
        lines.append(f"| {folder} | {group} | {' | '.join(cells)} |")
    return lines


def _cell(group: str, scores: Sequence[Score]) -> str:
    """Return what one group of lines of a set came to in one format."""
    if group.startswith("off"):
        clean = sum(s.n_points == 0 for s in scores)
        return f"{clean} of {len(scores)} without points, {sum(s.n_points for s in scores)} in all"
    found = [s.found for s in scores]
    if group == "pair":
        good = sum(share >= 0.9 for share in found)
        return f"{good} of {len(scores)} pairs by 90 %, median {np.median(found):.0%}"
    return (
        f"{min(found):.0%} to {max(found):.0%}, weakest line {min(s.weakest for s in scores):.0%}"
    )


def drawn(shot: Shot, width: int = 800) -> Image:
    """Return the picture, brightened where it is dark, and beside it the same with its points."""
    scale = width / shot.image.shape[1]
    how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_CUBIC
    plain = cv2.resize(shot.image, None, fx=scale, fy=scale, interpolation=how)
    if plain.mean() < _DARK:
        plain = np.rint(255.0 * np.sqrt(plain / 255.0)).astype(np.uint8)
    picture = plain.copy()
    red = shot.scores[0].picture.startswith("red")
    for x, y in np.rint((shot.points + 0.5) * scale - 0.5).astype(int):
        cv2.circle(picture, (int(x), int(y)), 1, _ON_RED_BGR if red else _ON_GREEN_BGR, -1)
    both: Image = np.hstack([plain, picture])
    return both


def around_lines(shot: Shot, lines: Sequence[tuple[str, Array]]) -> Shot:
    """Return a shot cut to where its lines are."""
    height, width = shot.image.shape[:2]
    everything = np.concatenate([polyline for _, polyline in lines])
    margin = _MARGIN * width
    x0, y0 = np.clip(everything.min(axis=0) - margin, 0, (width, height)).astype(int)
    x1, y1 = np.clip(everything.max(axis=0) + margin, 0, (width, height)).astype(int)
    inside = ((shot.points >= (x0, y0)) & (shot.points < (x1, y1))).all(axis=1)
    points = shot.points[inside] - (x0, y0)
    return dataclasses.replace(shot, image=shot.image[y0:y1, x0:x1], points=points)


def sheets(found: Sequence[Shot]) -> dict[str, Image]:
    """Return one picture for each set: all its shots with lines, green ones cut to these."""
    traced = traced_lines()
    shots_of: dict[str, list[Shot]] = defaultdict(list)
    for shot in found:
        name, group = shot.scores[0].picture, shot.scores[0].group
        if not group.startswith("off"):
            cut = around_lines(shot, traced[name]) if name.startswith("green") else shot
            shots_of[name.split("/")[0]].append(cut)
    return {folder: _in_columns(of) for folder, of in shots_of.items()}


def _in_columns(of: Sequence[Shot]) -> Image:
    """Return shots as one picture, two in a row unless there is but one."""
    columns = 1 if len(of) == 1 else 2
    tiles = [drawn(shot, _SHEET_WIDTH // (2 * columns)) for shot in of]
    rows = []
    for row in (tiles[i : i + columns] for i in range(0, len(tiles), columns)):
        height = max(len(tile) for tile in row)
        filled = [cv2.copyMakeBorder(t, 0, height - len(t), 0, 0, 0, value=_WHITE) for t in row]
        missing = [np.full_like(filled[0], 255)] * (columns - len(row))
        rows.append(np.hstack([*filled, *missing]))
    return np.vstack(rows)


def page(found: Sequence[Shot]) -> str:
    """Return one HTML page: every picture beside itself with the points drawn."""
    parts = ["<!doctype html><meta charset=utf-8><title>Real laser lines</title>"]
    parts.append("<style>body{font:14px sans-serif}img{max-width:100%}pre{margin:4px 0}</style>")
    for shot in found:
        jpg = cv2.imencode(".jpg", drawn(shot), [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()
        words = "\n".join(text_line(score) for score in shot.scores)
        code = base64.b64encode(jpg).decode()
        parts.append(f"<pre>{words}</pre><img src='data:image/jpeg;base64,{code}'>")
    return "\n".join(parts)


def main() -> int:
    """Print the table, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("samples", type=Path, help="folder of the photographs")
    parser.add_argument("--formats", default=",".join(FORMATS), help="such as png,jpg80,crf23")
    parser.add_argument("--page", type=Path, help="HTML page of all pictures, to write")
    parser.add_argument("--sheets", type=Path, help="folder for a JPEG file of each set's lines")
    given = parser.parse_args()
    found = []
    for shot in shots(given.samples, given.formats.split(",")):
        found.append(shot)
        print("\n".join(text_line(score) for score in shot.scores), flush=True)
    print("\n".join(["", *summary([score for shot in found for score in shot.scores])]))
    if given.page:
        given.page.write_text(page(found))
    if given.sheets:
        given.sheets.mkdir(parents=True, exist_ok=True)
        for folder, sheet in sheets(found).items():
            quality = [cv2.IMWRITE_JPEG_QUALITY, 70]
            cv2.imwrite(str(given.sheets / f"real-{folder}.jpg"), sheet, quality)
    return 0


if __name__ == "__main__":
    sys.exit(main())
