"""Time offset between the clocks of dive and vehicle, from common motion or from UTC.

The net is taken as still: when the vehicle turns right, the net's far normal turns left in the
dome's frame, and when its nose rises, the normal falls. So posture yaw changes opposite to heading,
and posture pitch opposite to the vehicle's pitch. `find_time_offset` compares rates between about
0.03 and 0.5 Hz: the bearing of the net itself, which changes as the vehicle moves along a cage, and
the compass's drift are slower.

`offset_from_clocks` compares the log's UTC with the creation time in a video's container.
"""

import contextlib
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray
from aqualvs.vehicle_logs.motion import (
    STEP_S,
    Channel,
    Match,
    OffsetScores,
    match_at,
    rates_of,
    robust_sigma,
    scores_of,
    without_outliers,
)
from aqualvs.vehicle_logs.vehicle_log import FIRST_BELIEVED_UTC_S, Signal, VehicleLog, utc_seconds

_LOBE_S = 1.0
"""Offsets within this distance of the best one belong to the same peak."""
_START_SIGMAS = 4.0
"""Sigmas of the clocks' offset within which the true one is expected."""


@dataclass(frozen=True, slots=True)
class PostureTrack:
    """Posture over a dive."""

    time_s: FloatArray  # Shape (n,): dive time, increasing.
    # Shape (n,): posture to the net in radians (paper, Eq. 24-26); undefined where not valid.
    yaw: FloatArray
    pitch: FloatArray
    # Shape (n,): where the posture is valid.
    valid: BoolArray

    def __post_init__(self) -> None:
        shapes = {np.shape(a) for a in (self.time_s, self.yaw, self.pitch, self.valid)}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1:
            raise ValueError(f"time_s, yaw, pitch and valid have shapes {shapes}; give one length")


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """Offset between two clocks: log time = dive time + offset_s."""

    offset_s: float  # Seconds.
    sigma_s: float  # Its standard deviation.
    # Of the vehicle's and the net's motion at this offset, 1 for full agreement; None if the offset
    # does not come from motion.
    correlation: float | None
    how: str  # Description of the source.


@dataclass(frozen=True, slots=True)
class OffsetRefusal:
    """Refusal of an offset, with the reason; falsy."""

    reason: str  # One line, with the remedy.

    def __bool__(self) -> Literal[False]:
        """Return False, so that `if offset:` reads well."""
        return False


def find_time_offset(
    log: VehicleLog, posture_track: PostureTrack, *, start: TimeOffset | None = None
) -> TimeOffset | OffsetRefusal:
    """Find the offset at which log and dive show the same motion.

    Parameters
    ----------
    log : VehicleLog
        Log with heading, pitch or both.
    posture_track : PostureTrack
        Posture of the dive.
    start : TimeOffset, optional
        Offset by the clocks. If motion alone is ambiguous, only offsets within four of its sigmas
        are considered.

    Returns
    -------
    offset : TimeOffset or OffsetRefusal
        A refusal if no offset is clearly the best: too little motion or overlap, or motion that
        repeats itself.

    Notes
    -----
    Each channel (yaw against heading, pitch against pitch) gives a correlation coefficient rho for
    every offset; the score is the sum of -n/2 log(1 - rho²) over channels with the right sign, n
    the number of independent pairs (Bartlett 1946). The best offset must explain blocks of three
    seconds better than every rival and than no motion at all, by 2.5 standard deviations of the
    blocks' differences (Vuong 1989). It is then refined by weighted least squares; its sigma comes
    from the scatter of the blocks' scores (sandwich estimate), so that it holds for correlated
    residuals.
    """
    channels = _channels(log, posture_track)
    if isinstance(channels, OffsetRefusal):
        return channels
    scores = scores_of(channels)
    found = _clear_peak(channels, scores, "")
    if not found and start is not None:
        near = np.abs(scores.offset_s - start.offset_s) <= _START_SIGMAS * start.sigma_s + _LOBE_S
        where = f" within {_START_SIGMAS * start.sigma_s:.0f} s of what the clocks say"
        nearby = replace(scores, overlap_s=np.where(near, scores.overlap_s, 0.0))
        found = _clear_peak(channels, nearby, where)
    if isinstance(found, OffsetRefusal):
        return found
    refined = _refine(channels, found)
    return refined if start is None else _compared(refined, start)


