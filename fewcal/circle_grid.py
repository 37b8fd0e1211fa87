"""Grids of equal black circles on white paper, symmetric and asymmetric."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .board_fields import COUNTS, check_length, is_count, match_form, read_number
from .circle_detection import detect_circles
from .detection import Detection
from .drawing import Drawing
from .errors import InvalidInput
from .grey import as_grey

RADIUS_SHARE = 0.3
"""Radius of the circles that are drawn, as a share of the distance to the nearest neighbour. Any from 0.2 to
0.4 is found."""


@dataclass(frozen=True)
class CircleGrid:
    """Circles in columns and rows.

    The board frame has its origin at the centre of the first circle, x along a row, y along a column and
    z = x cross y, away from a camera that looks at the printed side. The radius of the circles does not
    matter; it is found from the image.

    Parameters
    ----------
    columns, rows : int
        Circles along x and along y, at least 3 each.
    spacing : float
        Distance from a circle's centre to the next, metres.

    Raises
    ------
    InvalidInput
        When a count is below 3 or the spacing is not a positive length.
    """

    form: ClassVar[str] = "circles:COLUMNSxROWS:SPACING, for example circles:10x7:0.02 (circles, metres)"

    columns: int
    rows: int
    spacing: float

    def __post_init__(self) -> None:
        _check(self.columns, self.rows, self.spacing)

    @classmethod
    def parse(cls, text: str) -> CircleGrid:
        """Read the text form, see :func:`fewcal.parse_board`."""
        match = match_form(f"circles:{COUNTS}:(?P<spacing>[^:]+)", text, cls.form)
        return cls(int(match["columns"]), int(match["rows"]), read_number(match, "spacing", cls.form))

    def __str__(self) -> str:
        return f"circles:{self.columns}x{self.rows}:{float(self.spacing)!r}"

    @property
    def pattern(self) -> NDArray[np.bool_]:
        """(rows, columns) which cells of a grid of that spacing hold a circle: all."""
        return np.ones((self.rows, self.columns), dtype=bool)

    @property
    def points(self) -> NDArray[np.float64]:
        """(columns * rows, 3) centres, metres, row by row: x varies fastest, z = 0."""
        return _centres(self.pattern, self.spacing)

    @property
    def turns(self) -> int:
        """Turns in which it looks the same: 2, or 4 when it is square."""
        return 4 if self.columns == self.rows else 2

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Find the whole board in an image, see :meth:`fewcal.Board.detect`."""
        return detect_circles(as_grey(image), self, source, stamp_ns)

    def draw(self) -> Drawing:
        """Circles, and white as far as the next would be."""
        return _draw(self.points, RADIUS_SHARE * self.spacing, self.spacing)


@dataclass(frozen=True)
class AsymmetricCircleGrid:
    """Circles in rows of which every second one is shifted by half, as OpenCV counts and measures them.

    Circle j of row i is at x = (2 j + i mod 2) * spacing, y = i * spacing. The board frame is that of
    :class:`CircleGrid`.

    Parameters
    ----------
    columns, rows : int
        Circles in each row, and rows, at least 3 each; the common one is 4x11.
    spacing : float
        Distance of the rows, metres, which is half the distance of the circles in a row.

    Raises
    ------
    InvalidInput
        When a count is below 3 or the spacing is not a positive length.
    """

    form: ClassVar[str] = (
        "acircles:COLUMNSxROWS:SPACING, for example acircles:4x11:0.02 (circles in a row, rows, metres "
        "between rows)"
    )

    columns: int
    rows: int
    spacing: float

    def __post_init__(self) -> None:
        _check(self.columns, self.rows, self.spacing)

    @classmethod
    def parse(cls, text: str) -> AsymmetricCircleGrid:
        """Read the text form, see :func:`fewcal.parse_board`."""
        match = match_form(f"acircles:{COUNTS}:(?P<spacing>[^:]+)", text, cls.form)
        return cls(int(match["columns"]), int(match["rows"]), read_number(match, "spacing", cls.form))

    def __str__(self) -> str:
        return f"acircles:{self.columns}x{self.rows}:{float(self.spacing)!r}"

    @property
    def pattern(self) -> NDArray[np.bool_]:
        """(rows, 2 columns) which cells of such a grid hold a circle: every second, the first too."""
        return np.asarray(np.indices((self.rows, 2 * self.columns)).sum(axis=0) % 2 == 0)

    @property
    def points(self) -> NDArray[np.float64]:
        """(columns * rows, 3) centres, metres, row by row: x varies fastest, z = 0."""
        return _centres(self.pattern, self.spacing)

    @property
    def turns(self) -> int:
        """Turns in which it looks the same: 2 when the number of rows is even, else 1."""
        return 1 if self.rows % 2 else 2

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Find the whole board in an image, see :meth:`fewcal.Board.detect`."""
        return detect_circles(as_grey(image), self, source, stamp_ns)

    def draw(self) -> Drawing:
        """Circles, and white as far as the next would be."""
        return _draw(self.points, RADIUS_SHARE * math.sqrt(2) * self.spacing, self.spacing)


def _check(columns: int, rows: int, spacing: float) -> None:
    """Refuse what is no grid."""
    for name, count in (("columns", columns), ("rows", rows)):
        if not is_count(count, 3):
            raise InvalidInput(f"A circle grid needs at least 3 circles each way, but {name} is {count!r}.")
    check_length("spacing", spacing)


def _centres(pattern: NDArray[np.bool_], spacing: float) -> NDArray[np.float64]:
    """(N, 3) centres of the circles of a pattern, metres."""
    y, x = np.nonzero(pattern)
    return np.asarray(np.stack([x, y, np.zeros_like(x)], axis=1) * spacing, dtype=np.float64)


def _draw(points: NDArray[np.float64], radius: float, spacing: float) -> Drawing:
    """Draw discs of one radius, metres, at points (N, 3)."""
    discs = np.column_stack([points[:, :2], np.full(len(points), radius)])
    (left, top), (right, bottom) = points[:, :2].min(axis=0) - spacing, points[:, :2].max(axis=0) + spacing
    return Drawing([], discs, (left, top, right, bottom), f"spacing {1e3 * spacing:g} mm")
