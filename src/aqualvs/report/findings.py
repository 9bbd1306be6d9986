"""Headline numbers and warnings of a run's report, in plain words."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from aqualvs.geometry.arrays import FloatArray
from aqualvs.report.charts import reason_counts, stretch_span_s, stretch_text, stretches
from aqualvs.report.frames import SampleFrame
from aqualvs.report.html import Card
from aqualvs.report.points import PointSummary
from aqualvs.report.run_data import Track, mapping
from aqualvs.text import clock, count_text, sentence, signed


def headline(track: Track) -> list[Card]:
    """Return the numbers at the top of the report."""
    share, frames = float(track.valid.mean()), count_text(len(track), "frame")
    valid = f"{int(track.valid.sum())} of {frames}"
    seconds = float(track.time_s[-1] - track.time_s[0])
    rate = f", {(len(track) - 1) / seconds:.3g} per second" if seconds > 0.0 else ""
    cards = [
        _posture_card("Range", "mm", 0, track, scale=1e3, digits=1),
        _posture_card("Pitch", "°", 1, track, scale=1.0, digits=2),
        _posture_card("Yaw", "°", 2, track, scale=1.0, digits=2),
        Card("Frames with a posture", f"{100 * share:.1f} %", valid),
        Card("Duration", clock(seconds), frames + rate),
    ]
    water = track.n_water[np.isfinite(track.n_water)]
    if len(water):
        note = "fresh water is about 1.335, sea water 1.342"
        if np.ptp(water) > 1e-4:
            note = f"{water.min():.4f} to {water.max():.4f} over the dive"
        cards.append(Card("Water's refractive index", f"{np.median(water):.4f}", note))
    return cards


def warnings_of(
    track: Track,
    points: PointSummary | None,
    pictures: Mapping[int, SampleFrame],
    run: Mapping[str, Any],
    working_range: tuple[float, float] | None,
    names: list[str],
) -> list[str]:
    """Return what the reader of the report should know, most important first."""
    return [
        *_status_warnings(run, track),
        *_summary_text(run, "laser_agreement"),
        *_summary_text(run, "net_check"),
        *_gap_warnings(track),
        *_range_warnings(track, working_range),
        *_precision_warnings(track),
        *(_laser_warnings(points, names) if points is not None else ()),
        *_picture_warnings(pictures),
        *_water_warnings(track),
        *_own_warnings(run),
    ]


def errors_against(truth: FloatArray, posture: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Return rms and greatest absolute error (3,) each, and the number of frames compared.

    `truth`, `posture`, shape (N, 3): range in metres, pitch and yaw in degrees; NaN where there is
    none.
    """
    error = posture - truth
    error = error[np.isfinite(error).all(axis=1)]
    if not len(error):
        return np.full(3, np.nan), np.full(3, np.nan), 0
    return np.sqrt((error**2).mean(axis=0)), np.abs(error).max(axis=0), len(error)


def _posture_card(
    name: str, unit: str, column: int, track: Track, *, scale: float, digits: int
) -> Card:
    values = scale * track.posture[track.valid, column]
    if not len(values):
        return Card(name, "–", "no frame gave a posture")
    sign, gap = ("", " ") if column == 0 else ("+", "")
    note = f"{values.min():{sign}.{digits}f} to {values.max():{sign}.{digits}f}{gap}{unit}"
    sigmas = (scale * all_[track.valid, column] for all_ in (track.sigma, track.sigma_total))
    frame, total = (sigma[np.isfinite(sigma)] for sigma in sigmas)
    if len(frame):
        note += f"; σ typically {np.median(frame):.{digits}f}{gap}{unit} by the frame's noise, "
        note += f"{np.median(total):.{digits}f}{gap}{unit} with the rig's uncertainty"
    value = f"{np.median(values):{sign}.{digits}f}{gap}{unit}"
    return Card(name, signed(value), signed(f"median; {note}"))


