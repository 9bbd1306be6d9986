import re
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from aqualvs.geometry.arrays import FloatArray
from aqualvs.report.calibration_charts import residual_view
from aqualvs.report.calibration_material import ResidualMap, Series
from aqualvs.report.svg import Axis, decimals, line_chart, num, round_step, sampled

NASTY = "<b>&\"'</b>"
WIDTH, HEIGHT = 720, 576
# Where the frame of the vectors' chart begins and how wide it is, in the chart's own unit.
LEFT, HEAD, FRAME = 50.0, 30.0, 702.0
# Places are written to a tenth.
TENTH = 0.051


def parsed(html: str) -> ElementTree.Element:
    """Read a fragment as XML, which is stricter than HTML."""
    return ElementTree.fromstring(f"<div>{html}</div>")


def drawing(html: str, kind: str) -> ElementTree.Element:
    return next(svg for svg in parsed(html).iter("svg") if svg.get("class") == kind)


def numbers(path: str) -> list[float]:
    return [float(found) for found in re.findall(r"-?\d+(?:\.\d+)?", path)]


def residual_map(**changes: Any) -> ResidualMap:
    rng = np.random.default_rng(5)
    n = 400
    pixels = rng.uniform((10, 10), (700, 560), (n, 2))
    given: dict[str, Any] = {
        "title": "in air",
        "size_px": (WIDTH, HEIGHT),
        "pixels": pixels,
        "residuals": rng.normal(0.0, 0.1, (n, 2)),
        "view_index": np.arange(n) % 5,
        "inliers": np.ones(n, dtype=bool),
    }
    return ResidualMap(**(given | changes))


def series(**changes: Any) -> Series:
    x = np.linspace(0.0, 60.0, 301)
    given: dict[str, Any] = {
        "title": "index of the water",
        "x_label": "time, s",
        "y_label": "index",
        "x": x,
        "y": 1.3333 + 1e-4 * np.sin(x),
    }
    return Series(**(given | changes))


def curves(html: str) -> list[str]:
    """Return the path data of the line of a chart, one for each unbroken piece."""
    paths = drawing(html, "line-chart").iter("path")
    line = next(p.get("d", "") for p in paths if p.get("stroke-width") == "2")
    return [piece for piece in line.split("M") if piece]


@given(st.floats(1e-9, 1e9))
def test_round_steps_are_round_and_just_large_enough(least: float) -> None:
    step = round_step(least)
    mantissa = f"{step:e}".split("e")[0]
    assert float(mantissa) in (1.0, 2.0, 5.0)
    # Neighbours in 1, 2, 5, 10 differ by 2.5 at most; 1e-8 is for the powers' rounding.
    assert least * (1 - 1e-8) <= step <= 2.5 * least * (1 + 1e-8)


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.integers(2, 9))
def test_ticks_say_where_they_stand(low: float, span: float, count: int) -> None:
    axis = Axis(low, low + span, 100.0, 900.0)
    ticks = axis.ticks(count)
    assert len(ticks) <= count + 1
    step = round_step(span / count)
    for place, text in ticks:
        # Values are exact to the step's last decimal; a millionth of a step covers rounding.
        assert axis.at(float(text.replace("−", "-"))) == pytest.approx(
            place, abs=800 * step / span * 1e-3
        )
        assert 100 - 1e-3 <= place <= 900 + 1e-3
        assert text not in ("−0", "−0.0")


@pytest.mark.parametrize(
    ("step", "expected"), [(0.002, 3), (0.1, 1), (0.5, 1), (1.0, 0), (20.0, 0), (1e-6, 6)]
)
def test_steps_show_as_many_decimals_as_they_need(step: float, expected: int) -> None:
    assert decimals(step) == expected


def test_places_are_short() -> None:
    assert [num(v) for v in (3.0, -0.01, 2.25, -7.04, 1e4)] == ["3", "0", "2.2", "-7", "10000"]


def test_samples_are_the_same_every_time() -> None:
    rows = sampled(10_000, 300)
    np.testing.assert_array_equal(rows, sampled(10_000, 300))
    assert len(np.unique(rows)) == 300
    assert np.all(np.diff(rows) > 0)
    np.testing.assert_array_equal(sampled(7, 300), np.arange(7))
    assert len(sampled(7, 0)) == 0


