"""The unknowns of a camera, in the form that an estimator solves for."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .distortion import DEGREE, POLYNOMIAL, monomials

Array = NDArray[np.float64]

_EYE = np.eye(2)[:, :, None]
_TANGENTIAL_SWAPPED = np.array([0, 1, 3, 2])
"""The paper's k1, k2, k3, k4 are k1, k2, p2, p1 of plumb_bob, and the other way round."""

SHIFT = 3
"""Columns by a shift of a point along x, y and z, which stand before those of the unknowns."""

_POINT, _BY_X, _BY_Y = np.moveaxis(POLYNOMIAL.reshape(5, 3, 2, 13), 1, 0)


def _scale_free_terms() -> Array:
    """Terms (5, 12 * 2 * 13) of all columns of :meth:`ScaleFree.project` but the constant ones."""
    terms = np.zeros((5, 12, 2, 13))
    terms[:, 0], terms[:, 1] = _BY_X, _BY_Y
    # A longer lens moves a point by x d/dx + y d/dy, a shift along the axis by as much to the other side.
    terms[:, 3] = _POINT * DEGREE
    terms[:, 2] = -terms[:, 3]
    terms[:, 4, 1] = _POINT[:, 1]
    terms[0, 7:11] = _POINT[1:]
    terms[:, 11] = _POINT
    return terms.reshape(5, -1)


_SCALE_FREE = _scale_free_terms()


_NODES, _SHARES = np.polynomial.hermite_e.hermegauss(5)
_SHARES /= _SHARES.sum()
"""Points and weights that integrate over a normal distribution, by Gauss and Hermite."""

RADIAL = slice(4, 6)
"""Where the radial terms a1 and a2 are among the unknowns of a scale-free camera."""


class ScaleFree(NamedTuple):
    """The MAP estimator's unknowns, which depend neither on resolution nor on the unit of length.

    ln fx; ln(fy / fx); principal point offset from ((w-1)/2, (h-1)/2) in image diagonals; a1 = k1 rc^2,
    a2 = k2 rc^4, b1 = p1 rc, b2 = p2 rc, with rc = half the diagonal / fx at the current fx. The skew and k3
    are zero.

    With `in_pixels` the distortion acts on pixels as in the paper (eqs 10-13) instead of on normalised
    coordinates as in plumb_bob. The two differ by the distortion times ln(fy / fx), hundredths of a pixel.
    """

    image_size: tuple[int, int]
    in_pixels: bool = False

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 8

    @property
    def diagonal(self) -> float:
        """Diagonal of the image, pixels."""
        return math.hypot(*self.image_size)

    @property
    def centre(self) -> Array:
        """(2,) centre of the image, pixels."""
        return (np.array(self.image_size) - 1) / 2

    def natural(self, theta: Array) -> Array:
        """Convert (..., 8) unknowns to (..., 8) fx, fy, cx, cy, k1, k2, p1, p2."""
        fx = np.exp(theta[..., 0])
        power = (2 * fx / self.diagonal)[..., None] ** np.array([2, 4, 1, 1])
        return np.concatenate(
            [
                np.stack([fx, fx * np.exp(theta[..., 1])], axis=-1),
                self.centre + self.diagonal * theta[..., 2:4],
                theta[..., 4:8] * power,
            ],
            axis=-1,
        )

    def natural_jacobian(self, theta: Array) -> Array:
        """Derivative (..., 8, 8) of :meth:`natural` by the unknowns."""
        values = self.natural(theta)
        J = np.zeros((*theta.shape, 8))
        power = np.array([2, 4, 1, 1])
        J[..., 0, 0] = values[..., 0]
        J[..., 1, 0] = J[..., 1, 1] = values[..., 1]
        J[..., 2, 2] = J[..., 3, 3] = self.diagonal
        J[..., 4:8, 0] = power * values[..., 4:8]
        index = np.arange(4, 8)
        J[..., index, index] = (2 * values[..., :1] / self.diagonal) ** power
        return J

    def natural_spread(self, theta: Array, covariance: Array) -> Array:
        """Second moment (8, 8) of :meth:`natural` about what it is at `theta` (8,), for a covariance (8, 8).

        By Gauss-Hermite along ln fx, and by the derivative along all others. A focal length that is known to
        40 % may well be twice as long but not negative, and k1 = a1 / rc^2 with it four times as large, which
        the derivative alone would not tell.
        """
        if not np.isfinite(covariance).all():
            return np.full_like(covariance, np.inf)
        along = covariance[0] / math.sqrt(covariance[0, 0])
        across = covariance - np.outer(along, along)
        with np.errstate(over="ignore", invalid="ignore"):
            at = theta + _NODES[:, None] * along
            off, J = self.natural(at) - self.natural(theta), self.natural_jacobian(at)
            each = off[:, :, None] * off[:, None] + J @ across @ np.swapaxes(J, 1, 2)
            spread: Array = np.tensordot(_SHARES, each, 1)
        return np.where(np.isnan(spread), np.inf, spread)

    def theta(self, natural: Array) -> Array:
        """Invert :meth:`natural`."""
        fx = natural[..., :1]
        power = np.array([2, 4, 1, 1])
        return np.concatenate(
            [
                np.log(fx),
                np.log(natural[..., 1:2] / fx),
                (natural[..., 2:4] - self.centre) / self.diagonal,
                natural[..., 4:8] * (self.diagonal / (2 * fx)) ** power,
            ],
            axis=-1,
        )

    def project(self, rays: Array, theta: Array, columns: Array) -> None:
        """Project and differentiate.

        In units of half the diagonal, where a focal length puts an undistorted point at rays / rc, the
        coefficients of the distortion are a1, a2, b1 and b2 themselves. There every column is a polynomial of
        the same few terms, so that one product gives them all.

        Parameters
        ----------
        rays : (B, V, 2, N)
            x / z and y / z.
        theta : (B, 8)
        columns : (B, V, 3 + 8 + 1, 2, N), output
            Derivative of the pixels by a shift of the point along x, y and z at unit depth, by the unknowns,
            and the pixels themselves. Only the first two axes may have strides of their own.
        """
        diagonal = self.diagonal
        half = diagonal / 2
        fx, aspect = np.exp(theta[:, :2]).T
        before, after = np.empty((2, len(theta), 2))
        before[:] = fx[:, None] / half
        after[:] = half
        (before if self.in_pixels else after)[:, 1] *= aspect
        coefficients = np.ones((len(theta), 5))
        coefficients[:, 1:] = theta[:, 4:]
        terms = (coefficients @ _SCALE_FREE).reshape(-1, 12, 2, 13)
        terms *= after[:, None, :, None]
        terms[:, :2] *= before[:, :, None, None]
        terms[:, 5, 0, 12] = terms[:, 6, 1, 12] = diagonal
        terms[:, 11, :, 12] = self.centre + diagonal * theta[:, 2:4]
        values = monomials(rays * before[:, None, :, None])
        np.matmul(terms.reshape(-1, 1, 24, 13), values, out=columns.reshape(*columns.shape[:2], 24, -1))
        if self.in_pixels:
            columns[:, :, 4] = columns[:, :, 1] * rays[:, :, 1:]

    def pixel_coefficients(self, theta: Array) -> Array:
        """(..., 4) k1, k2, k3, k4 of the paper's eqs 10-13 that the unknowns mean with `in_pixels`."""
        half = self.diagonal / 2
        return theta[..., [4, 5, 7, 6]] / half ** np.array([2, 4, 1, 1])


