"""Views that show the board in the same place tell the same thing.

What moves neighbouring corners together, such as a bent board or what the lens model leaves out, does so
again in a second picture from the same place: its errors are those of the first. So copies share the weight
of one view, and a camera that looks at a board for a minute is not surer of itself than one that looks once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .views import View, ViewStack, align_views, distances

SAME_PLACE = 0.002
"""Distance of the boards in two views, as a share of the image diagonal, at which the second still counts by
its part of 1 - exp(-1/2) = 0.4: a board that nobody has moved stays within, one tilted anew does not."""


def copies(views: Sequence[View], image_size: tuple[int, int]) -> NDArray[np.float64]:
    """How many views show the board where each does, itself among them, those nearby counting in part.

    Parameters
    ----------
    views : sequence of V View
    image_size : (width, height), pixels

    Returns
    -------
    (V,)
    """
    if len(views) == 1:
        return np.ones(1)
    points, scale = align_views(views), SAME_PLACE * np.hypot(*image_size)
    apart = np.stack([distances(points, i) for i in range(len(views))])
    alike: NDArray[np.float64] = np.exp(-0.5 * (apart / scale) ** 2)
    return np.asarray(np.maximum(alike.sum(axis=1), 1))  # a view without points is nowhere


def share_weight(stack: ViewStack, count: NDArray[np.float64]) -> ViewStack:
    """Divide the weight of one view among its copies, of which there are `count` (V,)."""
    return stack._replace(weights=stack.weights / np.sqrt(count)[:, None])
