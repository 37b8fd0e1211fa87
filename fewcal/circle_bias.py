"""Where a circle's centre is seen: not at the centre of the ellipse that the circle is seen as.

Perspective shows the nearer half of a circle larger than the farther, and a lens bends what is left of the
ellipse, so that its centre is beside the image of the circle's centre, by the more the larger the circle
(Heikkila, "Geometric camera calibration using circular control points", 2000). The board tells how much: the
centres of all circles give the map f from the board to the image, a homography behind the division model of
two terms about a centre c near the middle of the image,

    x_u = (x_d - c) / (1 + l_1 r^2 + l_2 r^4),     r = |x_d - c|

and a polynomial for the rest, and the areas of the ellipses under it give the radius of the circles. Circles
of that radius are carried through f, an ellipse is fitted to each in the way the image was fitted, and what
its centre misses the image of the circle's centre by is taken off. A homography shows circles as exact
ellipses, for which this is exact.

The offset is a second derivative of f, so f has to be the lens's own shape: a polynomial through the centres
is near them all, yet has other derivatives and follows the errors of single centres.
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

LENS_WIDTH = np.array([0.5, 0.5, 0.05, 0.05])
"""Prior sd of l_1, l_2 and c in half diagonals: the lenses that `DIVISIONS` spans, with the centre where five
in six cameras have it. It matters where the board does not show them."""
MISFIT = 1e-3
"""What points are missed by, half diagonals, against which the prior is weighed: 0.4 px of 640x480, as sheets
are not flat. A tenth of it gives the same centres to a thousandth of a pixel."""
REST_DEGREE = 3
"""Of the polynomial for the rest, where there are circles enough: unequal focal lengths, a bent sheet."""
_STEPS = 10
"""Levenberg-Marquardt steps; from the best of `DIVISIONS` three suffice for most lenses."""
_CONVERGED = 1e-4
"""Share of the sum of squares below which a step is a tenth of an sd of the parameters."""
_ROUNDS = 2
"""Rounds of estimating the map from corrected centres; the second changes a hundredth of the offset."""
_ANGLES = np.arange(16) * (2 * np.pi / 16)
_CIRCLE = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
"""Points (16, 2) of the unit circle; an ellipse has five unknowns and the bend adds a few harmonics."""


class PlaneImage(NamedTuple):
    """How a lens shows a plane.

    Attributes
    ----------
    H : (3, 3)
        From the plane to the image without distortion, in half diagonals from c.
    division : (2,)
        The division model's l_1 and l_2, for radii in half diagonals.
    centre : (2,)
        The division model's c, pixels.
    half_diagonal : float
        Pixels.
    degree : int
        Of the polynomial, in the coordinates without distortion.
    rest : (T, 2)
        Its coefficients: what the division model leaves, half diagonals.
    """

    H: Array
    division: Array
    centre: Array
    half_diagonal: float
    degree: int
    rest: Array

    def __call__(self, plane: Array) -> Array:
        """Pixels (..., 2) of points (..., 2) of the plane."""
        straight = map_points(self.H, plane)
        seen = _divided(straight, self.division) + monomials(straight, self.degree) @ self.rest
        return np.asarray(self.centre + self.half_diagonal * seen)


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
    origin = plane.mean(axis=0)
    parameters = _fit_lens(plane - origin, found)
    H = np.append(parameters[:8], 1).reshape(3, 3)
    H[:, 2] -= H[:, :2] @ origin
    division, centre = parameters[8:10], parameters[10:]
    straight = map_points(H, plane)
    degree = min(REST_DEGREE, supported_degree(len(plane)))
    left = found - centre - _divided(straight, division)
    rest = np.asarray(np.linalg.lstsq(monomials(straight, degree), left, rcond=None)[0])
    return PlaneImage(H, division, middle + half_diagonal * centre, half_diagonal, degree, rest)


def _fit_lens(plane: Array, found: Array) -> Array:
    """Parameters of `_missed` for points of a plane about its origin, found in the image, half diagonals.

    Levenberg-Marquardt, with the prior as four more rows.
    """
    parameters = _start(plane, found)
    missed, J = _missed(parameters, plane, found)
    prior = np.eye(12)[8:] * (MISFIT / LENS_WIDTH)[:, None]
    damping = 1e-3
    for _ in range(_STEPS):
        rows, right = np.concatenate([J, prior]), np.concatenate([missed, prior @ parameters])
        scale = np.linalg.norm(rows, axis=0)
        scaled = rows / scale
        step = np.linalg.solve(scaled.T @ scaled + damping * np.eye(12), scaled.T @ right) / scale
        trial = parameters - step
        trial_missed, trial_J = _missed(trial, plane, found)
        before, after = right @ right, trial_missed @ trial_missed + np.sum((prior @ trial) ** 2)
        if after < before:
            parameters, missed, J = trial, trial_missed, trial_J
        damping *= 0.1 if after < before else 10.0
        if abs(before - after) < _CONVERGED * before:
            break
    return parameters


def _start(plane: Array, found: Array) -> Array:
    """Homography and l_1 without the other parameters: the best of some l_1."""
    stretch = np.maximum(1 + DIVISIONS[:, None] * np.sum(found**2, axis=1), MIN_STRETCH)[..., None]
    homographies = homographies_of_plane(plane, found / stretch)
    missed = (map_points(homographies, plane) - found / stretch) * stretch
    best = int(np.argmin(np.sum(missed**2, axis=(1, 2))))
    H = homographies[best] / homographies[best][2, 2]
    return np.concatenate([H.ravel()[:8], [DIVISIONS[best], 0, 0, 0]])


def _missed(parameters: Array, plane: Array, found: Array) -> tuple[Array, Array]:
    """What points are missed by, at the scale of the image, and its derivatives.

    Parameters
    ----------
    parameters : (12,)
        H row by row without its last element, which is 1, l_1, l_2, c.
    plane, found : (N, 2)
        The points on the plane and in the image, half diagonals.

    Returns
    -------
    missed : (2 N,)
        (x_u - H x) (1 + l_1 r^2 + l_2 r^4).
    J : (2 N, 12)
    """
    H = np.append(parameters[:8], 1).reshape(3, 3)
    (l_1, l_2), e = parameters[8:10], found - parameters[10:]
    r2 = np.sum(e**2, axis=1)[:, None]
    stretch = 1 + l_1 * r2 + l_2 * r2**2
    straight = map_points(H, plane)
    homogeneous = np.column_stack([plane, np.ones(len(plane))])
    by_row = -homogeneous * stretch / (homogeneous @ H[2])[:, None]
    J = np.zeros((len(plane), 2, 12))
    J[:, 0, :3] = J[:, 1, 3:6] = by_row
    J[:, :, 6:8] = -straight[:, :, None] * by_row[:, None, :2]
    J[:, :, 8], J[:, :, 9] = -straight * r2, -straight * r2**2
    J[:, :, 10:] = straight[:, :, None] * ((2 * l_1 + 4 * l_2 * r2) * e)[:, None, :] - np.eye(2)
    return (e - straight * stretch).ravel(), J.reshape(-1, 12)


def _divided(straight: Array, division: Array) -> Array:
    """Points (..., 2) without distortion through the division model about the origin, all in half diagonals.

    r = r_u (1 + l_1 r^2 + l_2 r^4) by Newton's method from its solution without l_2.
    """
    l_1, l_2 = division
    r_u = np.linalg.norm(straight, axis=-1, keepdims=True)
    r = 2 * r_u / (1 + np.sqrt(np.maximum(1 - 4 * l_1 * r_u**2, 0)))
    for _ in range(4):
        excess = r - r_u * (1 + l_1 * r**2 + l_2 * r**4)
        r = r - excess / (1 - r_u * (2 * l_1 * r + 4 * l_2 * r**3))
    return np.asarray(straight * (1 + l_1 * r**2 + l_2 * r**4))


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
    points, radius = centres, 0.3 * float(np.linalg.norm(plane - plane[0], axis=1)[1:].min())
    for _ in range(_ROUNDS):
        image = fit_plane_image(plane, points, image_shape)
        seen, shapes = _ellipses(image(plane[:, None] + radius * _CIRCLE))
        growth = float(np.median(np.sqrt(areas / np.sqrt(np.linalg.det(shapes)))))
        radius *= growth
        points = centres - growth**2 * (seen - image(plane))  # the offset grows with the square of the radius
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
