"""Grids of equal black circles on white paper, symmetric and asymmetric."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from .board_fields import COUNTS, check_length, is_count, match_form, read_number
from .circle_detection import detect_circles
from .detection import Detection
from .drawing import Drawing
from .errors import InvalidInput
from .grey import as_grey

Kind = TypeVar("Kind", bound="Circles")

RADIUS_SHARE = 0.3
"""Radius of the circles that are drawn, as a share of the distance to the nearest neighbour. Any from 0.2 to
0.4 is found."""


@dataclass(frozen=True)
class Circles(ABC):
    """What both kinds of circle grids share: circles in some cells of a square lattice."""

    kind: ClassVar[str]
    form: ClassVar[str]

    columns: int
    rows: int
    spacing: float

    def __post_init__(self) -> None:
        for name, count in (("columns", self.columns), ("rows", self.rows)):
            if not is_count(count, 3):
                raise InvalidInput(
                    f"A circle grid needs at least 3 circles each way, but {name} is {count!r}."
                )
        check_length("spacing", self.spacing)

    @classmethod
    def parse(cls: type[Kind], text: str) -> Kind:
        """Read the text form, see :func:`fewcal.parse_board`."""
        match = match_form(f"{cls.kind}:{COUNTS}:(?P<spacing>[^:]+)", text, cls.form)
        return cls(int(match["columns"]), int(match["rows"]), read_number(match, "spacing", cls.form))

    def __str__(self) -> str:
        return f"{self.kind}:{self.columns}x{self.rows}:{float(self.spacing)!r}"

    @property
    @abstractmethod
    def pattern(self) -> NDArray[np.bool_]:
        """(R, C) which cells of a lattice of that spacing hold a circle."""

    @property
    @abstractmethod
    def nearest(self) -> float:
        """Distance from a circle's centre to the nearest other, metres."""

    @property
    def points(self) -> NDArray[np.float64]:
        """(columns * rows, 3) centres, metres, row by row: x varies fastest, z = 0."""
        y, x = np.nonzero(self.pattern)
        return np.asarray(np.stack([x, y, np.zeros_like(x)], axis=1) * self.spacing, dtype=np.float64)

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Find the whole board in an image, see :meth:`fewcal.Board.detect`."""
        return detect_circles(as_grey(image), self, source, stamp_ns)

    def draw(self) -> Drawing:
        """Circles, and white as far as the next would be."""
        centres = self.points[:, :2]
        discs = np.column_stack([centres, np.full(len(centres), RADIUS_SHARE * self.nearest)])
        (left, top), (right, bottom) = centres.min(axis=0) - self.spacing, centres.max(axis=0) + self.spacing
        return Drawing([], discs, (left, top, right, bottom), f"spacing {1e3 * self.spacing:g} mm")


class CircleGrid(Circles):
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

    kind: ClassVar[str] = "circles"
    form: ClassVar[str] = "circles:COLUMNSxROWS:SPACING, for example circles:10x7:0.02 (circles, metres)"

    @property
    def pattern(self) -> NDArray[np.bool_]:
        """(rows, columns) which cells of a lattice of that spacing hold a circle: all."""
        return np.ones((self.rows, self.columns), dtype=bool)

    @property
    def nearest(self) -> float:
        """Distance from a circle's centre to the nearest other, metres."""
        return self.spacing

    @property
    def turns(self) -> int:
        """Turns in which it looks the same: 2, or 4 when it is square."""
        return 4 if self.columns == self.rows else 2


class AsymmetricCircleGrid(Circles):
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

    kind: ClassVar[str] = "acircles"
    form: ClassVar[str] = (
        "acircles:COLUMNSxROWS:SPACING, for example acircles:4x11:0.02 (circles in a row, rows, metres "
        "between rows)"
    )

    @property
    def pattern(self) -> NDArray[np.bool_]:
        """(rows, 2 columns) which cells of such a lattice hold a circle: every second, the first too."""
        return np.asarray(np.indices((self.rows, 2 * self.columns)).sum(axis=0) % 2 == 0)

    @property
    def nearest(self) -> float:
        """Distance from a circle's centre to the nearest other, metres: along a diagonal."""
        return math.sqrt(2) * self.spacing

    @property
    def turns(self) -> int:
        """Turns in which it looks the same: 2 when the number of rows is even, else 1."""
        return 1 if self.rows % 2 else 2
