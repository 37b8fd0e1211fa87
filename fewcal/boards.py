"""What is printed: calibration targets, and where their points are in metres.

A board has one text form, the same on the command line, in ROS parameters and in YAML:
``KIND:COLUMNSxROWS:SIZE``, sizes in metres.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInput

_FORM = "chessboard:COLUMNSxROWS:SQUARE, for example chessboard:9x6:0.025 (interior corners, metres)"


@runtime_checkable
class Board(Protocol):
    """A planar target with known points; ``str(board)`` is its text form."""

    @property
    def points(self) -> NDArray[np.float64]:
        """(N, 3) points in the board frame, metres, all with z = 0."""


@dataclass(frozen=True)
class Chessboard:
    """A chessboard, counted in interior corners.

    The board frame has its origin at the first interior corner, x along a row of corners, y along a
    column and z = x cross y, away from a camera that looks at the printed side.

    Parameters
    ----------
    columns, rows : int
        Interior corners along x and along y, at least 3 each. A board of 10x7 squares has 9x6.
    square_size : float
        Edge of a square, metres.

    Raises
    ------
    InvalidInput
        When a count is below 3 or the square size is not a positive length.
    """

    columns: int
    rows: int
    square_size: float

    def __post_init__(self) -> None:
        for name, count in (("columns", self.columns), ("rows", self.rows)):
            if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 3:
                raise InvalidInput(
                    f"A chessboard needs at least 3 interior corners each way, but {name} is {count!r}."
                )
        if not (isinstance(self.square_size, float | int | np.number) and 0 < self.square_size < math.inf):
            raise InvalidInput(
                f"The square size must be a positive length in metres, not {self.square_size!r}."
            )

    @property
    def points(self) -> NDArray[np.float64]:
        """(columns * rows, 3) interior corners, metres, row by row: x varies fastest, z = 0."""
        y, x = np.mgrid[: self.rows, : self.columns].reshape(2, -1)
        return np.stack([x, y, np.zeros_like(x)], axis=1) * float(self.square_size)

    def __str__(self) -> str:
        return f"chessboard:{self.columns}x{self.rows}:{float(self.square_size)!r}"


def parse_board(text: str) -> Chessboard:
    """Read the text form of a board; ``str(board)`` gives it back.

    Parameters
    ----------
    text : str
        For example ``chessboard:9x6:0.025``: 9 by 6 interior corners, squares of 25 mm.

    Raises
    ------
    InvalidInput
        When the text is not of that form; the message shows the form.
    """
    kind, _, rest = str(text).strip().partition(":")
    if kind != "chessboard":
        raise InvalidInput(f"There is no board kind {kind!r}; write {_FORM}.")
    match = re.fullmatch(r"(\d{1,4})[xX](\d{1,4}):([^:]+)", rest)
    if match is None:
        raise InvalidInput(f"{text!r} is not a board; write {_FORM}.")
    try:
        square_size = float(match[3])
    except ValueError:
        raise InvalidInput(f"{match[3]!r} in {text!r} is not a length in metres; write {_FORM}.") from None
    return Chessboard(int(match[1]), int(match[2]), square_size)
