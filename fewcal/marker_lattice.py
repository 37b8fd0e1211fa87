"""Which squares of an image belong to a board with markers, and which of the board's squares they are.

    image -> reduced copies, coarse to fine -> saddle points -> chains of corners -> the squares between them
          -> the markers in these -> where on the board the chain lies

Of copies too large to be searched whole, one window is searched: about the place where the copy before has
the strongest and densest saddle points. Too small there for its corners to be told from those of the markers'
bits, a board still has more of both than anything else that is usually seen.

The corners that edges link have integer coordinates, so that two markers of a chain say where all of its
corners are; the others need not be legible.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .corner_links import Linking
from .grey import GreyImage
from .grid import find_chains, local_axes, square_size
from .marker_geometry import local_frames
from .marker_placement import (
    MIN_VOTES,
    Layout,
    Placement,
    corners_of_squares,
    looks_so,
    place_by_likeness,
    place_by_numbers,
    turned,
)
from .markers import DICTIONARIES, read_levels, read_markers
from .reduction import SEARCHED_PX, WINDOW_PX, densest_window, reduce, reductions
from .saddle_points import SaddlePoints, find_saddle_points

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

MIN_CORNERS = 4
"""Fewest linked corners that are of interest: one square."""
MAX_CHAINS = 8
"""Chains of corners that are looked at, those of most corners first; what covers a board parts it in some."""
TELLING_ROWS = 2
"""Rows between two markers from which their numbers tell how wide the board is: boards of seven and of eight
squares have four markers in the first row."""
MIN_LINKED = 9
"""Linked corners of squares that are worth a look at a finer copy: those of four squares."""
SMALL_SQUARE_PX = 8.0
"""Squares smaller than this in one copy are shown better by the next."""
RESOLVED_PX = 20.0
"""Squares of this size in a copy have been found in it: their bits are some pixels wide."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """What an image shows of a board.

    Attributes
    ----------
    squares : (S, 2)
        Column and row of the squares of the board that were identified and have four corners.
    pixels : (S, 4, 2)
        Their corners in the image, to about a pixel, in the order of the board: upper left, upper right, and
        on around.
    border_bits : int
        Width of the markers' border.
    ids : (K,)
        Markers that were read in the chain that has most of them.
    cells : (K, 2)
        Their columns and rows, upright, counted from anywhere.
    votes : int
        How many markers of this chain lie as on the board; more than were read when they were placed by how
        they look.
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

    @property
    def square_px(self) -> float:
        """Median side of the squares, pixels; 0 when there are none."""
        sides = np.linalg.norm(np.diff(self.pixels, axis=1), axis=2)
        return float(np.median(sides)) if len(sides) else 0.0

    def markers_a_step(self, squares: int) -> int | None:
        """By how much the numbers of the markers grow that many squares down; None where that is not seen."""
        down = self.cells - self.cells[:, None]
        first, second = np.nonzero((down[..., 0] == 0) & (down[..., 1] == squares))
        steps = self.ids[second] - self.ids[first]
        if len(steps) < MIN_VOTES:
            return None
        different, votes = np.unique(steps, return_counts=True)
        return int(different[votes.argmax()])

    def fitting(self, layout: Layout) -> int:
        """How many of the markers lie as on another board."""
        return place_by_numbers(self.cells, self.ids, np.zeros_like(self.ids), layout).votes


@dataclass(frozen=True, eq=False)
class _Chain:
    """Corners (R, C, 2) that edges link, NaN where unknown, and the squares between them."""

    corners: Array
    cells: Indices
    quads: Array
    closed: NDArray[np.bool_]


class _Part(NamedTuple):
    """What one chain adds to a `Sighting`; see there."""

    squares: Indices
    pixels: Array
    ids: Indices
    cells: Indices
    votes: int


def find_squares(grey: GreyImage, layout: Layout) -> Sighting:
    """Find the squares of a board with markers.

    Parameters
    ----------
    grey : (H, W) array of uint8 or uint16
    layout : Layout
    """
    chains: list[Array] = []
    peaks, strength = np.empty((0, 2)), np.empty(0)
    best = _identify(grey, [], layout)
    for factor in reductions(grey):
        window = np.s_[:, :]
        if max(grey.shape) / factor > SEARCHED_PX and not _shows_small_squares(chains):
            if best.square_px >= RESOLVED_PX * 2 * factor:  # in the copy before
                break
            window = densest_window(peaks, strength, grey.shape, WINDOW_PX * factor)
        image = reduce(grey[window], factor)
        saddles = find_saddle_points(image)
        chains = list(_find_chains(image, saddles, layout.linking))
        origin = np.array([window[1].start or 0, window[0].start or 0])
        peaks, strength = (saddles.peaks + 0.5) * factor - 0.5 + origin, saddles.strength
        seen = _identify(grey, [(chain + 0.5) * factor - 0.5 + origin for chain in chains], layout)
        best = max(seen, best, key=lambda each: (len(each.squares), len(each.ids), len(each.unread)))
        if len(best.squares) == layout.whole:
            break
    return best


def _shows_small_squares(chains: list[Array]) -> bool:
    """Whether there are some so small that a finer copy may show more; one or two are chance."""
    return any(
        np.isfinite(chain[..., 0]).sum() >= MIN_LINKED and square_size(chain) < SMALL_SQUARE_PX
        for chain in chains
    )