def test_line_is_broken_where_values_are_missing() -> None:
    y = series().y.copy()
    y[100:120] = np.nan
    y[200] = np.inf
    assert len(curves(line_chart(series()))) == 1
    assert len(curves(line_chart(series(y=y)))) == 3


def test_line_lies_where_its_axes_say() -> None:
    chart = line_chart(series(x=np.array([0.0, 10.0]), y=np.array([0.0, 100.0])))
    texts = list(drawing(chart, "line-chart").iter("text"))
    across = {t.text: float(t.get("x", "")) for t in texts if t.get("text-anchor") == "middle"}
    # Numbers of the vertical axis stand five below the line that they name.
    up = {t.text: float(t.get("y", "")) - 5.0 for t in texts if t.get("text-anchor") == "end"}
    assert numbers(curves(chart)[0]) == pytest.approx(
        [across["0"], up["0"], across["10"], up["100"]], abs=2 * TENTH
    )


def test_band_is_one_sigma_wide() -> None:
    y, x = np.array([0.0, 100.0, 0.0]), np.array([0.0, 1.0, 2.0])
    chart = line_chart(series(x=x, y=y, sigma=np.full(3, 4.0)))
    middle = np.array(numbers(curves(chart)[0])[1::2])
    band = next(
        p.get("d", "") for p in drawing(chart, "line-chart").iter("path") if "Z" in p.get("d", "")
    )
    edge = np.array(numbers(band)[1::2])
    low, high = edge[:3], edge[3:][::-1]
    unit = (middle[0] - middle[1]) / 100.0
    # Two places, each to a tenth.
    np.testing.assert_allclose(low - middle, 4.0 * unit, atol=2 * TENTH)
    np.testing.assert_allclose(middle - high, 4.0 * unit, atol=2 * TENTH)


def test_huge_first_sigma_does_not_flatten_the_line() -> None:
    sigma = np.full(301, 2e-5)
    sigma[:5] = 0.3
    sigma[7] = np.inf
    y = np.array(numbers("".join(curves(line_chart(series(sigma=sigma)))))[1::2])
    assert np.ptp(y) > 100.0


def test_level_and_marks_are_drawn_and_named() -> None:
    chart = line_chart(
        series(level=(f"prior {NASTY}", 1.3340), marks=((20.0, f"step {NASTY}"), (500.0, "late")))
    )
    said = "".join(parsed(chart).itertext())
    assert f"prior {NASTY}" in said
    assert f"step {NASTY}" in said
    assert "late" not in said
    strokes = [p.get("stroke-dasharray") for p in drawing(chart, "line-chart").iter("path")]
    assert strokes.count("7 5") == 1
    assert strokes.count("3 3") == 1


def test_unknown_level_is_left_out() -> None:
    chart = line_chart(series(level=("prior", float("nan")), marks=((float("nan"), "when?"),)))
    assert "prior" not in chart
    assert "when?" not in chart
    assert "nan" not in chart


def test_words_of_marks_do_not_touch() -> None:
    marks = tuple((20.0 + 0.4 * i, f"event number {i}, long words") for i in range(30))
    chart = drawing(line_chart(series(marks=marks)), "line-chart")
    words = [t for t in chart.iter("text") if t.get("class") == "mark-words"]
    assert 3 <= len(words) <= 12
    spans = [(float(t.get("y", "")), float(t.get("x", "")), len(t.text or "") * 7.0) for t in words]
    for i, (y, x, width) in enumerate(spans):
        assert x + width <= 900.0
        for other_y, other_x, other_width in spans[i + 1 :]:
            assert y != other_y or x + width <= other_x or other_x + other_width <= x
    lines = [p for p in chart.iter("path") if p.get("stroke-dasharray") == "3 3"]
    assert len(lines) == 30


@pytest.mark.parametrize("y", [[1.33], [1.33, 1.33, 1.33], [0.0, 0.0]])
def test_constant_series_are_drawn(y: list[float]) -> None:
    values = np.array(y)
    chart = line_chart(series(x=np.arange(len(values)) * 1.0, y=values))
    assert curves(chart)
    assert "nan" not in chart
    assert "inf" not in chart


def test_series_without_values_says_so() -> None:
    empty = series(x=np.empty(0), y=np.empty(0))
    for chart in (line_chart(empty), line_chart(series(y=np.full(301, np.nan)))):
        assert "No value is known" in chart


