"""Frames a second of the whole scanner on one core, next to plain OpenCV and NumPy.

Run `python -m benchmarks scanning` for a table. The reference does the same job on the same
pictures in the same run, as one would first write it: grey, blur, brightest pixel and centroid on
every search line inside areas drawn by hand, `cv2.undistortPoints`, Snell's law at both spheres,
plane intersection, least squares. It knows which laser is where; the scanner finds out. Frames
are held in memory, so that decoding does not count. On the wall the reference must agree with the
scanner before anything is reported; on the net it measures something, right or wrong.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.optics.dome import Dome
from aqualvs.optics.rig import Rig
from aqualvs.scanner import Scanner
from aqualvs.scanning.candidates import Subsegments, find_candidates
from aqualvs.scanning.detection import FrameDetector
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.posture import range_pitch_yaw
from aqualvs.scanning.posture_estimator import FitMethod, PostureEstimator
from aqualvs.scanning.scan import Frame
from aqualvs.scanning.stripe import StripeOptions
from aqualvs.scanning.surfaces import SurfaceFinder
from aqualvs.scanning.target import TargetKind, choose_target
from aqualvs.scanning.triangulate import Triangulator
from aqualvs.simulation.render import Renderer
from aqualvs.simulation.scenarios import bluerov2_rig, example_rig, load_scenario
from aqualvs.simulation.video import VideoWriter
from aqualvs.sources import open_source
from aqualvs.sources.base import bgr_of

U8 = NDArray[np.uint8]
# An area drawn by hand reaches this far to either side of the stripe, as a share of the width.
_DRAWN_SHARE = 0.05
_HALF_WINDOW_PX = 7
_MIN_PEAK = 25
_ROUNDS = 15


@dataclass(frozen=True)
class Case:
    """One picture, as the scanner and as the reference take it."""

    rig: Rig
    bgr: U8
    frame: Frame
    areas: list[BoolArray]
    along_x: list[bool]


def make_case(rig: Rig, scenario: str) -> Case:
    scene = load_scenario(scenario).scene_at(1.0)
    picture = Renderer(rig, threads=2).render(scene, 1.0, np.random.default_rng(0))
    frame = decoded(picture.image, rig.size_px)
    bgr = bgr_of(frame)
    laser_bands = plan_bands(rig, rig.camera())
    pixels = [picture.lit.pixels[picture.lit.laser == i] for i in range(len(rig.lasers))]
    return Case(
        rig,
        bgr,
        frame,
        [drawn_area(rig, pixels, i) for i in range(len(pixels))],
        [search.axis is SearchAxis.ALONG_X for search in laser_bands],
    )


def decoded(image: U8, size_px: tuple[int, int]) -> Frame:
    """The picture as a decoder delivers it: through H.264, on planes of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "dive.mp4"
        with VideoWriter(path, size_px, 25.0) as video:
            for _ in range(3):
                video.write(image)
        with open_source(str(path)) as source:
            frame = list(source)[-1]
    assert frame.chroma is not None
    u, v = frame.chroma
    return Frame(0, 0.0, np.array(frame.luma), (np.array(u), np.array(v)))


def drawn_area(rig: Rig, pixels: list[FloatArray], mine: int) -> BoolArray:
    """Pixels near a laser's stripe and not near another's, as the paper masks them."""
    width, height = rig.size_px
    reach = round(_DRAWN_SHARE * width)
    near = []
    for i in range(len(pixels)):
        dots = np.full((height, width), 255, np.uint8)
        x, y = np.rint(pixels[i]).astype(int).clip([0, 0], [width - 1, height - 1]).T
        dots[y, x] = 0
        far = cv2.distanceTransform(dots, cv2.DIST_L2, 5)
        near.append(far < (reach if i == mine else 2 * _HALF_WINDOW_PX))
    others = np.any([near[i] for i in range(len(near)) if i != mine], axis=0)
    area: BoolArray = near[mine] & ~others
    return area


def plain_detect(bgr: U8, areas: list[BoolArray], along_x: list[bool]) -> list[FloatArray]:
    """Pixels (N, 2) of every laser: the centroid around the brightest pixel of each line."""
    grey = cv2.cvtColor(bgr, cv2.COLOR_BGR2GRAY)
    blurred = cv2.GaussianBlur(grey, (5, 5), 0)
    found = []
    for area, rows in zip(areas, along_x, strict=True):
        image, inside = (blurred, area) if rows else (blurred.T, area.T)
        masked = np.where(inside, image, 0)
        peak = masked.argmax(axis=1)
        line = np.flatnonzero(masked.max(axis=1) > np.median(image) + _MIN_PEAK)
        window = peak[line, None] + np.arange(-_HALF_WINDOW_PX, _HALF_WINDOW_PX + 1)
        whole = (window[:, 0] >= 0) & (window[:, -1] < image.shape[1])
        line, window = line[whole], window[whole]
        weight = image[line[:, None], window].astype(np.float64)
        weight -= weight.min(axis=1, keepdims=True)
        total = weight.sum(axis=1)
        position = (weight * window).sum(axis=1) / np.where(total > 0.0, total, 1.0)
        order = (position, line) if rows else (line, position)
        found.append(np.stack(order, axis=-1)[total > 0.0].astype(np.float64))
    return found


