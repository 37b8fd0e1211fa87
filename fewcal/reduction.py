"""Reduced copies of an image, in which boards are looked for coarse to fine."""

from __future__ import annotations

import cv2

from .grey import GreyImage

COARSEST_PX = 300
"""No reduced copy is smaller than this on its long side: a board across half of it has squares of 15 px."""
SEARCHED_PX = 1000
"""Copies up to this size are always searched, a larger full image only when there is evidence of a board;
chessboards are looked for in every smaller copy, circle grids in those up to this size."""


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
