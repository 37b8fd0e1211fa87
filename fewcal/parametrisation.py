"""The unknowns of a camera, in the form that an estimator solves for."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .distortion import distort_scaled

Array = NDArray[np.float64]

_EYE = np.eye(2)[:, :, None]
_TANGENTIAL_SWAPPED = np.array([0, 1, 3, 2])
"""The paper's k1, k2, k3, k4 are k1, k2, p2, p1 of plumb_bob, and the other way round."""


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

    def project(self, rays: Array, theta: Array, by_theta: Array) -> tuple[Array, Array]:
        """Project and differentiate.

        In units of half the diagonal, where a focal length puts an undistorted point at rays / rc, the
        coefficients of the distortion are a1, a2, b1 and b2 themselves.

        Parameters
        ----------
        rays : (B, V, 2, N)
            x / z and y / z.
        theta : (B, 8)
        by_theta : (B, V, 8, 2, N), output
            Derivative of the pixels by the unknowns.

        Returns
        -------
        pixels : (B, V, 2, N)
        by_rays : (B, V, 2, 2, N)
            Derivative by x / z, then y / z, of both coordinates.
        """
        half = self.diagonal / 2
        fx, aspect = np.exp(theta[:, :2]).T
        before, after = np.empty((2, len(theta), 2))
        before[:] = fx[:, None] / half
        after[:] = half
        (before if self.in_pixels else after)[:, 1] *= aspect
        distorted, by_rays, by_theta[:, :, 4:8] = distort_scaled(rays, theta[:, 4:8], before, after)
        along = by_rays * rays[:, :, :, None]
        np.add(along[:, :, 0], along[:, :, 1], out=by_theta[:, :, 0])
        if self.in_pixels:
            by_theta[:, :, 1] = along[:, :, 1]
        else:
            by_theta[:, :, 1, 0] = 0
            by_theta[:, :, 1, 1] = distorted[:, :, 1]
        by_theta[:, :, 2:4] = self.diagonal * _EYE
        return distorted + (self.centre + self.diagonal * theta[:, 2:4])[:, None, :, None], by_rays

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

    def project(self, rays: Array, theta: Array, by_theta: Array) -> tuple[Array, Array]:
        """Project and differentiate, as :meth:`ScaleFree.project` does."""
        fx, fy, _, _, skew = theta[:, :5].T[:, :, None, None]
        x, y = rays[:, :, 0], rays[:, :, 1]
        undistorted = np.stack([fx * x + skew * y, fy * y], axis=2)
        coefficients = self.coefficients(theta)[:, _TANGENTIAL_SWAPPED]
        one = np.ones((len(theta), 2))
        distorted, by_uv, by_coefficients = distort_scaled(undistorted, coefficients, one, one)
        by_theta[:, :, 0:2] = by_uv * rays[:, :, :, None]
        by_theta[:, :, 2:4] = _EYE
        by_theta[:, :, 4] = by_uv[:, :, 0] * y[:, :, None]
        by_theta[:, :, 5:] = by_coefficients[:, :, _TANGENTIAL_SWAPPED[: self.size - 5]]
        by_rays = by_uv * theta[:, None, :2, None, None]
        by_rays[:, :, 1] += skew[:, :, None] * by_uv[:, :, 0]
        return distorted + theta[:, None, 2:4, None], by_rays


Parametrisation: TypeAlias = ScaleFree | PixelModel
"""The two camera models that an adjustment solves for."""