def plain_points(rig: Rig, pixels: list[FloatArray]) -> FloatArray:
    """Points (N, 3) on the laser planes, through the dome."""
    camera = rig.camera()
    lens, dome = camera.lens, camera.housing
    assert isinstance(dome, Dome)
    matrix = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
    points = []
    for laser, at in zip(rig.lasers, pixels, strict=True):
        if not len(at):
            continue
        flat = cv2.undistortPoints(at[:, None], matrix, np.array(lens.distortion))[:, 0]
        d = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
        d = d / np.linalg.norm(d, axis=1, keepdims=True) @ camera.dome_from_cam.rotation.T
        p = camera.dome_from_cam.translation
        for radius, ratio in (
            (dome.inner_radius, camera.n_air / dome.n_acrylic),
            (dome.outer_radius, dome.n_acrylic / camera.n_water),
        ):
            along = np.sum(p * d, axis=1, keepdims=True)
            reach = np.sqrt(along**2 + radius**2 - np.sum(p * p, axis=-1, keepdims=True))
            p = p + (reach - along) * d
            cosine = reach / radius
            bent = np.sqrt(1.0 - ratio**2 * (1.0 - cosine**2))
            d = ratio * d - (ratio * cosine - bent) / radius * p
        distance = (laser.plane.offset - p @ laser.plane.normal) / (d @ laser.plane.normal)
        points.append((p + distance[:, None] * d)[distance > 0.0])
    return np.concatenate(points)


def plain_fit(points: FloatArray) -> tuple[float, float, float]:
    m = np.linalg.lstsq(points, np.ones(len(points)))[0]
    return range_pitch_yaw(m.astype(np.float64, copy=False))


def plain_scan(case: Case) -> tuple[float, float, float]:
    pixels = plain_detect(case.bgr, case.areas, case.along_x)
    return plain_fit(plain_points(case.rig, pixels))


def best_ms(call: Callable[[], object], rounds: int = _ROUNDS) -> float:
    """Least time of one call in milliseconds, after one that compiles."""
    call()
    best = np.inf
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - start)
    return 1e3 * best


def row(name: str, value: float, unit: str, reference: float | None) -> dict[str, Any]:
    """A row of the table; more frames a second are better, fewer milliseconds are."""
    ratio = None
    if reference is not None:
        ratio = value / reference if unit == "frames/s" else reference / value
    return {"name": name, "value": value, "unit": unit, "reference": reference, "ratio": ratio}


def stage_rows(case: Case, name: str) -> list[dict[str, Any]]:
    """Time the scanner's stages, each on what the one before it made."""
    rig, camera = case.rig, case.rig.camera()
    laser_bands = plan_bands(rig, camera)
    detector = FrameDetector(rig.size_px, laser_bands, StripeOptions())
    triangulator = Triangulator(rig, camera)
    processor = PostureEstimator(rig, laser_bands, FitMethod.ROBUST)
    finder = SurfaceFinder(rig)
    peaks = detector.detect(case.frame)
    candidates = find_candidates(peaks, laser_bands, triangulator)

    def surfaces() -> tuple[Subsegments, Any]:
        linked = candidates.linked()
        found = finder.find(linked)
        return linked.subsegments, choose_target(found, TargetKind.AUTO, rig.working_range)

    subsegments, target = surfaces()
    assert target is not None
    pixels = plain_detect(case.bgr, case.areas, case.along_x)
    points = plain_points(rig, pixels)
    stages: tuple[tuple[str, Callable[[], object], Callable[[], object] | None], ...] = (
        (
            "detect",
            lambda: detector.detect(case.frame),
            lambda: plain_detect(case.bgr, case.areas, case.along_x),
        ),
        (
            "read",
            lambda: find_candidates(peaks, laser_bands, triangulator),
            lambda: plain_points(rig, pixels),
        ),
        ("surfaces", surfaces, None),
        (
            "fit",
            lambda: processor.measure(candidates, subsegments, target),
            lambda: plain_fit(points),
        ),
    )
    return [
        row(f"{name}: {stage}", best_ms(ours), "ms", best_ms(plain) if plain else None)
        for stage, ours, plain in stages
    ]


def whole_row(case: Case, name: str) -> dict[str, Any]:
    scanner = Scanner(case.rig)
    posture = scanner.process(case.frame).posture
    assert posture, f"{name}: {posture}"
    if "wall" in name:
        plain = plain_scan(case)
        assert abs(plain[0] / posture.range - 1.0) < 0.01, (plain, posture)
    ours = 1e3 / best_ms(lambda: scanner.process(case.frame))
    return row(f"{name}: whole", ours, "frames/s", 1e3 / best_ms(lambda: plain_scan(case)))


def run() -> list[dict[str, Any]]:
    """Time the scanner on a wall and a net, small and wide.

    Returns
    -------
    list of dict
        name, value, unit, reference and ratio (how many times better than the reference); whole
        frames a second, then milliseconds of the stages. The search for surfaces has no plain
        counterpart: the reference is told which light is whose.
    """
    threads = cv2.getNumThreads()
    cases = []
    for rig in (example_rig(), bluerov2_rig()):
        for scenario in ("wall_yaw", "net_diamond"):
            name = f"{scenario.split('_')[0]} {rig.size_px[0]}x{rig.size_px[1]}"
            cases.append((make_case(rig, scenario), name))
    cv2.setNumThreads(1)
    try:
        whole = [whole_row(case, name) for case, name in cases]
        stages = [one for case, name in cases for one in stage_rows(case, name)]
    finally:
        cv2.setNumThreads(threads)
    return whole + stages
