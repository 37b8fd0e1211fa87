"""Whether views agree on one camera.

A view of another camera, or of the same one with another zoom or focus, is taken for noise by an estimator
that finds the noise with the camera. But each view alone says how its points scatter about the camera that
suits it best; what it loses when it must share one with the others is an error of the same size if there is
but one camera.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import POSE
from .copies import DISTINCT
from .noise import COMPUTED_PX, total_sigma

Array = NDArray[np.float64]

SPARE = 6
"""Rows of a view beyond the unknowns of its own, from which on its scatter says something."""


class Disagreement(NamedTuple):
    """What views lose by sharing a camera.

    Attributes
    ----------
    ratio : float
        Root mean square of their errors along what moves a camera, over what their own scatter foretells.
    alone_px : float
        Scatter of the points about a camera for each view, pixels.
    together_px : float
        Root mean square of those errors, pixels.
    worst : int
        View that loses most.
    """

    ratio: float
    alone_px: float
    together_px: float
    worst: int


def disagreement(
    reduced: Array, own: int, sigma: float, counts: NDArray[np.intp], times: Array
) -> Disagreement | None:
    """Compare what each view says of the camera with what all say together.

    Parameters
    ----------
    reduced : (V, S + 1, S + 1)
        Rows of each view without its pose, see :attr:`fewcal.elimination.Eliminated.camera`.
    own : int
        How many of the S unknowns, the first, are the camera's; the others are the board's and the lens's.
    sigma : float
        Unit of the rows, pixels.
    counts : (V,)
        Points of each view.
    times : (V,)
        Views that show the board where each does, which share the weight of one.

    Returns
    -------
    Disagreement
        None with fewer than two views of points enough.
    """
    spare = 2 * counts - POSE - own
    telling = np.flatnonzero(spare >= SPARE)
    distinct = float((1 / times[telling]).sum())
    if distinct < DISTINCT:
        return None
    squares = (sigma * reduced[telling, :, -1]) ** 2
    lost, left = squares[:, :own].sum(axis=1), squares[:, own:].sum()
    alone = max(float(np.sqrt(left / (spare / times)[telling].sum())), COMPUTED_PX)
    together = float(np.sqrt(lost.sum() / (own * (distinct - 1))))
    ratio = together / float(total_sigma(np.array(alone)))
    return Disagreement(ratio, alone, together, int(telling[(lost * times[telling]).argmax()]))
