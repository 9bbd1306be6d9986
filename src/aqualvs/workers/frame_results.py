"""Results of frames, a few frames at a time: measurement with and without the dome, in blocks."""

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar, cast, runtime_checkable

import numpy as np

from aqualvs.errors import AqualvsError
from aqualvs.geometry.arrays import FloatArray, IntArray
from aqualvs.optics.rig import Rig
from aqualvs.scanner import Scanner
from aqualvs.scanning.laser_bands import SearchAxis, plan_bands
from aqualvs.scanning.plane_fit import (
    PlaneFit,
    fit_robust,
    mark_inliers,
    plane_of_all,
    shared_error,
)
from aqualvs.scanning.posture import Posture, Reason, Refusal, posture_of
from aqualvs.scanning.scan import Frame, Scan
from aqualvs.scanning.stripe import StripePeaks
from aqualvs.scanning.triangulate import Triangulator

if TYPE_CHECKING:
    from aqualvs.scanning.row_motion import RowMotion

# Neighbouring points are redundant; a few hundred are enough for a comparison.
_EVERY = 4
_MIN_POINTS = 6


class BareLensComparison:
    """Measurement of a scan's posture with the rig's camera out of its housing.

    Detection, classification and the choice of the target are taken over from the scan, so that
    the difference is that of the ray model alone: the error of ignoring the dome (paper, section
    5.4).

    `rig`: a rig with a housing.
    """

    def __init__(self, rig: Rig) -> None:
        camera = rig.bare_camera()
        self._triangulator = Triangulator(rig, camera)
        self._along_x = np.array(
            [search.axis.value == "x" for search in plan_bands(rig, rig.camera())], np.int64
        )
        self._axis_in_dome = rig.dome_from_cam.rotate([0.0, 0.0, 1.0])

    def measure(self, scan: Scan) -> Posture | Refusal:
        """Return the bare-lens posture to the target of a scan, or the refusal in its place.

        However unlikely it looks, it is returned: what the bare lens makes of the target is what
        the comparison is about.
        """
        if not scan.posture:
            return scan.posture
        rows = np.flatnonzero(scan.points.used)[::_EVERY]
        laser = scan.points.laser[rows].astype(np.int64)
        placed = self._triangulator.triangulate(
            scan.points.pixels[rows], self._along_x[laser], laser
        )
        valid = placed.valid
        found, sensitivity = placed.points_in_dome[valid], placed.sensitivity[valid]
        if len(found) < _MIN_POINTS:
            return Refusal(Reason.TOO_FEW_POINTS, "a bare lens would see too few of the points")
        laser = laser[valid]
        fit = self._fit(found, sensitivity, laser)
        if fit is None:
            return Refusal(Reason.COLLINEAR, "the points do not fix a plane")
        group, inliers = np.arange(len(found)), np.empty(len(found), np.bool_)
        n_points, nearest, _ = mark_inliers(group, laser, fit.weights, False, found, inliers)
        return posture_of(fit, nearest, n_points, self._axis_in_dome)

    @staticmethod
    def _fit(points: FloatArray, sensitivity: FloatArray, laser: IntArray) -> PlaneFit | None:
        n, start = len(points), np.empty(3)
        if not plane_of_all(points, start):
            return None
        shared = shared_error(np.zeros(n))
        return fit_robust(points, sensitivity, np.ones(n), laser, np.zeros(n), start, shared)


T = TypeVar("T")


