"""Which squares of an image belong to a board with markers, and which of the board's squares they are.

    image -> reduced copies, coarse to fine -> saddle points -> chains of corners -> the squares between them
          -> the markers in these -> where on the board the chain lies

The corners that edges link have integer coordinates, so that two markers of a chain say where all of its
corners are; the others need not be legible.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from .grey import GreyImage
from .grid import Linking, find_chains, local_axes, square_size
from .marker_geometry import local_frames
from .markers import read_markers
from .reduction import SEARCHED_PX, reduce, reductions
from .saddle_points import find_saddle_points

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

LINKING = Linking(nearest=32, side=0.08)
"""A corner of an AprilGrid has neighbours beyond the corners of the tags around it and those of the bits
inside them; and the step across an edge is seen between the marker and the edge, or inside its border."""
MIN_CORNERS = 4
"""Fewest linked corners that are of interest: one square."""
MAX_CHAINS = 8
"""Chains of corners that are looked at, those of most corners first; what covers a board parts it in some."""
MIN_VOTES = 2
"""Markers that agree on where a chain lies on the board; a single one may be chance."""
SMALL_SQUARE_PX = 8.0
"""Squares smaller than this in one copy are shown better by the next."""
_CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])


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
        Distance of the markers from the edges of the squares, as a share of these. If there is one, all squares
        are of one size.
    turn : int
        Right angles by which the markers are printed turned anticlockwise.
    """

    numbers: Indices
    corners: Array
    dictionary: str
    border_bits: tuple[int, ...] = (1,)
    inset: float = 0.0
    turn: int = 0


@dataclass(frozen=True, eq=False)
class Sighting:
    """What an image shows of a board.

    Attributes
    ----------
    squares : (S, 2)
        Column and row of the squares of the board that were identified and have four corners.
    pixels : (S, 4, 2)
        Their corners in the image, to about a pixel, in the order of the board: upper left, upper right, lower
        right, lower left.
    border_bits : int
        Width of the markers' border.
    ids : (K,)
        Markers that were read in the chain that has most of them.
    cells : (K, 2)
        Their columns and rows, upright, counted from anywhere.
    votes : int
        How many of them lie as on the board.
    unread : (U, 4, 2)
        Squares without a marker of the dictionary, pixels.
    """

    squares: Indices
    pixels: Array
    border_bits: int
    ids: Indices
    cells: Indices
    votes: int
    unread: Array

    def plane(self, layout: Layout) -> Array:
        """(S, 4, 2) corners of the squares on the board, metres."""
        return _corners_of_squares(layout.corners)[self.squares[:, 1], self.squares[:, 0]]

    def markers_a_step(self, squares: int) -> int | None:
        """By how much the numbers of the markers grow that many squares down; None where that is not seen."""
        down = self.cells - self.cells[:, None]
        first, second = np.nonzero((down[..., 0] == 0) & (down[..., 1] == squares))
        steps = self.ids[second] - self.ids[first]
        steps = steps[steps > 0]
        return int(np.bincount(steps).argmax()) if len(steps) >= MIN_VOTES else None

    def fitting(self, layout: Layout) -> int:
        """How many of the markers lie as on another board."""
        return _place(self.cells, self.ids, np.zeros_like(self.ids), layout)[2]


@dataclass(frozen=True, eq=False)
class _Chain:
    """Squares between corners that edges link: corners (R, C, 2), NaN where unknown, and what they enclose."""

    corners: Array
    cells: Indices
    quads: Array
    closed: NDArray[np.bool_]


def find_squares(grey: GreyImage, layout: Layout) -> Sighting:
    """Find the squares of a board with markers.

    Parameters
    ----------
    grey : (H, W) array of uint8 or uint16
    layout : Layout
    """
    whole = int(np.isfinite(_corners_of_squares(layout.corners)).all(axis=(2, 3)).sum())
    chains: list[Array] = []
    best = _identify(grey, [], layout)
    for factor in reductions(grey):
        if max(grey.shape) / factor > SEARCHED_PX and not _shows_small_squares(chains):
            break
        chains = list(_find_chains(reduce(grey, factor)))
        seen = _identify(grey, [(chain + 0.5) * factor - 0.5 for chain in chains], layout)
        if (len(seen.squares), len(seen.ids)) > (len(best.squares), len(best.ids)):
            best = seen
        if len(best.squares) == whole:
            break
    return best


def _shows_small_squares(chains: list[Array]) -> bool:
    return any(square_size(chain) < SMALL_SQUARE_PX for chain in chains)


def _find_chains(image: GreyImage) -> Iterator[Array]:
    """Corners (R, C, 2) that are linked and enclose squares, NaN for others; x cross y away from the camera."""
    saddles = find_saddle_points(image)
    for grid, _ in islice(find_chains(image, saddles, LINKING, MIN_CORNERS), MAX_CHAINS):
        corners = np.where((grid >= 0)[..., None], saddles.points[grid], np.nan)
        closed = np.pad(np.isfinite(_corners_of_squares(corners)).all(axis=(2, 3)), 1)
        enclosing = closed[1:, 1:] | closed[1:, :-1] | closed[:-1, 1:] | closed[:-1, :-1]
        corners[~enclosing] = np.nan
        if enclosing.any():
            across, down = (np.nanmean(axes, axis=(0, 1)) for axes in local_axes(corners))
            yield corners if across[0] * down[1] > across[1] * down[0] else corners[:, ::-1]


