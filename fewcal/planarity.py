"""Whether corners lie on a plane, as some lens shows it.

A plane through a lens is a homography behind a smooth bend. The bulk of the bend is taken out by the division
model about the middle of the image (Fitzgibbon, "Simultaneous linear estimation of multiple view geometry and
lens distortion", 2001),

    x_u = x_d / (1 + lambda r_d^2)

and a polynomial takes the rest, and the bend of the paper; of several lambdas the one that leaves least is
taken. The fit is robust, so that a wrong corner does not bend it. What remains is judged against the size of
the squares: every lens and every sheet of paper passes, and no corner that belongs elsewhere. One that passes
and yet stands out from the others has been moved, by a smear that touches the next one, by the edge of a
shadow or by a finger, and is uncertain by as much.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .corner_refinement import RefinedCorners
from .grid import local_axes

Array = NDArray[np.float64]

MAX_RESIDUAL_SHARE = 0.07
"""Largest residual of a good corner as a share of its square: 110 deg lenses and paper that came off the wall
stay at half of it."""
MAX_RESIDUAL_SIGMAS = 6.0
"""A blurred corner may miss by its own uncertainty,"""
MAX_UNCERTAIN_SHARE = 0.42
"""but by no more than this share of its square: what strays from the window that it was looked for in belongs
elsewhere, however uncertain."""
DIVISIONS = np.linspace(-0.9, 0.3, 13)
"""Values of lambda tried, radii as a share of half the diagonal: from a fisheye to a strong pincushion."""
MIN_STRETCH = 0.05
"""Bound of 1 + lambda r^2, where a corner outside the image would turn it negative."""
POINTS_PER_TERM = 3.0
"""Corners for each term of the polynomial, so that it cannot follow single ones."""
MAX_DEGREE = 5
"""Degree of the polynomial, as far as there are corners for it."""
OUTLYING = 4.0
"""Residual that stands out, in sd of either direction: of points with normal errors one in 3000 does."""
TELLING_DEGREE = 3
"""A polynomial of a lower degree leaves more than the errors of the points, where the lens bends strongly."""
RAYLEIGH_MEDIAN = 1.1774
"""Median length of a two-dimensional error, in sd of either direction: sqrt(2 ln 2)."""
RIDGE = 1e-10
"""Share of the trace added to the diagonal of the normal equations: terms that a narrow board cannot tell
apart share what they have in common."""
_ROUNDS = 4
"""Rounds of reweighting; the weights hardly change after three."""


def planar_residuals(corners: RefinedCorners, image_shape: tuple[int, ...]) -> tuple[Array, Array, Array]:
    """Distance of each corner of a whole grid from where a plane behind a smooth lens would show it.

    Parameters
    ----------
    corners : RefinedCorners
        The corners of a whole grid.
    image_shape : (int, int)
        Height and width of the image, pixels.

    Returns
    -------
    residuals : (R, C, 2)
        Pixels, found less expected.
    allowed : (R, C)
        Largest length of a residual that a good corner may have, pixels.
    outlying : (R, C)
        How far off a corner is that stands out from the others, pixels; 0 for all others.
    """
    rows, columns = corners.points.shape[:2]
    plane = np.indices((rows, columns))[::-1].reshape(2, -1).T.astype(np.float64)
    square = np.fmin(*(np.linalg.norm(axes, axis=2) for axes in local_axes(corners.points)))
    residuals, allowed, outlying = plane_residuals(
        plane, corners.points.reshape(-1, 2), square.ravel(), corners.sigma.ravel(), image_shape
    )
    shape = rows, columns
    return residuals.reshape(*shape, 2), allowed.reshape(shape), outlying.reshape(shape)


def plane_residuals(
    plane: Array, pixels: Array, spacing: Array, sigma: Array, image_shape: tuple[int, ...]
) -> tuple[Array, Array, Array]:
    """Distance of each point from where a plane behind a smooth lens would show it.

    Parameters
    ----------
    plane : (N, 2)
        The points on the plane, in any unit.
    pixels : (N, 2)
        The same points in the image.
    spacing : (N,)
        Distance to their neighbours in the image, where it is shortest, pixels.
    sigma : (N,)
        Their sd, pixels.
    image_shape : (int, int)
        Height and width of the image, pixels.

    Returns
    -------
    residuals : (N, 2)
        Pixels, found less expected.
    allowed : (N,)
        Largest length of a residual that a good point may have, pixels.
    outlying : (N,)
        How far off a point is that stands out from the others, pixels; 0 for all others.
    """
    middle, half_diagonal = half_diagonals(image_shape)
    found = (pixels - middle) / half_diagonal
    residuals = half_diagonal * _residuals(plane, found, spacing / half_diagonal)
    allowed = np.clip(
        MAX_RESIDUAL_SIGMAS * sigma, MAX_RESIDUAL_SHARE * spacing, MAX_UNCERTAIN_SHARE * spacing
    )
    return residuals, allowed, _outlying(np.linalg.norm(residuals, axis=1), sigma)


def _outlying(residual: Array, sigma: Array) -> Array:
    """Residuals (N,) that stand out; 0 for others, and where the points are too few to tell."""
    if supported_degree(len(residual)) < TELLING_DEGREE:
        return np.zeros_like(residual)
    scatter = np.median(residual) / RAYLEIGH_MEDIAN
    return np.where(residual > OUTLYING * np.hypot(sigma, scatter), residual, 0.0)


def half_diagonals(image_shape: tuple[int, ...]) -> tuple[Array, float]:
    """Middle of an image (2,) and half its diagonal, pixels: origin and unit of the division model."""
    middle = (np.array(image_shape[1::-1]) - 1) / 2
    return middle, float(np.hypot(*middle)) + 0.5


def _residuals(board: Array, found: Array, square: Array) -> Array:
    """Residuals (N, 2) of points found, all in half diagonals; the lambda that leaves least is taken."""
    stretch = np.maximum(1 + DIVISIONS[:, None] * np.sum(found**2, axis=1), MIN_STRETCH)
    straight = found / stretch[..., None]
    flat = map_points(homographies_of_plane(board, straight), board)
    terms = _polynomial(flat)
    weights = np.ones(stretch.shape)
    for _ in range(_ROUNDS):
        weighted = np.swapaxes(terms * weights[..., None], 1, 2)
        normal = weighted @ terms
        ridge = RIDGE * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(terms.shape[2])
        fit = np.linalg.solve(normal + ridge, weighted @ (straight - flat))
        residual = (straight - flat - terms @ fit) * stretch[..., None]
        relative = np.linalg.norm(residual, axis=2) / square
        width = np.maximum(2 * np.median(relative, axis=1, keepdims=True), 1e-4)
        weights = 1 / (1 + (relative / width) ** 2) ** 2
    return np.asarray(residual[np.argmin(relative.mean(axis=1))])


def homographies_of_plane(plane: Array, images: Array) -> Array:
    """Best homographies (L, 3, 3) from points of a plane (N, 2) to several images of them (L, N, 2)."""
    middle, extent = plane.mean(axis=0), plane.std(axis=0)
    centre = images.mean(axis=1, keepdims=True)
    scale = images.std(axis=(1, 2), keepdims=True)
    x, y = np.moveaxis((images - centre) / scale, -1, 0)[..., None]
    X = np.broadcast_to(np.column_stack([(plane - middle) / extent, np.ones(len(plane))]), (*x.shape[:2], 3))
    nothing = np.zeros_like(X)
    in_x, in_y = np.concatenate([X, nothing, -x * X], axis=2), np.concatenate([nothing, X, -y * X], axis=2)
    rows = np.concatenate([in_x, in_y], axis=1)
    _, vectors = np.linalg.eigh(np.swapaxes(rows, 1, 2) @ rows)
    H = vectors[..., 0].reshape(-1, 3, 3)
    H[:, :2] = scale * H[:, :2] + np.swapaxes(centre, 1, 2) * H[:, 2:]
    H[..., :2] /= extent
    H[..., 2] -= H[..., :2] @ middle
    return H


def map_points(H: Array, points: Array) -> Array:
    """Points (..., N, 2) through homographies (..., 3, 3), which may have more axes before."""
    mapped = points @ np.swapaxes(H[..., :2], -1, -2) + H[..., None, :, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])


def _polynomial(points: Array) -> Array:
    """Monomials (L, N, T) of as high a degree as the number of points supports."""
    centred = points - points.mean(axis=1, keepdims=True)
    extent = np.abs(centred).max(axis=(1, 2), keepdims=True)
    return monomials(centred / extent, supported_degree(points.shape[1]))


def supported_degree(count: int) -> int:
    """Degree of a polynomial in two variables that so many points determine."""
    degree = 1
    while degree < MAX_DEGREE and (degree + 2) * (degree + 3) / 2 * POINTS_PER_TERM <= count:
        degree += 1
    return degree


def monomials(points: Array, degree: int) -> Array:
    """Products of powers (..., T) of the coordinates of points (..., 2), up to a degree."""
    x, y = np.moveaxis(points, -1, 0)
    terms = last = [np.ones_like(x)]
    for _ in range(degree):
        last = [*(x * term for term in last), y * last[-1]]
        terms = terms + last
    return np.stack(terms, axis=-1)
