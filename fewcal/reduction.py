"""Reduced copies of an image, in which boards are looked for coarse to fine."""

from __future__ import annotations

import cv2

from .grey import GreyImage

COARSEST_PX = 300
"""No reduced copy is smaller than this on its long side: a board across half of it has squares of 15 px."""
SEARCHED_PX = 1000
"""Copies up to this size are always searched, larger ones only when there is evidence of a board; on a
1920x1080 image that is every copy but the full one."""


def reductions(grey: GreyImage) -> list[int]:
    """Factors of the reduced copies, coarse to fine, each half the one before."""
    factor = 1
    while max(grey.shape) / (2 * factor) >= COARSEST_PX and min(grey.shape) >= 4 * factor:
        factor *= 2
    return [factor >> k for k in range(factor.bit_length())]


def reduce(grey: GreyImage, factor: int) -> GreyImage:
    """Mean over blocks of factor x factor pixels; a rest at the right and the bottom is left out."""
    if factor == 1:
        return grey
    height, width = (size // factor for size in grey.shape)
    block = grey[: height * factor, : width * factor]
    return cv2.resize(block, (width, height), interpolation=cv2.INTER_AREA)  # type: ignore[return-value]
