"""What a camera sees while somebody shows it a board: frames shared by the tests of session and commands."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from board_pictures import BOARD, CAMERA, SIZE, picture, pose
from numpy.typing import NDArray

from fewcal.rendering import render

PERIOD_NS = 100_000_000
SQUARE_PX = 34.0

Image = NDArray[np.uint8]


@lru_cache(maxsize=64)
def shown(
    tilt_deg: float,
    about_deg: float = 0.0,
    shift_px: float = 0.0,
    seed: int = 0,
    blur_px: float = 0.7,
    square_px: float = SQUARE_PX,
) -> Image:
    """The board tilted about an axis in the image plane, its middle off that of the image by shift_px."""
    T = pose(BOARD, square_px, tilt_deg, about_deg, shift_px=(shift_px, 0.0))
    image, _ = picture(T, seed=seed, blur_px=blur_px)
    image.setflags(write=False)
    return image


@lru_cache(maxsize=1)
def empty() -> Image:
    """The scene without a board."""
    image = render(CAMERA, SIZE, None, None, rng=np.random.default_rng(0))
    image.setflags(write=False)
    return image


def flat() -> Image:
    """A view that says next to nothing of the focal length."""
    return shown(1.0)


def pair() -> tuple[Image, Image]:
    """Two views that make a good camera."""
    return shown(40.0, 10.0), shown(40.0, 100.0)
