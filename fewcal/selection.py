"""Which views are worth having, judged by what the posterior would be with them.

Near one estimate of the camera each view adds a fixed matrix of information, so that the error bars of any
subset of views follow without calibrating again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from .adjustment import Adjustment, Geometry
from .calibration import Calibration
from .camera import project_jacobians
from .constraints import Priors
from .copies import repetition
from .departures import Departures
from .parametrisation import RADIAL, ScaleFree
from .posterior import posterior
from .views import View, align_views, distances, stack_views

Array = NDArray[np.float64]

GRID = 9
"""Directions across and down the image over which the projection error is averaged."""
EXHAUSTIVE = 20_000
"""Subsets that are all tried; beyond that views are added one by one, each time the best."""
CANDIDATES = 40
"""Views that a recording is thinned to before subsets are compared; 40 make 780 pairs."""


@dataclass(frozen=True, eq=False)
class Information:
    """What each view says about the camera, and what is known without any.

    Attributes
    ----------
    views : (V, S, S)
        Information matrices of camera and departures, poses eliminated, each as if there were no other view.
    prior : (S, S)
        Of the widths of the heavy-tailed priors that all the views together suggest.
    spread : (S, S)
        trace(`spread` C) is the mean squared projection error over the image for a covariance C, px^2.
    """

    views: Array
    prior: Array
    spread: Array

    def projection_std(self, subsets: Array) -> Array:
        """Root mean square projection error over the image that subsets of the views would leave.

        Parameters
        ----------
        subsets : (M, K) indices of views; an index may be repeated

        Returns
        -------
        (M,) pixels
        """
        total = self.prior + self.views[subsets].sum(axis=1) / repetition(subsets.shape[1])
        scale = 1 / np.sqrt(np.diagonal(total, axis1=-2, axis2=-1))
        inverse = np.linalg.inv(total * scale[:, :, None] * scale[:, None, :])
        covariance = inverse * scale[:, :, None] * scale[:, None, :]
        std: Array = np.sqrt(np.einsum("ij,mij->m", self.spread, covariance))
        return std


def information(calibration: Calibration, priors: Priors = Priors()) -> Information:
    """Information of each view of a calibration, at its estimate and its corner noise.

    Parameters
    ----------
    calibration : Calibration
        By the method map.
    priors : Priors
        Those it was made with.
    """
    model, camera = ScaleFree(calibration.image_size), calibration.camera
    theta = model.theta(np.concatenate([camera.intrinsics, camera.distortion[:4]]))
    stack = stack_views(calibration.views)
    poses = np.stack(calibration.board_poses)
    rotation = poses[:, :3, :3]
    position = (rotation @ stack.centroid[..., None])[..., 0] + poses[:, :3, 3]
    known = priors.rows(calibration.image_size)
    departures = Departures.of(
        stack.points, stack.pixels, model.image_size, camera.intrinsics[2:], theta[RADIAL]
    )
    problem = Adjustment(stack, model, known, departures=departures)
    unknowns = np.append(theta, calibration.departures)
    geometry = Geometry(unknowns[None], (rotation @ stack.plane)[None], position[None])
    rows = problem.rows(geometry, calibration.sigma_px)
    found = posterior(rows, known.tails(unknowns), known.normal(unknowns))
    spread = np.zeros_like(found.prior)
    spread[:8, :8] = _spread(model, theta)
    return Information(found.views, found.prior, spread)


def best_subset(known: Information, count: int) -> tuple[int, ...]:
    """Indices of the `count` views that together leave the smallest projection error, in ascending order."""
    total = len(known.views)
    if count >= total:
        return tuple(range(total))
    if math.comb(total, count) <= EXHAUSTIVE:
        subsets = np.array(list(combinations(range(total), count)))
        return tuple(subsets[np.argmin(known.projection_std(subsets))].tolist())
    chosen = list(best_subset(known, 2))
    while len(chosen) < count:
        rest = [i for i in range(total) if i not in chosen]
        errors = known.projection_std(np.array([[*chosen, i] for i in rest]))
        chosen.append(rest[int(np.argmin(errors))])
    return tuple(sorted(chosen))


def thin(views: Sequence[View], count: int = CANDIDATES) -> list[int]:
    """Indices of views that differ most from each other in the image, in ascending order.

    Starting with the first view, the one whose points lie farthest from those of all chosen so far is added
    (farthest-point sampling). Views are held against each other by the points that both show; those that
    show different parts of the board differ as far as can be.
    """
    if len(views) <= count:
        return list(range(len(views)))
    points = align_views(views)
    chosen = [0]
    distance = distances(points, 0)
    while len(chosen) < count and distance.max() > 0:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, distances(points, chosen[-1]))
    return sorted(chosen)


def _spread(model: ScaleFree, theta: Array) -> Array:
    natural = model.natural(theta)
    axes = [np.linspace(0, length - 1, GRID) for length in model.image_size]
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    # Directions through undistorted pixels: near enough to weigh errors, and defined for every camera.
    rays = np.column_stack([(pixels - natural[2:4]) / natural[:2], np.ones(len(pixels))])
    found = project_jacobians(rays, natural[:4], np.append(natural[4:], 0.0))
    J = np.concatenate([found.d_intrinsics, found.d_distortion[..., :4]], axis=-1) @ model.natural_jacobian(
        theta
    )
    spread: Array = np.einsum("nki,nkj->ij", J, J) / len(pixels)
    return spread
