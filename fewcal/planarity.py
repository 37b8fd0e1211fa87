"""Whether corners lie on a plane, as some lens shows it.

A plane through a lens is a homography followed by a smooth bend. The bend is fitted as a polynomial in the
coordinates that the homography predicts, robustly, so that a wrong corner does not bend it; what remains is
judged against the size of the squares. The polynomial follows a barrel of 30 % and a bent sheet of paper, and
no corner that belongs elsewhere.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .corner_refinement import RefinedCorners
from .grid import local_axes

Array = NDArray[np.float64]

MAX_RESIDUAL_SHARE = 0.08
"""Largest residual of a corner as a share of its square; the real views of strong distortion stay below
half of it and wrong corners miss by more than twice as much."""
MAX_RESIDUAL_SIGMAS = 6.0
"""A blurred corner may miss by its own uncertainty."""
POINTS_PER_TERM = 3.0
"""Corners for each term of the polynomial, so that it cannot follow single ones."""
_ROUNDS = 4
"""Rounds of reweighting."""


def planar_residuals(corners: RefinedCorners) -> tuple[Array, Array]:
    """Distance of each corner from where a plane behind a smooth lens would show it.

    Parameters
    ----------
    corners : RefinedCorners
        The corners of a whole grid.

    Returns
    -------
    residuals : (R, C, 2)
        Pixels, found less expected.
    allowed : (R, C)
        Largest length of a residual that a good corner may have, pixels.
    """
    points = corners.points
    rows, columns = points.shape[:2]
    y, x = np.mgrid[:rows, :columns].reshape(2, -1).astype(np.float64)
    found = points.reshape(-1, 2)
    across, down = local_axes(points)
    square = np.minimum(np.linalg.norm(across, axis=2), np.linalg.norm(down, axis=2))
    residual = _residuals(np.stack([x, y], axis=1), found, square.ravel())
    allowed = np.maximum(MAX_RESIDUAL_SHARE * square, MAX_RESIDUAL_SIGMAS * corners.sigma)
    return residual.reshape(rows, columns, 2), allowed


def _residuals(board: Array, found: Array, square: Array) -> Array:
    H, _ = cv2.findHomography(board, found, 0)
    if H is None:
        return np.full_like(found, np.inf)
    flat = cv2.perspectiveTransform(board[None], H)[0]
    centre, scale = flat.mean(axis=0), np.abs(flat - flat.mean(axis=0)).max()
    terms = _polynomial((flat - centre) / max(float(scale), 1e-9), len(found))
    weights = np.ones(len(found))
    for _ in range(_ROUNDS):
        fit, *_ = np.linalg.lstsq(terms * weights[:, None], (found - flat) * weights[:, None], rcond=None)
        residual = found - flat - terms @ fit
        relative = np.linalg.norm(residual, axis=1) / square
        width = max(2 * float(np.median(relative)), 1e-4)
        weights = 1 / (1 + (relative / width) ** 2)
    return np.asarray(residual)


def _polynomial(x: Array, count: int) -> Array:
    """Monomials of as high a degree, at most 5, as the number of points supports."""
    degree = 1
    while degree < 5 and (degree + 2) * (degree + 3) / 2 * POINTS_PER_TERM <= count:
        degree += 1
    powers = [(i, k - i) for k in range(degree + 1) for i in range(k + 1)]
    return np.stack([x[:, 0] ** i * x[:, 1] ** j for i, j in powers], axis=1)
