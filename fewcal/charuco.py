"""The ChArUco board: a chessboard with a marker in each white square, of which a part is enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .board_fields import COUNTS, check_length, is_count, lattice, match_form, read_number
from .charuco_detection import detect_charuco, white_squares
from .detection import Detection
from .drawing import Drawing, cells
from .errors import InvalidInput
from .grey import as_grey
from .markers import check_dictionary, find_dictionary, marker_bits

Array = NDArray[np.float64]

MARGIN = 0.25
"""White margin, squares: the outer squares only have to be kept apart from what lies behind."""


@dataclass(frozen=True)
class Charuco:
    """A ChArUco board, counted in squares as OpenCV counts it.

    Its points are the interior corners. The board frame is OpenCV's: the origin at the outer corner of the
    first square, x along a row, y along a column and z = x cross y, away from a camera that looks at the
    printed side. The first square is black; only boards with an even number of rows printed before
    OpenCV 4.6 begin with a white one, and OpenCV calls their pattern legacy.

    Parameters
    ----------
    columns, rows : int
        Squares along x and along y, at least 3 each, and 4 in one direction.
    square_size, marker_size : float
        Edge of a square and edge of a marker with its black border, metres.
    dictionary : str
        Where the markers come from, one of OpenCV's predefined dictionaries such as ``DICT_5X5_100``.
    legacy : bool
        OpenCV's legacy pattern.

    Raises
    ------
    InvalidInput
        When a count is too small, a length is none, the marker is as large as the square or the dictionary
        has too few markers.
    """

    form: ClassVar[str] = (
        "charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY, for example charuco:7x5:0.04:0.03:DICT_5X5_100 "
        "(squares, metres; :legacy at the end for boards with even rows printed before OpenCV 4.6)"
    )
    turns: ClassVar[int] = 1

    columns: int
    rows: int
    square_size: float
    marker_size: float
    dictionary: str
    legacy: bool = False

    def __post_init__(self) -> None:
        if not (is_count(self.columns, 3) and is_count(self.rows, 3) and max(self.columns, self.rows) > 3):
            raise InvalidInput(
                f"A ChArUco board needs at least 4x3 squares, not {self.columns!r}x{self.rows!r}."
            )
        check_length("square size", self.square_size)
        check_length("marker size", self.marker_size)
        if self.marker_size >= self.square_size:
            raise InvalidInput(
                f"A marker of {self.marker_size!r} m does not fit into a square of {self.square_size!r} m; "
                "the edge of a square comes first, then that of a marker."
            )
        check_dictionary(self.dictionary, self.marker_count)

    @classmethod
    def parse(cls, text: str) -> Charuco:
        """Read the text form, see :func:`fewcal.parse_board`."""
        match = match_form(
            f"charuco:{COUNTS}:(?P<square>[^:]+):(?P<marker>[^:]+):(?P<dictionary>[^:]+)(?P<legacy>:legacy)?",
            text,
            cls.form,
        )
        return cls(
            int(match["columns"]),
            int(match["rows"]),
            read_number(match, "square", cls.form),
            read_number(match, "marker", cls.form),
            find_dictionary(match["dictionary"]),
            match["legacy"] is not None,
        )

    def __str__(self) -> str:
        return (
            f"charuco:{self.columns}x{self.rows}:{float(self.square_size)!r}:{float(self.marker_size)!r}:"
            f"{self.dictionary}{':legacy' * self.legacy}"
        )

    @property
    def points(self) -> Array:
        """(N, 3) interior corners, metres, row by row: x varies fastest, z = 0."""
        first = np.array([1.0, 1.0, 0.0]) * self.square_size
        return lattice(self.columns - 1, self.rows - 1, self.square_size) + first

    @property
    def first_is_white(self) -> bool:
        """Whether the square at the origin is white."""
        return self.legacy and self.rows % 2 == 0

    @property
    def marker_count(self) -> int:
        """How many markers there are: one for each white square."""
        return self.columns * self.rows // 2

    @property
    def marker_corners(self) -> Array:
        """(M, 4, 2) corners of the markers by number, metres: upper left, upper right, and on around."""
        squares = white_squares(self.columns, self.rows, self.first_is_white)
        gap = (self.square_size - self.marker_size) / 2
        corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * self.marker_size
        return squares[:, None] * float(self.square_size) + gap + corners

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Find the board or a part of it in an image, see :meth:`fewcal.Board.detect`.

        The view has the corners that were found: at least 6, not in one line.
        """
        return detect_charuco(as_grey(image), self, source, stamp_ns)

    def draw(self) -> Drawing:
        """Black squares, and a marker in each white one."""
        edge = float(self.square_size)
        black = np.indices((self.rows, self.columns)).sum(axis=0) % 2 == int(self.first_is_white)
        polygons = cells(black, 0.0, 0.0, edge)
        bits = np.pad(marker_bits(self.dictionary, np.arange(self.marker_count)), ((0, 0), (1, 1), (1, 1)))
        for marker, (left, top) in zip(bits, self.marker_corners[:, 0], strict=True):
            polygons += cells(~marker, left, top, float(self.marker_size) / len(marker))
        margin = MARGIN * edge
        return Drawing(
            polygons,
            np.empty((0, 3)),
            (-margin, -margin, self.columns * edge + margin, self.rows * edge + margin),
            f"square {1e3 * edge:g} mm, marker {1e3 * self.marker_size:g} mm",
        )
