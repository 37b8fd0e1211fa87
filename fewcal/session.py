"""Frames in, a camera out: keeps the one or two views worth keeping.

The same class serves the live node and the offline command, so that the same frames give the same camera.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .boards import Chessboard
from .calibration import Calibration, calibrate
from .constraints import Priors
from .detection import Detection, detect_board
from .errors import BoardNotFound, DegenerateViews, InvalidInput
from .selection import best_subset, information
from .verdict import Thresholds
from .views import View

MOTION_WINDOW_NS = 500_000_000
"""Frames farther apart than this say nothing about motion: a robot took them one by one."""


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
    board : Chessboard
    criteria : Criteria

    Attributes
    ----------
    read, with_board : int
        Frames seen, and those of them that showed the board.
    rejected : Counter
        Frames by the reason for which they were not kept.
    """

    def __init__(self, board: Chessboard, criteria: Criteria = Criteria()) -> None:
        self.board = board
        self.criteria = criteria
        self.image_size: tuple[int, int] | None = None
        self.read = 0
        self.with_board = 0
        self.rejected: Counter[str] = Counter()
        self._previous: tuple[int, View | None] | None = None

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
            Kept when the frame shows the board whole, sharp and still.

        Raises
        ------
        InvalidInput
            When the array is no image, or its size differs from the frames before.
        """
        self._check_size(image)
        self.read += 1
        try:
            detection = detect_board(image, self.board, source, stamp_ns)
        except BoardNotFound as error:
            self._remember(stamp_ns, None)
            return self._reject(error.reason, str(error))
        self.with_board += 1
        motion = self._motion_px(detection.view)
        self._remember(stamp_ns, detection.view)
        if detection.sharpness < self.criteria.min_sharpness:
            return self._reject(
                "blurred",
                f"The edges are {detection.edge_width_px:.1f} px wide, "
                f"{1 / self.criteria.min_sharpness:.1f} px are allowed; hold the board still, or focus.",
                detection,
            )
        if motion > self.criteria.max_motion_px:
            moved = (
                f"The board moved {motion:.1f} px" if np.isfinite(motion) else "The board has just appeared"
            )
            return self._reject(
                "moving",
                f"{moved} since the frame before, {self.criteria.max_motion_px:g} px are allowed; "
                "hold it still.",
                detection,
            )
        return Decision(True, "kept", "The board is whole, sharp and still.", detection)

    def _check_size(self, image: NDArray[Any]) -> None:
        if np.ndim(image) < 2:
            raise InvalidInput("An image needs rows and columns.")
        size = (int(image.shape[1]), int(image.shape[0]))
        if self.image_size not in (None, size):
            assert self.image_size is not None
            raise InvalidInput(
                f"The image size changed from {self.image_size[0]}x{self.image_size[1]} to "
                f"{size[0]}x{size[1]}; all views of a calibration must have one size."
            )
        self.image_size = size

    def _motion_px(self, view: View) -> float:
        """Largest motion of a corner since the frame before; infinite when that frame had no board."""
        if self._previous is None or view.stamp_ns is None:
            return 0.0
        stamp_ns, before = self._previous
        if not 0 <= view.stamp_ns - stamp_ns <= MOTION_WINDOW_NS:
            return 0.0
        if before is None:
            return float("inf")
        return float(np.linalg.norm(view.image_points - before.image_points, axis=1).max())

    def _remember(self, stamp_ns: int | None, view: View | None) -> None:
        self._previous = None if stamp_ns is None else (stamp_ns, view)

    def _reject(self, reason: str, message: str, detection: Detection | None = None) -> Decision:
        self.rejected[reason] += 1
        return Decision(False, reason, message, detection)


class Session:
    """Takes frames one at a time and keeps the views that make the best camera.

    While views are missing, a view is kept when it tells more than a second look at one that is there would.
    When there are enough but the camera is not usable yet, a better view takes the place of the one it makes
    superfluous.

    Parameters
    ----------
    board : Chessboard
    views_required : int
        Views to keep, 1 or more.
    method : {"map", "zhu2020", "zhang"}
        Of the calibration; which views are kept is judged by map in any case.
    priors : Priors
    thresholds : Thresholds
    criteria : Criteria
    """

    def __init__(
        self,
        board: Chessboard,
        views_required: int = 2,
        method: str = "map",
        priors: Priors = Priors(),
        thresholds: Thresholds = Thresholds(),
        criteria: Criteria = Criteria(),
    ) -> None:
        if views_required < 1:
            raise InvalidInput(f"At least one view is needed, not {views_required}.")
        self.frames = FrameFilter(board, criteria)
        self.views_required = views_required
        self.method = method
        self.priors = priors
        self.thresholds = thresholds
        self._kept: list[View] = []
        self._judged: Calibration | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """The views kept so far."""
        return tuple(self._kept)

    @property
    def complete(self) -> bool:
        """Whether there are as many views as required and the camera they make is usable."""
        enough = len(self._kept) >= self.views_required
        return enough and self._judged is not None and self._judged.verdict.usable

    def add(self, image: NDArray[Any], stamp_ns: int | None = None, source: str = "") -> Decision:
        """Take one frame, see :meth:`FrameFilter.look`; a kept frame's view is added to `views`."""
        decision = self.frames.look(image, stamp_ns, source)
        if not decision.kept or decision.detection is None:
            return decision
        decision = self._consider(decision.detection)
        if not decision.kept:
            self.frames.rejected[decision.reason] += 1
        return decision

    def capture(self, image: NDArray[Any], stamp_ns: int | None = None, source: str = "") -> Decision:
        """Keep the view of one frame whatever it adds, if it is whole, sharp and still."""
        decision = self.frames.look(image, stamp_ns, source)
        if decision.kept and decision.detection is not None:
            self._keep([*self._kept, decision.detection.view])
        return decision

    def calibrate(self) -> Calibration:
        """Calibrate from the views kept so far; they stay kept whatever happens.

        Raises
        ------
        DegenerateViews
            When there is no view, or the views determine no camera.
        """
        size = self.frames.image_size
        if not self._kept or size is None:
            raise DegenerateViews("No view has been kept yet; show the board whole, sharp and still.")
        if self.method == "map" and self._judged is not None:
            return self._judged
        return calibrate(self._kept, size, self.method, self.priors, self.thresholds)

    def remove_last(self) -> None:
        """Forget the view kept last, if there is one."""
        self._keep(self._kept[:-1])

    def reset(self) -> None:
        """Forget everything, the image size included."""
        self.frames = FrameFilter(self.frames.board, self.frames.criteria)
        self._keep([])

    def _keep(self, views: list[View]) -> None:
        size = self.frames.image_size
        self._kept = views
        self._judged = None
        if views and size is not None:
            try:
                self._judged = calibrate(views, size, "map", self.priors, self.thresholds)
            except DegenerateViews:
                self._judged = None

    def _consider(self, detection: Detection) -> Decision:
        """Judge a good view by the projection error that would be left with it and without it."""
        if not self._kept:
            self._keep([detection.view])
            return Decision(True, "kept", "The first view is kept.", detection)
        assert self.frames.image_size is not None
        together = [*self._kept, detection.view]
        try:
            trial = calibrate(together, self.frames.image_size, "map", self.priors, self.thresholds)
        except DegenerateViews as error:
            return Decision(False, "degenerate", str(error), detection)
        known = information(trial, self.priors)
        old = list(range(len(self._kept)))
        if len(self._kept) < self.views_required:
            again = known.projection_std(np.array([[*old, i] for i in old])).min()
            chosen = (*old, len(old))
        else:
            again = known.projection_std(np.array([old]))[0]
            chosen = best_subset(known, self.views_required)
        expected = known.projection_std(np.array([chosen]))[0]
        ratio = self.frames.criteria.max_error_ratio
        if len(old) not in chosen or expected > ratio * again:
            return Decision(
                False,
                "nothing new",
                "This view tells little that the kept ones do not; tilt the board by 30 deg or more about "
                "another axis.",
                detection,
            )
        replaced = len(self._kept) >= self.views_required
        self._keep([together[i] for i in chosen])
        message = f"The expected projection error falls from {again:.2f} to {expected:.2f} px."
        return Decision(True, "replaced" if replaced else "kept", message, detection)