class PixelModel(NamedTuple):
    """The unknowns of the paper: fx, fy, u0, v0, s and its distortion in pixels.

    `tangential` adds k3 and k4 (eqs 12-13), which the paper's method estimates and Zhang's does not.
    """

    tangential: bool

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 9 if self.tangential else 7

    def coefficients(self, theta: Array) -> Array:
        """(..., 4) k1, k2, k3, k4 of eqs 10-13."""
        if self.tangential:
            return theta[..., 5:9]
        return np.concatenate([theta[..., 5:7], np.zeros_like(theta[..., 5:7])], axis=-1)

    def project(self, rays: Array, theta: Array, columns: Array) -> None:
        """Project and differentiate, as :meth:`ScaleFree.project` does."""
        fx, fy, _, _, skew = theta[:, :5].T[:, :, None, None]
        x, y = rays[:, :, 0], rays[:, :, 1]
        undistorted = np.stack([fx * x + skew * y, fy * y], axis=2)
        coefficients = np.ones((len(theta), 5))
        coefficients[:, 1:] = self.coefficients(theta)[:, _TANGENTIAL_SWAPPED]
        terms = np.tensordot(coefficients, POLYNOMIAL, 1).reshape(-1, 1, 6, 13)
        values = monomials(undistorted)
        distorted, by_u, by_v = np.moveaxis(
            (terms @ values).reshape(*rays.shape[:2], 3, *rays.shape[2:]), 2, 0
        )
        columns[:, :, 0] = fx[..., None] * by_u
        columns[:, :, 1] = skew[..., None] * by_u + fy[..., None] * by_v
        columns[:, :, 2] = -(columns[:, :, 0] * x[:, :, None] + columns[:, :, 1] * y[:, :, None])
        of_theta = columns[:, :, SHIFT:-1]
        of_theta[:, :, 0], of_theta[:, :, 1] = by_u * x[:, :, None], by_v * y[:, :, None]
        of_theta[:, :, 2:4] = _EYE
        of_theta[:, :, 4] = by_u * y[:, :, None]
        by_coefficients = _POINT[1:][_TANGENTIAL_SWAPPED[: self.size - 5]].reshape(-1, 13) @ values
        of_theta[:, :, 5:] = by_coefficients.reshape(of_theta[:, :, 5:].shape)
        columns[:, :, -1] = distorted + theta[:, None, 2:4, None]


Parametrisation: TypeAlias = ScaleFree | PixelModel
"""The two camera models that an adjustment solves for."""
