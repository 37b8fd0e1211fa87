"""What an estimator found, in the terms of every method: a plumb_bob camera and how well it is known."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .adjustment import Estimate
from .agreement import Disagreement, disagreement
from .camera import Camera, project
from .constraints import FOCAL, PRIOR_ROWS, Priors
from .copies import Copies, share_weight
from .departures import COUNT, axial_remainder, radial_terms
from .elimination import eliminate
from .map_estimator import estimate_map
from .noise import Noise
from .parametrisation import PixelModel, ScaleFree
from .pixel_camera import from_plumb_bob, nearest_plumb_bob, plumb_bob_jacobian
from .posterior import determined_share, gaussian_covariance, posterior
from .prior_rows import PriorRows
from .views import ViewStack

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Solution:
    """What an estimator found.

    Attributes
    ----------
    camera : Camera
    pixel_distortion : (4,) k1, k2, k3, k4 of the paper's eqs 10-13
    skew : float
        Pixels.
    unheld_px : float
        How far `camera` misses the points beyond what was found does, root mean square, pixels.
    sigma_px : float
        Standard deviation of a point that counts, pixels.
    departures : (4,) of board and lens
    covariance : (8, 8) of fx, fy, cx, cy, k1, k2, p1, p2, or None
    settled : dict or None
        Share of its prior variance that the data removed, of every quantity with a prior.
    prior_conflicts : dict
        Residual of every prior, standard deviations.
    disagreement : Disagreement or None
        Of the views.
    """

    camera: Camera
    pixel_distortion: Array
    skew: float
    unheld_px: float
    sigma_px: float
    departures: Array
    covariance: Array | None
    settled: dict[str, float] | None
    prior_conflicts: dict[str, float]
    disagreement: Disagreement | None


def map_solution(found: Estimate, alike: Copies) -> Solution:
    """See what :func:`fewcal.map_estimator.estimate_map` found, whichever of its two models it chose.

    `alike` are the copies among the views, see :func:`fewcal.copies.copies`.
    """
    model, known = found.adjustment.model, found.adjustment.constraint
    assert isinstance(model, ScaleFree)
    assert isinstance(known, PriorRows)
    theta = found.geometry.theta[0, : model.size]
    natural = model.natural(theta)
    if model.in_pixels:
        coefficients = model.pixel_coefficients(theta)
        camera = nearest_plumb_bob(np.append(natural[:4], 0.0), coefficients, model.image_size)
    else:
        fx, fy, cx, cy = natural[:4].tolist()
        camera = Camera(fx, fy, cx, cy, np.append(natural[4:], 0.0))
        coefficients = from_plumb_bob(camera)
    rows = found.adjustment.rows(found.geometry, found.sigma)
    unknowns = found.geometry.theta[0]
    result = posterior(rows, known.tails(unknowns), known.normal(unknowns))
    conflicts = np.maximum(known.distance(unknowns), np.abs(result.against_prior))
    left = _worst_by_name(1 - determined_share(result))
    return Solution(
        camera=camera,
        pixel_distortion=coefficients,
        skew=0.0,
        unheld_px=0.0,
        sigma_px=found.sigma,
        departures=found.geometry.theta[0, model.size :],
        covariance=model.natural_spread(theta, result.covariance[:8, :8]),
        settled={name: 1 - share for name, share in left.items()},
        prior_conflicts=_worst_by_name(conflicts),
        disagreement=_disagreement(result.reduced, found, alike),
    )


def with_stated_focal(
    solution: Solution,
    stack: ViewStack,
    size: tuple[int, int],
    priors: Priors,
    alike: Copies,
    tilted: bool = True,
) -> Solution:
    """Hold a focal length that was stated, if any, against what the views say without it, both with their sd.

    What is stated surely can make everything else give way, at a camera where the views seem to agree. What
    they say near that camera counts as well, but for boards that are not `tilted`: their share in it is not
    linear.
    """
    if priors.focal_px is None:
        return solution
    free = map_solution(estimate_map(stack, size, replace(priors, focal_px=None), alike), alike)
    mean, sd = priors.focal_px
    off = abs(math.log(free.camera.fx / mean)) / math.hypot(sd / mean, focal_std(free, size))
    near = solution.prior_conflicts[FOCAL] if tilted else 0.0
    return replace(solution, prior_conflicts={**solution.prior_conflicts, FOCAL: max(off, near)})


def pixel_solution(found: Estimate, size: tuple[int, int], priors: Priors, alike: Copies) -> Solution:
    """See what an estimator of :mod:`fewcal.zhu2020` found in images of a size, pixels.

    `alike` are the copies among the views, see :func:`fewcal.copies.copies`.
    """
    model, theta = found.adjustment.model, found.geometry.theta[0]
    assert isinstance(model, PixelModel)
    # The paper weighs all views alike, also as n of eq 29; but copies tell nothing new.
    shared = replace(found.adjustment, views=share_weight(found.adjustment.views, alike.times))
    rows = shared.rows(found.geometry, found.sigma)
    coefficients = model.coefficients(theta)
    squares = (rows.r**2).sum(keepdims=True)[0] * found.sigma**2
    sigma = float(np.sqrt(Noise.of(shared.views, priors).variance(squares)[0]))
    covariance: Array | None = None
    if model.tangential:
        penalty = found.adjustment.constraint(found.geometry.theta)[1][0] * np.sqrt((1 / alike.times).mean())
        of_theta = gaussian_covariance(rows, penalty) * (sigma / found.sigma) ** 2
        covariance = _propagated(of_theta, plumb_bob_jacobian(theta))
    camera = nearest_plumb_bob(theta[:5], coefficients, size)
    views = found.adjustment.views
    even = replace(found.adjustment, views=views._replace(weights=np.sign(views.weights)))
    beyond = squared_errors(found, camera).sum() - even.linearise(found.geometry).squares[0]
    unheld = math.sqrt(max(float(beyond), 0.0) / views.counts.sum())
    return Solution(
        camera=camera,
        pixel_distortion=coefficients,
        skew=float(theta[4]),
        unheld_px=unheld,
        sigma_px=sigma,
        departures=np.zeros(COUNT),
        covariance=covariance,
        settled=None,
        prior_conflicts={},
        disagreement=_disagreement(eliminate(rows).camera, found, alike),
    )


def _disagreement(reduced: Array, found: Estimate, alike: Copies) -> Disagreement | None:
    """Of the views, whose reduced rows have the weights of :func:`fewcal.copies.share_weight`."""
    problem = found.adjustment
    unit = found.sigma * math.sqrt(alike.repeated)
    return disagreement(reduced, problem.model.size, unit, problem.views.counts, alike.times)


def _propagated(covariance: Array, J: Array) -> Array:
    """Covariance (8, 8) through a Jacobian (8, S); infinite where a part of it is."""
    if not np.isfinite(covariance).all():
        return np.full((len(J), len(J)), np.inf)
    propagated: Array = J @ covariance @ J.T
    return propagated


def _worst_by_name(values: Array) -> dict[str, float]:
    """Gather rows that speak of one quantity under its name, keeping the largest value."""
    worst: dict[str, float] = {}
    for name, value in zip(PRIOR_ROWS, values.tolist(), strict=True):
        worst[name] = max(value, worst.get(name, value))
    return worst


def focal_std(solution: Solution, size: tuple[int, int]) -> float:
    """Relative one sigma of fx of a solution that has a covariance, for images of a size, pixels."""
    assert solution.covariance is not None
    sd = spread(solution.covariance, solution.camera, solution.departures, size)
    return float(sd[0]) / solution.camera.fx


def spread(covariance: Array, camera: Camera, departures: Array, size: tuple[int, int]) -> Array:
    """One sigma (8,) of the parameters, see :attr:`Calibration.std`."""
    sd: Array = np.sqrt(np.diagonal(covariance))
    axial = departures[2] * axial_remainder(size, camera.intrinsics[2:], radial_terms(camera, size))
    sd[:2] = np.hypot(sd[:2], axial * camera.intrinsics[:2])
    return sd


def squared_errors(found: Estimate, camera: Camera) -> Array:
    """Sum of squared distances between what a camera projects and what was observed, (V,), px^2."""
    views, (_, rotation, position) = found.adjustment.views, found.geometry
    points = rotation[0, :, :, :2] @ views.points + position[0, :, :, None]
    projected = project(np.swapaxes(points, 1, 2), camera.intrinsics, camera.distortion)
    off = np.where(views.weights[..., None] > 0, projected - np.swapaxes(views.pixels, 1, 2), 0)
    squares: Array = (off * off).sum(axis=(1, 2))
    return squares
