"""Where a circle's centre is seen: not at the centre of the ellipse that the circle is seen as.

Perspective shows the nearer half of a circle larger than the farther, and a lens bends what is left of the
ellipse, so that its centre is beside the image of the circle's centre, by the more the larger the circle
(Heikkila, "Geometric camera calibration using circular control points", 2000). The board tells how much: the
centres of all circles give the map f from the board to the image, a homography behind the division model

    x_u = x_d / (1 + lambda r_d^2)

about the middle of the image and a polynomial for the rest, and the areas of the ellipses under it give the
radius of the circles. Circles of that radius are carried through f, an ellipse is fitted to each in the way
the image was fitted, and what its centre misses the image of the circle's centre by is taken off. A
homography shows circles as exact ellipses, for which this is exact.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .planarity import (
    DIVISIONS,
    MIN_STRETCH,
    half_diagonals,
    homographies_of_plane,
    map_points,
    monomials,
    supported_degree,
)

Array = NDArray[np.float64]

POINTS_PER_TERM = 2.0
"""Circles for each term of the polynomial: all of them are known to be right."""
_ROUNDS = 3
"""Rounds of estimating the map from corrected centres; the third changes nothing that can be seen."""
_REFINEMENTS = 3
"""Rounds in which lambda is found, each on as many values within one step of the best so far."""
_ANGLES = np.arange(24) * (2 * np.pi / 24)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Points (24, 2) of the unit circle; an ellipse has five unknowns and the bend adds a few harmonics."""


class PlaneImage(NamedTuple):
    """How a lens shows a plane.

    Attributes
    ----------
    H : (3, 3)
        From the plane to the image without distortion, in half diagonals from its middle.
    division : float
        The division model's lambda, for radii in half diagonals.
    middle : (2,)
        Middle of the image, pixels.
    half_diagonal : float
        Pixels.
    degree : int
        Of the polynomial, in the coordinates without distortion.
    rest : (T, 2)
        Its coefficients: what the division model leaves, half diagonals.
    """

    H: Array
    division: float
    middle: Array
    half_diagonal: float
    degree: int
    rest: Array

    def __call__(self, plane: Array) -> Array:
        """Pixels (..., 2) of points (..., 2) of the plane."""
        straight = map_points(self.H, plane)
        seen = _divided(straight, self.division) + monomials(straight, self.degree) @ self.rest
        return np.asarray(self.middle + self.half_diagonal * seen)


def fit_plane_image(plane: Array, pixels: Array, image_shape: tuple[int, ...]) -> PlaneImage:
    """Fit the map of a plane to the image.

    Parameters
    ----------
    plane, pixels : (N, 2)
        The same points on the plane and in the image.
    image_shape : (int, int)
        Height and width, pixels.
    """
    middle, half_diagonal = half_diagonals(image_shape)
    found = (pixels - middle) / half_diagonal
    divisions = DIVISIONS
    for _ in range(_REFINEMENTS):
        stretch = np.maximum(1 + divisions[:, None] * np.sum(found**2, axis=1), MIN_STRETCH)[..., None]
        homographies = homographies_of_plane(plane, found / stretch)
        missed = (map_points(homographies, plane) - found / stretch) * stretch
        best = int(np.argmin(np.sum(missed**2, axis=(1, 2))))
        H, division = homographies[best], float(divisions[best])
        step = divisions[1] - divisions[0]
        divisions = division + np.linspace(-step, step, len(divisions))
    straight = map_points(H, plane)
    degree = supported_degree(len(plane), POINTS_PER_TERM)
    terms = monomials(straight, degree)
    scale = np.linalg.norm(terms, axis=0)
    rest = (
        np.linalg.lstsq(terms / scale, found - _divided(straight, division), rcond=None)[0] / scale[:, None]
    )
    return PlaneImage(H, division, middle, half_diagonal, degree, rest)


def _divided(straight: Array, division: float) -> Array:
    """Points (..., 2) without distortion through the division model, all in half diagonals."""
    r2 = np.sum(straight**2, axis=-1, keepdims=True)
    return np.asarray(straight * (2 / (1 + np.sqrt(np.maximum(1 - 4 * division * r2, 0)))))


def circle_centres(
    plane: Array, centres: Array, covariances: Array, image_shape: tuple[int, ...]
) -> tuple[Array, float]:
    """Images of the centres of equal circles, from the ellipses that they are seen as.

    Parameters
    ----------
    plane : (N, 2)
        Centres of the circles on their plane.
    centres : (N, 2)
        Centres of the ellipses, pixels.
    covariances : (N, 2, 2)
        Of the area of each ellipse, px^2.
    image_shape : (int, int)
        Height and width, pixels.

    Returns
    -------
    points : (N, 2)
        Images of the circles' centres, pixels.
    radius : float
        Of the circles, in units of `plane`.
    """
    areas = np.sqrt(np.linalg.det(covariances))
    points, radius = centres, 0.1 * float(np.linalg.norm(plane - plane[0], axis=1)[1:].min())
    for _ in range(_ROUNDS):
        image = fit_plane_image(plane, points, image_shape)
        seen, shapes = _ellipses(image(plane[:, None] + radius * _CIRCLE))
        radius *= float(np.median(np.sqrt(areas / np.sqrt(np.linalg.det(shapes)))))
        seen, _ = _ellipses(image(plane[:, None] + radius * _CIRCLE))
        points = centres - (seen - image(plane))
    return points, radius


def _ellipses(outlines: Array) -> tuple[Array, Array]:
    """Centres (N, 2) and covariances (N, 2, 2) of the ellipses through images of circles (N, T, 2).

    In coordinates y in which the outline is nearly the unit circle, q(y) = 1 is fitted by its distances along
    the normals of the outline, all parts of its length counting alike as in a picture.
    """
    middle = outlines.mean(axis=1)
    A = 2 * np.swapaxes(outlines, 1, 2) @ _CIRCLE / len(_CIRCLE)
    y = np.linalg.solve(A, np.swapaxes(outlines - middle[:, None], 1, 2))
    speed = np.linalg.norm(A @ np.stack([-_CIRCLE[:, 1], _CIRCLE[:, 0]]), axis=1)
    weights = speed**-0.5  # the root of the length that a point stands for, and distance per unit of q
    rows = np.stack([y[:, 0] ** 2, 2 * y[:, 0] * y[:, 1], y[:, 1] ** 2, y[:, 0], y[:, 1]], axis=-1)
    rows *= weights[..., None]
    normal = np.swapaxes(rows, 1, 2) @ rows
    conic = np.linalg.solve(normal, np.swapaxes(rows, 1, 2) @ weights[..., None])[..., 0]
    Q = conic[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
    offset = -np.linalg.solve(Q, conic[:, 3:, None]) / 2
    # 1 + l^T Q^-1 l / 4 is the level of q about its own centre.
    level = 1 + np.swapaxes(offset, 1, 2) @ Q @ offset
    shapes = A @ np.linalg.inv(Q) @ np.swapaxes(A, 1, 2) * level / 4
    return middle + (A @ offset)[..., 0], shapes