def test_long_series_stay_small_and_keep_their_peak() -> None:
    x = np.arange(100_000) * 0.04
    y = np.zeros(len(x))
    y[54_321] = 5.0
    chart = line_chart(series(x=x, y=y, sigma=np.full(len(x), 0.1)))
    assert len(chart) < 60_000
    places = np.array(numbers("".join(curves(chart)))[1::2])
    assert np.ptp(places) > 100.0


def vectors(html: str, colour: str = "var(--accent)") -> FloatArray:
    """Return start and vector of every point drawn, in the chart's unit, shape (N, 4)."""
    inner = drawing(html, "map")
    found = []
    for path in [p for g in inner.iter("g") if g.get("stroke") == colour for p in g.iter("path")]:
        if path.get("stroke-width") == "1.1":
            found += numbers(path.get("d", ""))
    return np.array(found).reshape(-1, 4)


def crosses(html: str) -> int:
    paths = drawing(html, "map").iter("path")
    return sum(path.get("d", "").count("m0 -8l-8 8") for path in paths)


def magnification(html: str) -> tuple[float, float, float]:
    """Return the scale bar's residual, the factor in words, and the bar's length as drawn."""
    chart = drawing(html, "map")
    words = next(t.text or "" for t in chart.iter("text") if t.get("class") == "strong")
    found = re.match(r"([\d.]+) px; residuals are drawn ([\d,.e+]+) times", words)
    assert found is not None
    bar = next(p for p in chart.iter("path") if p.get("stroke-width") == "2")
    x0, _, x1, _ = numbers(bar.get("d", ""))
    return float(found[1]), float(found[2].replace(",", "")), x1 - x0


@pytest.mark.parametrize("noise", [1e-3, 0.1, 7.0])
def test_vectors_have_the_length_that_the_legend_says(noise: float) -> None:
    found = residual_map(residuals=np.random.default_rng(1).normal(0.0, noise, (400, 2)))
    html = residual_view(found, [])
    residual, factor, length = magnification(html)
    assert length == pytest.approx(residual * factor * FRAME / WIDTH, abs=2 * TENTH)
    assert 40.0 < length < 130.0
    drawn = vectors(html)
    assert len(drawn) == 400
    order = np.argsort(found.view_index, kind="stable")
    starts = np.array([LEFT, HEAD]) + (found.pixels[order] + 0.5) * FRAME / WIDTH
    np.testing.assert_allclose(drawn[:, :2], starts, atol=TENTH)
    wanted = found.residuals[order] * factor * FRAME / WIDTH
    short = np.hypot(*wanted.T) < 60.0
    assert short.mean() > 0.99
    np.testing.assert_allclose(drawn[short, 2:], wanted[short], atol=TENTH)


def test_long_vectors_are_cut_and_keep_their_direction() -> None:
    residuals = np.full((400, 2), 0.05)
    residuals[7] = (-30.0, 40.0)
    html = residual_view(residual_map(residuals=residuals), [])
    drawn = vectors(html)
    longest = drawn[np.hypot(drawn[:, 2], drawn[:, 3]).argmax(), 2:]
    assert np.hypot(*longest) == pytest.approx(0.09 * FRAME, abs=2 * TENTH)
    assert longest[1] / longest[0] == pytest.approx(-4 / 3, abs=0.01)
    assert "The longest vectors are cut" in html


def test_outliers_are_marked_and_do_not_set_the_scale() -> None:
    inliers, residuals = np.ones(400, dtype=bool), residual_map().residuals.copy()
    # Far more than the tenth that the scale leaves aside among used points.
    inliers[:100] = False
    residuals[:100] = 25.0
    html = residual_view(residual_map(inliers=inliers, residuals=residuals), [])
    assert magnification(html)[:2] == magnification(residual_view(residual_map(), []))[:2]
    assert crosses(html) == 100
    assert "100 outliers left out" in html
    assert "outlier, not used" in html
    assert "outlier" not in residual_view(residual_map(), [])


def test_points_of_a_view_tell_its_name_and_rms() -> None:
    residuals = np.full((400, 2), 0.3)
    residuals[1::5] = (0.03, 0.04)
    html = residual_view(residual_map(residuals=residuals), [NASTY, "b.png"])
    titles = [t.text or "" for t in drawing(html, "map").iter("title")]
    assert titles == [
        f"{NASTY}: 0.424 px rms",
        "b.png: 0.050 px rms",
        *(f"view {i}: 0.424 px rms" for i in (3, 4, 5)),
    ]


