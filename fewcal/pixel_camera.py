"""Between plumb_bob and the paper's distortion in pixels.

For fx = fy = f without skew they are one model: k1 = K1 / f^2, k2 = K2 / f^4, k3 = p2 / f, k4 = p1 / f (the
right-hand sides plumb_bob's). Otherwise one is the nearest to the other.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .camera import Camera, project_pixel_model
from .distortion import distort_jacobians

Array = NDArray[np.float64]

_GRID = 21
"""Samples along each side of the image, over which the nearest model is fitted."""


def from_plumb_bob(camera: Camera) -> Array:
    """(4,) k1, k2, k3, k4 of the paper's eqs 10-13 for a plumb_bob camera, with f = sqrt(fx fy)."""
    f = np.sqrt(camera.fx * camera.fy)
    k1, k2, p1, p2, _ = camera.distortion
    return np.array([k1 / f**2, k2 / f**4, p2 / f, p1 / f])


def nearest_plumb_bob(intrinsics: Array, coefficients: Array, image_size: tuple[int, int]) -> Camera:
    """Plumb_bob camera of the same focal lengths and principal point that projects most alike.

    Parameters
    ----------
    intrinsics : (5,) fx, fy, u0, v0, s, pixels
    coefficients : (4,) k1, k2, k3, k4 of eqs 10-13
    image_size : (width, height)
        The difference is least, in the sense of squares, over this image. Skew has no counterpart.

    Returns
    -------
    Camera
        With k3 = 0.
    """
    fx, fy, u0, v0, skew = intrinsics
    side = [np.linspace(0, length - 1, _GRID) for length in image_size]
    u, v = (axis.ravel() for axis in np.meshgrid(*side))
    y = (v - v0) / fy
    x = (u - u0 - skew * y) / fx
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    pixels = project_pixel_model(rays, intrinsics, coefficients)
    _, J = distort_jacobians(rays[:, :2], np.zeros(5))
    focal = np.array([fx, fy])
    displacement = pixels - (rays[:, :2] * focal + [u0, v0])
    found = np.linalg.lstsq((J[..., :4] * focal[:, None]).reshape(-1, 4), displacement.ravel(), rcond=None)[0]
    return Camera(fx, fy, u0, v0, np.append(found, 0.0))


def plumb_bob_jacobian(theta: Array) -> Array:
    """Derivative (8, 9) of fx, fy, cx, cy, K1, K2, p1, p2 by fx, fy, u0, v0, s, k1, k2, k3, k4.

    By the relation of the two models for f = sqrt(fx fy) without skew.
    """
    fx, fy = theta[:2]
    f = np.sqrt(fx * fy)
    power, source = np.array([2, 4, 1, 1]), np.array([5, 6, 8, 7])
    J = np.zeros((8, 9))
    J[:4, :4] = np.eye(4)
    J[np.arange(4, 8), source] = f**power
    values = theta[source] * f**power
    J[4:, 0], J[4:, 1] = power * values / (2 * fx), power * values / (2 * fy)
    return J
