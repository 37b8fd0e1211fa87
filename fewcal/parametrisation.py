"""The unknowns of a camera, in the form that an estimator solves for."""

from __future__ import annotations

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .camera import project_jacobians, project_pixel_model_jacobians

Array = NDArray[np.float64]


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

    def project(self, points: Array, theta: Array) -> tuple[Array, Array, Array]:
        """Project points and differentiate.

        Parameters
        ----------
        points : (B, V, N, 3) camera frame, metres
        theta : (B, size)

        Returns
        -------
        pixels : (B, V, N, 2)
        d_points : (B, V, N, 2, 3)
        d_theta : (B, V, N, 2, size)
        """
        if self.in_pixels:
            return self._project_in_pixels(points, theta)
        natural = self.natural(theta)[:, None, :]
        distortion = np.concatenate([natural[..., 4:], np.zeros_like(natural[..., :1])], axis=-1)
        found = project_jacobians(points, natural[..., :4], distortion)
        d_natural = np.concatenate([found.d_intrinsics, found.d_distortion[..., :4]], axis=-1)
        d_theta = d_natural @ self.natural_jacobian(theta)[:, None, None]
        return found.pixels, found.d_points, d_theta

    def pixel_coefficients(self, theta: Array) -> Array:
        """(..., 4) k1, k2, k3, k4 of the paper's eqs 10-13 that the unknowns mean with `in_pixels`."""
        half = self.diagonal / 2
        return theta[..., [4, 5, 7, 6]] / half ** np.array([2, 4, 1, 1])

    def _project_in_pixels(self, points: Array, theta: Array) -> tuple[Array, Array, Array]:
        natural = self.natural(theta)[:, None, :]
        intrinsics = np.concatenate([natural[..., :4], np.zeros_like(natural[..., :1])], axis=-1)
        found = project_pixel_model_jacobians(points, intrinsics, self.pixel_coefficients(theta)[:, None, :])
        to_intrinsics = self.natural_jacobian(theta)[:, None, None, :4, :4]
        by_distortion = found.d_distortion[..., [0, 1, 3, 2]] / (self.diagonal / 2) ** np.array([2, 4, 1, 1])
        d_theta = np.concatenate([found.d_intrinsics[..., :4] @ to_intrinsics, by_distortion], axis=-1)
        return found.pixels, found.d_points, d_theta


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

    def project(self, points: Array, theta: Array) -> tuple[Array, Array, Array]:
        """Project points and differentiate, as :meth:`ScaleFree.project` does."""
        parts = theta[:, None, :]
        found = project_pixel_model_jacobians(points, parts[..., :5], self.coefficients(parts))
        d_theta = np.concatenate([found.d_intrinsics, found.d_distortion], axis=-1)
        return found.pixels, found.d_points, d_theta[..., : self.size]


Parametrisation: TypeAlias = ScaleFree | PixelModel
"""The two camera models that an adjustment solves for."""