def test_many_points_are_thinned_with_outliers_first() -> None:
    rng, n = np.random.default_rng(2), 20_000
    inliers = np.ones(n, dtype=bool)
    inliers[:40] = False
    many = residual_map(
        pixels=rng.uniform(0, 570, (n, 2)),
        residuals=rng.normal(0, 0.1, (n, 2)),
        view_index=np.arange(n) % 30,
        inliers=inliers,
    )
    html = residual_view(many, [])
    assert len(vectors(html)) == 3000 - 40
    assert crosses(html) == 40
    assert "A random 3,000 of 20,000 points are drawn" in html
    assert len(html) < 170_000
    assert html == residual_view(many, [])
    all_out = residual_view(residual_map(inliers=np.zeros(400, dtype=bool)), [], n_vectors=100)
    assert crosses(all_out) == 100


def test_coverage_counts_used_points_in_square_cells() -> None:
    # Ten cells of 72 px to a row, eight rows.
    pixels = np.array([[-0.5, -0.5], [71.4, 71.4], [71.6, 0.0], [719.4, 575.4], [300.0, 300.0]])
    few = residual_map(
        pixels=pixels,
        residuals=np.full((5, 2), 0.1),
        view_index=np.zeros(5, dtype=int),
        inliers=np.array([True, True, True, True, False]),
    )
    html = residual_view(few, [])
    chart = drawing(html, "coverage")
    assert len(list(chart.iter("rect"))) == 80
    shown = [(float(t.get("x", "")), t.text) for t in chart.iter("text")]
    assert shown == [(20.9, "2"), (60.7, "1"), (379.1, "1")]
    assert "Coverage: 4 % of the picture" in html
    assert "1 outlier left out" in html
    assert "hatched cells hold none" in html
    assert len([p for p in chart.iter("path") if p.get("stroke") == "#b08968"]) == 3 * 77


def test_histogram_counts_every_residual_beside_the_gaussian() -> None:
    rng = np.random.default_rng(3)
    n = 5000
    found = residual_map(
        pixels=rng.uniform(0, 570, (n, 2)),
        residuals=rng.normal(0, 0.2, (n, 2)),
        view_index=np.zeros(n, dtype=int),
        inliers=np.ones(n, dtype=bool),
    )
    html = residual_view(found, [])
    chart = drawing(html, "histogram")
    bars = np.array([float(r.get("height", "")) for r in chart.iter("rect")])
    bell = numbers(
        next(p for p in chart.iter("path") if p.get("stroke-width") == "1.8").get("d", "")
    )
    tops = np.array(bell).reshape(-1, 2)
    foot = 240.0 - 46.0
    middles = [float(r.get("x", "")) + 0.5 * float(r.get("width", "")) for r in chart.iter("rect")]
    curve = foot - np.interp(middles, tops[:, 0], tops[:, 1])
    # The tallest bar holds about 1000 of 10 000 values: it scatters by 3 %, three times that here.
    np.testing.assert_allclose(bars, curve, atol=0.1 * bars.max())
    assert bars.sum() == pytest.approx(curve.sum(), rel=0.01)
    rms = np.sqrt((found.residuals**2).mean())
    assert f"the Gaussian of their rms, {rms:.3f} px. 68 % lie within" in html


@pytest.mark.parametrize(
    "changes",
    [
        {"residuals": np.zeros((400, 2))},
        {"inliers": np.zeros(400, dtype=bool)},
        {"residuals": np.full((400, 2), np.nan)},
        {"pixels": np.full((400, 2), np.inf)},
        {"pixels": np.full((400, 2), 1e5)},
        {"size_px": (4000, 30)},
    ],
)
def test_odd_maps_are_drawn(changes: dict[str, Any]) -> None:
    html = residual_view(residual_map(**changes), [])
    parsed(html)
    assert "nan" not in html.lower()
    assert "inf" not in html


def test_empty_map_says_so() -> None:
    empty = residual_map(
        pixels=np.empty((0, 2)),
        residuals=np.empty((0, 2)),
        view_index=np.empty(0, dtype=int),
        inliers=np.empty(0, dtype=bool),
    )
    html = residual_view(empty, [])
    assert "No points." in html
    assert "Coverage: 0 %" in html
    assert "nan" not in html
