"""What the views say about the camera, and how surely.

The covariance comes from an orthogonal decomposition of the rows themselves, priors among them, with columns
scaled to unit length. Inverting J'J instead would square the condition number, and a pseudo-inverse reports
zero for exactly what the data leave open.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Rows
from .camera import Camera, project_jacobians

Array = NDArray[np.float64]

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
"""The parameters of a camera that have error bars, in the order of the covariance."""


class Posterior(NamedTuple):
    """Gaussian approximation of the posterior at the estimate.

    Attributes
    ----------
    covariance : (S, S) of the camera's unknowns, poses marginalised
    prior_covariance : (S, S) or None
        What was known before the first view; None where that leaves an unknown free.
    """

    covariance: Array
    prior_covariance: Array | None


def posterior(rows: Rows, prior: Array | None = None) -> Posterior:
    """Covariance of the camera from the rows of its linearisation.

    Each view is reduced by its own QR decomposition to the rows that speak of the camera alone, so that the
    work grows linearly with the number of views.

    Parameters
    ----------
    rows : Rows
    prior : (K, S), optional
        Derivatives of the constraint rows at the prior's own mode. Far from it the rows of a heavy-tailed
        prior are nearly flat, as if nothing had been known. Those of `rows` when left out.
    """
    reduced = camera_rows(rows)
    constraint = rows.prior_by_camera
    known = covariance_from_rows(constraint if prior is None else prior)
    return Posterior(
        covariance_from_rows(np.concatenate([reduced.reshape(-1, reduced.shape[-1]), constraint])),
        known if np.isfinite(known).all() else None,
    )


def camera_rows(rows: Rows) -> Array:
    """Eliminate the pose of each view.

    Returns
    -------
    (V, S, S) upper triangular rows whose J'J is the information of that view about the camera, at most S of
    them independent.
    """
    pose_count, size = rows.by_pose.shape[-1], rows.by_camera.shape[-1]
    stacked = np.concatenate([rows.by_pose, rows.by_camera], axis=-1)
    length = np.linalg.norm(stacked, axis=1, keepdims=True)
    length = np.where(length > 0, length, 1)
    missing = pose_count + size - stacked.shape[1]
    if missing > 0:
        stacked = np.pad(stacked, ((0, 0), (0, missing), (0, 0)))
    triangle = np.asarray(np.linalg.qr(stacked / length, mode="r"))
    reduced: Array = triangle[:, pose_count:, pose_count:] * length[:, :, pose_count:]
    return reduced


def covariance_from_rows(rows: Array) -> Array:
    """(J'J)^-1 of (M, S) rows by QR with scaled columns; infinite where no row holds an unknown."""
    length = np.linalg.norm(rows, axis=0)
    if not np.all(length > 0) or len(rows) < rows.shape[1]:
        return np.full((rows.shape[1], rows.shape[1]), np.inf)
    triangle = np.linalg.qr(rows / length, mode="r")
    if np.abs(np.diagonal(triangle)).min() < np.finfo(float).eps * len(rows):
        return np.full((rows.shape[1], rows.shape[1]), np.inf)
    inverse = np.linalg.inv(triangle) / length[:, None]
    covariance: Array = inverse @ inverse.T
    return covariance


def determined_share(result: Posterior) -> Array:
    """For each unknown the share that the data determined: 1 - posterior variance / prior variance, (S,)."""
    if result.prior_covariance is None:
        return np.ones(len(result.covariance))
    share = 1 - np.diagonal(result.covariance) / np.diagonal(result.prior_covariance)
    return np.clip(share, 0, 1)


def projection_std(camera: Camera, covariance: Array, pixels: Array) -> Array:
    """One sigma of where the direction that a pixel sees projects, in its worst direction in the image.

    Parameters
    ----------
    camera : Camera
    covariance : (8, 8) of fx, fy, cx, cy, k1, k2, p1, p2
    pixels : (N, 2)

    Returns
    -------
    (N,) pixels; NaN where the distortion model folds over.
    """
    rays = camera.unproject(pixels, folded="nan")
    found = project_jacobians(rays, camera.intrinsics, camera.distortion)
    J = np.concatenate([found.d_intrinsics, found.d_distortion[..., :4]], axis=-1)
    if not np.isfinite(covariance).all():
        return np.full(len(pixels), np.inf)
    spread = J @ covariance @ np.swapaxes(J, -1, -2)
    a, b, c = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
    largest: Array = np.sqrt((a + c) / 2 + np.hypot((a - c) / 2, b))
    return largest
