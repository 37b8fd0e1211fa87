"""The distortion polynomial, its derivatives and its inverse.

    r2 = x^2 + y^2
    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2)
    y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3) + p1 (r2 + 2 y^2) + 2 p2 x y

plumb_bob applies it to normalised coordinates, the paper to pixels about the principal point (see
:mod:`fewcal.camera`). Any leading axes broadcast.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_BOUND_GRID = np.linspace(0, 3, 61)
"""Undistorted radii looked at, as a share of the distorted one."""
_BOUND_MARGIN = 0.05
"""More than the slope of a lens changes between two of them."""

_NEWTON_STEPS = 50
"""Both inversions stop by themselves, in about 6 steps; this only bounds a sequence that does not."""
_NEWTON_TOLERANCE = 1e-14
"""Relative step at which an inversion is as exact as a double can hold."""
_NEWTON_SHRINKS, _NEWTON_NEAR = 0.75, 1e-6
"""A Newton step is at most this share of the last one, or of the radius, where rounding decides; else the
bracket is halved. Steps towards a fold shrink by half."""
_FARTHEST = 1e100
"""Undistorted radius up to which one is looked for."""
_FOLD_START = 0.9
"""Where the search starts, as a share of the fold radius, for a point that only p1 and p2 may have pushed
beyond the fold. Any start from 0.8 to 0.98 finds the same rays in simulated lenses."""
_FOLD_REACH = 1.2
"""How far p1 and p2 can move the fold, as a share of its radius, for coefficients up to 0.02; a solution
farther out lies on another sheet of the polynomial."""


def distort(points: Array, coefficients: Array) -> Array:
    """Apply the distortion polynomial.

    Parameters
    ----------
    points : (..., N, 2)
        Undistorted coordinates: normalised for plumb_bob, pixels about the principal point for the paper's.
    coefficients : (..., 5)
        k1, k2, p1, p2, k3 in the unit that belongs to the points.

    Returns
    -------
    (..., N, 2) distorted coordinates.
    """
    x, y = points[..., 0], points[..., 1]
    k1, k2, p1, p2, k3 = columns(coefficients)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def distort_jacobians(points: Array, coefficients: Array) -> tuple[Array, Array]:
    """Differentiate :func:`distort`.

    Returns
    -------
    d_points : (..., N, 2, 2)
    d_coefficients : (..., N, 2, 5) by k1, k2, p1, p2, k3
    """
    x, y = points[..., 0], points[..., 1]
    k1, k2, p1, p2, k3 = columns(coefficients)
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # d radial / d r2
    shape = np.broadcast_shapes(x.shape, radial.shape)
    d_points = np.empty((*shape, 2, 2))
    d_points[..., 0, 0] = radial + 2 * xx * slope + 2 * p1 * y + 6 * p2 * x
    d_points[..., 0, 1] = 2 * xy * slope + 2 * p1 * x + 2 * p2 * y
    d_points[..., 1, 0] = d_points[..., 0, 1]
    d_points[..., 1, 1] = radial + 2 * yy * slope + 6 * p1 * y + 2 * p2 * x
    d_coefficients = np.empty((*shape, 2, 5))
    for row, coordinate in enumerate((x, y)):
        d_coefficients[..., row, 0] = coordinate * r2
        d_coefficients[..., row, 1] = coordinate * r2 * r2
        d_coefficients[..., row, 4] = coordinate * r2 * r2 * r2
    d_coefficients[..., 0, 2] = d_coefficients[..., 1, 3] = 2 * xy
    d_coefficients[..., 0, 3] = r2 + 2 * xx
    d_coefficients[..., 1, 2] = r2 + 2 * yy
    return d_points, d_coefficients


def monomials(points: Array) -> Array:
    """Evaluate what the polynomial of k3 = 0 and its derivatives consist of; the points come last.

    Parameters
    ----------
    points : (..., 2, N)

    Returns
    -------
    (..., 13, N)
        x, y, x^2, x y, y^2, the last three times r2, x and y times r2, x and y times r2^2, and 1.
    """
    terms = np.empty((*points.shape[:-2], 13, points.shape[-1]))
    terms[..., 0:2, :] = points
    np.multiply(points, points, out=terms[..., 2:5:2, :])
    np.multiply(points[..., 0, :], points[..., 1, :], out=terms[..., 3, :])
    r2 = (terms[..., 2, :] + terms[..., 4, :])[..., None, :]
    np.multiply(terms[..., 2:5, :], r2, out=terms[..., 5:8, :])
    np.multiply(points, r2, out=terms[..., 8:10, :])
    np.multiply(terms[..., 8:10, :], r2, out=terms[..., 10:12, :])
    terms[..., 12, :] = 1
    return terms


DEGREE = np.array([1, 1, 2, 2, 2, 4, 4, 4, 3, 3, 5, 5, 0])
"""Degree of each of :func:`monomials`: its factor under x d/dx + y d/dy."""

POLYNOMIAL = np.zeros((5, 6, 13))
"""Terms of :func:`monomials` in x', y', dx'/dx, dy'/dx, dx'/dy and dy'/dy, for each of 1, k1, k2, p1, p2."""
POLYNOMIAL[0, [0, 1, 2, 5], [0, 1, 12, 12]] = 1
POLYNOMIAL[1, [0, 1, 2, 2, 3, 4, 5, 5], [8, 9, 2, 4, 3, 3, 2, 4]] = 1, 1, 3, 1, 2, 2, 1, 3
POLYNOMIAL[2, [0, 1, 2, 2, 3, 4, 5, 5], [10, 11, 5, 7, 6, 6, 5, 7]] = 1, 1, 5, 1, 4, 4, 1, 5
POLYNOMIAL[3, [0, 1, 1, 2, 3, 4, 5], [3, 2, 4, 1, 0, 0, 1]] = 2, 1, 3, 2, 2, 2, 6
POLYNOMIAL[4, [0, 0, 1, 2, 3, 4, 5], [2, 4, 3, 0, 1, 1, 0]] = 3, 1, 2, 6, 2, 2, 2


def fold_radius(distortion: Array) -> Array:
    """Undistorted radius at which the radial distortion turns back on itself.

    Beyond it two directions share one image point, so that no ray belongs to the image there. It is the
    smallest positive root in r of d/dr [r (1 + k1 r^2 + k2 r^4 + k3 r^6)] = 0.

    Parameters
    ----------
    distortion : (..., 5)
        k1, k2, p1, p2, k3.

    Returns
    -------
    (...) radius in the unit of the undistorted coordinates; infinite where the model never folds.
    """
    # With q = 1 / r^2 the condition q^3 + 3 k1 q^2 + 5 k2 q + 7 k3 = 0 is monic whatever vanishes.
    companion = np.zeros((*distortion.shape[:-1], 3, 3))
    companion[..., 1, 0] = companion[..., 2, 1] = 1
    for row, (coefficient, factor) in enumerate(((4, 7), (1, 5), (0, 3))):
        companion[..., row, 2] = -factor * distortion[..., coefficient]
    roots = np.linalg.eigvals(companion)
    size = np.abs(roots).max(axis=-1, keepdims=True)
    real = (np.abs(roots.imag) <= 1e-7 * size) & (roots.real > 1e-12 * (1 + size))
    largest = np.max(np.where(real, roots.real, 0), axis=-1)
    return np.where(largest > 0, 1 / np.sqrt(np.where(largest > 0, largest, 1)), np.inf)


def surely_invertible(radius: float, coefficients: Array) -> bool:
    """Whether a bound proves that every distorted point within a radius has one undistorted point.

    Where the smaller eigenvalue of the Jacobian, the lesser of radial factor and slope of the radial map, is
    more than the 6 |p| r that p1 and p2 can take from it, all over a disc, the map is one to one there; and
    the disc of radius r covers all within r (1 + k1 r^2 + ...) - 3 |p| r^2.

    Parameters
    ----------
    radius : float
        In the unit of the distorted coordinates.
    coefficients : (5,)
        k1, k2, p1, p2, k3.
    """
    k1, k2, p1, p2, k3 = coefficients.tolist()
    tangential = math.hypot(p1, p2)
    r = radius * _BOUND_GRID
    r2 = r * r
    factor = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3))
    proven = np.minimum(factor, slope) > 6 * tangential * r + _BOUND_MARGIN
    proven &= np.logical_and.accumulate(proven)
    return bool((proven & (r * factor - 3 * tangential * r2 > radius)).any())


def is_upright(d_points: Array) -> NDArray[np.bool_]:
    """Whether a model with Jacobians (..., 2, 2) is on its way there: neither at a fold nor behind one."""
    determinant = d_points[..., 0, 0] * d_points[..., 1, 1] - d_points[..., 0, 1] ** 2
    upright: NDArray[np.bool_] = (determinant > 0) & (d_points[..., 0, 0] > 0)
    return upright


def undistort(points: Array, coefficients: Array) -> Array:
    """Invert :func:`distort`; NaN where the model has folded over.

    The radius is found first, between zero and the fold where it is monotone, by a safeguarded Newton
    iteration that cannot leave that interval; Newton steps in the plane then account for p1 and p2, which
    also move the fold itself, outwards on one side of the image.

    Parameters
    ----------
    points : (..., N, 2)
        Distorted coordinates.
    coefficients : (..., 5)
        k1, k2, p1, p2, k3.

    Returns
    -------
    (..., N, 2) undistorted coordinates.
    """
    radius = np.hypot(points[..., 0], points[..., 1])
    undistorted_radius = _undistort_radius(radius, coefficients)
    with np.errstate(invalid="ignore", over="ignore"):
        xy = points * (undistorted_radius / np.where(radius > 0, radius, 1))[..., None]
        scale = np.maximum(undistorted_radius, np.finfo(float).tiny)
        upright = np.ones(xy.shape[:-1], dtype=bool)
        for _ in range(_NEWTON_STEPS):
            error = distort(xy, coefficients) - points
            J, _ = distort_jacobians(xy, coefficients)
            determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] ** 2
            upright = is_upright(J)
            step = (
                np.stack(
                    [
                        J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1],
                        J[..., 0, 0] * error[..., 1] - J[..., 0, 1] * error[..., 0],
                    ],
                    axis=-1,
                )
                / np.where(determinant > 0, determinant, np.nan)[..., None]
            )
            xy = xy - step
            if not np.any(np.abs(step).max(axis=-1) > _NEWTON_TOLERANCE * scale):
                break
        # The fold itself is where the determinant reaches zero, so a ray beyond it is not the one wanted.
        far = np.hypot(xy[..., 0], xy[..., 1]) > _FOLD_REACH * fold_radius(coefficients)[..., None]
        missed = ~(np.abs(distort(xy, coefficients) - points).max(axis=-1) <= 1e-9 * (radius + scale))
    xy[missed | far | ~upright] = np.nan
    return xy


def _undistort_radius(distorted: Array, coefficients: Array) -> Array:
    k1, k2, _, _, k3 = columns(coefficients)
    fold = np.broadcast_to(fold_radius(coefficients)[..., None], distorted.shape)

    def value(r: Array) -> Array:
        r2 = r * r
        return r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))

    low = np.zeros_like(distorted)
    high = np.where(np.isfinite(fold), fold, np.maximum(distorted, 1e-300))
    with np.errstate(over="ignore", invalid="ignore"):
        while np.any(short := np.isinf(fold) & (value(high) < distorted) & (high < _FARTHEST)):
            high = np.where(short, 2 * high, high)
        reachable = value(high) >= distorted
        r = np.minimum(distorted, high)
        last = np.full_like(r, np.inf)
        for _ in range(_NEWTON_STEPS):
            r2 = r * r
            error = value(r) - distorted
            low, high = np.where(error < 0, r, low), np.where(error >= 0, r, high)
            slope = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3))
            newton = r - error / np.where(slope > 0, slope, np.nan)
            step = np.abs(newton - r)
            # At the ends of the bracket Newton has arrived, so the comparison admits them. Steps that do not
            # shrink lead to and fro between two points.
            shrinks = (step <= _NEWTON_SHRINKS * last) | (step <= _NEWTON_NEAR * r)
            inside = (newton >= low) & (newton <= high) & shrinks
            following = np.where(inside, newton, (low + high) / 2)
            last = np.abs(following - r)
            moved = last > _NEWTON_TOLERANCE * following
            r = following
            if not moved.any():
                break
    return np.where(reachable, r, _FOLD_START * fold)


def columns(values: Array) -> list[Array]:
    """Split the last axis of (..., K) into K arrays (..., 1), which broadcast over the points."""
    return [values[..., None, i] for i in range(values.shape[-1])]
