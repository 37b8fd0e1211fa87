"""What board and lens do that the model leaves out.

Boards bend, their squares are not quite square, and lenses are not quite plumb_bob. A bend of a thousandth of
the board's size moves the focal length by per cents, squares that are as much longer than wide by tenths, and
all views share them. So two coefficients of a bend, one of the lens and one of the print are unknowns beside
the camera, with priors of what real boards and lenses do (`Priors.board_bend`, `Priors.lens_remainder`,
`Priors.print_stretch`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

COUNT = 4
"""Unknowns after those of the camera: bend along x, bend along y, remainder of the lens, stretch."""
_NODES, _weights = np.polynomial.legendre.leggauss(8)
_AREA = np.outer(_weights, _weights).ravel()
"""Gauss-Legendre over the image, exact for the products of two powers of r up to the seventh."""


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
    def of(cls, points: Array, pixels: Array, image_size: tuple[int, int], centre: Array) -> Departures:
        """Departures of points (V, 2, N) of boards, metres, that are seen at pixels (V, 2, N).

        Those of the lens are about a centre (2,), pixels.
        """
        return cls(lifts(points), lens_remainder(pixels, image_size, centre), points * [[0.5], [-0.5]])

    def about(self, centre: Array, pixels: Array, image_size: tuple[int, int]) -> Departures:
        """The same with another centre of the lens."""
        return self._replace(shift=lens_remainder(pixels, image_size, centre))


def lifts(points: Array) -> Array:
    """Lift (V, 2, N) of points (V, 2, N), metres: parabolas across the board, as high as its diagonal."""
    half = np.ptp(points, axis=-1).max(axis=0)[:, None] / 2
    lift: Array = 2 * np.hypot(*half) * (points / half) ** 2
    return lift


def lens_remainder(pixels: Array, image_size: tuple[int, int], centre: Array) -> Array:
    """Shift (V, 2, N) at pixels (V, 2, N) by the next radial term, less what f, k1 and k2 can take over.

    In half diagonals about a centre (2,), the principal point or the place in the image nearest to it, it is
    r^7 less its best fit by r, r^3 and r^5 over the image, so that the camera beside it is the best one of
    the model. It is taken where the points are seen instead of where the camera puts them, which changes it
    by a small share.
    """
    centre = np.clip(centre, 0, np.array(image_size))
    half = np.hypot(*image_size) / 2
    at = (pixels - centre[:, None]) / half
    r2 = (at * at).sum(axis=-2, keepdims=True)
    a, b, c = _taken_over(image_size, centre)
    shift: Array = half * at * (((r2 - c) * r2 - b) * r2 - a)
    return shift


def axial_remainder(image_size: tuple[int, int], centre: Array) -> float:
    """Relative change of the focal length on the axis by the remainder of the lens, for a coefficient of 1.

    The camera beside it fits the whole image best, so that it is not the lens's on the axis.
    """
    return -float(_taken_over(image_size, np.clip(centre, 0, np.array(image_size)))[0])


def _taken_over(image_size: tuple[int, int], centre: Array) -> Array:
    """Coefficients (3,) of r, r^3 and r^5 that fit r^7 best over the image."""
    size = np.array(image_size)
    x, y = (((_NODES * size[:, None] + size[:, None] - 1) / 2 - centre[:, None]) / (np.hypot(*size) / 2)) ** 2
    r2 = (x[:, None] + y).ravel()
    odd = r2 ** np.array([[0], [1], [2], [3]])  # r, r^3, r^5 and r^7, all over r
    fitted, seventh = odd[:3] * (r2 * _AREA), odd[3]
    return np.asarray(np.linalg.solve(fitted @ odd[:3].T, fitted @ seventh))
