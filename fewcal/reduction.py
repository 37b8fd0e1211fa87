"""Reduced copies of an image, in which boards are looked for coarse to fine, and windows in these."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from .grey import GreyImage

Array = NDArray[np.float64]

COARSEST_PX = 300
"""No reduced copy is smaller than this on its long side: a board across half of it has squares of 15 px."""
SEARCHED_PX = 1000
"""Copies up to this size are always searched, larger ones only when there is evidence of a board, and a
window of them for boards with markers; chessboards are looked for in every copy smaller than the full image,
circle grids in those up to this size."""
WINDOW_PX = 500
"""Side of a window of a copy larger than that; a board of 15 squares of 32 px fits in."""
CELLS = 16
"""Cells along the side of a window in which points are counted."""


def reductions(grey: GreyImage, coarsest_px: float = COARSEST_PX) -> list[int]:
    """Factors of the reduced copies, coarse to fine, each half the one before.

    Parameters
    ----------
    grey : (H, W) array
    coarsest_px : float
        Least length of their long side, pixels.
    """
    factor = 1
    while max(grey.shape) / (2 * factor) >= coarsest_px and min(grey.shape) >= 4 * factor:
        factor *= 2
    return [factor >> k for k in range(factor.bit_length())]


def reduce(grey: GreyImage, factor: int) -> GreyImage:
    """Mean over blocks of factor x factor pixels, a power of two; a rest at the right and below is left out.

    Rounded at each halving, which is ten times as fast as one mean over large blocks.
    """
    while factor > 1:
        height, width = (size // 2 for size in grey.shape)
        block = grey[: 2 * height, : 2 * width]
        grey = cv2.resize(block, (width, height), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
        factor //= 2
    return grey


def densest_window(points: Array, weights: Array, shape: tuple[int, ...], side: int) -> tuple[slice, slice]:
    """Square window of an image about the place where points are densest.

    Parameters
    ----------
    points : (N, 2)
        Pixels inside the image.
    weights : (N,)
        What each of them counts.
    shape : (int, int)
        Rows and columns of the image.
    side : int
        Side of the window, pixels; it is smaller only where the image is.

    Returns
    -------
    rows, columns : slice
    """
    cell = max(side // CELLS, 1)
    rows, columns = (size // cell + 1 for size in shape)
    x, y = (np.rint(points).astype(np.intp) // cell).T
    total = np.bincount(y * columns + x, weights, rows * columns).reshape(rows, columns).astype(float)
    # The Gaussian is as wide as half the window, so that what is as large lies in the middle of it.
    density = cv2.GaussianBlur(total, (0, 0), CELLS / 8, borderType=cv2.BORDER_CONSTANT)
    middle = (np.array(divmod(int(density.argmax()), columns)) + 0.5) * cell
    starts = np.clip(np.rint(middle - side / 2), 0, np.maximum(np.array(shape) - side, 0)).astype(int)
    top, left = starts.tolist()
    return slice(top, top + side), slice(left, left + side)
