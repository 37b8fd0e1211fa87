"""Closed-form cameras from homographies: the paper's simplified one and Zhang's.

With h_i the i-th column of a homography and B = A^-T A^-1, orthonormal board axes require h_1' B h_2 = 0 and
h_1' B h_1 = h_2' B h_2: two equations a view (paper eqs 21-22).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import ImaginaryFocalLength

Array = NDArray[np.float64]


def simplified_intrinsics(H: Array, principal_point: Array, held: bool = False) -> Array:
    """Camera with fx = fy = f and no skew (paper eqs 19-27).

    One view: the principal point is taken as given and f follows from v_12 . b = 0. Two or more: b is the
    null vector of the stacked equations and gives the principal point too.

    Parameters
    ----------
    H : (..., V, 3, 3)
        Homographies of V views.
    principal_point : (2,)
        Used for one view, and to condition the equations of more, pixels.
    held : bool
        Take it as given for more views too; f^2 is then the least-squares solution of all equations.

    Returns
    -------
    (..., 3) f^2, u0, v0. What is not positive, infinite or NaN in f^2 is for the caller to refuse, with
    :func:`checked_focal_length`.
    """
    centre = np.asarray(principal_point, dtype=np.float64)
    shift = np.eye(3)
    shift[:2, 2] = -centre
    H = shift @ H
    if H.shape[-3] == 1:
        v12 = _v(H, 0, 1)[..., 0, :]
        with np.errstate(divide="ignore", invalid="ignore"):
            squared = -v12[..., 3] / v12[..., 0]
        return np.concatenate([squared[..., None], np.broadcast_to(centre, (*squared.shape, 2))], axis=-1)
    # Pixels as the unit would spread the entries of b over six decades; the image size does not.
    size = max(float(np.linalg.norm(centre)), 1.0)
    H = np.diag([1 / size, 1 / size, 1.0]) @ H
    H = H / np.linalg.norm(H, axis=(-2, -1), keepdims=True)
    rows = np.concatenate([_v(H, 0, 1), _v(H, 0, 0) - _v(H, 1, 1)], axis=-2)
    if held:
        by_square, rest = rows[..., 0], rows[..., 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            squared = -(by_square * rest).sum(axis=-1) / (by_square * by_square).sum(axis=-1) * size**2
        return np.concatenate([squared[..., None], np.broadcast_to(centre, (*squared.shape, 2))], axis=-1)
    _, _, vt = np.linalg.svd(rows, full_matrices=False)
    with np.errstate(divide="ignore", invalid="ignore"):
        b = vt[..., 3, :] / vt[..., 3, 3:]
        squared = b[..., 0] - b[..., 1] ** 2 - b[..., 2] ** 2
    return np.concatenate([squared[..., None] * size**2, b[..., 1:3] * size + centre], axis=-1)


def zhang_intrinsics(H: Array) -> Array:
    """Zhang's closed form (2000, eqs 7-9 and appendix B): five intrinsics from the 6-vector b.

    As in the paper's comparison, b is the singular vector of the smallest singular value whatever the number
    of views, although fewer than three views leave it undetermined.

    Parameters
    ----------
    H : (..., V, 3, 3)

    Returns
    -------
    (..., 5) fx^2, fy^2, u0, v0, skew. What is not positive, infinite or NaN in the squares is for the caller
    to refuse, with :func:`checked_focal_length`; the skew is NaN then.
    """
    H = H / np.linalg.norm(H, axis=(-2, -1), keepdims=True)
    rows = np.concatenate([_zhang_v(H, 0, 1), _zhang_v(H, 0, 0) - _zhang_v(H, 1, 1)], axis=-2)
    b11, b12, b22, b13, b23, b33 = np.moveaxis(np.linalg.svd(rows)[2][..., 5, :], -1, 0)
    determinant = b11 * b22 - b12 * b12
    with np.errstate(divide="ignore", invalid="ignore"):
        v0 = (b12 * b13 - b11 * b23) / determinant
        scale = b33 - (b13 * b13 + v0 * (b12 * b13 - b11 * b23)) / b11
        fx2, fy2 = scale / b11, scale * b11 / determinant
        u0 = -(b12 * v0 + b13) * fx2 / scale
        skew = -b12 * fx2 * np.sqrt(fy2) / scale
    return np.stack([fx2, fy2, u0, v0, skew], axis=-1)


def checked_focal_length(squared: float) -> float:
    """Take the root of f^2, or say that there is none.

    Raises
    ------
    ImaginaryFocalLength
    """
    if not (np.isfinite(squared) and squared > 0):
        raise ImaginaryFocalLength(
            f"The closed form gives f^2 = {squared:.3g} px^2, so this method finds no focal length in these "
            'views; add one with the board tilted by 30 deg or more about another axis, or use method "map".'
        )
    return float(np.sqrt(squared))


def poses_from_homographies(H: Array, A: Array) -> tuple[Array, Array]:
    """Board poses of views with a known camera matrix (paper eq 28).

    Parameters
    ----------
    H : (..., 3, 3)
        Homographies from board plane (z = 0) to pixels.
    A : (..., 3, 3)
        Camera matrices, pixels.

    Returns
    -------
    R : (..., 3, 3) rotation nearest to [r1 r2 r1 x r2]
    t : (..., 3) origin of the board plane in the camera frame, metres, in front of the camera
    """
    columns = np.linalg.solve(A, H)
    columns = columns / np.linalg.norm(columns[..., :1], axis=-2, keepdims=True)
    columns = columns * np.where(columns[..., 2:, 2:] < 0, -1.0, 1.0)
    r1, r2 = columns[..., 0], columns[..., 1]
    return nearest_rotation(np.stack([r1, r2, np.cross(r1, r2)], axis=-1)), columns[..., 2]


def nearest_rotation(matrices: Array) -> Array:
    """Project (..., 3, 3) matrices onto SO(3) in the Frobenius norm."""
    u, _, vt = np.linalg.svd(matrices)
    u = u * np.stack([np.ones(u.shape[:-2])] * 2 + [np.linalg.det(u @ vt)], axis=-1)[..., None, :]
    rotations: Array = u @ vt
    return rotations


def _v(H: Array, i: int, j: int) -> Array:
    """Row v_ij of eq 24, by the unknowns b = (u0^2 + v0^2 + f^2, u0, v0, 1) of eq 25."""
    a, c = H[..., :, i], H[..., :, j]
    return np.stack(
        [
            a[..., 2] * c[..., 2],
            -(a[..., 2] * c[..., 0] + a[..., 0] * c[..., 2]),
            -(a[..., 1] * c[..., 2] + a[..., 2] * c[..., 1]),
            a[..., 0] * c[..., 0] + a[..., 1] * c[..., 1],
        ],
        axis=-1,
    )


def _zhang_v(H: Array, i: int, j: int) -> Array:
    """Row v_ij of Zhang's eq 8, by b = (B11, B12, B22, B13, B23, B33)."""
    a, c = H[..., :, i], H[..., :, j]
    return np.stack(
        [
            a[..., 0] * c[..., 0],
            a[..., 0] * c[..., 1] + a[..., 1] * c[..., 0],
            a[..., 1] * c[..., 1],
            a[..., 2] * c[..., 0] + a[..., 0] * c[..., 2],
            a[..., 2] * c[..., 1] + a[..., 1] * c[..., 2],
            a[..., 2] * c[..., 2],
        ],
        axis=-1,
    )
