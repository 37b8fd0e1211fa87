"""Which frames show the board sharp and still."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import astuple, dataclass
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .boards import Board
from .checks import checked_stamp, require_kind
from .detection import Detection, check_board, detect_board
from .errors import BoardNotFound, InvalidInput
from .grey import GreyImage, as_grey
from .views import MIN_COMMON, View, align_views

MOTION_WINDOW_NS = 500_000_000
"""Frames farther apart than this say nothing about motion: a robot took them one by one."""
MARGIN_SQUARES = 3.0
"""Squares around the corners in which a board that has hardly moved is found again: its outer squares, which
may be larger than most by perspective, and some of what surrounds them."""


@dataclass(frozen=True)
class Criteria:
    """When a view is worth keeping.

    Parameters
    ----------
    min_sharpness : float
        Smallest inverse edge width, 1/px (see :class:`fewcal.detection.Detection`): edges of 8 px or less.
    max_motion_px : float
        Farthest that any corner may have moved since the frame before, pixels.
    max_error_ratio : float
        A view must bring the expected projection error below this share of what a second look at a view that
        is kept already would bring.
    """

    min_sharpness: float = 0.125
    max_motion_px: float = 2.0
    max_error_ratio: float = 0.8

    def __post_init__(self) -> None:
        # Infinity is a limit that nothing exceeds.
        if not all(
            isinstance(value, Real) and value <= math.inf and not value < 0 for value in astuple(self)
        ):
            raise InvalidInput(f"Criteria are numbers that are not negative, unlike {self!r}.")


@dataclass(frozen=True, eq=False)
class Decision:
    """What became of a frame.

    Attributes
    ----------
    kept : bool
    reason : str
        "kept", "replaced", or why not, in a word or two fit for counting.
    message : str
        The same as a sentence.
    detection : Detection or None
        The board, when the frame showed it.
    """

    kept: bool
    reason: str
    message: str
    detection: Detection | None = None


class FrameFilter:
    """Finds the board in frame after frame and passes on the views that are sharp and still.

    Parameters
    ----------
    board : Board
    criteria : Criteria

    Attributes
    ----------
    read, with_board : int
        Frames seen, and those of them that showed the board.
    rejected : Counter
        Frames by the reason for which they were not kept.
    """

    def __init__(self, board: Board, criteria: Criteria = Criteria()) -> None:
        check_board(board)
        require_kind("criteria", criteria, Criteria)
        self.board = board
        self.criteria = criteria
        self.read = 0
        self.with_board = 0
        self.rejected: Counter[str] = Counter()
        self._before: tuple[int, View | GreyImage | None] | None = None

    def pass_by(self, image: NDArray[Any], stamp_ns: int | None = None) -> None:
        """Let a frame pass that nobody needs: only a look at the next one may take it into account.

        Parameters
        ----------
        image : (H, W) or (H, W, C) array of uint8 or uint16
        stamp_ns : int, optional
        """
        self._remember(stamp_ns, as_grey(image).copy())  # the caller may fill the same memory anew

    def turn_away(self, reason: str) -> None:
        """Count a frame that is not to be looked at."""
        self.read += 1
        self.rejected[reason] += 1

    def look(self, image: NDArray[Any], stamp_ns: int | None = None, source: str = "") -> Decision:
        """Look at one frame.

        Parameters
        ----------
        image : (H, W) or (H, W, C) array of uint8 or uint16
        stamp_ns : int, optional
            Time of the frame, nanoseconds. Without it nothing is known about motion.
        source : str

        Returns
        -------
        Decision
            Kept when the frame shows the board sharp and still.

        Raises
        ------
        InvalidInput
            When the array is no image.
        """
        grey = as_grey(image)  # what is no image is not counted as a frame
        self.read += 1
        try:
            detection = detect_board(grey, self.board, source, stamp_ns)
        except BoardNotFound as error:
            self._remember(stamp_ns, None)
            return self._reject(error.reason, str(error))
        self.with_board += 1
        motion = self._motion_px(detection, grey.shape)
        self._remember(stamp_ns, detection.view)
        if detection.sharpness < self.criteria.min_sharpness:
            return self._reject(
                "blurred",
                f"The edges are {detection.edge_width_px:.1f} px wide, "
                f"{1 / self.criteria.min_sharpness:.1f} px are allowed; hold the board still, or focus.",
                detection,
            )
        if motion > self.criteria.max_motion_px:
            return self._reject("moving", self._moved(motion), detection)
        return Decision(True, "kept", "The board is sharp and still.", detection)

    def _moved(self, motion_px: float) -> str:
        if not np.isfinite(motion_px):
            return "The frame before does not show the board here; hold it still."
        return (
            f"The board moved {motion_px:.1f} px since the frame before, {self.criteria.max_motion_px:g} px "
            "are allowed; hold it still."
        )

    def _motion_px(self, detection: Detection, shape: tuple[int, ...]) -> float:
        """Largest motion of a corner since the frame before; infinite when that frame had no board."""
        view = detection.view
        if self._before is None or view.stamp_ns is None:
            return 0.0
        stamp_ns, before = self._before
        if not 0 <= view.stamp_ns - stamp_ns <= MOTION_WINDOW_NS:
            return 0.0
        if isinstance(before, View):
            return shift_px(view, before)
        return np.inf if before is None or before.shape != shape else self._motion_since(before, detection)

    def _motion_since(self, grey: GreyImage, detection: Detection) -> float:
        """Motion since a frame that has not been looked at: only where the board is now, which is quick."""
        points = detection.view.image_points
        margin = MARGIN_SQUARES * detection.square_px
        low = np.maximum(np.floor(points.min(axis=0) - margin), 0).astype(int)
        high = np.ceil(points.max(axis=0) + margin).astype(int)
        try:
            before = detect_board(grey[low[1] : high[1], low[0] : high[0]], self.board).view
        except BoardNotFound:
            return np.inf
        return shift_px(detection.view, View(before.object_points, before.image_points + low))

    def _remember(self, stamp_ns: int | None, frame: View | GreyImage | None) -> None:
        stamp_ns = checked_stamp(stamp_ns)
        self._before = None if stamp_ns is None else (stamp_ns, frame)

    def _reject(self, reason: str, message: str, detection: Detection | None = None) -> Decision:
        self.rejected[reason] += 1
        return Decision(False, reason, message, detection)


def shift_px(view: View, other: View) -> float:
    """Largest distance between where two views of one board show the same point, pixels.

    Infinite when they have hardly a point in common: then the board must have moved.
    """
    points, other_points = align_views([view, other])
    distance = np.linalg.norm(points - other_points, axis=1)
    common = np.isfinite(distance)
    return float(distance[common].max()) if common.sum() >= MIN_COMMON else np.inf
