"""Find an AprilGrid, or a part of it, and say why when there is none to use."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .corner_links import Linking
from .corner_refinement import Squares
from .detection import Detection
from .errors import BoardNotFound
from .grey import GreyImage
from .marker_boards import CornerGrid, locate_board, mirrored
from .marker_lattice import Sighting, find_squares
from .marker_placement import Layout
from .markers import DICTIONARIES, in_mirror, recognise
from .tag_gap import seen_gap

if TYPE_CHECKING:
    from .aprilgrid import AprilGrid

Array = NDArray[np.float64]

BORDER_BITS = 2
"""Kalibr's tags have a black border of two bits, where those of the AprilTag library have one."""
LINKING = Linking(nearest=32, side=0.06, least_side_px=0.8, max_step_ratio=math.inf)
"""A corner has neighbours beyond the corners of the tags around it and those of the bits inside them; the
step across an edge is seen inside the border, half a bit off; the edges of the small squares are short, how
much shorter than those of the tags differs from board to board."""
REACH = 1.5
"""Tags are held against their neighbours, across the diagonal too: 1.41 times their pitch."""
SQUARE = 1.5
"""Edge of the squares that meet at a corner, in gaps: the small one is one gap wide, the tag several."""
SAME_GAP = 0.015
"""How far the gap that is seen may be from the one asked for, as a share of the tag. On real boards it is off
by 0.002; a gap off by 0.02 moves k1 of a usable camera by its sigma."""
SURELY = 6.0
"""And by how many of its own sd, which few or small tags leave."""


def detect_aprilgrid(
    grey: GreyImage, board: AprilGrid, source: str = "", stamp_ns: int | None = None
) -> Detection:
    """Find an AprilGrid or a part of it, see :meth:`fewcal.boards.Board.detect`."""
    layout = aprilgrid_layout(board)
    seen = find_squares(grey, layout)
    if seen.votes < len(seen.ids) or len(seen.squares) == 0:
        reason = _explain(grey, board, seen)
        if reason is not None:
            raise reason
    gap, sd = seen_gap(_lattice(layout, seen))
    if abs(gap - board.gap) > max(SAME_GAP, SURELY * sd):
        raise BoardNotFound(
            "wrong size",
            f"The gaps between the tags are {gap:.2f} of a tag, not {board.gap:g}; give the gap of the board "
            "that is shown.",
        )
    square = SQUARE * board.gap * board.tag_size
    cells = DICTIONARIES[board.dictionary][0] + 2 * seen.border_bits
    grid = CornerGrid(
        board.points[:, :2].reshape(2 * board.rows, 2 * board.columns, 2),
        square,
        Squares(known=seen.border_bits / cells * board.tag_size / square),
        REACH * board.pitch,
    )
    return locate_board(
        grey, grid, layout.quads[seen.squares[:, 1], seen.squares[:, 0]], seen.pixels, source, stamp_ns
    )


@lru_cache(maxsize=4)
def aprilgrid_layout(board: AprilGrid) -> Layout:
    """Tags, small squares and gaps, row by row from the top."""
    numbers = np.full((2 * board.rows - 1, 2 * board.columns - 1), -1)
    rows = slice(None, None, 2 if board.from_top else -2)
    numbers[rows, ::2] = np.arange(board.rows * board.columns).reshape(board.rows, board.columns)
    corners = board.points[:, :2].reshape(2 * board.rows, 2 * board.columns, 2)[::-1]
    # OpenCV's tags are upside down.
    return Layout(numbers, corners, board.dictionary, LINKING, (BORDER_BITS, 1), turn=2)


def _lattice(layout: Layout, seen: Sighting) -> Array:
    """Corners (R + 1, C + 1, 2) of the squares that are seen, pixels; NaN for the others."""
    corners = np.full(layout.corners.shape, np.nan)
    for i, (right, down) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
        corners[seen.squares[:, 1] + down, seen.squares[:, 0] + right] = seen.pixels[:, i]
    return corners


def _explain(grey: GreyImage, board: AprilGrid, seen: Sighting) -> BoardNotFound | None:
    """Say why few tags or none fit the board; None when nothing fits better."""
    if any(
        in_mirror(grey, seen.unread, board.dictionary, border, least=len(seen.ids))
        for border in (BORDER_BITS, 1)
    ):
        return mirrored()
    if len(seen.ids) < 2:
        for border in (BORDER_BITS, 1):
            other = recognise(grey, seen.unread, border)
            if other is not None and other != board.dictionary:
                family = other.replace("DICT_APRILTAG_", "tag")
                return BoardNotFound(
                    "wrong size",
                    f"The tags are those of {family}, not of {board.family}; name the family that the board "
                    "was printed with.",
                )
        return BoardNotFound(
            "no board",
            f"No tags of {board.family} are to be seen; show the board sharp, well lit and close by.",
        )
    step = seen.markers_a_step(2)
    if step is not None and (step > 0) != board.from_top:
        row, hint = ("top", "add :top to the board") if step > 0 else ("bottom", "leave :top away")
        return BoardNotFound("wrong size", f"The tags are counted from the {row} row; {hint}.")
    columns = step and abs(step)
    if columns not in (None, board.columns):
        return BoardNotFound(
            "wrong size",
            f"The tags lie as on a board {columns} tags wide, not {board.columns}; give the size of the "
            "board that is shown.",
        )
    count = board.columns * board.rows
    if seen.ids.max() >= count:
        return BoardNotFound(
            "wrong size",
            f"Tags up to number {seen.ids.max()} are seen, {board} ends with {count - 1}; "
            "give the number of rows of the board that is shown.",
        )
    return None
