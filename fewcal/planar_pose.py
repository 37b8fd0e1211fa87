"""The two poses of a plane that one picture of it allows.

A plane seen from afar looks the same tilted to either side. IPPE (Collins and Bartoli, Infinitesimal
Plane-based Pose Estimation, IJCV 2014) finds both rotations in closed form from the first derivatives of the
homography at the board's centroid. Only one of them is right, and which one is sometimes known only after the
camera is, so both are starts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .closed_form import nearest_rotation

Array = NDArray[np.float64]


def planar_poses(H: Array, board_points: Array, rays: Array, weights: Array) -> tuple[Array, Array]:
    """Both poses of each view.

    Parameters
    ----------
    H : (..., 3, 3)
        Homographies from the board's plane, centroid at the origin, to normalised coordinates (A^-1 H).
    board_points : (..., 2, N)
        In that plane, metres.
    rays : (..., 2, N)
        Normalised image coordinates of the points.
    weights : (..., N)
        0 leaves a point out.

    Returns
    -------
    R : (..., 2, 3, 3), t : (..., 2, 3)
        The pose with the smaller error first.
    """
    R = _rotations(H)
    turned = R[..., :2] @ board_points[..., None, :, :]
    t = _translations(turned, rays, weights)
    X = turned + t[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = (X[..., :2, :] / X[..., 2:, :] - rays[..., None, :, :]) * weights[..., None, None, :]
    squares = (error * error).sum(axis=(-2, -1))
    order = np.argsort(squares, axis=-1)
    return (
        np.take_along_axis(R, order[..., None, None], axis=-3),
        np.take_along_axis(t, order[..., None], axis=-2),
    )


def _rotations(H: Array) -> Array:
    H = H / H[..., 2:, 2:]
    p = H[..., :2, 2]
    J = H[..., :2, :2] - p[..., :, None] * H[..., 2:, :2]
    # R_v turns the optical axis into the ray of the centroid.
    ray = np.concatenate([p, np.ones_like(p[..., :1])], axis=-1)
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    R_v = _from_z_to(ray)
    B = R_v[..., :2, :2] - p[..., :, None] * R_v[..., 2:, :2]
    A = np.linalg.solve(B, J)
    gamma = np.linalg.svd(A, compute_uv=False)[..., :1, None]
    R22 = A / np.where(gamma > 0, gamma, 1)
    rest = np.eye(2) - np.swapaxes(R22, -1, -2) @ R22
    first = np.sqrt(np.maximum(rest[..., 0, 0], 0))
    second = np.sqrt(np.maximum(rest[..., 1, 1], 0)) * np.where(rest[..., 0, 1] < 0, -1.0, 1.0)
    b = np.stack([first, second], axis=-1)
    both = []
    for sign in (1.0, -1.0):
        columns = np.concatenate([R22, sign * b[..., None, :]], axis=-2)
        third = np.cross(columns[..., 0], columns[..., 1])
        both.append(R_v @ np.concatenate([columns, third[..., None]], axis=-1))
    return nearest_rotation(np.stack(both, axis=-3))


def _from_z_to(ray: Array) -> Array:
    """Shortest rotation that takes the z axis to a unit vector with positive z."""
    x, y, z = ray[..., 0], ray[..., 1], ray[..., 2]
    R = np.empty((*ray.shape[:-1], 3, 3))
    R[..., 0, 0], R[..., 0, 1], R[..., 0, 2] = 1 - x * x / (1 + z), -x * y / (1 + z), x
    R[..., 1, 0], R[..., 1, 1], R[..., 1, 2] = R[..., 0, 1], 1 - y * y / (1 + z), y
    R[..., 2, 0], R[..., 2, 1], R[..., 2, 2] = -x, -y, z
    return R


def _translations(turned: Array, rays: Array, weights: Array) -> Array:
    """Solve x (X3 + t3) = X1 + t1 and its like for y, in the least-squares sense."""
    used = (weights > 0).astype(float)[..., None, :]
    normal = np.zeros((*rays.shape[:-2], 1, 3, 3))
    normal[..., 0, 0, 0] = normal[..., 0, 1, 1] = used[..., 0, :].sum(axis=-1)
    normal[..., 0, :2, 2] = normal[..., 0, 2, :2] = -(used * rays).sum(axis=-1)
    normal[..., 0, 2, 2] = (used * rays * rays).sum(axis=(-2, -1))
    rays, used = rays[..., None, :, :], used[..., None, :, :]
    miss = used * (rays * turned[..., 2:, :] - turned[..., :2, :])
    right = np.concatenate([miss.sum(axis=-1), -(rays * miss).sum(axis=(-2, -1))[..., None]], axis=-1)
    translations: Array = np.linalg.solve(normal, right[..., None])[..., 0]
    return translations
