"""What is printed: calibration targets, each with its points in metres and the way to find it.

A board has one text form, the same on the command line, in ROS parameters and in YAML: ``KIND:...``, sizes in
metres.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .charuco import Charuco
from .chessboard import Chessboard
from .circle_grid import AsymmetricCircleGrid, CircleGrid
from .detection import Detection
from .drawing import Drawing
from .errors import InvalidInput

__all__ = ["AsymmetricCircleGrid", "Board", "Charuco", "Chessboard", "CircleGrid", "parse_board"]


@runtime_checkable
class Board(Protocol):
    """A planar target with known points; ``str(board)`` is its text form."""

    @property
    def points(self) -> NDArray[np.float64]:
        """(N, 3) points in the board frame, metres, all with z = 0."""

    def detect(self, image: NDArray[Any], source: str = "", stamp_ns: int | None = None) -> Detection:
        """Find the board in an image.

        Parameters
        ----------
        image : (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) array of uint8 or uint16
            Grey, BGR(A) or RGB(A).
        source : str
            Where the image comes from; kept in the view.
        stamp_ns : int, optional
            Time of the image, nanoseconds; kept in the view.

        Raises
        ------
        BoardNotFound
            When the board cannot be located; `reason` is one of ``BoardNotFound.REASONS``.
        InvalidInput
            When the array is no image.
        """

    def draw(self) -> Drawing:
        """What is printed, in the board frame.

        Raises
        ------
        InvalidInput
            When the board is an object that is not printed.
        """


class _Kind(Protocol):
    """A class of boards that can be read from text."""

    @property
    def form(self) -> str:
        """The text form with an example, as part of a sentence."""

    def parse(self, text: str) -> Board:
        """Read a board from its whole text form."""


_KINDS: dict[str, _Kind] = {
    "chessboard": Chessboard,
    "charuco": Charuco,
    "circles": CircleGrid,
    "acircles": AsymmetricCircleGrid,
}
"""Kinds of boards by the word that their text form begins with."""


def parse_board(text: str) -> Board:
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
    text = str(text).strip()
    kind = text.partition(":")[0]
    if kind not in _KINDS:
        forms = "; or ".join(known.form for known in _KINDS.values())
        raise InvalidInput(f"There is no board kind {kind!r}; write {forms}.")
    return _KINDS[kind].parse(text)
