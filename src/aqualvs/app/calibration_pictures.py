"""Pictures of a calibration with points drawn over them, small enough to embed."""

import base64
from collections.abc import Sequence
from html import escape

import cv2
import numpy as np

from aqualvs.app import calibration_svg as draw
from aqualvs.app.calibration_material import MarkKind, Overlay, PictureShot
from aqualvs.app.report_html import Raw
from aqualvs.geometry.arrays import FloatArray
from aqualvs.scanning.scan import ImagePlane

# Greatest width and JPEG quality, tried in this order until a picture fits its share of the page.
_SIZES = ((960, 80), (800, 75), (640, 72), (480, 65), (360, 55), (240, 45))
_ALL_BYTES = 340_000
_MOST_BYTES = 130_000
_ALL_MARKS = 6000
_UNDER = "#10181c"
# Size of a mark and widths of its line and of the dark edge under it, for a picture 640 wide.
_SHAPES: dict[MarkKind, tuple[float, float, float]] = {
    "cross": (5.0, 1.5, 3.2),
    "dot": (0.0, 4.0, 5.6),
    "circle": (5.5, 1.5, 3.2),
}


def picture_view(shots: Sequence[PictureShot]) -> Raw:
    """Return pictures with their points, captions and legends.

    Raises
    ------
    ValueError
        If an image is empty, not of 8 bits, or neither grey nor of three channels.
    """
    figures = "".join(_figure(shot, index, len(shots)) for index, shot in enumerate(shots))
    return Raw(f'<div class="shots">{figures}</div>')


def _figure(shot: PictureShot, index: int, count: int) -> str:
    jpeg, width, height = _embedded(shot.image, min(_MOST_BYTES, _ALL_BYTES // count))
    scale = width / shot.image.shape[1]
    body = [f'<image href="data:image/jpeg;base64,{jpeg}" width="{width}" height="{height}"/>']
    limit = _ALL_MARKS // count // max(len(shot.points), 1)
    for layer, overlay in enumerate(shot.points):
        name = f"marks-{index}-{layer}"
        body.append(_marks(overlay, name, scale, width / 640.0, limit))
    picture = draw.svg(width, height, body, alt=_alt(shot), kind="picture")
    return (
        f"<figure>{picture}<figcaption>{escape(shot.caption)}</figcaption>"
        f"{_legend(shot.points)}</figure>"
    )


def _embedded(image: ImagePlane, most_bytes: int) -> tuple[str, int, int]:
    """Return a picture as JPEG in base64 with its width and height."""
    if image.dtype != np.uint8 or not image.size or image.ndim not in (2, 3):
        raise ValueError(f"image has shape {image.shape} of {image.dtype}, expected 8-bit pixels")
    if image.ndim == 3 and image.shape[2] != 3:
        raise ValueError(f"image has {image.shape[2]} channels, expected grey or 3")
    for widest, quality in _SIZES:
        jpeg, width, height = _jpeg(image, widest, quality)
        if len(jpeg) <= most_bytes:
            break
    return base64.b64encode(jpeg).decode("ascii"), width, height


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
    layers = "".join(
        f'<use href="#{name}" stroke="{colour}" stroke-width="{draw.num(width)}"/>'
        for colour, width in ((_UNDER, wide), (escape(overlay.colour), thin))
    )
    return (
        f'<defs><path id="{name}" d="{path}"/></defs>'
        f'<g fill="none" stroke-linecap="round">{layers}</g>'
    )


def _path(places: FloatArray, kind: MarkKind, size: float) -> str:
    if kind == "dot":
        return draw.points_path(places)
    s, d = draw.num(size), draw.num(2.0 * size)
    if kind == "cross":
        shape = (-size, 0.0, f"h{d}m-{s} -{s}v{d}")
    else:
        shape = (-size, 0.0, f"a{s} {s} 0 1 0 {d} 0a{s} {s} 0 1 0 -{d} 0")
    dx, dy, rest = shape
    return "".join(f"M{draw.num(x + dx)} {draw.num(y + dy)}{rest}" for x, y in places.tolist())


def _alt(shot: PictureShot) -> str:
    shown = ", ".join(overlay.label for overlay in shot.points if overlay.label)
    return f"{shot.caption}; drawn over it: {shown}" if shown else shot.caption


def _legend(points: Sequence[Overlay]) -> str:
    items = "".join(
        f"<li>{_key(overlay)}{escape(overlay.label)}</li>" for overlay in points if overlay.label
    )
    return f'<ul class="legend">{items}</ul>' if items else ""


def _key(overlay: Overlay) -> str:
    size, thin, wide = _SHAPES[overlay.kind]
    path = _path(np.array([[9.0, 8.0]]), overlay.kind, size)
    lines = "".join(
        f'<path d="{path}" stroke="{colour}" stroke-width="{width}"/>'
        for colour, width in ((_UNDER, wide), (escape(overlay.colour), thin))
    )
    return (
        '<svg class="key square" viewBox="0 0 18 16" fill="none" stroke-linecap="round" '
        f'aria-hidden="true">{lines}</svg>'
    )
