"""True-to-scale PDF of black rectangles and small text: all that printed targets need.

Lengths are millimetres from a page's top-left corner, x right, y down. All rectangles of a page are
one path, so that no viewer shows seams between neighbours; the file asks viewers not to scale it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from aqualvs.geometry.arrays import FloatArray

_POINTS_PER_MM = 72.0 / 25.4


@dataclass(frozen=True, slots=True)
class Text:
    """A line of Helvetica.

    Attributes
    ----------
    x, y : float
        Where it begins, on its base line, in millimetres.
    size : float
        Height of its letters' em, in millimetres.
    words : str
        Latin letters.
    """

    x: float
    y: float
    size: float
    words: str


@dataclass(frozen=True, slots=True)
class Page:
    """One page.

    Attributes
    ----------
    width, height : float
        In millimetres.
    rectangles : array, shape (N, 4)
        x, y, width, height of what is black, in millimetres.
    texts : tuple of Text
    """

    width: float
    height: float
    rectangles: FloatArray
    texts: tuple[Text, ...] = field(default=())


def pdf_bytes(pages: Sequence[Page], title: str) -> bytes:
    """Return a PDF file of these pages; the same pages give the same bytes."""
    kids = " ".join(f"{4 + 2 * i} 0 R" for i in range(len(pages)))
    objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for i, page in enumerate(pages):
        width, height = page.width * _POINTS_PER_MM, page.height * _POINTS_PER_MM
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] "
            f"/Resources << /Font << /F 3 0 R >> >> /Contents {5 + 2 * i} 0 R >>"
        )
        content = _content(page)
        objects.append(f"<< /Length {len(_encoded(content))} >>\nstream\n{content}\nendstream")
    objects.append(f"<< /Title ({_escaped(title)}) /Producer (aqualvs) >>")
    return _file(objects)


def _content(page: Page) -> str:
    """Return a page's drawing: millimetres, y down."""
    scale = f"{_POINTS_PER_MM:.8f}"
    height = f"{page.height * _POINTS_PER_MM:.4f}"
    lines = [f"{scale} 0 0 -{scale} 0 {height} cm", "0 g"]
    lines += [" ".join(f"{value:.4f}" for value in row) + " re" for row in page.rectangles]
    lines.append("f")
    for text in page.texts:
        place = f"1 0 0 -1 {text.x:.4f} {text.y:.4f} Tm"
        lines.append(f"BT /F {text.size:.3f} Tf {place} ({_escaped(text.words)}) Tj ET")
    return "\n".join(lines)


def _escaped(words: str) -> str:
    return words.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")


def _encoded(text: str) -> bytes:
    return text.encode("cp1252", errors="replace")


def _file(objects: Sequence[str]) -> bytes:
    """Return the file of these objects; the last one is its information."""
    body = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    places = []
    for i, text in enumerate(objects):
        places.append(len(body))
        body += f"{i + 1} 0 obj\n".encode() + _encoded(text) + b"\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    n = len(objects) + 1
    end = (
        f"xref\n0 {n}\n0000000000 65535 f \n{table}trailer\n"
        f"<< /Size {n} /Root 1 0 R /Info {n - 1} 0 R >>\nstartxref\n{len(body)}\n%%EOF\n"
    )
    return body + end.encode()
