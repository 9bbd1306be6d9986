"""Charts of the residuals and pictures of a calibration.

Residuals over the picture are shown as vectors, as coverage (points per cell), and as a histogram
beside the Gaussian of their rms. Pictures with detected points drawn over them are embedded as
JPEG, scaled down to a size that suits a page.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from typing import NamedTuple

import cv2
import numpy as np

from aqualvs.geometry.arrays import BoolArray, FloatArray, IntArray
from aqualvs.report import svg as draw
from aqualvs.report.calibration_material import MarkKind, Overlay, PictureShot, ResidualMap
from aqualvs.report.html import Raw, data_url
from aqualvs.scanning.scan import ImagePlane

_UNDER = "#10181c"
# Size of a mark and widths of its line and of the dark edge under it, for a picture 640 wide.
_SHAPES: dict[MarkKind, tuple[float, float, float]] = {
    "cross": (5.0, 1.5, 3.2),
    "dot": (0.0, 4.0, 5.6),
    "circle": (5.5, 1.5, 3.2),
}


def picture_view(shots: Sequence[PictureShot]) -> Raw:
    """Return pictures with their points, captions and legends.

    Raises `ValueError` if an image is empty, not of 8 bits, or neither grey nor of three channels.
    """
    figures = "".join(_figure(shot, index, len(shots)) for index, shot in enumerate(shots))
    return Raw(f'<div class="shots">{figures}</div>')


def _figure(shot: PictureShot, index: int, count: int) -> str:
    all_bytes, max_bytes, all_marks = 340_000, 130_000, 6000
    address, width, height = _embedded(shot.image, min(max_bytes, all_bytes // count))
    scale = width / shot.image.shape[1]
    limit = all_marks // count // max(len(shot.points), 1)
    body = [f'<image href="{address}" width="{width}" height="{height}"/>']
    body += [
        _marks(overlay, f"marks-{index}-{layer}", scale, width / 640.0, limit)
        for layer, overlay in enumerate(shot.points)
    ]
    shown = ", ".join(overlay.label for overlay in shot.points if overlay.label)
    alt = f"{shot.caption}; drawn over it: {shown}" if shown else shot.caption
    picture = draw.svg(width, height, body, alt=alt, kind="picture")
    return (
        f"<figure>{picture}<figcaption>{escape(shot.caption)}</figcaption>"
        f"{_legend(shot.points)}</figure>"
    )


def _embedded(image: ImagePlane, most_bytes: int) -> tuple[str, int, int]:
    """Return a picture as an address with its width and height."""
    if image.dtype != np.uint8 or not image.size or image.ndim not in (2, 3):
        raise ValueError(f"image has shape {image.shape} of {image.dtype}, expected 8-bit pixels")
    if image.ndim == 3 and image.shape[2] != 3:
        raise ValueError(f"image has {image.shape[2]} channels, expected grey or 3")
    # Greatest width and JPEG quality, tried in this order until a picture fits its share of the
    # page.
    sizes = ((960, 80), (800, 75), (640, 72), (480, 65), (360, 55), (240, 45))
    for widest, quality in sizes:
        jpeg, width, height = _jpeg(image, widest, quality)
        if len(jpeg) <= most_bytes:
            break
    return data_url(jpeg, "jpeg"), width, height


def _jpeg(image: ImagePlane, widest: int, quality: int) -> tuple[bytes, int, int]:
    small = image
    if image.shape[1] > widest:
        size = (widest, max(1, round(image.shape[0] * widest / image.shape[1])))
        small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    _, jpeg = cv2.imencode(".jpg", small, (cv2.IMWRITE_JPEG_QUALITY, quality))
    return jpeg.tobytes(), small.shape[1], small.shape[0]


def _marks(overlay: Overlay, name: str, scale: float, grown: float, limit: int) -> str:
    """Return the marks twice, dark and wide below, so that they stand out from any picture."""
    pixels = overlay.pixels[np.isfinite(overlay.pixels).all(axis=1)]
    places = (pixels[draw.sampled(len(pixels), limit)] + 0.5) * scale
    size, thin, wide = (grown * value for value in _SHAPES[overlay.kind])
    path = _path(places, overlay.kind, size)
    layers = _edged(f'<use href="#{name}"', overlay.colour, draw.num(wide), draw.num(thin))
    return (
        f'<defs><path id="{name}" d="{path}"/></defs>'
        f'<g fill="none" stroke-linecap="round">{layers}</g>'
    )


def _edged(shape: str, colour: str, wide: object, thin: object) -> str:
    """Return a shape, begun as an element, in its colour over a dark and wider one."""
    return (
        f'{shape} stroke="{_UNDER}" stroke-width="{wide}"/>'
        f'{shape} stroke="{escape(colour)}" stroke-width="{thin}"/>'
    )


def _path(places: FloatArray, kind: MarkKind, size: float) -> str:
    if kind == "dot":
        return draw.points_path(places)
    s, d = draw.num(size), draw.num(2.0 * size)
    shape = f"a{s} {s} 0 1 0 {d} 0a{s} {s} 0 1 0 -{d} 0"
    if kind == "cross":
        shape = f"h{d}m-{s} -{s}v{d}"
    return "".join(f"M{draw.num(x - size)} {draw.num(y)}{shape}" for x, y in places.tolist())


def _legend(points: Sequence[Overlay]) -> str:
    items = "".join(
        f"<li>{_key(overlay)}{escape(overlay.label)}</li>" for overlay in points if overlay.label
    )
    return f'<ul class="legend">{items}</ul>' if items else ""


def _key(overlay: Overlay) -> str:
    size, thin, wide = _SHAPES[overlay.kind]
    path = _path(np.array([[9.0, 8.0]]), overlay.kind, size)
    lines = _edged(f'<path d="{path}"', overlay.colour, wide, thin)
    return (
        '<svg class="key square" viewBox="0 0 18 16" fill="none" stroke-linecap="round" '
        f'aria-hidden="true">{lines}</svg>'
    )


N_VECTORS = 3000


class _VectorLayout(NamedTuple):
    """Layout of a map of residuals, in units of its view box."""

    width: float = 760.0
    left: float = 50.0
    head: float = 30.0
    right: float = 8.0
    foot: float = 28.0
    # Lengths of vectors as a share of the picture's width: typical ones, and where long ones are
    # cut.
    typical: float = 0.03
    longest: float = 0.09


_VECTORS = _VectorLayout()


class _SideLayout(NamedTuple):
    """Layout of the charts beside the map: coverage and histogram."""

    columns: int = 10
    width: float = 400.0
    height: float = 240.0
    bins: int = 32
    reach: float = 4.0


_BESIDE = _SideLayout()

_PALE, _DEEP = np.array([222.0, 238.0, 245.0]), np.array([11.0, 92.0, 125.0])
_GAUSS_WITHIN_ONE = math.erf(math.sqrt(0.5))


@dataclass(frozen=True, slots=True)
class _Scale:
    """From pixels to places in the chart, and from residuals to vectors."""

    per_px: float
    magnified: float
    longest: float

    def places(self, pixels: FloatArray) -> FloatArray:
        """Return where pixels lie; the centre of the first is half a pixel inside the frame."""
        return np.array([_VECTORS.left, _VECTORS.head]) + (pixels + 0.5) * self.per_px

    def vectors(self, residuals: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Return vectors in the chart and which had to be cut."""
        vectors = residuals * (self.magnified * self.per_px)
        length = np.hypot(vectors[:, 0], vectors[:, 1])
        cut = length > self.longest
        shrink = np.where(cut, self.longest / np.where(cut, length, 1.0), 1.0)
        return vectors * shrink[:, None], cut