def _corners_of_squares(corners: Array) -> Array:
    """(R, C, 4, 2) corners of the squares between (R + 1, C + 1, 2) corners, clockwise from the upper left."""
    return np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2)


def _chain(corners: Array, even: bool) -> _Chain:
    """Squares of a chain: those of which all corners are known, and their neighbours where all are alike."""
    known = np.isfinite(corners[..., 0])
    if even:
        corners, known = np.pad(corners, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan), np.pad(known, 1)
        corners = _extended(corners, known)
    count = known[:-1, :-1].astype(int) + known[:-1, 1:] + known[1:, 1:] + known[1:, :-1]
    quads = _corners_of_squares(corners)
    rows, columns = np.nonzero((count >= 2) & np.isfinite(quads).all(axis=(2, 3)))
    return _Chain(
        corners, np.stack([columns, rows], axis=1), quads[rows, columns], count[rows, columns] == 4
    )


def _extended(corners: Array, known: NDArray[np.bool_]) -> Array:
    """Corners with those beside known ones where the plane of these, seen in perspective, has them."""
    wide = np.pad(known, 1)
    rows, columns = known.shape
    beside = np.any([wide[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=0) & ~known
    place = np.stack(np.nonzero(known), axis=1)[:, ::-1].astype(float)
    wanted = np.stack(np.nonzero(beside), axis=1)[:, ::-1].astype(float)
    frames, _ = local_frames(place, corners[known], np.ones(len(place)), wanted)
    extended = corners.copy()
    extended[beside] = frames[:, :2, 2]
    return extended


def _identify(grey: GreyImage, found: Sequence[Array], layout: Layout) -> Sighting:
    """Read the markers in chains of corners, and place these on the board."""
    chains = [_chain(corners, layout.inset > 0) for corners in found]
    quads = np.concatenate([np.empty((0, 4, 2)), *(chain.quads for chain in chains)])
    readings = {
        border: read_markers(grey, quads, layout.dictionary, border, layout.inset)
        for border in layout.border_bits
    }
    border = max(readings, key=lambda border: int((readings[border][0] >= 0).sum()))
    ids, turns = readings[border]
    turns = (turns - layout.turn) % 4
    squares, pixels = [np.empty((0, 2), np.intp)], [np.empty((0, 4, 2))]
    first, votes, most = 0, 0, np.empty((0, 2), np.intp)
    own_ids = np.empty(0, np.intp)
    for chain in chains:
        own = slice(first, first + len(chain.cells))
        first = own.stop
        read = ids[own] >= 0
        turn, offset, agreeing = _place(chain.cells[read], ids[own][read], turns[own][read], layout)
        if read.sum() > len(own_ids):
            own_ids, votes = ids[own][read], agreeing
            most = _turned(chain.cells[read], turn)
        if agreeing >= MIN_VOTES:
            cells = _turned(chain.cells, turn) + offset
            inside = np.all((cells >= 0) & (cells < np.array(layout.numbers.shape[::-1])), axis=1)
            column, row = np.where(inside[:, None], cells, 0).T
            meeting = np.isfinite(_corners_of_squares(layout.corners)[row, column]).all(axis=(1, 2))
            kept = inside & meeting & chain.closed
            squares.append(cells[kept])
            pixels.append(np.roll(chain.quads[kept], turn, axis=1))
    return Sighting(
        np.concatenate(squares), np.concatenate(pixels), border, own_ids, most, votes, quads[ids < 0]
    )


def _place(cells: Indices, ids: Indices, turns: Indices, layout: Layout) -> tuple[int, Indices, int]:
    """Say how a chain lies on the board: right angles, shift in squares, and how many markers say so.

    When none is of the board the turn is that of most markers.
    """
    if len(ids) == 0:
        return 0, np.zeros(2, np.intp), 0
    place = np.full((max(int(ids.max()), int(layout.numbers.max())) + 1, 2), -1)
    rows, columns = np.nonzero(layout.numbers >= 0)
    place[layout.numbers[rows, columns]] = np.stack([columns, rows], axis=1)
    usual = int(np.bincount(turns).argmax())
    own = place[ids][:, 0] >= 0
    if not own.any():
        return usual, np.zeros(2, np.intp), 0
    turned = np.array([_turned(cell[None], turn)[0] for cell, turn in zip(cells[own], turns[own], strict=True)])
    said = np.column_stack([turns[own], place[ids[own]] - turned])
    different, votes = np.unique(said, axis=0, return_counts=True)
    best = different[votes.argmax()]
    return int(best[0]), best[1:], int(votes.max())


def _turned(cells: Indices, turn: int) -> Indices:
    """Cells (K, 2), column and row, of a grid turned by so many right angles."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn % 4]
    twice = (2 * cells + 1) @ np.array([[cosine, sine], [-sine, cosine]])  # about the corner between four
    return (twice - 1) // 2