def _channels(log: VehicleLog, track: PostureTrack) -> tuple[Channel, ...] | OffsetRefusal:
    """Return the rates of the angles that both dive and log have, each on one grid."""
    pairs: list[tuple[str, Signal, Signal]] = []
    for name, values, logged in (
        ("yaw", track.yaw, log.heading),
        ("pitch", track.pitch, log.pitch),
    ):
        if logged is None:
            continue
        kept = without_outliers(values, track.valid)
        seen = Signal.from_samples(track.time_s[kept], values[kept])
        if seen is None:
            return OffsetRefusal("the dive has no valid posture; give the offset yourself")
        pairs.append((name, seen, logged))
    if not pairs:
        return OffsetRefusal(
            f"{log.name} holds neither heading nor pitch; give the offset yourself"
        )
    dive = min(a.time_s[0] for _, a, _ in pairs), max(a.time_s[-1] for _, a, _ in pairs)
    span = min(a.time_s[0] for _, _, a in pairs), max(a.time_s[-1] for _, _, a in pairs)
    longest_s = 24 * 3600.0
    for what, (begin, end) in (("the dive", dive), (log.name, span)):
        if end - begin > longest_s:
            return OffsetRefusal(
                f"{what} covers {(end - begin) / 3600.0:.0f} hours; cut it, or check that its "
                "times are seconds"
            )
    return tuple(
        Channel(name, rates_of(seen, *dive), rates_of(logged, *span))
        for name, seen, logged in pairs
    )


def _clear_peak(
    channels: tuple[Channel, ...], scores: OffsetScores, where: str
) -> float | OffsetRefusal:
    """Return the offset on the grid that is clearly the best."""
    min_overlap_s = 30.0
    enough = scores.overlap_s >= min_overlap_s
    if not enough.any():
        longest = float(scores.overlap_s.max(initial=0.0))
        return OffsetRefusal(
            f"dive and log share at most {longest:.0f} s with valid posture{where}, and "
            f"{min_overlap_s:.0f} s are needed; give the offset yourself"
        )
    peaks = _peaks(scores, enough)
    if not peaks:
        return OffsetRefusal(
            f"posture and log show no common motion at any offset{where}; give the offset yourself"
        )
    best, rivals = peaks[0], peaks[1:]
    margin, rival = _margin(channels, best, rivals)
    # Least number of standard deviations by which the best offset must exceed all others.
    min_margin = 2.5
    if margin >= min_margin:
        return best
    if rival is None:
        return OffsetRefusal(
            f"the motion common to posture and log is too small to determine the offset{where} "
            f"(best {best:.2f} s, {margin:.1f} sigma from chance); give the offset yourself"
        )
    return OffsetRefusal(
        f"offsets of {best:.2f} s and {rival:.2f} s explain the motion almost equally well{where} "
        f"({margin:.1f} sigma apart); give the offset yourself"
    )


def _peaks(scores: OffsetScores, allowed: BoolArray) -> list[float]:
    """Return the offsets of the best peaks, the highest first."""
    height = np.where(allowed, scores.score, 0.0)
    # Imported here: it takes a second, and only this function needs it.
    from scipy.signal import find_peaks

    # Padded, since a peak may be the first or the last.
    tops, _ = find_peaks(np.pad(height, 1), height=1e-9, distance=round(_LOBE_S / STEP_S))
    ranked = tops[np.argsort(height[tops - 1])[::-1]] - 1
    n_rivals = 30
    return [float(scores.offset_s[i]) for i in ranked[: n_rivals + 1]]


def _margin(
    channels: tuple[Channel, ...], best: float, rivals: list[float]
) -> tuple[float, float | None]:
    """Return the margin of the best offset over the strongest rival, in sigmas, and that rival.

    The rival is None if it is the hypothesis that there is no common motion.
    """
    at_best = [match_at(channel, best) for channel in channels]
    scales = [_scale(match) for match in at_best]
    without_motion = [c.seen.rate for c in channels]
    chosen = [match.residual for match in at_best]
    least, strongest = _advantage(without_motion, chosen, scales), None
    for rival in rivals:
        others = [match_at(channel, rival).residual for channel in channels]
        advantage = _advantage(others, chosen, scales)
        if advantage < least:
            least, strongest = advantage, rival
    return least, strongest


def _scale(match: Match) -> float:
    spread = robust_sigma(match.residual[match.predicted])
    return spread if spread > 0.0 else 1.0


def _advantage(others: list[FloatArray], chosen: list[FloatArray], scales: list[float]) -> float:
    """Return by how many sigmas the chosen residuals are smaller, from sums over blocks."""
    gain = np.zeros(len(chosen[0]))
    for other, residual, scale in zip(others, chosen, scales, strict=True):
        gain += (other / scale) ** 2 - (residual / scale) ** 2
    sums = _blocks(gain)
    spread = math.sqrt(float(sums @ sums))
    return float(sums.sum()) / spread if spread > 0.0 else 0.0


def _blocks(values: FloatArray) -> FloatArray:
    """Return the sums over blocks."""
    # Longer than a single motion, so that blocks are independent.
    block_s = 3.0
    return np.add.reduceat(values, np.arange(0, len(values), round(block_s / STEP_S)))


