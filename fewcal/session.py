"""Frames in, a camera out: keeps the one or two views worth keeping.

The same class serves the live node and the offline command, so that the same frames give the same camera.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable
from dataclasses import astuple, dataclass
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .board_fields import is_count
from .boards import Board
from .calibration import Calibration, calibrate, check_options
from .checks import require_kind
from .constraints import Priors
from .detection import Detection, check_board, detect_board
from .errors import BoardNotFound, DegenerateViews, InvalidInput
from .grey import GreyImage, as_grey, size_of
from .selection import best_subset, information
from .verdict import Thresholds
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
        if not all(isinstance(value, Real) and float(value) >= 0 for value in astuple(self)):
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
        self._remember(stamp_ns, as_grey(image))

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


class Session:
    """Takes frames one at a time and keeps the views that make the best camera.

    While views are missing, a view is kept when it tells more than a second look at one that is there would,
    or when the camera is usable already and stays so.
    When there are enough, a better view takes the place of the one it makes superfluous.

    No list is ever changed in place, so that ``copy.copy`` of a session is one that can go its own way; the
    two share the frame filter until either is reset.

    Parameters
    ----------
    board : Board
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
        board: Board,
        views_required: int = 2,
        method: str = "map",
        priors: Priors = Priors(),
        thresholds: Thresholds = Thresholds(),
        criteria: Criteria = Criteria(),
    ) -> None:
        _check_count(views_required)
        check_options(method, priors, thresholds)
        self.frames = FrameFilter(board, criteria)
        self.views_required = views_required
        self.method = method
        self.priors = priors
        self.thresholds = thresholds
        self.image_size: tuple[int, int] | None = None
        self._kept: list[View] = []
        self._judged: Calibration | None = None

    @property
    def views(self) -> tuple[View, ...]:
        """The views kept so far."""
        return tuple(self._kept)

    @property
    def estimate(self) -> Calibration | None:
        """What map makes of the views kept so far; None when they make no camera."""
        return self._judged

    @property
    def complete(self) -> bool:
        """Whether there are as many views as required and the camera they make is usable."""
        return len(self._kept) >= self.views_required and self._usable

    @property
    def _usable(self) -> bool:
        return self._judged is not None and self._judged.verdict.usable

    def add(self, image: NDArray[Any], stamp_ns: int | None = None, source: str = "") -> Decision:
        """Take one frame, see :meth:`FrameFilter.look`; a kept frame's view is added to `views`."""
        return self._take(image, stamp_ns, source, self._consider)

    def capture(self, image: NDArray[Any], stamp_ns: int | None = None, source: str = "") -> Decision:
        """Keep the view of one frame whatever it adds, if it is sharp and still."""
        return self._take(image, stamp_ns, source, self._capture)

    def _take(
        self,
        image: NDArray[Any],
        stamp_ns: int | None,
        source: str,
        judge: Callable[[Detection, tuple[int, int]], Decision],
    ) -> Decision:
        decision = self.frames.look(image, stamp_ns, source)
        if decision.detection is None or not decision.kept:
            return decision
        size = size_of(image)
        if self._kept and size != self.image_size:
            result = self._other_size(decision.detection, size)
        else:
            result = judge(decision.detection, size)
        if not result.kept:
            self.frames.rejected[result.reason] += 1
        return result

    def _other_size(self, detection: Detection, size: tuple[int, int]) -> Decision:
        assert self.image_size is not None
        return Decision(
            False,
            "other size",
            f"This image is {size[0]}x{size[1]}, the views kept are {self.image_size[0]}x"
            f"{self.image_size[1]}; all views of a calibration must have one size: go back to it, or reset.",
            detection,
        )

    def calibrate(self) -> Calibration:
        """Calibrate from the views kept so far; they stay kept whatever happens.

        Raises
        ------
        DegenerateViews
            When there is no view, or the views determine no camera.
        """
        if not self._kept or self.image_size is None:
            raise DegenerateViews("No view has been kept yet; show the board sharp and still.")
        if self.method == "map" and self._judged is not None:
            return self._judged
        return calibrate(self._kept, self.image_size, self.method, self.priors, self.thresholds)

    def configure(self, views_required: int, method: str, thresholds: Thresholds, criteria: Criteria) -> None:
        """Change what is asked for; the views stay, and are judged anew when the thresholds changed.

        Raises
        ------
        InvalidInput
            When an argument is not what it should be; then nothing is changed.
        """
        _check_count(views_required)
        check_options(method, self.priors, thresholds)
        require_kind("criteria", criteria, Criteria)
        judge_anew = thresholds != self.thresholds
        self.views_required, self.method, self.thresholds = views_required, method, thresholds
        self.frames.criteria = criteria
        if judge_anew and self.image_size is not None:
            self._keep(self._kept, self.image_size)

    def remove_last(self) -> None:
        """Forget the view kept last, if there is one."""
        if self._kept and self.image_size is not None:
            self._keep(self._kept[:-1], self.image_size)

    def reset(self) -> None:
        """Forget every view and every frame."""
        self.frames = FrameFilter(self.frames.board, self.frames.criteria)
        self._kept, self._judged, self.image_size = [], None, None

    def _keep(self, views: list[View], size: tuple[int, int], judged: Calibration | None = None) -> None:
        self._kept, self.image_size, self._judged = views, size, judged
        if views and judged is None:
            # The views stay kept even when no camera can be found for them.
            with contextlib.suppress(DegenerateViews):
                self._judged = calibrate(views, size, "map", self.priors, self.thresholds)

    def _capture(self, detection: Detection, size: tuple[int, int]) -> Decision:
        message = f"View {len(self._kept) + 1} is kept."
        if same := next((i for i, view in enumerate(self._kept, 1) if self._looks_like(detection, view)), 0):
            message += (
                f" It shows the board where view {same} does and tells nothing new; move before the next."
            )
        self._keep([*self._kept, detection.view], size)
        return Decision(True, "kept", message, detection)

    def _looks_like(self, detection: Detection, view: View) -> bool:
        """Whether the board is where a view shows it, as far as the motion allowed goes."""
        return shift_px(detection.view, view) <= self.frames.criteria.max_motion_px

    def _consider(self, detection: Detection, size: tuple[int, int]) -> Decision:
        """Judge a good view by the projection error that would be left with it and without it."""
        if not self._kept:
            return self._capture(detection, size)
        # A board held still is most of what a camera sees, so that saves most of the time.
        if any(self._looks_like(detection, view) for view in self._kept):
            return _nothing_new(detection)
        together = [*self._kept, detection.view]
        try:
            trial = calibrate(together, size, "map", self.priors, self.thresholds)
        except DegenerateViews as error:
            return Decision(False, "degenerate", str(error), detection)
        known = information(trial, self.priors)
        old = list(range(len(self._kept)))
        full = len(old) >= self.views_required
        # What a view has to beat: a second look at one that is there, or the views as they are.
        rivals = [old] if full else [[*old, i] for i in old]
        chosen = best_subset(known, len(old)) if full else (*old, len(old))
        rival = known.projection_std(np.array(rivals)).min()
        expected = known.projection_std(np.array([chosen]))[0]
        # Views that make a usable camera have nothing left to wait for but their number.
        enough = not full and self._usable and trial.verdict.usable
        if not enough and expected >= self.frames.criteria.max_error_ratio * rival:
            return _nothing_new(detection)
        self._keep([together[i] for i in chosen], size, None if full else trial)
        message = f"The expected projection error is {expected:.2f} px now."
        return Decision(True, "replaced" if full else "kept", message, detection)


def _check_count(views_required: object) -> None:
    if not is_count(views_required, 1):
        raise InvalidInput(f"views_required must be a whole number, at least 1, not {views_required!r}.")


def _nothing_new(detection: Detection) -> Decision:
    return Decision(
        False,
        "nothing new",
        "This view tells little that the kept ones do not; "
        "tilt the board by 30 deg or more about another axis.",
        detection,
    )