def block_length(size_px: tuple[int, int]) -> int:
    """Return how many frames make a block: a few, and less than 32 MB.

    Measuring eight frames step by step takes a third less than one after the other, between which
    the decoder displaces all code from the caches; more than eight gain nothing.
    """
    n_bytes = 3 * size_px[0] * size_px[1] // 2
    max_frames = 8
    max_bytes = 32 << 20
    return max(1, min(max_frames, max_bytes // n_bytes))


def in_blocks(
    items: Iterator[T], length: int, breaks: type[Exception] = AqualvsError
) -> Iterator[list[T]]:
    """Yield lists of up to `length` items; none is lost where their source breaks off.

    `breaks`: how it breaks off; raised after the items before it.
    """
    block: list[T] = []
    try:
        for item in items:
            block.append(item)
            if len(block) == length:
                yield block
                block = []
    except breaks:
        if block:
            yield block
        raise
    if block:
        yield block


def read_ahead(items: Iterator[T]) -> Iterator[T]:
    """Yield items that a thread fetches, up to two of them before they are wanted.

    An exception of `items` is raised where it belongs in the order. When the iteration is given up,
    the thread ends after the item that it is fetching.
    """
    end = object()
    with ThreadPoolExecutor(1, "frames") as thread:
        try:
            fetched = deque(thread.submit(next, items, end) for _ in range(2))
            while (item := fetched.popleft().result()) is not end:
                fetched.append(thread.submit(next, items, end))
                yield cast("T", item)
        finally:
            thread.shutdown(cancel_futures=True)


class ScanInputs(NamedTuple):
    """Rig and stripe peaks that a scan was computed from, for recordings."""

    rig: Rig  # In the water as known at the time of the frame.
    peaks: dict[SearchAxis, StripePeaks]


class FrameScanner(Protocol):
    """Interface of a scanner for a run."""

    def process(self, frame: Frame) -> Scan:
        """Return the scan of one frame."""


@runtime_checkable
class RecordableScanner(FrameScanner, Protocol):
    """Base of scanners that also return what they compute their scans from."""

    def process(self, frame: Frame) -> Scan:
        """Return the scan of one frame."""
        return self.process_with_inputs(frame)[0]

    def process_with_inputs(self, frame: Frame) -> tuple[Scan, ScanInputs]:
        """Return the scan of one frame, and its inputs."""


@dataclass(frozen=True, slots=True)
class FrameResult:
    """Result of one frame."""

    scan: Scan
    # Result when the dome is ignored; None for a rig without a dome.
    bare: Posture | Refusal | None
    # None for a frame that was lost, or that another process has measured.
    frame: Frame | None = None
    # Rig and stripes that the scan was computed from; None where the scanner does not return them.
    inputs: "ScanInputs | None" = None
    # Whether the scan is that of a frame that could not be decoded.
    is_lost: bool = False


class FrameProcessor:
    """Measurement of frames, with the dome and without.

    `scanner`: for the same rig.
    """

    def __init__(self, rig: Rig, scanner: FrameScanner) -> None:
        self._scanner = scanner
        # How many frames it is best given at a time.
        self.block_length = block_length(rig.size_px) if isinstance(scanner, Scanner) else 1
        self._bare_lens = BareLensComparison(rig) if rig.housing is not None else None

    def measure(self, frames: Sequence[Frame]) -> list[FrameResult]:
        """Measure frames, in their order."""
        return [
            FrameResult(scan, self._bare(scan), frame, inputs)
            for (scan, inputs), frame in zip(self._scans(frames), frames, strict=True)
        ]

    def lost(self, scan: Scan) -> FrameResult:
        """Complete the scan of a lost frame."""
        return FrameResult(scan, self._bare(scan), is_lost=True)

    def _bare(self, scan: Scan) -> Posture | Refusal | None:
        return None if self._bare_lens is None else self._bare_lens.measure(scan)

    def _scans(self, frames: Sequence[Frame]) -> list[tuple[Scan, ScanInputs | None]]:
        scanner = self._scanner
        if isinstance(scanner, RecordableScanner):
            return [scanner.process_with_inputs(frame) for frame in frames]
        if not isinstance(scanner, Scanner) or type(scanner).process is not Scanner.process:
            return [(scanner.process(frame), None) for frame in frames]
        # Step by step for all frames: code that has just run is still in the caches, from which
        # decoding and the other step would displace it.
        peaks = [scanner.detect(frame) for frame in frames]
        scans: list[tuple[Scan, ScanInputs | None]] = []
        for frame, found in zip(frames, peaks, strict=True):
            scan = scanner.measure(frame.index, frame.time_s, found)
            found, scan = scanner.without_colour(frame, found, scan)
            scans.append((scan, ScanInputs(scanner.rig, found)))
        return scans


def corrected_rows(
    blocks: Generator[list[FrameResult], None, None], rig: Rig
) -> Generator[list[FrameResult], None, None]:
    """Yield results corrected to the middle of each rolling-shutter picture, blurred ones refused.

    Results of shutters that need no neighbours are yielded unchanged. Others come a few frames
    late, when the frames after them are known; none is lost where their source breaks off.

    `blocks`: results as measured, in the order of the dive; closed at the end.
    """
    with closing(blocks):
        if not rig.shutter.needs_neighbours:
            yield from blocks
            return
        from aqualvs.scanning.row_motion import REACH, RowMotion

        motion, measured, n_done = RowMotion(rig), list[FrameResult](), 0
        block: list[FrameResult] | None = []
        broken_off = None
        while block is not None:
            try:
                block = next(blocks, None)
            except AqualvsError as fault:
                block, broken_off = None, fault
            measured += block or []
            stop = max(n_done, len(measured) - (0 if block is None else REACH))
            if stop > n_done:
                yield [_corrected(motion, measured, i, REACH) for i in range(n_done, stop)]
            n_done = min(stop, REACH)
            del measured[: stop - n_done]
        if broken_off is not None:
            raise broken_off


def _corrected(
    motion: "RowMotion", measured: Sequence[FrameResult], i: int, reach: int
) -> FrameResult:
    """Return a result corrected to its picture's middle by up to `reach` results on each side."""
    one = measured[i]
    beside = [*measured[max(i - reach, 0) : i], *measured[i + 1 : i + 1 + reach]]
    scan = motion.correct(one.scan, [other.scan for other in beside])
    seen, found, bare = one.scan.posture, scan.posture, one.bare
    if isinstance(seen, Posture) and isinstance(found, Posture) and isinstance(bare, Posture):
        # The same motion, seen by a camera without its dome.
        bare = motion.moved(bare, found.numbers - seen.numbers)
    elif bare is not None and isinstance(found, Refusal):
        bare = found
    return replace(one, scan=scan, bare=bare)


def result_blocks(
    blocks: Iterator[list[tuple[list[Scan], Frame]]], processor: FrameProcessor
) -> Generator[list[FrameResult], None, None]:
    """Yield the results of blocks of frames, and of lost frames, in the order of the dive.

    `blocks`: frames, each with the scans of the lost frames right before it, see `with_losses`.
    """
    for block in blocks:
        results = list[FrameResult]()
        measured = processor.measure([frame for _, frame in block])
        for (lost, _), result in zip(block, measured, strict=True):
            results += [*map(processor.lost, lost), result]
        yield results
