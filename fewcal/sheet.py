"""A board on a sheet of paper, at true scale, with what tells whether it was printed so.

Below the board stand a ruler, the text form of the board, and the lengths that a ruler can check on it.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .boards import Board
from .drawing import Drawing, rectangles
from .errors import InvalidInput

Array = NDArray[np.float64]

PAPERS_MM = {
    "A5": (148.0, 210.0),
    "A4": (210.0, 297.0),
    "letter": (215.9, 279.4),
    "legal": (215.9, 355.6),
    "A3": (297.0, 420.0),
    "tabloid": (279.4, 431.8),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
}
"""Width and height upright, ISO 216 and ANSI/ASME Y14.1; the first that is large enough is advised."""
LARGEST_MM = 5000.0
"""A PDF page is at most 14400 points wide, 5080 mm."""
SMALLEST_MM = 5.0
"""Of a whole board: printers at 600 dpi draw its squares with some ten dots."""
UNPRINTABLE_MM = 5.0
"""Office printers leave about so much white along the edges."""
RULERS_MM = (100, 50, 20, 10)
"""Lengths of the ruler: the longest for which there is room is taken."""
TICK_MM, TICKS_EVERY_MM, LINE_MM = 3.0, 10, 0.2
"""Height of the ruler's ticks, their spacing, and the width of its lines."""
TEXT_MM, GAP_MM = 3.0, 1.5
"""Size of the text, from line to line when set solid, and the white between what stands below the board."""
FOOTER_MM = GAP_MM + TICK_MM + GAP_MM + TEXT_MM + UNPRINTABLE_MM
"""Height of what stands below the board: the ruler, and below it the text."""
GLYPH_SHARE = 0.58
"""Mean width of a letter of Helvetica as a share of its size, rather too much than too little."""


@dataclass(frozen=True)
class Text:
    """A line of text: where its baseline begins from the upper left corner of the sheet, and its size, mm."""

    x: float
    y: float
    size: float
    content: str


@dataclass(frozen=True, eq=False)
class Sheet:
    """What is printed on one sheet of paper.

    Attributes
    ----------
    title : str
        The text form of the board.
    width, height : float
        Of the paper as the board stands on it, mm.
    drawing : Drawing
        Board and ruler; metres from the upper left corner of the sheet, x to the right and y down.
    texts : tuple of Text
    """

    title: str
    width: float
    height: float
    drawing: Drawing
    texts: tuple[Text, ...]


def lay_out(board: Board, paper: str) -> Sheet:
    """Put a board on paper, upright if it fits so and across if not.

    Parameters
    ----------
    board : Board
    paper : str
        One of ``PAPERS_MM``, in any case, or a width and height in millimetres such as ``900x600``.

    Raises
    ------
    InvalidInput
        When there is no such paper, the board does not fit, or is nothing that is printed.
    """
    drawing = board.draw()
    left, top, right, bottom = drawing.ink
    if (largest := 1e3 * max(right - left, bottom - top)) < SMALLEST_MM:
        raise InvalidInput(
            f"{board} is {largest:.2g} mm large, which no printer draws well; lengths are in metres, "
            "0.025 for 25 mm."
        )
    name, upright = _paper(paper)
    size = _fitting(drawing, upright)
    if size is None:
        raise InvalidInput(_too_large(board, drawing, name, upright))
    left, top, right, bottom = _bounds(drawing)
    x = (size[0] - left - right) / 2
    # What is free is shared evenly above the board and between it and what stands below.
    y = (size[1] - FOOTER_MM - top - bottom) / 2
    ruler, texts = _footer(str(board), drawing.caption, *size)
    placed = drawing.moved(1e-3 * x, 1e-3 * y)
    whole = Drawing(
        [*placed.polygons, *ruler], placed.discs, (0.0, 0.0, 1e-3 * size[0], 1e-3 * size[1]), drawing.caption
    )
    return Sheet(str(board), *size, whole, texts)


