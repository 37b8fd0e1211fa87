"""Views that show the board in the same place tell the same thing.

What moves neighbouring corners together, such as a bent board or what the lens model leaves out, does so
again in a second picture from the same place: its errors are those of the first. So copies share the weight
of one view, and a camera that looks at a board for a minute is not surer of itself than one that looks once.
Views from elsewhere repeat a small part of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .views import View, ViewStack, align_views, distances

SAME_PLACE = 0.002
"""Distance of the boards in two views, as a share of the image diagonal, at which the second still counts by
its part of 1 - exp(-1/2) = 0.4: a board that nobody has moved stays within, one tilted anew does not."""

SHARED = 0.05
"""Share of the variance of a view's errors that every other view repeats, wherever it shows the board: how
the board was printed, and what the lens does beyond the model. With it the error bars of 30 and 100 views
hold as those of two do (doc/estimator.md)."""

DISTINCT = 1.5
"""Number of different views, copies counted once, below which there is but one."""


class Copies(NamedTuple):
    """Which of V views show the board in the same place.

    Attributes
    ----------
    times : (V,)
        How many do where each does, itself among them, those nearby counting in part.
    original : (V,) of int
        The first view that each repeats, point by point; itself where there is none.
    """

    times: NDArray[np.float64]
    original: NDArray[np.intp]

    @property
    def repeated(self) -> float:
        """How much less all views together count than the sum of them, copies taken for one view."""
        return repetition(float((1 / self.times).sum()))


def copies(views: Sequence[View], image_size: tuple[int, int]) -> Copies:
    """Compare views with each other.

    Parameters
    ----------
    views : sequence of V View
    image_size : (width, height), pixels
    """
    count, original, scale = np.ones(len(views)), np.arange(len(views)), SAME_PLACE * np.hypot(*image_size)
    for group in _of_one_board(views):
        points = align_views([views[i] for i in group])
        apart = np.stack([distances(points, i) for i in range(len(group))])
        alike = np.exp(-0.5 * (apart / scale) ** 2).sum(axis=1)
        count[group] = np.maximum(alike, 1)  # a view without points is nowhere
        for later, earlier in np.argwhere(np.tril(apart <= scale, -1)):
            i, j = group[later], group[earlier]
            if original[i] == i and np.array_equal(views[i].object_points, views[j].object_points):
                original[i] = original[j]
    return Copies(count, original)


def _of_one_board(views: Sequence[View]) -> list[NDArray[np.intp]]:
    """Indices of views that have points in common, directly or through others, in groups of two or more."""
    if all(np.array_equal(view.object_points, views[0].object_points) for view in views):
        board = np.zeros(len(views), dtype=np.intp)
    else:
        everything = np.concatenate([view.object_points for view in views])
        points, column = np.unique(everything, axis=0, return_inverse=True)
        view, column = np.repeat(np.arange(len(views)), [len(view) for view in views]), column.ravel()
        board, before = np.arange(len(views)), np.full(len(views), -1)
        while np.any(board != before):
            before = board.copy()
            of_point = np.full(len(points), len(views))
            np.minimum.at(of_point, column, board[view])
            np.minimum.at(board, view, of_point[column])
            board = board[board]
    groups = [np.flatnonzero(board == first) for first in np.unique(board)]
    return [group for group in groups if len(group) > 1]


def repetition(views: float) -> float:
    """How much less so many different views count together than the sum of them; up to 20 count in all."""
    return 1 + SHARED * max(views - 1, 0)


def share_weight(stack: ViewStack, count: NDArray[np.float64]) -> ViewStack:
    """Divide the weight of one view among its `count` (V,) copies, and that of all among what they repeat."""
    repeated = count * repetition(float((1 / count).sum()))
    return stack._replace(weights=stack.weights / np.sqrt(repeated)[:, None])
