"""Frames in, a camera out: keeps the one or two views worth keeping.

The same class serves the live node and the offline command, so that the same frames give the same camera.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .board_fields import is_count
from .boards import Board
from .calibration import Calibration, calibrate, check_options
from .checks import require_kind
from .constraints import Priors
from .detection import Detection
from .errors import DegenerateViews, InvalidInput
from .frame_filter import Criteria, Decision, FrameFilter, shift_px
from .grey import size_of
from .selection import best_subset, information
from .verdict import Thresholds
from .views import View

SAME_VIEW_PX = 2.0
"""Farthest that a point may be from where a view shows it, for the board to be where that view shows it."""


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
        """Whether the board is where a view shows it."""
        return shift_px(detection.view, view) <= SAME_VIEW_PX

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
        wanted = enough or expected < self.frames.criteria.max_error_ratio * rival
        if not wanted or len(old) not in chosen:
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
