"""What board and lens do that the model leaves out.

Boards bend, their squares are not quite square, and lenses are not quite plumb_bob. A bend of a thousandth of
the board's size moves the focal length by per cents, squares that are as much longer than wide by tenths, and
all views share them. So two coefficients of a bend, one of the lens and one of the print are unknowns beside
the camera, with priors of what real boards and lenses do (`Priors.board_bend`, `Priors.lens_remainder`,
`Priors.print_stretch`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .camera import Camera

Array = NDArray[np.float64]

COUNT = 4
"""Unknowns after those of the camera: bend along x, bend along y, remainder of the lens, stretch."""
_NODES, _weights = np.polynomial.legendre.leggauss(8)
_AREA = np.outer(_weights, _weights).ravel()
"""Gauss-Legendre over the image, exact for the products of two powers of r up to the seventh."""


STRAIGHT = np.zeros(2)
"""Radial terms of a lens without distortion."""
_UNDISTORTED = 1e-9
"""Half diagonals to which a radius is undistorted."""
_NEWTON_STEPS = 20
_LEAST_SLOPE = 0.1
"""So near to a fold a step is held short."""


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
    def of(
        cls,
        points: Array,
        pixels: Array,
        image_size: tuple[int, int],
        centre: Array,
        radial: Array = STRAIGHT,
    ) -> Departures:
        """Departures of points (V, 2, N) of boards, metres, that are seen at pixels (V, 2, N).

        Those of the lens are as :func:`lens_remainder` has them.
        """
        shift = lens_remainder(pixels, image_size, centre, radial)
        return cls(lifts(points), shift, points * [[0.5], [-0.5]])

    def about(self, centre: Array, pixels: Array, image_size: tuple[int, int], radial: Array) -> Departures:
        """The same about another centre and distortion of the lens."""
        return self._replace(shift=lens_remainder(pixels, image_size, centre, radial))


def radial_terms(camera: Camera, size: tuple[int, int]) -> Array:
    """Coefficients (2,) of r^2 and r^4 in half diagonals of the image."""
    rc = np.hypot(*size) / 2 / camera.fx
    return np.asarray(camera.distortion[:2] * [rc**2, rc**4])


def lifts(points: Array) -> Array:
    """Lift (V, 2, N) of points (V, 2, N), metres: parabolas across the board, as high as its diagonal."""
    half = np.ptp(points, axis=-1).max(axis=0)[:, None] / 2
    lift: Array = 2 * np.hypot(*half) * (points / half) ** 2
    return lift


def lens_remainder(
    pixels: Array, image_size: tuple[int, int], centre: Array, radial: Array = STRAIGHT
) -> Array:
    """Shift (V, 2, N) at pixels (V, 2, N) by the next radial term, less what f, k1 and k2 can take over.

    In half diagonals about a centre (2,), the principal point or the place in the image nearest to it, it is
    r^7 less its best fit by r, r^3 and r^5 over the image, so that the camera beside it is the best one of
    the model. r is that of a point without the distortion, as in the model, of which `radial` (2,) are the
    terms a1 and a2 in these units: near the corners of a wide image it is half as large again as where the
    point is seen.
    """
    centre = np.clip(centre, 0, np.array(image_size))
    half = np.hypot(*image_size) / 2
    at = (pixels - centre[:, None]) / half
    r = np.sqrt((at * at).sum(axis=-2, keepdims=True))
    at = at * (_undistorted(r, radial) / np.maximum(r, 1e-300))
    r2 = (at * at).sum(axis=-2, keepdims=True)
    a, b, c = _taken_over(image_size, centre, radial)
    shift: Array = half * at * (((r2 - c) * r2 - b) * r2 - a)
    return shift


def axial_remainder(image_size: tuple[int, int], centre: Array, radial: Array = STRAIGHT) -> float:
    """Relative change of the focal length on the axis by the remainder of the lens, for a coefficient of 1.

    The camera beside it fits the whole image best, so that it is not the lens's on the axis.
    """
    return -float(_taken_over(image_size, np.clip(centre, 0, np.array(image_size)), radial)[0])


def _undistorted(r: Array, radial: Array) -> Array:
    """Radii without the distortion r (1 + a1 r^2 + a2 r^4); as they are seen where there is none."""
    a1, a2 = radial.tolist()
    if a1 == a2 == 0:
        return r
    u, highest = r, np.minimum(2 * r, _fold(a1, a2))
    for _ in range(_NEWTON_STEPS):
        u2 = u * u
        off = u * (1 + u2 * (a1 + a2 * u2)) - r
        if np.abs(off).max(initial=0.0) < _UNDISTORTED:
            return u
        u = np.clip(u - off / np.maximum(1 + u2 * (3 * a1 + 5 * a2 * u2), _LEAST_SLOPE), 0, highest)
    return np.where(np.abs(off) < _UNDISTORTED, u, r)


def _fold(a1: float, a2: float) -> float:
    """Radius at which r (1 + a1 r^2 + a2 r^4) turns back; beyond, where it may rise again, is no lens."""
    inside = 9 * a1 * a1 - 20 * a2
    below = math.sqrt(inside) - 3 * a1 if inside >= 0 else 0.0
    return math.sqrt(2 / below) if below > 0 else math.inf


def _taken_over(image_size: tuple[int, int], centre: Array, radial: Array) -> Array:
    """Coefficients (3,) of r, r^3 and r^5 that fit r^7 best over the image."""
    size = np.array(image_size)
    x, y = (((_NODES * size[:, None] + size[:, None] - 1) / 2 - centre[:, None]) / (np.hypot(*size) / 2)) ** 2
    r2 = _undistorted(np.sqrt((x[:, None] + y).ravel()), radial) ** 2
    odd = r2 ** np.array([[0], [1], [2], [3]])  # r, r^3, r^5 and r^7, all over r
    fitted, seventh = odd[:3] * (r2 * _AREA), odd[3]
    return np.asarray(np.linalg.solve(fitted @ odd[:3].T, fitted @ seventh))
