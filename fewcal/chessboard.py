"""The chessboard, counted in interior corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .board_fields import COUNTS, check_length, is_count, lattice, match_form, read_number
from .chessboard_detection import detect_chessboard
from .detection import Detection
from .drawing import Drawing, cells
from .errors import InvalidInput
from .grey import as_grey

MARGIN = 0.25
"""White margin, squares: every interior corner has its four squares about it already, so it only has to keep
them apart from what lies behind."""


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

    form: ClassVar[str] = (
        "chessboard:COLUMNSxROWS:SQUARE, for example chessboard:9x6:0.025 (interior corners, metres)"
    )

    columns: int
    rows: int
    square_size: float

    def __post_init__(self) -> None:
        for name, count in (("columns", self.columns), ("rows", self.rows)):
            if not is_count(count, 3):
                raise InvalidInput(
                    f"A chessboard needs at least 3 interior corners each way, but {name} is {count!r}."
                )
        check_length("square size", self.square_size)

    @classmethod
    def parse(cls, text: str) -> Chessboard:
        """Read the text form, see :func:`fewcal.parse_board`."""
        match = match_form(f"chessboard:{COUNTS}:(?P<square>[^:]+)", text, cls.form)
        return cls(int(match["columns"]), int(match["rows"]), read_number(match, "square", cls.form))

    def __str__(self) -> str:
        return f"chessboard:{self.columns}x{self.rows}:{float(self.square_size)!r}"

    @property
    def points(self) -> NDArray[np.float64]:
        """(columns * rows, 3) interior corners, metres, row by row: x varies fastest, z = 0."""
        return lattice(self.columns, self.rows, self.square_size)

    @property
    def turns(self) -> int:
        """Turns in which it looks the same: 1 when columns and rows differ by an odd number, else 2 or 4."""
        if (self.columns - self.rows) % 2:
            return 1
        return 4 if self.columns == self.rows and self.columns % 2 == 0 else 2

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Find the whole board in an image, see :meth:`fewcal.Board.detect`."""
        return detect_chessboard(as_grey(image), self, source, stamp_ns)

    def draw(self) -> Drawing:
        """Squares all round the interior corners; the one at the origin's outer side is black."""
        edge = float(self.square_size)
        black = np.indices((self.rows + 1, self.columns + 1)).sum(axis=0) % 2 == 0
        margin = MARGIN * edge
        return Drawing(
            cells(black, -edge, -edge, edge),
            np.empty((0, 3)),
            (-edge - margin, -edge - margin, self.columns * edge + margin, self.rows * edge + margin),
            f"square {1e3 * edge:g} mm",
        )