def _status_warnings(run: Mapping[str, Any], track: Track) -> Iterator[str]:
    status = run.get("status")
    if status is not None and status != "finished":
        until = clock(float(track.time_s[-1]))
        yield f"The run did not finish (status: {status}); this page covers it up to {until}."
    n_frames = mapping(run, "summary").get("n_frames")
    if isinstance(n_frames, int) and n_frames > len(track):
        yield f"posture.csv holds {len(track)} of the run's {n_frames} frames: it is truncated."
    if run.get("error"):
        yield f"The run ended with: {run['error']}"
    share = float(track.valid.mean())
    if share < 0.5:
        example = mapping(run, "summary").get("refused_example")
        why = f" {sentence(example)}" if isinstance(example, str) else ""
        yield f"Only {100 * share:.0f} % of the frames gave a posture.{why}"
    elif share < 0.75:
        reason, count = reason_counts(track)[0]
        yield (
            f"{100 * (1.0 - share):.0f} % of the frames gave no posture; the commonest reason: "
            f"{reason} ({count_text(count, 'frame')})."
        )


def _summary_text(run: Mapping[str, Any], name: str) -> Iterator[str]:
    """Yield what a part of the run's summary has to say, as a sentence."""
    words = mapping(mapping(run, "summary"), name).get("words")
    if isinstance(words, str) and words:
        yield sentence(words)


def _gap_warnings(track: Track) -> Iterator[str]:
    spans = [(*stretch_span_s(found, track), found) for found in stretches(track)]
    long_gap_s, max_gaps = 2.0, 3
    long = [(end - start, start, found) for start, end, found in spans if end - start > long_gap_s]
    long.sort(key=lambda gap: -gap[0])
    for length, start, found in long[:max_gaps]:
        words = stretch_text(found, track)
        yield f"No posture for {clock(length)} from {clock(start)} on: {words}."
    if len(long) > max_gaps:
        yield f"{len(long) - max_gaps} more gaps longer than {long_gap_s:g} s."


def _range_warnings(track: Track, working_range: tuple[float, float] | None) -> Iterator[str]:
    if working_range is None:
        return
    near, far = working_range
    ranges = track.posture[track.valid, 0]
    outside = int(((ranges < near) | (ranges > far)).sum())
    if outside:
        frames = f"{count_text(outside, 'frame')} {'lies' if outside == 1 else 'lie'}"
        yield (
            f"{frames} outside the rig's working range of {1e3 * near:.0f}–{1e3 * far:.0f} mm; "
            "values outside are less accurate."
        )


def _precision_warnings(track: Track) -> Iterator[str]:
    relative = track.sigma_total[track.valid, 0] / track.posture[track.valid, 0]
    loose_share = 0.02
    loose = float((relative > loose_share).mean()) if len(relative) else 0.0
    if loose > 0.05:
        yield f"{100 * loose:.0f} % of the ranges have a sigma above {100 * loose_share:g} %."
    n_points = track.n_points[track.valid & np.isfinite(track.n_points)]
    few_points = 60
    if len(n_points) and np.median(n_points) < few_points:
        yield (
            f"Few points on the target: {np.median(n_points):.0f} in a typical frame. "
            "Check focus, exposure and the lasers."
        )


def _laser_warnings(points: PointSummary, names: list[str]) -> Iterator[str]:
    used = points.on_target.sum(axis=0)
    total = used.sum()
    for index, name in enumerate(names):
        share = used[index] / total if total else 0.0
        if total and share < 0.3 / len(names):
            yield f"Laser “{name}” gave only {100 * share:.1f} % of the target points."


def _picture_warnings(pictures: Mapping[int, SampleFrame]) -> Iterator[str]:
    shares = np.array([picture.saturated for picture in pictures.values()])
    shares = shares[np.isfinite(shares)]
    if len(shares) and np.median(shares) > 0.5:
        yield (
            f"Stripes are saturated in the sample frames ({100 * np.median(shares):.0f} % of "
            "their points): shorten the exposure or dim the lasers."
        )


def _water_warnings(track: Track) -> Iterator[str]:
    water = track.n_water[np.isfinite(track.n_water)]
    water_step = 5e-4
    if len(water) and np.ptp(water) > water_step:
        yield (
            f"The water's index changed by {np.ptp(water):.4f} during the dive: a change of "
            "medium, a leak, or a target that moved."
        )


def _own_warnings(run: Mapping[str, Any]) -> Iterator[str]:
    """Yield what the run itself put on record."""
    for place in (run, mapping(run, "summary")):
        found = place.get("warnings")
        if isinstance(found, list):
            yield from (sentence(str(words)) for words in found)
