"""The default estimator: maximum a posteriori, from many starts, with the corner noise estimated.

How much a residual counts follows from all residuals together (:mod:`fewcal.noise`), so that noise and camera
are found in one minimisation.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Adjustment, Estimate, Geometry
from .closed_form import simplified_intrinsics
from .constraints import Priors
from .errors import DegenerateViews
from .homography import homographies
from .least_squares import Minimum, Stop, Tolerances, minimise
from .noise import Noise, total_sigma
from .parametrisation import ScaleFree
from .planar_pose import planar_poses
from .views import ViewStack

Array = NDArray[np.float64]

FOCAL_STARTS = (0.6, 1.2, 2.4, 5.0)
"""Focal lengths to start from, in max(width, height): every lens lies within a factor of 1.5 of one."""
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

_COARSE = Tolerances(decrease=1e-2, relative=1e-3, iterations=25)
_ROUND = Tolerances(decrease=1e-4, relative=1e-4, iterations=50)
_FINE = Tolerances(decrease=1e-12, relative=1e-12)


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
    width = max(model.image_size)
    noise = Noise.of(views, priors)
    problem = Adjustment(views, model, lambda theta: priors.rows(theta, width))
    expected = float(total_sigma(np.array(noise.median)))
    start = _starts(views, model, priors)
    found = minimise(problem, start, _COARSE, lambda squares: np.full_like(squares, expected**2))
    state = _best(found, noise, KEPT_STARTS)
    # Noise and camera can explain the same residuals in two ways: much noise and a camera that the prior
    # likes, or little noise and the camera that the data ask for. Both are followed, and judged at the end.
    trusting = minimise(problem, state, _ROUND, lambda squares: np.full_like(squares, TRUSTING_PX**2))
    lowest = float(noise.scatter(trusting.equations.squares).min())
    state = Geometry(*(np.concatenate(parts) for parts in zip(state, trusting.state, strict=True)))
    found = minimise(problem, state, _ROUND, noise.variance)
    found = minimise(problem, _best(found, noise, 1), _FINE, noise.variance)
    objective = float(_objective(found, noise)[0])
    sigma = float(np.sqrt(found.variance[0]))
    return _Found(Estimate(problem, found.state, sigma, Stop(int(found.stop[0]))), objective, lowest)


def _starts(views: ViewStack, model: ScaleFree, priors: Priors) -> Geometry:
    """Every focal length with every combination of the two poses of each view."""
    H = homographies(views.points, views.pixels, views.weights)
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
    rays = (views.pixels - model.centre[:, None]) / f[:, None, None, None]
    R, t = planar_poses(A_inv @ H, views.points, rays, views.weights)
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


def _objective(found: Minimum[Geometry], noise: Noise) -> Array:
    return noise.objective(found.equations.squares, found.equations.shared[:, -1, -1])


def _best(found: Minimum[Geometry], noise: Noise, count: int) -> Geometry:
    """Keep the distinct minima of lowest objective, each judged at the scatter that suits it best."""
    objective = _objective(found, noise)
    usable = np.flatnonzero(np.isfinite(objective))
    if not len(usable):
        raise DegenerateViews(
            "No camera has these views in front of it; check that object and image points belong together."
        )
    kept = usable[_distinct(found.state.theta[usable], objective[usable])[:count]]
    return Geometry(*(part[kept] for part in found.state))


def _distinct(values: Array, objective: Array) -> NDArray[np.intp]:
    """Items from best to worst, without the hopeless and those that agree with a better one."""
    kept: list[int] = []
    for item in np.argsort(objective, kind="stable"):
        if objective[item] > objective.min() + HOPELESS:
            break
        if all(np.abs(values[item] - values[other]).max() > SAME for other in kept):
            kept.append(int(item))
    return np.array(kept)