def residual_view(found: ResidualMap, names: Sequence[str], *, n_vectors: int = N_VECTORS) -> Raw:
    """Return a map's charts: vectors, coverage, histogram, each with its words.

    `names`: of the views that `found.view_index` counts. At most `n_vectors` points are drawn;
    outliers go first, the others are a random choice.
    """
    points = _finite(found)
    side = "".join(
        f"<figure>{chart}<figcaption>{escape(words)}</figcaption></figure>"
        for chart, words in (_coverage_chart(points), _histogram(points))
    )
    vectors, words, legend = _vector_chart(points, names, n_vectors)
    return Raw(
        f'<div class="residuals"><figure>{vectors}{legend}<figcaption>{escape(words)}'
        f'</figcaption></figure><div class="side">{side}</div></div>'
    )


def _vector_chart(
    points: ResidualMap, names: Sequence[str], n_vectors: int
) -> tuple[Raw, str, Raw]:
    """Return one vector per point, what to say of them, and a legend."""
    scale = _scale_of(points)
    rows = _thinned(points, n_vectors)
    width, height = (scale.per_px * side for side in points.size_px)
    vectors, cut = scale.vectors(points.residuals)
    starts = scale.places(points.pixels)
    # An inner picture of the frame's size cuts what would run over the numbers beside it.
    frame = f"{_VECTORS.left:g} {_VECTORS.head:g} {draw.num(width)} {draw.num(height)}"
    x, y, w, h = frame.split()
    body = [
        *_frame(points.size_px, scale),
        f'<svg x="{x}" y="{y}" width="{w}" height="{h}" viewBox="{frame}">',
        *_view_groups(points, rows, starts, vectors, names),
        *_outliers(rows[~points.inliers[rows]], starts, vectors),
        "</svg>",
        *_scale_bar(scale),
    ]
    words = _vector_text(points, len(rows), bool(cut[rows].any()))
    total = (width + _VECTORS.left + _VECTORS.right, height + _VECTORS.head + _VECTORS.foot)
    chart = draw.svg(*total, body, alt=f"{points.title}: residual vectors. {words}", kind="map")
    return chart, words, _vector_legend(bool((~points.inliers).any()))


