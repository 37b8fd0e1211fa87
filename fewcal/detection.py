"""Find a board in an image: what all kinds of boards share.

Each kind looks for itself (``Board.detect``); its module says how.
"""

from __future__ import annotations

import importlib
import reprlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .errors import BoardNotFound, InvalidInput
from .views import View

if TYPE_CHECKING:
    from .boards import Board

Array = NDArray[np.float64]

EDGE_WIDTH_PER_BLUR = 2.563
"""Width of an edge between 10 % and 90 % of its step, in Gaussian standard deviations."""
MAX_EDGE_SHARE = 0.5
"""Widest edge, as a share of the square: beyond it the edges of one square run into each other."""
MIN_BORDER_PX = 2.0
"""A corner closer to the border of the image does not show its four squares."""


@dataclass(frozen=True, eq=False)
class Detection:
    """A board found in an image.

    Attributes
    ----------
    view : View
        The correspondences, with the sd of each point. Boards that are told from a part of them have only
        the points seen, in the order of ``board.points``.
    edge_width_px : float
        How wide the edges of the squares are in the image, between 10 % and 90 % of the step from black to
        white: median over the corners, in the direction in which it is larger. 2 px is sharp; defocus and
        motion widen it.
    square_px : float
        Median length of the shorter side of the squares in the image.
    """

    view: View
    edge_width_px: float
    square_px: float

    @property
    def sharpness(self) -> float:
        """Inverse of the edge width, per pixel: 0.5 is sharp, 0.1 is out of focus or in motion."""
        return 1 / self.edge_width_px


def prepare() -> None:
    """Import at once what the first detection would import, for programs that somebody waits for."""
    for module in ("scipy.sparse.csgraph", "scipy.spatial"):
        importlib.import_module(module)


def detect(image: NDArray[Any], board: Board, source: str = "", stamp_ns: int | None = None) -> View:
    """Find a board in an image.

    Parameters
    ----------
    image : (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) array of uint8 or uint16
        Grey, BGR(A) or RGB(A).
    board : Board
        The board to look for.
    source : str
        Where the image comes from; kept in the view.
    stamp_ns : int, optional
        Time of the image, nanoseconds; kept in the view.

    Returns
    -------
    View with the points in the order of ``board.points`` and one sd for each, pixels. Kinds that may be seen
    in part give the points that were found.

    Raises
    ------
    BoardNotFound
        When the board cannot be located; `reason` is one of ``BoardNotFound.REASONS``.
    InvalidInput
        When the array is no image.
    """
    return detect_board(image, board, source, stamp_ns).view


def detect_board(
    image: NDArray[Any], board: Board, source: str = "", stamp_ns: int | None = None
) -> Detection:
    """Find a board as :func:`detect` does, and measure how sharply the image shows it."""
    check_board(board)
    return board.detect(image, source, stamp_ns)


def check_board(board: object) -> None:
    """Refuse what is no board, such as the text form of one.

    Raises
    ------
    InvalidInput
    """
    if not hasattr(board, "detect"):
        raise InvalidInput(
            f"board must be a fewcal board, such as fewcal.parse_board gives, not {reprlib.repr(board)}."
        )


def edge_width(blur: Array) -> float:
    """Median width of edges, pixels, in the direction in which it is larger, from their blur (..., 2), sd."""
    return EDGE_WIDTH_PER_BLUR * float(np.median(blur.reshape(-1, 2), axis=0).max())


def blurred(edge_width_px: float, square_px: float) -> BoardNotFound:
    """Say that the image is too blurred for squares of this size."""
    return BoardNotFound(
        "blurred",
        f"The edges of the squares are {edge_width_px:.1f} px wide and the squares {square_px:.1f} px; "
        "hold the board still, or focus.",
    )


def outside(image_shape: tuple[int, ...], points: Array, margin: float) -> bool:
    """Whether any point lies beyond the border of the image or closer to it than a margin, pixels."""
    size = np.array(image_shape[1::-1])
    return bool(((points < margin) | (points > size - 1 - margin)).any())
