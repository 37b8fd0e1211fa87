"""Find a ChArUco board, or a part of it, and say why when there is none to use."""

from __future__ import annotations

from dataclasses import replace
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

if TYPE_CHECKING:
    from .charuco import Charuco

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

REACH = 2.1
"""Squares are held against those up to two squares off."""


def detect_charuco(
    grey: GreyImage, board: Charuco, source: str = "", stamp_ns: int | None = None
) -> Detection:
    """Find a ChArUco board or a part of it, see :meth:`fewcal.boards.Board.detect`."""
    marker = board.marker_size / board.square_size
    gap, border = (1 - marker) / 2, marker / (DICTIONARIES[board.dictionary][0] + 2)
    layout = charuco_layout(board)
    seen = find_squares(grey, layout)
    if seen.votes < len(seen.ids) or len(seen.squares) == 0:
        reason = _explain(grey, board, seen)
        if reason is not None:
            raise reason
    grid = CornerGrid(
        board.points[:, :2].reshape(board.rows - 1, board.columns - 1, 2),
        board.square_size,
        Squares(gap, gap + border),
        REACH * board.square_size,
    )
    return locate_board(
        grey, grid, layout.quads[seen.squares[:, 1], seen.squares[:, 0]], seen.pixels, source, stamp_ns
    )


@lru_cache(maxsize=4)
def charuco_layout(board: Charuco) -> Layout:
    """Squares, and a marker in each white one; at the rim no squares meet."""
    numbers = np.full((board.rows, board.columns), -1)
    column, row = white_squares(board.columns, board.rows, board.first_is_white).T
    numbers[row, column] = np.arange(board.marker_count)
    corners = np.full((board.rows + 1, board.columns + 1, 2), np.nan)
    corners[1:-1, 1:-1] = board.points[:, :2].reshape(board.rows - 1, board.columns - 1, 2)
    gap = (1 - board.marker_size / board.square_size) / 2
    # The step across an edge is seen half way to the marker; the corners of two markers' bits are in between.
    return Layout(numbers, corners, board.dictionary, Linking(nearest=32, side=gap / 2), inset=gap)


def _explain(grey: GreyImage, board: Charuco, seen: Sighting) -> BoardNotFound | None:
    """Say why few markers or none fit the board; None when nothing fits better."""
    inset = (1 - board.marker_size / board.square_size) / 2
    if in_mirror(grey, seen.unread, board.dictionary, 1, inset, len(seen.ids)):
        return mirrored()
    if len(seen.ids) < 2:
        other = recognise(grey, seen.unread, 1, inset)
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
    columns = seen.markers_a_step(2)
    if columns is not None and columns < 0:  # some dictionaries have the mirror images of their markers too
        return mirrored()
    if columns not in (None, board.columns):
        return BoardNotFound(
            "wrong size",
            f"The markers lie as on a board {columns} squares wide, not {board.columns}; give the size of "
            "the board that is shown, in squares.",
        )
    if seen.ids.max() >= board.marker_count:
        return BoardNotFound(
            "wrong size",
            f"Markers up to number {seen.ids.max()} are seen, {board} ends with {board.marker_count - 1}; "
            "give the number of rows of the board that is shown, in squares.",
        )
    other_age = replace(board, legacy=not board.legacy)
    if (
        other_age.first_is_white != board.first_is_white
        and seen.fitting(charuco_layout(other_age)) > seen.votes
    ):
        age, hint = (
            ("since", "leave :legacy away") if board.legacy else ("before", "add :legacy to the board")
        )
        return BoardNotFound(
            "wrong size", f"The markers lie as on boards with even rows printed {age} OpenCV 4.6; {hint}."
        )
    return None


def white_squares(columns: int, rows: int, first_is_white: bool) -> Indices:
    """(M, 2) column and row of the white squares, in the order of their markers."""
    row, column = np.nonzero(np.indices((rows, columns)).sum(axis=0) % 2 == (0 if first_is_white else 1))
    return np.stack([column, row], axis=1)