def _coverage_chart(points: ResidualMap) -> tuple[Raw, str]:
    """Return how many used points lie in each cell of the picture, and the share covered."""
    counts = _cell_counts(points)
    covered = 100.0 * float((counts > 0).mean())
    width, height = points.size_px
    size = _BESIDE.width - 2.0
    tall = size * height / width
    dx, dy = size / counts.shape[1], tall / counts.shape[0]
    body: list[str] = []
    for (row, column), count in np.ndenumerate(counts):
        x, y = 1.0 + dx * column, 1.0 + dy * row
        body += _cell(x, y, dx, dy, int(count), int(counts.max()))
    words = f"Coverage: {covered:.0f} % of the picture’s cells hold points (see the counts)"
    words += "." if counts.all() else "; hatched cells hold none."
    alt = f"{points.title}: coverage of the picture, {covered:.0f} % of its cells hold points"
    return draw.svg(_BESIDE.width, tall + 2.0, body, alt=alt, kind="coverage"), words


def _histogram(points: ResidualMap) -> tuple[Raw, str]:
    """Return the histogram of used residuals beside the Gaussian of their rms."""
    values = points.used_residuals.ravel()
    rms = _rms(values)
    if not len(values) or not rms > 0.0:
        return Raw(""), "No residuals to count."
    reach = _BESIDE.reach * rms
    counts, edges = np.histogram(values, _BESIDE.bins, range=(-reach, reach))
    dense = np.linspace(-reach, reach, 97)
    bell = len(values) * (2.0 * _BESIDE.reach / _BESIDE.bins) / math.sqrt(2.0 * math.pi)
    curve = bell * np.exp(-0.5 * (dense / rms) ** 2)
    x_axis = draw.Axis(-reach, reach, 10.0, _BESIDE.width - 10.0)
    y_axis = draw.Axis(0.0, 1.06 * max(float(counts.max()), bell), _BESIDE.height - 46.0, 8.0)
    body = [
        *_bars(counts, edges, x_axis, y_axis),
        f'<path d="{draw.polyline(x_axis.place(dense), y_axis.place(curve))}" fill="none" '
        f'stroke="{draw.OUTLIER}" stroke-width="1.8"/>',
        *_histogram_axis(x_axis, y_axis),
    ]
    words = _histogram_text(values, rms)
    alt = f"{points.title}: histogram of residuals. {words}"
    return draw.svg(_BESIDE.width, _BESIDE.height, body, alt=alt, kind="histogram"), words


def _finite(found: ResidualMap) -> ResidualMap:
    fine = np.isfinite(found.pixels).all(axis=1) & np.isfinite(found.residuals).all(axis=1)
    pixels, residuals = found.pixels[fine], found.residuals[fine]
    view, inliers = found.view_index[fine], found.inliers[fine]
    return replace(found, pixels=pixels, residuals=residuals, view_index=view, inliers=inliers)


def _scale_of(points: ResidualMap) -> _Scale:
    """Return the scale at which nine of ten used residuals are at most of typical length."""
    width = points.size_px[0]
    per_px = (_VECTORS.width - _VECTORS.left - _VECTORS.right) / width
    residuals = points.used_residuals if points.inliers.any() else points.residuals
    lengths = np.hypot(residuals[:, 0], residuals[:, 1])
    typical = float(np.quantile(lengths, 0.9)) if len(lengths) else 0.0
    # Without any residual every magnification is as good; one pixel then fills the typical length.
    least = _VECTORS.typical * width / (typical if typical > 1e-9 else 1.0)
    return _Scale(per_px, draw.round_step(least / 2.0), _VECTORS.longest * width * per_px)


