"""Find a ChArUco board, or a part of it, and say why when there is none to use."""

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
    from .charuco import Charuco

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

REACH = 2.1
"""Markers are held against those one square off across the diagonal, and two along a row or a column."""
MOST_COLUMNS = 40
"""Widest board that is tried to explain markers that lie otherwise."""


def detect_charuco(
    grey: GreyImage, board: Charuco, source: str = "", stamp_ns: int | None = None
) -> Detection:
    """Find a ChArUco board or a part of it, see :meth:`fewcal.boards.Board.detect`."""
    extent = max(board.columns, board.rows) * board.square_size / board.marker_size
    found = find_board_markers(grey, board.dictionary, 1, board.marker_count, extent)
    own = found.take(found.ids < board.marker_count)
    plane = board.marker_corners[own.ids]
    marker = board.marker_size / board.square_size
    gap, border = (1 - marker) / 2, marker / (DICTIONARIES[board.dictionary][0] + 2)
    grid = CornerGrid(
        board.points[:, :2].reshape(board.rows - 1, board.columns - 1, 2),
        board.square_size,
        Squares(gap, gap + border),
        REACH * board.square_size,
    )
    explain = partial(_explain, grey, board, found)
    return locate_board(grey, grid, plane, own.corners, len(found), explain, source, stamp_ns)


def _explain(grey: GreyImage, board: Charuco, found: Markers, fitting: int) -> BoardNotFound | None:
    """Say why few markers or none fit the board; None when nothing fits better."""
    if len(found) < 2:
        other = recognise(grey, found.candidates)
        if other is not None and other != board.dictionary:
            return BoardNotFound(
                "wrong size",
                f"The markers are those of {other}, not of {board.dictionary}; name the dictionary that the "
                "board was printed with.",
            )
        return BoardNotFound(
            "no board",
            f"No markers of {board.dictionary} are to be seen; show the board sharp, well lit and close by.",
        )
    most, columns, first_white = max(
        (_fitting(found, columns, white), columns, white)
        for columns in range(2, MOST_COLUMNS)
        for white in (False, True)
    )
    if most <= max(fitting, 2):
        return None
    if columns != board.columns:
        return BoardNotFound(
            "wrong size",
            f"The markers lie as on a board {columns} squares wide, not {board.columns}; give the size of "
            "the board that is shown, in squares.",
        )
    if first_white == board.first_is_white:
        return BoardNotFound(
            "wrong size",
            f"Markers up to number {found.ids.max()} are seen, {board} ends with {board.marker_count - 1}; "
            "give the number of rows of the board that is shown, in squares.",
        )
    age, hint = ("before", "add :legacy to the board") if first_white else ("since", "leave :legacy away")
    return BoardNotFound(
        "wrong size", f"The markers lie as on boards with even rows printed {age} OpenCV 4.6; {hint}."
    )


def _fitting(found: Markers, columns: int, first_is_white: bool) -> int:
    """How many of the markers lie as on a board so many squares wide."""
    rows = 2 * (int(found.ids.max()) + 1) // columns + 2
    squares = white_squares(columns, rows, first_is_white)[found.ids]
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=np.float64)
    return int(largest_board(squares[:, None] + unit, found.corners, REACH).sum())


def white_squares(columns: int, rows: int, first_is_white: bool) -> Indices:
    """(M, 2) column and row of the white squares, in the order of their markers."""
    row, column = np.nonzero(np.indices((rows, columns)).sum(axis=0) % 2 == (0 if first_is_white else 1))
    return np.stack([column, row], axis=1)
