"""Where on a board some of its squares are, told by the markers in them.

Squares are counted by column and row, those of the board from its upper left and those of an image from
anywhere. Legible markers vote for how the ones lie on the others. Where blur leaves none legible, all of them
together still look like one part of the board and like no other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from .corner_links import Linking
from .markers import marker_bits

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MIN_VOTES = 2
"""Markers that agree on where the squares are; a single one may be chance."""
MIN_COMPARED = 6
"""Markers that are compared with the board when none is legible."""
MIN_LIKENESS = 0.6
"""Correlation of what they show with the board. Chance gives 0.15 (sd) for six markers of 4x4 bits, of which
blur leaves half independent, and a board of another width, on which two rows of five agree, 0.4."""
BLUR = np.array([0.25, 0.5, 0.25], np.float32)
"""Blur along a row of bits at which they are just not legible any more: 0.7 of a bit, sd."""


@dataclass(frozen=True, eq=False)
class Layout:
    """What is where on a board, by squares: those between its corners, tags and gaps among them.

    Attributes
    ----------
    numbers : (R, C)
        Marker in each square, -1 for none.
    corners : (R + 1, C + 1, 2)
        Corners of the squares, metres; NaN where no squares meet.
    dictionary : str
        Where the markers come from.
    border_bits : tuple of int
        How wide their black border may be.
    inset : float
        Distance of the markers from the edges of the squares, as a share of these. If there is one, all
        squares are of one size.
    turn : int
        Right angles by which the markers are printed turned anticlockwise.
    linking : Linking
        What tells that two corners are neighbours.
    """

    numbers: Indices
    corners: Array
    dictionary: str
    linking: Linking
    border_bits: tuple[int, ...] = (1,)
    inset: float = 0.0
    turn: int = 0

    @cached_property
    def quads(self) -> Array:
        """(R, C, 4, 2) corners of each square, metres."""
        return corners_of_squares(self.corners)

    @cached_property
    def whole(self) -> int:
        """How many of the squares have four corners."""
        return int(np.isfinite(self.quads).all(axis=(2, 3)).sum())


class Placement(NamedTuple):
    """How squares lie on a board: turned clockwise by right angles, then moved by columns and rows.

    So many markers say so, which lie so many rows apart.
    """

    turn: int = 0
    offset: tuple[int, int] = (0, 0)
    votes: int = 0
    rows: int = 0

    def on_board(self, cells: Indices) -> Indices:
        """Column and row on the board of squares (K, 2) of the image."""
        return turned(cells, self.turn) + self.offset


def corners_of_squares(corners: Array) -> Array:
    """(R, C, 4, 2) corners of the squares between (R + 1, C + 1, 2), clockwise from the upper left."""
    return np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2)


def turned(cells: Indices, turn: int) -> Indices:
    """Squares (K, 2), column and row, of a grid that is turned clockwise by so many right angles."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn % 4]
    twice = (2 * cells + 1) @ np.array([[cosine, sine], [-sine, cosine]])  # about the corner between four
    return np.asarray((twice - 1) // 2)


def place_by_numbers(cells: Indices, ids: Indices, turns: Indices, layout: Layout) -> Placement:
    """Place squares by the markers read in them.

    Parameters
    ----------
    cells : (K, 2)
        Column and row of the squares in the image.
    ids, turns : (K,)
        Their markers, and by how many right angles these are turned anticlockwise against those of the board.
    layout : Layout

    Returns
    -------
    The placement that most markers say; without votes and as they are turned when none is on the board.
    """
    if len(ids) == 0:
        return Placement()
    rows, columns = np.nonzero(layout.numbers >= 0)
    place = np.full((max(ids.max(), layout.numbers.max()) + 1, 2), -1)
    place[layout.numbers[rows, columns]] = np.stack([columns, rows], axis=1)
    own = place[ids, 0] >= 0
    if not own.any():
        return Placement(int(np.bincount(turns).argmax()))
    upright = np.stack([turned(cells[own], turn) for turn in range(4)])[turns[own], np.arange(own.sum())]
    said = np.column_stack([turns[own], place[ids[own]] - upright])
    different, which, votes = np.unique(said, axis=0, return_inverse=True, return_counts=True)
    most = int(votes.argmax())
    turn, column, row = different[most].tolist()
    agreeing = place[ids[own]][which.ravel() == most]
    return Placement(turn, (column, row), int(votes.max()), int(np.ptp(agreeing[:, 1])))


def place_by_likeness(cells: Indices, levels: Array, border_bits: int, layout: Layout) -> Placement:
    """Place squares, all of which must be on the board, by how their markers look together.

    Parameters
    ----------
    cells : (K, 2)
        Column and row of the squares in the image.
    levels : (K, n, n)
        Brightness of their bits, without the border.
    border_bits : int
        Width of the border.
    layout : Layout

    Returns
    -------
    The most likely placement, all its markers voting for it; without votes when it is not likely enough.
    """
    best, most = Placement(), MIN_LIKENESS
    if len(cells) < MIN_COMPARED:
        return best
    levels = _levelled(levels)
    looks = _blurred(layout.dictionary, int(layout.numbers.max()) + 1, layout.turn, border_bits)
    for turn in range(4):
        place = turned(cells, turn)
        place, first = place - place.min(axis=0), place.min(axis=0)
        upright = np.rot90(levels, -turn, axes=(1, 2))
        free = np.array(layout.numbers.shape[::-1]) - place.max(axis=0)
        for offset in product(range(free[0]), range(free[1])):
            column, row = (place + offset).T
            number = layout.numbers[row, column]
            marked = number >= 0
            if marked.sum() >= MIN_COMPARED:
                likeness = _correlation(upright[marked], looks[number[marked]])
                if likeness > most:
                    shift = (offset[0] - int(first[0]), offset[1] - int(first[1]))
                    best, most = Placement(turn, shift, int(marked.sum())), likeness
    return best


def looks_so(placement: Placement, cells: Indices, levels: Array, border_bits: int, layout: Layout) -> bool:
    """Whether markers that are not legible look as a placement has them, if there are any.

    Parameters as for :func:`place_by_likeness`, of these markers.
    """
    place = placement.on_board(cells)
    inside = np.all((place >= 0) & (place < np.array(layout.numbers.shape[::-1])), axis=1)
    column, row = place[inside].T
    number = layout.numbers[row, column]
    marked = number >= 0
    if not marked.any():
        return True
    looks = _blurred(layout.dictionary, int(layout.numbers.max()) + 1, layout.turn, border_bits)
    upright = np.rot90(_levelled(levels[inside]), -placement.turn, axes=(1, 2))
    # One or two have no less in common with each other than with what is printed.
    return float(np.mean(upright[marked] * _levelled(looks[number[marked]]))) > MIN_LIKENESS


def _levelled(levels: Array) -> Array:
    """Markers (K, n, n) less their mean brightness, in units of their contrast."""
    spread = levels.std(axis=(1, 2), keepdims=True)
    levelled: Array = (levels - levels.mean(axis=(1, 2), keepdims=True)) / np.maximum(spread, 1e-9)
    return levelled


@lru_cache(maxsize=4)
def _blurred(dictionary: str, count: int, turn: int, border_bits: int) -> NDArray[np.float32]:
    """(M, n, n) markers as they are printed, blurred, by number."""
    printed = np.rot90(marker_bits(dictionary, np.arange(count)), turn, axes=(1, 2)).astype(np.float32)
    padded = np.pad(printed, ((0, 0), (border_bits, border_bits), (border_bits, border_bits)))
    inner = slice(border_bits, -border_bits)
    return np.stack([cv2.sepFilter2D(each, -1, BLUR, BLUR)[inner, inner] for each in padded])


def _correlation(seen: Array, printed: Array) -> float:
    """Correlation of markers (K, n, n) less what all of them have in common, such as the border's shade."""
    seen, printed = seen - seen.mean(axis=0), printed - printed.mean(axis=0)
    return float(np.sum(seen * printed) / np.sqrt(np.sum(seen**2) * np.sum(printed**2) + 1e-9))
