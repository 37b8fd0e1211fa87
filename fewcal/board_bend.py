"""The bend of the board, which every view shares.

No board is flat, and a bend of a thousandth of its size moves the focal length by per cents. The estimate
takes the board for flat; its error bars count two parabolic coefficients as unknowns beside the camera, to
cover what a bend may have done to it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .adjustment import Rows
from .scale_mixture import Tails

Array = NDArray[np.float64]

SCALE, NU = 5e-4, 2.0
"""Of a t distribution of the bend along either side of the board, as a share of its diagonal. mrcal finds up
to 4e-3, half of them below 4e-4, on the boards of seven public sets."""


def with_bend(rows: Rows, points: Array) -> Rows:
    """Add the bend along x and along y to the unknowns that all views share.

    A point (x, y) lifted by h moves in the image as turns of the board move it: a turn about y lifts it by
    -x, one about x by y. With x^2 = x x the columns of the bend follow from those of the pose.

    Parameters
    ----------
    rows : Rows
        Those of the priors stay as they are.
    points : (V, 2, N)
        Those of the views, :attr:`ViewStack.points`, metres.
    """
    half = np.ptp(points, axis=-1).max(axis=0) / 2
    lift = (2 * np.hypot(*half) / half[:, None] ** 2 * [[-1], [1]] * points).swapaxes(-1, -2)
    by_bend = rows.by_pose[..., [1, 0]] * np.concatenate([lift, lift], axis=1)
    return rows._replace(by_camera=np.concatenate([rows.by_camera, by_bend], axis=-1))


def with_bend_prior(tails: Tails) -> Tails:
    """Add the prior of the bend, at a flat board."""
    rows, size = tails.by_unknowns.shape
    by_unknowns = np.zeros((rows + 2, size + 2))
    by_unknowns[:rows, :size] = tails.by_unknowns
    by_unknowns[[-2, -1], [-2, -1]] = 1 / SCALE
    groups = len(tails.nu)
    return Tails(
        np.append(tails.z, [0, 0]),
        by_unknowns,
        np.append(tails.group, [groups, groups + 1]),
        np.append(tails.nu, [NU, NU]),
    )