def _thinned(points: ResidualMap, limit: int) -> IntArray:
    """Return the rows to draw: outliers up to half the limit, then used points at random."""
    outliers, used = np.flatnonzero(~points.inliers), np.flatnonzero(points.inliers)
    outliers = outliers[draw.sampled(len(outliers), max(limit // 2, limit - len(used)))]
    used = used[draw.sampled(len(used), limit - len(outliers))]
    return np.sort(np.concatenate([outliers, used]))


def _frame(size_px: tuple[int, int], scale: _Scale) -> Iterator[str]:
    """Yield the picture's edge with round pixels beside it."""
    width, height = (scale.per_px * side for side in size_px)
    yield draw.box(_VECTORS.left, _VECTORS.head, width, height, fill=draw.PAPER, stroke=draw.EDGE)
    half = 0.5 * scale.per_px
    x_axis = draw.Axis(0.0, float(size_px[0]), _VECTORS.left + half, _VECTORS.left + half + width)
    y_axis = draw.Axis(0.0, float(size_px[1]), _VECTORS.head + half, _VECTORS.head + half + height)
    foot = _VECTORS.head + height
    for x, words in x_axis.ticks(7):
        if x < _VECTORS.left + width - 14.0:
            yield draw.line(x, foot, x, foot + 5) + draw.words_at(x, foot + 20, words)
    yield draw.words_at(_VECTORS.left + width, foot + 20, "px", anchor="end")
    for y, words in y_axis.ticks(6):
        if y < foot:
            yield draw.line(_VECTORS.left - 5, y, _VECTORS.left, y)
            yield draw.words_at(_VECTORS.left - 9, y + 5, words, anchor="end")


def _view_groups(
    points: ResidualMap,
    rows: IntArray,
    starts: FloatArray,
    vectors: FloatArray,
    names: Sequence[str],
) -> Iterator[str]:
    """Yield the used points, view by view, with a tooltip of the view and its rms."""
    style = f'stroke="{draw.ACCENT}" fill="none" stroke-linecap="round"'
    rows = rows[points.inliers[rows]]
    for view in np.unique(points.view_index[rows]).tolist():
        mine = rows[points.view_index[rows] == view]
        rms = _rms_of_lengths(points.residuals[points.inliers & (points.view_index == view)])
        name = names[view] if 0 <= view < len(names) else f"view {view + 1}"
        yield (
            f"<g {style}><title>{escape(name)}: {rms:.3f} px rms</title>"
            f'<path d="{draw.points_path(starts[mine])}" stroke-width="2.6"/>'
            f'<path d="{_vector_path(starts[mine], vectors[mine])}" stroke-width="1.1"/></g>'
        )


def _outliers(rows: IntArray, starts: FloatArray, vectors: FloatArray) -> Iterator[str]:
    if len(rows):
        corners = (starts[rows] - 4.0).tolist()
        crosses = "".join(f"M{draw.num(x)} {draw.num(y)}l8 8m0 -8l-8 8" for x, y in corners)
        yield (
            f'<path d="{crosses}{_vector_path(starts[rows], vectors[rows])}" fill="none" '
            f'stroke="{draw.OUTLIER}" stroke-width="1.5"/>'
        )


def _vector_path(starts: FloatArray, vectors: FloatArray) -> str:
    return "".join(
        f"M{draw.num(x)} {draw.num(y)}l{draw.num(dx)} {draw.num(dy)}"
        for (x, y), (dx, dy) in zip(starts.tolist(), vectors.tolist(), strict=True)
    )


def _scale_bar(scale: _Scale) -> Iterator[str]:
    """Yield a bar of a round residual with its length and the magnification in words."""
    per_residual = scale.magnified * scale.per_px
    residual = draw.round_step(45.0 / per_residual)
    y, end = 14.0, _VECTORS.left + residual * per_residual
    yield draw.line(_VECTORS.left, y, end, y, colour=draw.ACCENT, more=' stroke-width="2"')
    for x in (_VECTORS.left, end):
        yield draw.line(x, y - 5, x, y + 5, colour=draw.ACCENT, more=' stroke-width="2"')
    words = f"{residual:g} px; residuals are drawn {scale.magnified:,g} times as long as they are"
    yield draw.words_at(end + 10, y + 5, words, anchor="start", kind="strong")


def _vector_text(points: ResidualMap, drawn: int, cut: bool) -> str:
    total, used = len(points.inliers), points.used_residuals
    if not total:
        return "No points."
    said = f"{int(points.inliers.sum()):,} points used"
    if len(used):
        said += f", {_rms_of_lengths(used):.3f} px rms"
    if total > len(used):
        many = "" if total - len(used) == 1 else "s"
        said += f"; {total - len(used):,} outlier{many} left out"
    said += "."
    if drawn < total:
        said += f" A random {drawn:,} of {total:,} points are drawn."
    return said + (" The longest vectors are cut." if cut else "")


def _vector_legend(outliers: bool) -> Raw:
    vector = (
        f'<path d="M5 9h0" stroke-width="4" stroke-linecap="round" stroke="{draw.ACCENT}"/>'
        f'<path d="M5 9L25 4" stroke="{draw.ACCENT}" stroke-width="1.4"/>'
    )
    shapes = [(vector, "dot: measured point; line: its residual (measured minus predicted)")]
    if outliers:
        cross = f'<path d="M9 2l8 8m0 -8l-8 8" stroke="{draw.OUTLIER}" stroke-width="1.7"/>'
        shapes.append((cross, "outlier, not used"))
    items = "".join(
        f'<li><svg class="key" viewBox="0 0 28 12" fill="none" aria-hidden="true">{shape}</svg>'
        f"{words}</li>"
        for shape, words in shapes
    )
    return Raw(f'<ul class="legend">{items}</ul>')


def _cell_counts(points: ResidualMap) -> IntArray:
    """Return the used points in each cell; cells are about square, ten to a row."""
    width, height = points.size_px
    rows = max(1, round(_BESIDE.columns * height / width))
    pixels = points.pixels[points.inliers] + 0.5
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], bins=(rows, _BESIDE.columns), range=((0, height), (0, width))
    )
    return counts.astype(np.int64)


def _cell(x: float, y: float, dx: float, dy: float, count: int, most: int) -> Iterator[str]:
    if not count:
        yield draw.box(x, y, dx, dy, fill=draw.PAPER, stroke=draw.EDGE)
        yield draw.line(x, y + dy, x + dx, y, colour="#b08968")
        yield draw.line(x, y + dy / 2, x + dx / 2, y, colour="#b08968")
        yield draw.line(x + dx / 2, y + dy, x + dx, y + dy / 2, colour="#b08968")
        return
    # The root keeps thinly covered cells apart from each other.
    deep = math.sqrt(count / most)
    red, green, blue = (_PALE + deep * (_DEEP - _PALE)).round().astype(int)
    yield draw.box(x, y, dx, dy, fill=f"#{red:02x}{green:02x}{blue:02x}", stroke=draw.PAPER)
    shown = f"{count}" if count < 10_000 else f"{count / 1000:.0f}k"
    # Where black and white words contrast equally.
    kind = "on-deep" if deep > 0.74 else "on-pale"
    yield draw.words_at(x + dx / 2, y + dy / 2 + 4.5, shown, kind=kind)


def _bars(
    counts: IntArray, edges: FloatArray, x_axis: draw.Axis, y_axis: draw.Axis
) -> Iterator[str]:
    lefts, tops = x_axis.place(edges), y_axis.place(counts.astype(np.float64))
    width = float(lefts[1] - lefts[0])
    for left, top in zip(lefts[:-1].tolist(), tops.tolist(), strict=True):
        yield draw.box(left, top, width, y_axis.start - top, fill=draw.BAND, stroke=draw.PAPER)


def _histogram_axis(x_axis: draw.Axis, y_axis: draw.Axis) -> Iterator[str]:
    foot = y_axis.start
    yield draw.line(x_axis.start, foot, x_axis.end, foot)
    for x, words in x_axis.ticks(8):
        yield draw.line(x, foot, x, foot + 5) + draw.words_at(x, foot + 20, words)
    middle = 0.5 * (x_axis.start + x_axis.end)
    yield draw.words_at(middle, foot + 40, "residual in x and in y, px", kind="axis")


def _histogram_text(values: FloatArray, rms: float) -> str:
    within = 100.0 * float((np.abs(values) <= rms).mean())
    beyond = int((np.abs(values) > _BESIDE.reach * rms).sum())
    said = (
        f"Bars: residuals, x and y separately. Line: the Gaussian of their rms, {rms:.3f} px. "
        f"{within:.0f} % lie within one rms (Gaussian: {100 * _GAUSS_WITHIN_ONE:.0f} %)"
    )
    return said + (f"; {beyond:,} beyond the chart." if beyond else ".")


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else math.nan


def _rms_of_lengths(residuals: FloatArray) -> float:
    return _rms(np.hypot(residuals[:, 0], residuals[:, 1]))
