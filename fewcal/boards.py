"""What is printed: calibration targets, each with its points in metres and the way to find it.

A board has one text form, the same on the command line, in ROS parameters and in YAML: ``KIND:...``, sizes in
metres.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .aprilgrid import AprilGrid
from .charuco import Charuco
from .chessboard import Chessboard
from .circle_grid import AsymmetricCircleGrid, CircleGrid
from .detection import Detection, check_board
from .drawing import Drawing
from .errors import InvalidInput
from .known_object import KnownObject

__all__ = [
    "AprilGrid",
    "AsymmetricCircleGrid",
    "Board",
    "Charuco",
    "Chessboard",
    "CircleGrid",
    "KnownObject",
    "parse_board",
    "pose_ambiguity",
]


@runtime_checkable
class Board(Protocol):
    """A planar target with known points; ``str(board)`` is its text form."""

    @property
    def points(self) -> NDArray[np.float64]:
        """(N, 3) points in the board frame, metres, all in one plane: z = 0 on what is printed."""

    @property
    def turns(self) -> int:
        """In how many turns about its own normal the board looks the same; 1 when it has but one way up."""

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
    "aprilgrid": AprilGrid,
    "circles": CircleGrid,
    "acircles": AsymmetricCircleGrid,
    "points": KnownObject,
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


def pose_ambiguity(board: Board) -> str:
    """Say what follows when a board looks the same turned in its plane; empty when it does not.

    The camera is none the worse, since every view has a pose of its own. But what compares the poses of
    several views, or of several cameras, takes one way up for the other.
    """
    check_board(board)
    if board.turns == 1:
        return ""
    return (
        f"{board} looks the same turned by {360 // board.turns} degrees: the camera is calibrated all the "
        "same, but T_camera_board may be turned by as much from view to view, so do not use the poses for "
        "hand-eye or extrinsic calibration; a chessboard with an odd and an even count, such as 9x6, has one "
        "way up."
    )