def _paper(name: str) -> tuple[str, tuple[float, float]]:
    """Name of a paper as it is written, and its size in mm."""
    for known, size in PAPERS_MM.items():
        if known.lower() == name.strip().lower():
            return known, size
    match = re.fullmatch(r"(\d{1,4}(?:\.\d{1,3})?)[xX](\d{1,4}(?:\.\d{1,3})?)", name.strip())
    if match is None:
        raise InvalidInput(
            f"There is no paper {name!r}; choose from {', '.join(PAPERS_MM)} or give width and height in mm, "
            "such as 900x600."
        )
    width, height = float(match[1]), float(match[2])
    if not 0 < min(width, height) <= max(width, height) <= LARGEST_MM:
        raise InvalidInput(
            f"There is no paper of {width:g} x {height:g} mm; its sides may have up to {LARGEST_MM:g} mm."
        )
    return "a sheet", (width, height)


def _bounds(drawing: Drawing) -> tuple[float, float, float, float]:
    """Least x and y, largest x and y, mm, of the board with its margin and what no printer reaches."""
    ink, extent = 1e3 * np.array(drawing.ink), 1e3 * np.array(drawing.extent)
    # White margin may lie where a printer cannot print; black must not. Below the board there is the footer.
    left, top = np.minimum(extent[:2], ink[:2] - UNPRINTABLE_MM)
    return float(left), float(top), float(max(extent[2], ink[2] + UNPRINTABLE_MM)), float(extent[3])


def _needed(drawing: Drawing) -> tuple[float, float]:
    """Width and height, mm, that the board needs with its margin and what stands below it."""
    left, top, right, bottom = _bounds(drawing)
    return right - left, bottom - top + FOOTER_MM


def _fitting(drawing: Drawing, upright: tuple[float, float]) -> tuple[float, float] | None:
    """Turn the paper so that the board fits; None when it fits neither way."""
    width, height = _needed(drawing)
    for size in (upright, upright[::-1]):
        if width <= size[0] and height <= size[1]:
            return size
    return None


def _too_large(board: Board, drawing: Drawing, name: str, size: tuple[float, float]) -> str:
    width, height = _needed(drawing)
    enough = next((known for known, other in PAPERS_MM.items() if _fitting(drawing, other)), None)
    advice = f"it fits on {enough}"
    if enough is None:
        advice = f"not even A0 is enough, give a size such as {math.ceil(width)}x{math.ceil(height)}"
    return (
        f"{board} needs {width:.1f} x {height:.1f} mm with its margin and ruler, more than {name} "
        f"({size[0]:g} x {size[1]:g} mm) has; {advice}."
    )


def _footer(
    form: str, caption: str, width: float, height: float
) -> tuple[list[np.ndarray], tuple[Text, ...]]:
    """Ruler and text at the lower edge of a sheet of so many mm."""
    room = width - 2 * UNPRINTABLE_MM
    bottom = height - UNPRINTABLE_MM
    words = "   ".join(part for part in (form, caption, "print at 100 %, not fitted to the page") if part)
    words_size = min(TEXT_MM, room / (GLYPH_SHARE * len(words)))
    texts = [Text(UNPRINTABLE_MM, bottom - 0.25 * TEXT_MM, words_size, words)]
    y = bottom - TEXT_MM - GAP_MM
    for length in RULERS_MM:
        label = f"{length} mm"
        if length + GAP_MM + GLYPH_SHARE * TEXT_MM * len(label) <= room:
            texts.append(Text(UNPRINTABLE_MM + length + GAP_MM, y, TEXT_MM, label))
            return _ruler(length, UNPRINTABLE_MM, y), tuple(texts)
    return [], tuple(texts)


def _ruler(length: int, x: float, y: float) -> list[Array]:
    """Outlines, metres, of a ruler of so many mm; it is measured between the middles of its ticks."""
    middle = x + np.arange(0, length + 1, TICKS_EVERY_MM)
    half = LINE_MM / 2
    low = np.stack([middle - half, np.full(len(middle), y - TICK_MM)], axis=1)
    high = np.stack([middle + half, np.full(len(middle), y - LINE_MM)], axis=1)
    low = np.append(low, [[x - half, y - LINE_MM]], axis=0)
    high = np.append(high, [[x + length + half, y]], axis=0)
    return rectangles(1e-3 * low, 1e-3 * high)
