"""What the views say about the camera, and how surely.

Covariances come from orthogonal decompositions of the rows themselves, priors among them, with columns scaled
to unit length. Inverting J'J instead would square the condition number, and a pseudo-inverse reports
zero for exactly what the data leave open.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Rows
from .camera import Camera, project_jacobians
from .elimination import eliminate
from .scale_mixture import moments
from .tails import Tails
from .variational import contradictions

Array = NDArray[np.float64]

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
"""The parameters of a camera that have error bars, in the order of the covariance."""


class Posterior(NamedTuple):
    """What is left open at the estimate.

    Attributes
    ----------
    covariance : (S, S)
        Of the unknowns of :class:`Eliminated` about the estimate, poses marginalised, see
        :class:`fewcal.scale_mixture.Moments`.
    prior_covariance : (S, S)
        What was known before the first view, the precision of every prior at its mean.
    reduced : (V, S + 1, S + 1)
        Rows of each view without its pose, see :attr:`fewcal.elimination.Eliminated.camera`.
    prior : (S, S)
        Information of the priors at the mean of their precision, given the views.
    against_prior : (S,)
        How far each normal prior is from what everything else says, in standard deviations of the two
        together; zero for the others, which give way.
    """

    covariance: Array
    prior_covariance: Array
    reduced: Array
    prior: Array
    against_prior: Array

    @property
    def views(self) -> Array:
        """(V, S, S) information of each view."""
        J = self.reduced[..., :-1]
        information: Array = np.swapaxes(J, -1, -2) @ J
        return information


def posterior(rows: Rows, tails: Tails, normal: Array) -> Posterior:
    """What the rows of a linearisation and heavy-tailed priors leave open.

    Each view is reduced by its own QR decomposition to the rows that speak of the shared unknowns alone, so
    that the work grows linearly with the number of views.

    Parameters
    ----------
    rows : Rows
    tails : Tails
    normal : (S, S)
        Rows of a normal distribution as wide as all of the priors together, see
        :meth:`fewcal.prior_rows.PriorRows.normal`.
    """
    reduced = eliminate(rows).camera
    J, r = reduced[..., :-1], reduced[..., -1]
    data = J.reshape(-1, J.shape[-1])
    found = moments(data, r.ravel(), tails)
    # Alternatives are as wide as all of them together, whichever it is in the end.
    of_one = tails.group[-len(normal) :] >= len(tails.height)
    precision = np.where(of_one, found.precision[-len(normal) :], 1.0)
    return Posterior(
        found.covariance,
        covariance_from_rows(normal),
        reduced,
        normal.T @ (precision[:, None] * normal),
        contradictions(data, r.ravel(), tails, found.covariance)[-len(normal) :],
    )


def gaussian_covariance(rows: Rows, constraint: Array) -> Array:
    """Covariance (S, S) of the camera from the rows of its linearisation and those (K, S) of a constraint."""
    J = eliminate(rows).camera[..., :-1]
    return covariance_from_rows(np.concatenate([J.reshape(-1, J.shape[-1]), constraint]))


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