def _refine(channels: tuple[Channel, ...], start_s: float) -> TimeOffset:
    """Return the offset that fits best by weighted least squares, with its sandwich sigma."""
    offset = start_s
    max_iterations, converged_s = 8, 1e-5
    for _ in range(max_iterations):
        gradient, curvature = _normal_equation(channels, offset, _weights(channels, offset))
        step = float(np.clip(gradient.sum() / curvature.sum(), -_LOBE_S / 4, _LOBE_S / 4))
        offset += step
        if abs(step) < converged_s:
            break
    matches = [match_at(channel, offset) for channel in channels]
    best = max(match.correlation for match in matches)
    shared_s = STEP_S * max(np.count_nonzero(match.predicted) for match in matches)
    parts = [
        f"{channel.name} (correlation {match.correlation:.2f}, share {match.gain:.2f})"
        for channel, match in zip(channels, matches, strict=True)
    ]
    how = f"motion over {shared_s:.0f} s: {' and '.join(parts)}"
    return TimeOffset(offset, _sigma(channels, offset), best, how)


def _weights(channels: tuple[Channel, ...], offset_s: float) -> list[FloatArray]:
    """Return Huber's weights of each channel's samples, divided by the residuals' variance."""
    weights = []
    huber = 1.5
    for channel in channels:
        match = match_at(channel, offset_s)
        scale = _scale(match)
        size = np.abs(match.residual) / scale
        weights.append(1.0 / np.maximum(size / huber, 1.0) / scale**2)
    return weights


def _normal_equation(
    channels: tuple[Channel, ...], offset_s: float, weights: list[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return the terms (n,) of each sample in the negative gradient and in the curvature.

    The derivative of a residual by the offset is the gain times the slope of the logged rate.
    """
    n = len(channels[0].seen.rate)
    gradient, curvature = np.zeros(n), np.full(n, 1e-300)
    for channel, weight in zip(channels, weights, strict=True):
        match = match_at(channel, offset_s)
        change = match.gain * match.slope
        gradient -= np.where(match.predicted, weight * change * match.residual, 0.0)
        curvature += np.where(match.predicted, weight * change**2, 0.0)
    return gradient, curvature


def _sigma(channels: tuple[Channel, ...], offset_s: float) -> float:
    """Return the standard deviation of the offset from the scatter of the blocks' gradients.

    The derivative of the gradient is taken by differences: noise in the log makes its slopes, and
    with them the curvature, too large. Each block's gradient is increased according to its leverage
    (MacKinnon & White 1985, HC3), which matters if the offset depends on a few turns.
    """
    weights = _weights(channels, offset_s)
    gradient, curvature = _normal_equation(channels, offset_s, weights)
    shares = _blocks(curvature) / curvature.sum()
    sums = _blocks(gradient) / np.maximum(1.0 - shares, 0.1)
    probe_s = 0.1
    later, _ = _normal_equation(channels, offset_s + probe_s, weights)
    earlier, _ = _normal_equation(channels, offset_s - probe_s, weights)
    derivative = float(earlier.sum() - later.sum()) / (2.0 * probe_s)
    slope = derivative if derivative > 0.0 else float(curvature.sum())
    return math.sqrt(float(sums @ sums)) / slope


def _compared(found: TimeOffset, start: TimeOffset) -> TimeOffset:
    """Return the offset with a comparison with that of the clocks in its description."""
    difference = start.offset_s - found.offset_s
    sigma = math.hypot(found.sigma_s, start.sigma_s)
    verdict = "agree" if abs(difference) <= _START_SIGMAS * sigma else "are not to be trusted"
    return replace(found, how=f"{found.how}; the clocks {verdict} ({difference:+.1f} s off)")


VIDEO_UTC_SIGMA_S = 5.0
"""Standard deviation of a video's creation time: containers state whole seconds, some the end of
recording or the time of copying, and few cameras' clocks are set more accurately."""


def dive_start_utc(video: str | Path) -> float | None:
    """Return the UTC of a video's creation according to its container, in seconds since 1970.

    Only the container's `creation_time` is used; times of the file change when it is copied. None
    if the container does not state it, or states the zero of its calendar.
    """
    import av

    try:
        with av.open(str(video), metadata_errors="ignore") as container:
            stamps = [container.metadata.get("creation_time")]
            stamps += [stream.metadata.get("creation_time") for stream in container.streams.video]
    except (av.error.FFmpegError, OSError):
        return None
    for stamp in filter(None, stamps):
        with contextlib.suppress(ValueError):
            if utc_seconds(stamp) > FIRST_BELIEVED_UTC_S:
                return utc_seconds(stamp)
    return None


def offset_from_clocks(
    log: VehicleLog, dive_start_utc_s: float | None, sigma_s: float = VIDEO_UTC_SIGMA_S
) -> TimeOffset | OffsetRefusal:
    """Return the offset by the clocks of dive and log.

    `dive_start_utc_s`: UTC of dive time 0, with the standard deviation `sigma_s`.
    """
    if log.start_utc_s is None or log.start_utc_sigma_s is None:
        return OffsetRefusal(f"{log.name} does not know the time of day")
    if dive_start_utc_s is None:
        return OffsetRefusal("the dive does not know the time of day")
    return TimeOffset(
        dive_start_utc_s - log.start_utc_s,
        math.hypot(sigma_s, log.start_utc_sigma_s),
        None,
        "clocks of dive and log",
    )
