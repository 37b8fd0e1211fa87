"""What board and lens do that the model leaves out.

Boards bend, their squares are not quite square, and lenses are not quite plumb_bob. A bend of a thousandth of
the board's size moves the focal length by per cents, squares that are as much longer than wide by tenths, and
all views share them. So two coefficients of a bend, one of the lens and one of the print are unknowns beside
the camera, with priors of what real boards and lenses do (`Priors.board_bend`, `Priors.lens_remainder`,
`Priors.print_stretch`).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COUNT = 4
"""Unknowns after those of the camera: bend along x, bend along y, remainder of the lens, stretch."""
_CELLS = 32


class Departures(NamedTuple):
    """What a coefficient of 1 does to the points of some views.

    Attributes
    ----------
    lift : (V, 2, N) along the board's normal, metres, by the bend along x and by the one along y
    shift : (V, 2, N) in the image, pixels, by the remainder of the lens
    stretch : (V, 2, N) in the board's plane, metres, by squares that are e times as wide as high
    """

    lift: Array
    shift: Array
    stretch: Array

    @classmethod
    def of(cls, points: Array, pixels: Array, image_size: tuple[int, int]) -> Departures:
        """Departures of points (V, 2, N) of boards, metres, that are seen at pixels (V, 2, N)."""
        return cls(lifts(points), lens_remainder(pixels, image_size), points * [[0.5], [-0.5]])


def lifts(points: Array) -> Array:
    """Lift (V, 2, N) of points (V, 2, N), metres: parabolas across the board, as high as its diagonal."""
    half = np.ptp(points, axis=-1).max(axis=0)[:, None] / 2
    lift: Array = 2 * np.hypot(*half) * (points / half) ** 2
    return lift


def lens_remainder(pixels: Array, image_size: tuple[int, int]) -> Array:
    """Shift (V, 2, N) at pixels (V, 2, N) by the next radial term, less what f, k1 and k2 can take over.

    In half diagonals about the centre of the image it is r^7 less its best fit by r, r^3 and r^5 over the
    image, so that the camera beside it is the best one of the model. It is taken where the points are seen
    instead of where the camera puts them, which changes it by a small share.
    """
    half = np.hypot(*image_size) / 2
    at = (pixels - ((np.array(image_size) - 1) / 2)[:, None]) / half
    r2 = (at * at).sum(axis=-2, keepdims=True)
    a, b, c = _taken_over(image_size)
    shift: Array = half * at * (((r2 - c) * r2 - b) * r2 - a)
    return shift


@lru_cache(maxsize=64)
def _taken_over(image_size: tuple[int, int]) -> tuple[float, ...]:
    """Coefficients of r, r^3 and r^5 that fit r^7 best over the image."""
    half = np.hypot(*image_size) / 2
    middles = (np.arange(_CELLS) + 0.5) / _CELLS - 0.5
    x, y = np.meshgrid(*(middles * length / half for length in image_size))
    r = np.hypot(x, y).ravel()
    return tuple(np.linalg.lstsq(r[:, None] ** [1, 3, 5], r**7, rcond=None)[0].tolist())
