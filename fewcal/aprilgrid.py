"""The AprilGrid as Kalibr prints it: tags with small squares between their corners, seen whole or in part."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .aprilgrid_detection import BORDER_BITS, detect_aprilgrid
from .board_fields import COUNTS, check_length, is_count, match_form, read_number
from .detection import Detection
from .drawing import Drawing, cells, rectangles
from .errors import InvalidInput
from .grey import as_grey
from .markers import DICTIONARIES, marker_bits

Array = NDArray[np.float64]

FAMILIES = {"tag" + name.removeprefix("DICT_APRILTAG_"): name for name in DICTIONARIES if "APRILTAG" in name}
"""OpenCV's dictionary of each family."""


@dataclass(frozen=True)
class AprilGrid:
    """An AprilGrid, counted in tags, whose numbers begin with 0 at the lower left, as Kalibr's do.

    Its points are the corners of the tags in Kalibr's order: row by row from the bottom, each from left to
    right, two rows of corners for each row of tags. The board frame has Kalibr's origin, the lower left
    corner of the lower left tag, and its x, to the right along a row; but y points down and z = x cross y
    away from a camera that looks at the printed side, as for all boards here. Kalibr has y up and z out of
    the board: its coordinates are (x, -y, -z) of these.

    The border of the tags may be two bits wide, as Kalibr's is and as they are drawn, or one bit, as in the
    AprilTag library; an image shows which.

    Parameters
    ----------
    columns, rows : int
        Tags along x and along y, 2 or more of them together.
    tag_size : float
        Edge of a tag with its black border, metres: Kalibr's tagSize.
    gap : float
        Space between tags as a share of the tag, below 1: Kalibr's tagSpacing.
    family : str
        ``tag36h11``, ``tag36h10``, ``tag25h9`` or ``tag16h5``.
    from_top : bool
        Whether the numbers of the tags begin with 0 at the upper left and go row by row downwards.

    Raises
    ------
    InvalidInput
        When a count is too small, a length is none or the family is unknown or has too few tags.
    """

    form: ClassVar[str] = (
        "aprilgrid:COLUMNSxROWS:TAG:GAP:FAMILY, for example aprilgrid:6x6:0.088:0.3:tag36h11 "
        "(tags, metres, gap as a share of the tag; :top at the end when tag 0 is at the upper left)"
    )
    turns: ClassVar[int] = 1
    drawn_border_bits: ClassVar[int] = BORDER_BITS

    columns: int
    rows: int
    tag_size: float
    gap: float
    family: str
    from_top: bool = False

    def __post_init__(self) -> None:
        if not (is_count(self.columns, 1) and is_count(self.rows, 1) and self.columns * self.rows > 1):
            raise InvalidInput(f"An AprilGrid needs two tags or more, not {self.columns!r}x{self.rows!r}.")
        check_length("tag size", self.tag_size)
        if isinstance(self.gap, bool) or not (isinstance(self.gap, float | np.floating) and 0 < self.gap < 1):
            raise InvalidInput(f"The gap must be a share of the tag between 0 and 1, not {self.gap!r}.")
        if not isinstance(self.family, str) or self.family not in FAMILIES:
            raise InvalidInput(f"There is no family {self.family!r}; there are {', '.join(FAMILIES)}.")
        count = DICTIONARIES[self.dictionary][1]
        if self.columns * self.rows > count:
            raise InvalidInput(
                f"{self.family} has {count} tags, the board needs {self.columns * self.rows}; choose "
                "a smaller board or another family."
            )

    @classmethod
    def parse(cls, text: str) -> AprilGrid:
        """Read the text form, see :func:`fewcal.parse_board`."""
        match = match_form(
            f"aprilgrid:{COUNTS}:(?P<tag>[^:]+):(?P<gap>[^:]+):(?P<family>[^:]+)(?P<top>:top)?",
            text,
            cls.form,
        )
        family = match["family"].lower()
        return cls(
            int(match["columns"]),
            int(match["rows"]),
            read_number(match, "tag", cls.form),
            read_number(match, "gap", cls.form, "a share of the tag"),
            family if family in FAMILIES else match["family"],
            match["top"] is not None,
        )

    def __str__(self) -> str:
        return (
            f"aprilgrid:{self.columns}x{self.rows}:{float(self.tag_size)!r}:{float(self.gap)!r}:{self.family}"
            f"{':top' * self.from_top}"
        )

    @property
    def dictionary(self) -> str:
        """OpenCV's name of the family."""
        return FAMILIES[self.family]

    @property
    def pitch(self) -> float:
        """From a tag to the next, metres."""
        return float((1 + self.gap) * self.tag_size)

    @property
    def points(self) -> Array:
        """(4 * columns * rows, 3) corners of the tags, metres, row by row from the bottom, z = 0."""
        lines = [
            (np.arange(count)[:, None] * self.pitch + [0, self.tag_size]).ravel()
            for count in (self.columns, self.rows)
        ]
        x, up = np.meshgrid(*lines)
        return np.stack([x, 0 - up, np.zeros_like(x)], axis=-1).reshape(-1, 3)

    @property
    def tag_corners(self) -> Array:
        """(M, 4, 2) corners of the tags by number, metres: upper left, upper right, and on around."""
        row, column = np.divmod(np.arange(self.columns * self.rows), self.columns)
        if self.from_top:
            row = self.rows - 1 - row
        lower_left = np.stack([column, -row], axis=1) * self.pitch
        return lower_left[:, None] + np.array([[0, -1], [1, -1], [1, 0], [0, 0]]) * float(self.tag_size)

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Find the board or a part of it in an image, see :meth:`fewcal.Board.detect`.

        The view has the corners that were found: at least 6, not in one line.
        """
        return detect_aprilgrid(as_grey(image), self, source, stamp_ns)

    def draw(self) -> Drawing:
        """Tags with a border of two bits, and a small square at each of their corners, as by Kalibr."""
        space = self.pitch - float(self.tag_size)
        across, down = np.meshgrid(
            np.arange(self.columns + 1) * self.pitch - space, -np.arange(self.rows + 1) * self.pitch
        )
        corner = np.stack([across, down], axis=-1).reshape(-1, 2)
        polygons = rectangles(corner, corner + space)
        # Of OpenCV's tags the first bit is the lower right one of the tag as it is printed.
        bits = np.rot90(marker_bits(self.dictionary, np.arange(self.columns * self.rows)), 2, axes=(1, 2))
        border = (self.drawn_border_bits, self.drawn_border_bits)
        tags = np.pad(bits, ((0, 0), border, border))
        for tag, (left, top) in zip(tags, self.tag_corners[:, 0], strict=True):
            polygons += cells(~tag, left, top, float(self.tag_size) / len(tag))
        right, top = self.columns * self.pitch, -self.rows * self.pitch
        return Drawing(
            polygons,
            np.empty((0, 3)),
            (-2 * space, top - space, right + space, 2 * space),
            f"tag {1e3 * self.tag_size:g} mm, space {1e3 * space:g} mm",
        )
