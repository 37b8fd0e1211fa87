"""A sheet as PDF, SVG or PNG: few enough shapes that each format is written as it stands.

All outlines form one path, so that a viewer leaves no hairlines between the bits of a marker.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.sax.saxutils import escape

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInput
from .files import write_atomically
from .sheet import Sheet

DPI = 300
"""Pixels per inch of a PNG unless told otherwise."""
MIN_DPI, MAX_DPI = 25, 2400
MAX_PIXELS = 600_000_000
"""A PNG of A0 at 600 dpi has 558 million."""
_POINTS_PER_MM = 72 / 25.4
"""PDF reference 1.7, section 8.3.2.3: a unit is 1/72 inch."""
_ARCS = 8
"""Bezier curves for a circle: eight miss it by 4e-6 of the radius, four by 3e-4."""
_CAP_SHARE = 0.72
"""Height of a capital letter of Helvetica as a share of its size."""
_BAND_ROWS = 512
"""Rows of a PNG computed at a time, which bounds the memory."""


def write_sheet(sheet: Sheet, path: str | Path, dpi: float = DPI) -> None:
    """Write a sheet as PDF, SVG or PNG, as the suffix of the file says, whole or not at all.

    Parameters
    ----------
    sheet : Sheet
    path : str or path
    dpi : float
        Pixels per inch of a PNG.

    Raises
    ------
    InvalidInput
        When the suffix is another, the resolution makes no sense, or the file cannot be written.
    """
    suffix = Path(path).suffix.lower()
    if suffix == ".png":
        content: str | bytes = as_png(sheet, dpi)
    elif suffix in _VECTOR:
        content = _VECTOR[suffix](sheet)
    else:
        raise InvalidInput(f"{path} says no format; give a file that ends in .pdf, .svg or .png.")
    write_atomically(path, content)


def as_svg(sheet: Sheet) -> str:
    """Scalable Vector Graphics 1.1; one unit is a millimetre."""
    width, height = _number(sheet.width), _number(sheet.height)
    outlines = "".join(f"M{_joined(polygon, 'L')}Z" for polygon in _outlines(sheet))
    discs = "".join(
        f'<circle cx="{_number(x)}" cy="{_number(y)}" r="{_number(radius)}"/>\n'
        for x, y, radius in 1e3 * sheet.drawing.discs
    )
    texts = "".join(
        f'<text x="{_number(text.x)}" y="{_number(text.y)}" font-size="{_number(text.size)}" '
        f'font-family="Helvetica, Arial, sans-serif" xml:space="preserve">{escape(text.content)}</text>\n'
        for text in sheet.texts
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
        f'viewBox="0 0 {width} {height}">\n<title>{escape(sheet.title)}</title>\n'
        f'<rect width="{width}" height="{height}" fill="white"/>\n'
        f'<path d="{outlines}"/>\n{discs}{texts}</svg>\n'
    )


def as_pdf(sheet: Sheet) -> bytes:
    """PDF 1.6, which can ask the viewer not to scale what it prints."""
    content = _pdf_content(sheet).encode("ascii")
    width, height = _number(sheet.width * _POINTS_PER_MM), _number(sheet.height * _POINTS_PER_MM)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width} {height}] /Contents 4 0 R "
        "/Resources << /Font << /F 5 0 R >> >> >>".encode(),
        b"<< /Length %d >>\nstream\n%b\nendstream" % (len(content), content),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        f"<< /Title {_pdf_string(sheet.title)} /Producer (fewcal) >>".encode(),
    ]
    file = b"%PDF-1.6\n"
    places = []
    for number, item in enumerate(objects, start=1):
        places.append(len(file))
        file += b"%d 0 obj\n%b\nendobj\n" % (number, item)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    count = len(objects) + 1
    return file + (
        b"xref\n0 %d\n0000000000 65535 f \n%btrailer\n<< /Size %d /Root 1 0 R /Info 6 0 R >>\n"
        b"startxref\n%d\n%%%%EOF\n" % (count, table, count, len(file))
    )


def _pdf_content(sheet: Sheet) -> str:
    """Operators that draw the page; the first turns the axes to millimetres from the upper left corner."""
    scale = f"{_POINTS_PER_MM:.9f}"
    lines = [f"{scale} 0 0 -{scale} 0 {_number(sheet.height * _POINTS_PER_MM)} cm"]
    lines += [f"{_joined(polygon, ' l ', ' m ')} l h" for polygon in _outlines(sheet)]
    lines += [_pdf_circle(*disc) for disc in (1e3 * sheet.drawing.discs).tolist()]
    lines.append("f")
    for text in sheet.texts:
        place = f"1 0 0 -1 {_number(text.x)} {_number(text.y)} Tm"
        lines.append(f"BT /F {_number(text.size)} Tf {place} {_pdf_string(text.content)} Tj ET")
    return "\n".join(lines)


def _pdf_circle(x: float, y: float, radius: float) -> str:
    step = 2 * math.pi / _ARCS
    angle = step * np.arange(_ARCS + 1)
    on = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along = 4 / 3 * math.tan(step / 4) * np.stack([-on[:, 1], on[:, 0]], axis=1)
    curves = np.concatenate([(on + along)[:-1], (on - along)[1:], on[1:]], axis=1)
    points = radius * np.concatenate([on[0], curves.ravel()]).reshape(-1, 2) + (x, y)
    first, *rest = (f"{_number(px)} {_number(py)}" for px, py in points)
    arcs = (f"{' '.join(rest[i : i + 3])} c" for i in range(0, len(rest), 3))
    return f"{first} m {' '.join(arcs)} h"


def _pdf_string(text: str) -> str:
    plain = text.encode("ascii", "replace").decode()
    return "(" + plain.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)") + ")"


def as_png(sheet: Sheet, dpi: float = DPI) -> bytes:
    """8-bit grey PNG that says how large its pixels are; what an edge crosses has its share of black."""
    if not MIN_DPI <= dpi <= MAX_DPI:
        raise InvalidInput(f"{dpi:g} dpi make no sense; give {MIN_DPI} to {MAX_DPI}, such as {DPI}.")
    per_metre = round(dpi / 0.0254)  # a PNG can say whole numbers only
    width, height = (round(1e-3 * side * per_metre) for side in (sheet.width, sheet.height))
    if width * height > MAX_PIXELS:
        raise InvalidInput(
            f"At {dpi:g} dpi the sheet has {width} x {height} pixels, which are too many; give a lower "
            "resolution, or a PDF or SVG file, which have none."
        )
    image = np.empty((height, width), np.uint8)
    columns = np.arange(width + 1) / per_metre
    for start in range(0, height, _BAND_ROWS):
        rows = np.arange(start, min(start + _BAND_ROWS, height) + 1) / per_metre
        image[start : start + _BAND_ROWS] = np.rint(255 * (1 - sheet.drawing.coverage(columns, rows)))
    _letter(image, sheet, 1e-3 * per_metre)
    encoded = cv2.imencode(".png", image)[1].tobytes()
    header = encoded[: 8 + 25]  # signature and IHDR, after which pHYs may stand
    return header + _png_chunk(b"pHYs", struct.pack(">IIB", per_metre, per_metre, 1)) + encoded[8 + 25 :]


def _png_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _letter(image: NDArray[np.uint8], sheet: Sheet, per_mm: float) -> None:
    """Write the texts into an image, in place."""
    font = cv2.FONT_HERSHEY_SIMPLEX
    for text in sheet.texts:
        capital = _CAP_SHARE * text.size * per_mm
        thickness = max(1, round(capital / 9))
        scale = cv2.getFontScaleFromHeight(font, max(1, round(capital)), thickness)
        place = round(text.x * per_mm), round(text.y * per_mm)
        cv2.putText(image, text.content, place, font, scale, (0,), thickness, cv2.LINE_AA)


def _outlines(sheet: Sheet) -> Iterator[NDArray[np.float64]]:
    """Outlines of the polygons, millimetres."""
    return (1e3 * polygon for polygon in sheet.drawing.polygons)


def _joined(polygon: NDArray[np.float64], between: str, after_first: str | None = None) -> str:
    """Corners of an outline, with what a format writes between them."""
    first, *rest = (f"{_number(x)} {_number(y)}" for x, y in polygon)
    return first + (after_first or between) + between.join(rest)


def _number(value: float) -> str:
    """To a ten-thousandth, of a millimetre as a rule; no exponent, which PDF does not know."""
    return f"{value:.4f}".rstrip("0").rstrip(".")


_VECTOR: dict[str, Callable[[Sheet], str | bytes]] = {".pdf": as_pdf, ".svg": as_svg}
