"""The default estimator: the middle of the posterior near its highest point, with the corner noise estimated.

How much a residual counts follows from all residuals together (:mod:`fewcal.noise`), so that noise and camera
are found in one minimisation.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Adjustment, Estimate, Geometry, MapProblem
from .constraints import Normal, Priors
from .copies import Copies, share_weight
from .departures import Departures
from .elimination import eliminate
from .least_squares import Minimum, NormalEquations, Stop, Tolerances, minimise, solve, take
from .noise import COMPUTED_PX, Noise
from .parametrisation import RADIAL, ScaleFree
from .starts import HOPELESS, contenders, starting_points, unprejudiced
from .variational import middle
from .views import ViewStack

Array = NDArray[np.float64]

TRUSTING_PX = 0.01
"""Standard deviation with which data are taken at their word at first; no camera measures better."""
NONE = Normal(0.0, 1e-12)
"""Of a departure that there is not."""
TRUST_LEVELS = np.linspace(0, 1, 6)
"""Standard deviations looked at, from the first to the one of trust, as steps of their logarithm."""
WORTHWHILE = 0.3
"""Gain in the objective, foreseen, for which the other explanation is followed."""

ELSEWHERE = 1.1
"""Scatter of the residuals over the lowest foreseen, from which on other minima are looked for. A third of
drawn cameras are beyond it, and six of seven of those whose lowest minimum would be missed."""
CONTRADICTED = 2.5
"""Standard deviations from a prior from which on other minima are looked for as well."""
SETTLED = 1e-2
"""Length of the last Gauss-Newton step to the middle of the posterior, standard deviations; what is left is
of the order of its square."""

_ROUND = Tolerances(decrease=1e-2, relative=0.0, iterations=50)
_FINE = Tolerances(decrease=1e-4, relative=0.0, iterations=1500, damping=1e-6, final_step=True)
"""Exact points at a small angle leave a long, narrow valley; views that a camera saw take a few steps. The
rest of the way is that to the middle of the posterior."""


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def estimate_map(
    views: ViewStack, image_size: tuple[int, int], priors: Priors, alike: Copies | None = None
) -> Estimate:
    """Find the camera and poses in the middle of the posterior.

    Parameters
    ----------
    views : ViewStack
    image_size : (width, height), pixels
    priors : Priors
    alike : Copies, optional
        Of these views, see :func:`fewcal.copies.copies`; each counts in full when left out.

    Raises
    ------
    DegenerateViews
        When no start leads to a camera with the board in front of it.
    """
    shared = views if alike is None else share_weight(views, alike.times)
    original = np.arange(len(views.points)) if alike is None else alike.original
    found = _estimate(shared, ScaleFree(image_size), priors, original)
    if found.lowest_scatter < COMPUTED_PX:
        # Points this exact were computed: they have no errors to repeat, however alike the views are, and if
        # board and lens can be perfect they are. Perhaps the camera is the paper's, whose distortion acts on
        # pixels.
        exact = replace(priors, board_bend=NONE, lens_remainder=NONE, print_stretch=NONE)
        models = [ScaleFree(image_size, in_pixels) for in_pixels in (False, True)]
        perfect = [_estimate(views, model, exact, original, found.estimate.geometry) for model in models]
        best = min(perfect, key=lambda each: each.objective)
        if best.lowest_scatter < COMPUTED_PX:
            return best.estimate
        found = _estimate(views, ScaleFree(image_size), priors, original)
    return found.estimate


class _Found(NamedTuple):
    """The best minimum, its objective, and the scatter that is left when the data are taken at their word."""

    estimate: Estimate
    objective: float
    lowest_scatter: float


def _estimate(
    views: ViewStack,
    model: ScaleFree,
    priors: Priors,
    original: NDArray[np.intp],
    start: Geometry | None = None,
) -> _Found:
    """Find the best minimum for one camera model, or the one that a start leads to."""
    problem = _problem(views, model, priors)
    noise, starts = problem.noise, None
    if start is None:
        few, place = _few(problem, original, priors)
        starts = starting_points(few.views, model, priors)
        start = _repeated(contenders(few, starts, place), place)
    found = _descend(problem, start)
    first, (scatter, objective) = found, _ahead(problem, found)
    if objective < found.objective[0] - WORTHWHILE:
        trusting = minimise(problem.believing(noise.known(TRUSTING_PX)), found.state, _ROUND)
        scatter = float(noise.scatter(trusting.equations.squares)[0])
        found = _lower(found, _descend(problem, trusting.state))
    if starts is not None and _doubtful(problem, first, scatter):
        found = _lower(found, _descend(problem, _repeated(unprejudiced(few, starts), place)))
    settled, state, sigma = _settled(problem, found)
    estimate = Estimate(settled, state, sigma, Stop(int(found.stop[0])))
    return _Found(estimate, float(found.objective[0]), scatter)


def _problem(views: ViewStack, model: ScaleFree, priors: Priors) -> MapProblem:
    departures = Departures.of(views.points, views.pixels, model.image_size, model.centre)
    return MapProblem(views, model, priors.rows(model.image_size), Noise.of(views, priors), departures)


def _few(
    problem: MapProblem, original: NDArray[np.intp], priors: Priors
) -> tuple[MapProblem, NDArray[np.intp]]:
    """Leave copies out, which tell of the boards' poses what their originals do, and would take many starts.

    Returns
    -------
    problem : MapProblem
        Of the views left, each with the weight of its copies.
    place : (V,) which of them each view repeats
    """
    kept, place, times = np.unique(original, return_inverse=True, return_counts=True)
    if len(kept) == len(place):
        return problem, np.arange(len(place))
    views = take(problem.views, kept)
    views = views._replace(weights=views.weights * np.sqrt(times)[:, None])
    return _problem(views, problem.model, priors), place


def _repeated(state: Geometry, place: NDArray[np.intp]) -> Geometry:
    """Give copies the pose of the view at some place, which each repeats."""
    return state._replace(rotation=state.rotation[:, place], position=state.position[:, place])


def _descend(problem: MapProblem, start: Geometry) -> Minimum[Geometry]:
    """Find the lowest minimum that some starts lead to."""
    several = problem.believing(problem.noise.repeat(len(start.theta)))
    return minimise(several, start, _FINE, lead=HOPELESS).best()


def _lower(one: Minimum[Geometry], other: Minimum[Geometry]) -> Minimum[Geometry]:
    return other if other.objective[0] < one.objective[0] else one


def _doubtful(problem: MapProblem, found: Minimum[Geometry], lowest_scatter: float) -> bool:
    """Whether a minimum leaves more than the data would, or contradicts a prior."""
    scatter = float(problem.noise.scatter(found.equations.squares)[0])
    contradicted = bool(problem.constraint.distance(found.state.theta[0]).max() > CONTRADICTED)
    return scatter > COMPUTED_PX and (contradicted or scatter > ELSEWHERE * lowest_scatter)


def _settled(problem: MapProblem, found: Minimum[Geometry]) -> tuple[Adjustment, Geometry, float]:
    """Go from a minimum to the middle of the posterior and to the noise there, and let the boards follow.

    By Gauss-Newton steps, as long as they grow shorter. Where they do not, the model being far from linear or
    rounding the only noise, the minimum stays. The departures of the lens are from here on about its
    principal point, which moves by too little to matter within a step.

    Returns
    -------
    problem : Adjustment
        With the departures of the answer.
    state : Geometry
    sigma : float
    """
    priors, noise, model = problem.constraint, problem.noise, problem.model
    state, sigma, squares = found.state, float(np.sqrt(found.variance[0])), None
    assert problem.departures is not None
    moved, length = problem, math.inf
    while length > SETTLED:
        about = model.natural(state.theta[0])[2:4]
        departures = problem.departures.about(
            about, problem.views.pixels, model.image_size, state.theta[0, RADIAL]
        )
        moved = replace(problem, departures=departures)
        eliminated = eliminate(moved.rows(state, sigma))
        reduced = eliminated.camera.reshape(-1, state.theta.shape[1] + 1)
        centre = middle(
            reduced[:, :-1],
            reduced[:, -1],
            priors.tails(state.theta[0]),
            squares,
            partial(_variance, noise, sigma**2),
        )
        if centre is None or not centre.length < length:
            return problem, found.state, float(np.sqrt(found.variance[0]))
        state = moved.retract(state, centre.step[None], eliminated.pose_steps(centre.step)[None])
        sigma, squares, length = sigma * math.sqrt(centre.variance), centre.squares, centre.length
    return moved, state, sigma


def _variance(noise: Noise, unit: float, squares: float) -> float:
    """Variance of rows for their sum of squares, all in units of one variance."""
    return float(noise.variance(np.array([squares * unit]))[0]) / unit


def _ahead(problem: MapProblem, found: Minimum[Geometry]) -> tuple[float, float]:
    """Foresee what becomes of a minimum when the data are trusted more, up to their word.

    Noise and camera can explain the same residuals in two ways: much noise and a camera that the prior likes,
    or little noise and the camera that the data ask for.

    Returns
    -------
    scatter : float
        Left by the camera that the data ask for, in the linear model, pixels.
    objective : float
        Lowest on the way there.
    """
    own = np.sqrt(found.variance[0])
    sigma = own * (TRUSTING_PX / own) ** TRUST_LEVELS
    equations = NormalEquations(*(np.repeat(part, len(sigma), axis=0) for part in found.equations))
    # The state is one step ahead of the equations, the last, which is too short to matter.
    shared, local, _ = solve(equations, sigma**2, np.zeros(len(sigma)))
    squares = equations.squares_after(shared, local)
    prior_squares = problem.constraint.squares(found.state.theta + shared)
    noise = problem.noise.repeat(len(sigma))
    return float(noise.scatter(squares)[-1]), float(noise.objective(squares, prior_squares).min())
