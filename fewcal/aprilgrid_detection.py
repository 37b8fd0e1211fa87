"""Find an AprilGrid, or a part of it, and say why when there is none to use."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .corner_refinement import Squares
from .detection import Detection
from .errors import BoardNotFound
from .grey import GreyImage
from .marker_boards import CornerGrid, locate_board
from .marker_geometry import largest_board
from .markers import DICTIONARIES, Markers, find_board_markers, recognise

if TYPE_CHECKING:
    from .aprilgrid import AprilGrid

Array = NDArray[np.float64]

BORDER_BITS = 2
"""Kalibr's tags have a black border of two bits, where those of the AprilTag library have one."""
REACH = 1.5
"""Tags are held against their neighbours, across the diagonal too: 1.41 times their pitch."""
SQUARE = 1.5
"""Edge of the squares that meet at a corner, in gaps: the small one is one gap wide, the tag several."""
USUAL_GAP = 0.3
"""Gap of Kalibr's own boards, good enough to tell how many columns there are."""
MOST_COLUMNS = 40
"""Widest board that is tried to explain tags that lie otherwise."""


def detect_aprilgrid(
    grey: GreyImage, board: AprilGrid, source: str = "", stamp_ns: int | None = None
) -> Detection:
    """Find an AprilGrid or a part of it, see :meth:`fewcal.boards.Board.detect`."""
    count, extent = board.columns * board.rows, max(board.columns, board.rows) * (1 + board.gap)
    found = find_board_markers(grey, board.dictionary, BORDER_BITS, count, extent)
    own = found.take(found.ids < count)
    plane = np.roll(board.tag_corners, 2, axis=1)[own.ids]  # OpenCV's tags are upside down
    square = SQUARE * board.gap * board.tag_size
    border = BORDER_BITS / (DICTIONARIES[board.dictionary][0] + 2 * BORDER_BITS) * board.tag_size
    grid = CornerGrid(
        board.points[:, :2].reshape(2 * board.rows, 2 * board.columns, 2),
        square,
        Squares(known=border / square),
        REACH * board.pitch,
    )
    explain = partial(_explain, grey, board, found)
    return locate_board(grey, grid, plane, own.corners, len(found), explain, source, stamp_ns)


def _explain(grey: GreyImage, board: AprilGrid, found: Markers, fitting: int) -> BoardNotFound | None:
    """Say why few tags or none fit the board; None when nothing fits better."""
    if len(found) < 2:
        other = recognise(grey, found.candidates, BORDER_BITS)
        if other is not None and other != board.dictionary:
            return BoardNotFound(
                "wrong size",
                f"The tags are those of {other.removeprefix('DICT_')}, not of {board.family}; name the "
                "family that the board was printed with.",
            )
        return BoardNotFound(
            "no board",
            f"No tags of {board.family} with a border of two bits are to be seen; show the board sharp, well "
            "lit and close by.",
        )
    most, columns = max((_fitting(found, columns), columns) for columns in range(1, MOST_COLUMNS))
    if most <= max(fitting, 2):
        return None
    if columns != board.columns:
        return BoardNotFound(
            "wrong size",
            f"The tags lie as on a board {columns} tags wide, not {board.columns}; give the size of the "
            "board that is shown.",
        )
    return BoardNotFound(
        "wrong size",
        f"Tags up to number {found.ids.max()} are seen, {board} ends with {board.columns * board.rows - 1}; "
        "give the number of rows of the board that is shown.",
    )


def _fitting(found: Markers, columns: int) -> int:
    """How many of the tags lie as on a board so many tags wide, whatever the gap."""
    row, column = np.divmod(found.ids, columns)
    unit = np.array([[1, 0], [0, 0], [0, -1], [1, -1]], dtype=np.float64)
    plane = np.stack([column, -row], axis=1)[:, None] * (1 + USUAL_GAP) + unit
    return int(largest_board(plane, found.corners, REACH * (1 + USUAL_GAP)).sum())
