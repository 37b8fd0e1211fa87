"""The default estimator: maximum a posteriori, from many starts, with the corner noise estimated.

Corner errors are not independent: a bent board, uneven ink and what the lens model leaves out move
neighbouring corners together. So a view of N corners carries the information of fewer: the likelihood is
raised to the power 1 / CORRELATION^2 (a composite likelihood), which is the same as a standard deviation of
CORRELATION times the scatter s of the residuals. On top of it comes the part of the model error that camera
and poses absorb, so that no residual shows it. The scatter itself is unknown, with a log-normal prior, and is
found with the camera by alternation.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Adjustment, Estimate, Geometry
from .closed_form import simplified_intrinsics
from .constraints import Priors
from .errors import DegenerateViews
from .homography import homographies
from .least_squares import Stop, Tolerances, minimise
from .parametrisation import ScaleFree
from .planar_pose import planar_poses
from .views import ViewStack

Array = NDArray[np.float64]

FOCAL_STARTS = (0.6, 1.2, 2.4, 5.0)
"""Focal lengths to start from, in max(width, height): every lens lies within a factor of 1.5 of one."""
CORRELATION = 2.0
"""Ratio of the standard deviation that counts to the scatter of the residuals: 0.5 px was found about right
on real boards whose residuals scatter by 0.25 px (doc/estimator.md)."""
MODEL_ERROR_PX = 0.3
"""Model error that camera and poses absorb, pixels: with corners that scatter by less than 0.1 px, error bars
without it are too small by half on real boards (doc/estimator.md)."""
ABSORBED = 3.0
"""Largest ratio of the absorbed model error to the scatter that it leaves; exact data have neither."""
TRUSTING_PX = 0.01
"""Standard deviation with which data are taken at their word at first; no camera measures better."""
COMPUTED_PX = 0.02
"""Scatter that the corners of no camera stay below, pixels."""
FOCAL_LIMITS = (0.05, 100.0)
"""Closed-form focal lengths outside this range, in max(width, height), are no use as starts."""
ENUMERATED_VIEWS = 3
"""Up to here both poses of every view are combined, 2^V starts a focal length; more views settle it."""
SAME = 1e-3
"""Two starts that agree to this in every unknown of the camera have found one minimum."""
HOPELESS = 50.0
"""Difference of the objective at which a minimum is given up: exp(-50) is its share of the probability."""
KEPT_STARTS = 4
"""Distinct minima followed to the end."""
ROUNDS = 40
"""Alternations of camera and scatter at most; exact data need the most, since the scatter falls to zero."""
SCATTER_TOLERANCE = 1e-3
"""Relative change of the scatter at which the alternation has settled."""

_COARSE = Tolerances(gradient=1e-3, step=1e-2, cost=1e-4, iterations=25)
_ROUND = Tolerances(gradient=1e-6, step=1e-3, cost=1e-6, iterations=50)
_FINE = Tolerances()


def estimate_map(views: ViewStack, image_size: tuple[int, int], priors: Priors) -> Estimate:
    """Find the camera and poses of highest posterior probability.

    Parameters
    ----------
    views : ViewStack
    image_size : (width, height), pixels
    priors : Priors

    Raises
    ------
    DegenerateViews
        When no start leads to a camera with the board in front of it.
    """
    found = _estimate(views, ScaleFree(image_size), priors)
    if found.lowest_scatter < COMPUTED_PX:
        # Points this exact were computed, perhaps with the paper's camera, whose distortion acts on pixels.
        in_pixels = _estimate(views, ScaleFree(image_size, in_pixels=True), priors)
        if in_pixels.objective < found.objective:
            return in_pixels.estimate
    return found.estimate


class _Found(NamedTuple):
    """The best minimum, its objective, and the scatter that is left when the data are taken at their word."""

    estimate: Estimate
    objective: float
    lowest_scatter: float


def _estimate(views: ViewStack, model: ScaleFree, priors: Priors) -> _Found:
    """Find the best minimum for one camera model."""
    start = _starts(views, model, priors)
    width = max(model.image_size)
    sigma = np.full(len(start.theta), _total_sigma(np.array(priors.corner_sigma_px[0])))
    problem = Adjustment(views, model, lambda theta: priors.rows(theta, width), sigma)
    found = minimise(problem, start, _COARSE)
    state, _ = _best(problem, found.state, found.cost, priors, KEPT_STARTS)
    # Noise and camera can explain the same residuals in two ways: much noise and a camera that the prior
    # likes, or little noise and the camera that the data ask for. Both are followed, and judged at the end.
    state = Geometry(*(np.concatenate([part, part]) for part in state))
    problem = problem.take(np.zeros(len(state.theta), dtype=np.intp))
    sigma = point_sigma(problem, state, priors)
    sigma[len(sigma) // 2 :] = TRUSTING_PX
    problem = replace(problem, sigma=sigma)
    state = minimise(problem, state, _ROUND).state
    lowest = float(_scatter(problem, state, priors).min())
    for _ in range(ROUNDS):
        sigma = point_sigma(problem, state, priors)
        change = np.abs(np.log(sigma / problem.sigma)).max()
        problem = replace(problem, sigma=sigma)
        found = minimise(problem, state, _ROUND)
        state, cost = found.state, found.cost
        if change < SCATTER_TOLERANCE:
            break
        # What has come to the same minimum with the same noise goes on as one.
        values = np.concatenate([state.theta, np.log(problem.sigma)[:, None]], axis=1)
        kept = _distinct(values, _objective(problem, state, priors))
        state, cost = Geometry(*(part[kept] for part in state)), cost[kept]
        problem = problem.take(kept)
    state, objective = _best(problem, state, cost, priors, 1)
    problem = problem.take(np.arange(1))
    problem = replace(problem, sigma=point_sigma(problem, state, priors))
    last = minimise(problem, state, _FINE)
    return _Found(Estimate(problem, last.state, Stop(int(last.stop[0]))), objective, lowest)


def point_sigma(problem: Adjustment, state: Geometry, priors: Priors) -> Array:
    """Standard deviation of an image point of weight 1 for each start, pixels, (B,)."""
    return _total_sigma(_scatter(problem, state, priors))


def _total_sigma(scatter: Array) -> Array:
    total: Array = np.hypot(CORRELATION * scatter, np.minimum(MODEL_ERROR_PX, ABSORBED * scatter))
    return total


def _starts(views: ViewStack, model: ScaleFree, priors: Priors) -> Geometry:
    """Every focal length with every combination of the two poses of each view."""
    plane = views.plane_points
    H = homographies(plane, views.pixels, views.weights)
    width = max(model.image_size)
    focal = [width * share for share in FOCAL_STARTS]
    squared = simplified_intrinsics(H, model.centre)[0]
    if (FOCAL_LIMITS[0] * width) ** 2 < squared < (FOCAL_LIMITS[1] * width) ** 2:
        focal.append(float(np.sqrt(squared)))
    if priors.focal_px is not None:
        focal.append(priors.focal_px[0])
    f = np.array(focal)
    A_inv = np.zeros((len(f), 1, 3, 3))
    A_inv[..., 0, 0] = A_inv[..., 1, 1] = 1 / f[:, None]
    A_inv[..., :2, 2] = -model.centre / f[:, None, None]
    A_inv[..., 2, 2] = 1
    rays = (views.pixels - model.centre) / f[:, None, None, None]
    R, t = planar_poses(A_inv @ H, plane, rays, views.weights)
    R = R @ np.swapaxes(views.plane, -1, -2)[None, :, None]
    count = len(views.points)
    choices = np.array(
        list(product((0, 1), repeat=count)) if count <= ENUMERATED_VIEWS else [(0,) * count, (1,) * count]
    )
    index = np.arange(count)
    R, t = R[:, index, choices], t[:, index, choices]  # (F, C, V, ...)
    theta = np.zeros((len(f), 1, 8))
    theta[..., 0] = np.log(f)[:, None]
    theta[..., 4:6] = priors.radial.mean(np.log(f / width))[0][:, None]
    theta = np.broadcast_to(theta, (len(f), len(choices), 8))
    return Geometry(theta.reshape(-1, 8), R.reshape(-1, count, 3, 3), t.reshape(-1, count, 3))


def _best(
    problem: Adjustment, state: Geometry, cost: Array, priors: Priors, count: int
) -> tuple[Geometry, float]:
    """Keep the distinct minima of lowest objective, each judged at the scatter that suits it best."""
    usable = np.flatnonzero(np.isfinite(cost))
    if not len(usable):
        raise DegenerateViews(
            "No camera has these views in front of it; check that object and image points belong together."
        )
    state = Geometry(*(part[usable] for part in state))
    objective = _objective(problem.take(usable), state, priors)
    kept = _distinct(state.theta, objective)[:count]
    return Geometry(*(part[kept] for part in state)), float(objective[kept[0]])


def _objective(problem: Adjustment, state: Geometry, priors: Priors) -> Array:
    """Negative log posterior of each minimum at the scatter that suits it best, (B,), up to a constant."""
    scatter = _scatter(problem, state, priors)
    sigma = _total_sigma(scatter)
    squares = problem.squares(state).sum(axis=1)
    informative = _degrees_of_freedom(problem.views) / CORRELATION**2
    deviation = np.log(scatter / priors.corner_sigma_px[0]) / priors.corner_sigma_px[1]
    constraint = (problem.constraint(state.theta)[0] ** 2).sum(axis=1)
    objective: Array = 0.5 * (squares / sigma**2 + constraint + deviation**2) + informative * np.log(sigma)
    return objective


def _distinct(values: Array, objective: Array) -> NDArray[np.intp]:
    """Items from best to worst, without the hopeless and those that agree with a better one."""
    kept: list[int] = []
    for item in np.argsort(objective, kind="stable"):
        if objective[item] > objective.min() + HOPELESS:
            break
        if all(np.abs(values[item] - values[other]).max() > SAME for other in kept):
            kept.append(int(item))
    return np.array(kept)


def _scatter(problem: Adjustment, state: Geometry, priors: Priors) -> Array:
    """Scatter s of the residuals, pixels: the root of n (1 - q / s^2) + ln(s / s0) / tau^2 = 0.

    n is the number of degrees of freedom over CORRELATION^2, q their mean square. The left side is concave
    and rises with ln s, so Newton's iteration climbs to the root from below.
    """
    median, spread = priors.corner_sigma_px
    freedom = _degrees_of_freedom(problem.views)
    n = freedom / CORRELATION**2
    lowest = np.log(median) - n * spread**2
    q = problem.squares(state).sum(axis=1) / max(freedom, 1)
    log_s = np.clip(0.5 * np.log(np.maximum(q, 1e-300)), lowest, np.log(median))
    for _ in range(100):
        share = n * q * np.exp(-2 * log_s)
        step = (n - share + (log_s - np.log(median)) / spread**2) / (2 * share + 1 / spread**2)
        log_s = log_s - step
        if np.abs(step).max() < 1e-12:
            break
    scatter: Array = np.exp(log_s)
    return scatter


def _degrees_of_freedom(views: ViewStack) -> int:
    """Rows less the unknowns that only data can settle: six a view and eight of the camera."""
    return max(2 * int((views.weights > 0).sum()) - 6 * len(views.points) - 8, 0)