def _find_chains(image: GreyImage, saddles: SaddlePoints, linking: Linking) -> Iterator[Array]:
    """Linked corners (R, C, 2) that enclose squares, NaN for others; x cross y away from the camera."""
    for grid, _ in islice(find_chains(image, saddles, linking, MIN_CORNERS), MAX_CHAINS):
        corners = np.where((grid >= 0)[..., None], saddles.points[grid], np.nan)
        closed = np.pad(np.isfinite(corners_of_squares(corners)).all(axis=(2, 3)), 1)
        enclosing = closed[1:, 1:] | closed[1:, :-1] | closed[:-1, 1:] | closed[:-1, :-1]
        corners[~enclosing] = np.nan
        if enclosing.any():
            across, down = (np.nanmean(axes, axis=(0, 1)) for axes in local_axes(corners))
            yield corners if across[0] * down[1] > across[1] * down[0] else corners[:, ::-1]


def _chain(corners: Array, even: bool) -> _Chain:
    """Squares of a chain: those of which all corners are known, and their neighbours where all are alike."""
    known = np.isfinite(corners[..., 0])
    if even:
        corners, known = np.pad(corners, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan), np.pad(known, 1)
        corners = _extended(corners, known)
    count = known[:-1, :-1].astype(int) + known[:-1, 1:] + known[1:, 1:] + known[1:, :-1]
    quads = corners_of_squares(corners)
    rows, columns = np.nonzero((count >= 2) & np.isfinite(quads).all(axis=(2, 3)))
    return _Chain(corners, np.stack([columns, rows], axis=1), quads[rows, columns], count[rows, columns] == 4)


def _extended(corners: Array, known: NDArray[np.bool_]) -> Array:
    """Corners with those beside known ones where the plane of these, seen in perspective, has them."""
    wide = np.pad(known, 1)
    rows, columns = known.shape
    beside = (
        np.any([wide[i : i + rows, j : j + columns] for i in range(3) for j in range(3)], axis=0) & ~known
    )
    place = np.stack(np.nonzero(known), axis=1)[:, ::-1].astype(float)
    wanted = np.stack(np.nonzero(beside), axis=1)[:, ::-1].astype(float)
    frames = local_frames(place, corners[known], np.ones(len(place)), wanted)
    extended = corners.copy()
    extended[beside] = frames[:, :2, 2]
    return extended


def _identify(grey: GreyImage, found: Sequence[Array], layout: Layout) -> Sighting:
    """Read the markers in chains of corners, and place these on the board."""
    chains = [_chain(corners, layout.inset > 0) for corners in found]
    seen: list[Sighting] = []
    for border in layout.border_bits:
        seen.append(_with_border(grey, chains, border, layout))
        if len(seen[-1].squares) == layout.whole:
            break
    return max(seen, key=lambda each: (len(each.squares), len(each.ids)))


def _with_border(grey: GreyImage, chains: list[_Chain], border: int, layout: Layout) -> Sighting:
    """Do so given how wide the border of the markers is."""
    quads = np.concatenate([np.empty((0, 4, 2)), *(chain.quads for chain in chains)])
    cells = DICTIONARIES[layout.dictionary][0] + 2 * border
    levels = read_levels(grey, quads, cells, layout.inset)
    ids, turns = read_markers(levels, layout.dictionary)
    inner = levels[:, border:-border, border:-border]
    ends = np.cumsum([len(chain.quads) for chain in chains])[:-1]
    parts = [_Part(np.empty((0, 2), np.intp), np.empty((0, 4, 2)), ids[:0], np.empty((0, 2), np.intp), 0)]
    if chains:
        split = (np.split(each, ends) for each in (ids, (turns - layout.turn) % 4, inner))
        parts += [_part(layout, border, *each) for each in zip(chains, *split, strict=True)]
    squares, pixels = (np.concatenate(each) for each in list(zip(*parts, strict=True))[:2])
    main = max(parts, key=lambda part: (len(part.ids), part.votes))
    return Sighting(squares, pixels, border, *main[2:], quads[ids < 0])


def _part(layout: Layout, border: int, chain: _Chain, ids: Indices, turns: Indices, levels: Array) -> _Part:
    """Place one chain, given the markers in its squares, -1 for none, and how bright their bits are."""
    read = ids >= 0
    rest = chain.closed & ~read
    placement = place_by_numbers(chain.cells[read], ids[read], turns[read], layout)
    upright = turned(chain.cells[read], placement.turn)
    if placement.votes < MIN_VOTES:
        placement = place_by_likeness(chain.cells, levels, border, layout)
    elif placement.rows < TELLING_ROWS and not (
        placement.votes == read.sum() and looks_so(placement, chain.cells[rest], levels[rest], border, layout)
    ):
        placement = Placement(placement.turn)
    cells = placement.on_board(chain.cells)
    known = chain.closed & (placement.votes >= MIN_VOTES)
    known &= np.all((cells >= 0) & (cells < np.array(layout.numbers.shape[::-1])), axis=1)
    column, row = cells[known].T
    known[known] = np.isfinite(layout.quads[row, column]).all(axis=(1, 2))
    pixels = np.roll(chain.quads[known], placement.turn, axis=1)
    return _Part(cells[known], pixels, ids[read], upright, placement.votes)
