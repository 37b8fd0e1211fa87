"""The two poses of a plane that one picture of it allows.

A plane seen from afar looks the same tilted to either side. IPPE (Collins and Bartoli, Infinitesimal
Plane-based Pose Estimation, IJCV 2014) finds both rotations in closed form from the first derivatives of the
homography at the board's centroid. Only one of them is right, and which one is sometimes known only after the
camera is, so both are starts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 1e-15
"""Below this the tilt of a board that faces the line of sight is rounding."""
_BOTH = np.array([np.ones((3, 3)), [[1, 1, -1], [1, 1, -1], [-1, -1, 1]]])
"""Signs by which the two rotations differ: both have the same first two rows and columns."""


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
    swap = (squares[..., 0] > squares[..., 1])[..., None, None]
    return np.where(swap[..., None], R[..., ::-1, :, :], R), np.where(swap, t[..., ::-1, :], t)


def _rotations(H: Array) -> Array:
    H = H / H[..., 2:, 2:]
    p = H[..., :2, 2]
    J = H[..., :2, :2] - p[..., :, None] * H[..., 2:, :2]
    # R_v turns the optical axis into the ray of the centroid.
    z = 1 / np.sqrt(1 + (p * p).sum(axis=-1))
    R_v = _from_z_to(p[..., 0] * z, p[..., 1] * z, z)
    B = R_v[..., :2, :2] - p[..., :, None] * R_v[..., 2:, :2]
    A = np.linalg.solve(B, J)
    square = np.swapaxes(A, -1, -2) @ A
    xx, xy, yy = square[..., 0, 0], square[..., 0, 1], square[..., 1, 1]
    gamma2 = (xx + yy) / 2 + np.hypot((xx - yy) / 2, xy)
    # The third row b makes unit columns at right angles: b b' is what the first two rows lack of that.
    xx, xy, yy = 1 - xx / gamma2, -xy / gamma2, 1 - yy / gamma2
    larger = np.maximum(np.maximum(xx, yy), ROUNDING)
    b = np.where(xx > yy, [larger, xy], [xy, larger]) / np.sqrt(larger)
    columns = np.concatenate(
        [A / np.sqrt(gamma2)[..., None, None], np.moveaxis(b, 0, -1)[..., None, :]], axis=-2
    )
    first, second = columns[..., 0], columns[..., 1]
    third = first[..., [1, 2, 0]] * second[..., [2, 0, 1]] - first[..., [2, 0, 1]] * second[..., [1, 2, 0]]
    one = np.concatenate([columns, third[..., None]], axis=-1)
    both: Array = R_v[..., None, :, :] @ (one[..., None, :, :] * _BOTH)
    return both


def _from_z_to(x: Array, y: Array, z: Array) -> Array:
    """Shortest rotation that takes the z axis to a unit vector with positive z."""
    R = np.empty((*z.shape, 3, 3))
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
