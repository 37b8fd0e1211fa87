"""Any picture, as one plane of grey levels."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInput

GreyImage = NDArray[np.uint8] | NDArray[np.uint16]


def as_grey(image: NDArray[Any]) -> GreyImage:
    """Reduce a picture to grey levels of its own depth.

    Parameters
    ----------
    image : (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) array of uint8 or uint16
        Grey or colour. Colour is taken as BGR(A), OpenCV's order; RGB(A) serves as well, since a board is
        black and white and only the weights of red and blue change places.

    Returns
    -------
    (H, W) array of the same depth, contiguous.

    Raises
    ------
    InvalidInput
        When it is no such array.
    """
    if not isinstance(image, np.ndarray):
        raise InvalidInput(f"An image must be a numpy array, not {type(image).__name__}.")
    if image.dtype.kind != "u" or image.dtype.itemsize > 2:
        raise InvalidInput(
            f"An image must hold uint8 or uint16, not {image.dtype}; scale and convert it first."
        )
    colour = image.ndim == 3 and image.shape[2] in (1, 3, 4)
    if image.size == 0 or not (image.ndim == 2 or colour):
        raise InvalidInput(
            f"An image must have shape (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), not {image.shape}."
        )
    native = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("="))
    if image.ndim == 2 or image.shape[2] == 1:
        return native.reshape(image.shape[:2])
    code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
    grey: GreyImage = np.asarray(cv2.cvtColor(native, code), dtype=native.dtype)
    return grey


def size_of(image: NDArray[Any]) -> tuple[int, int]:
    """(width, height) of an image array, pixels."""
    return int(image.shape[1]), int(image.shape[0])
