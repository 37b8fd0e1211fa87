"""The default estimator: the middle of the posterior near its highest point, with the corner noise estimated.

How much a residual counts follows from all residuals together (:mod:`fewcal.noise`), so that noise and camera
are found in one minimisation.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Adjustment, Estimate, Geometry
from .closed_form import simplified_intrinsics
from .constraints import Normal, Priors
from .copies import Copies, share_weight
from .departures import COUNT, Departures
from .elimination import eliminate
from .errors import DegenerateViews
from .homography import homographies
from .least_squares import (
    Minimum,
    NormalEquations,
    Stop,
    Tolerances,
    minimise,
    solve,
    take,
)
from .noise import COMPUTED_PX, Noise
from .parametrisation import RADIAL, ScaleFree
from .planar_pose import planar_poses
from .prior_rows import PriorRows
from .radial_prior import Lenses
from .variational import middle
from .views import ViewStack

Array = NDArray[np.float64]

FOCAL_STARTS = (0.6, 1.2, 2.4, 5.0)
"""Focal lengths to start from, in max(width, height): every lens lies within a factor of 1.5 of one."""
TRUSTING_PX = 0.01
"""Standard deviation with which data are taken at their word at first; no camera measures better."""
NONE = Normal(0.0, 1e-12)
"""Of a departure that there is not."""
FOCAL_LIMITS = (0.05, 100.0)
"""Closed-form focal lengths outside this range, in max(width, height), are no use as starts."""
ENUMERATED_VIEWS = 3
"""Up to here both poses of every view are combined, 2^V starts a focal length; more views settle it."""
HOPELESS = 50.0
"""Difference of the objective at which a minimum is given up: exp(-50) is its share of the probability."""

TRUST_LEVELS = np.linspace(0, 1, 6)
"""Standard deviations looked at, from the first to the one of trust, as steps of their logarithm."""
WORTHWHILE = 0.3
"""Gain in the objective, foreseen, for which the other explanation is followed."""

ELSEWHERE = 1.1
"""Scatter of the residuals over the lowest foreseen, from which on other minima are looked for. A third of
drawn cameras are beyond it, and six of seven of those whose lowest minimum would be missed."""
CONTRADICTED = 2.5
"""Standard deviations from a prior from which on other minima are looked for as well."""
WIDE = 20.0
"""How many times as wide t priors are for that. With 5 nearly twice as many minima stay missed."""

SETTLED = 1e-2
"""Length of the last Gauss-Newton step to the middle of the posterior, standard deviations; what is left is
of the order of its square."""

RUNNERS = 2
"""Focal lengths that set out for each arrangement of the boards."""
PROMISING = 10.0
"""Multiple of the lowest cost foreseen after one step up to which a start sets out, with HOPELESS on top.
With real boards the arrangement that won in the end was foreseen at up to 3.8 times the lowest."""

_COARSE = Tolerances(decrease=0.5, relative=0.0, iterations=25, damping=1e-4)
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
    assert noise is not None
    if start is None:
        few, place = _few(problem, original, priors)
        starts = _starts(few.views, model, priors)
        start = _repeated(_contenders(few, starts, place), place)
    found = _descend(problem, start)
    first, (scatter, objective) = found, _ahead(problem, noise, found)
    if objective < found.objective[0] - WORTHWHILE:
        trusting = minimise(problem.believing(noise.known(TRUSTING_PX)), found.state, _ROUND)
        scatter = float(noise.scatter(trusting.equations.squares)[0])
        found = _lower(found, _descend(problem, trusting.state))
    if starts is not None and _doubtful(problem, first, scatter):
        found = _lower(found, _descend(problem, _repeated(_unprejudiced(few, starts), place)))
    settled, state, sigma = _settled(problem, found)
    estimate = Estimate(settled, state, sigma, Stop(int(found.stop[0])))
    return _Found(estimate, float(found.objective[0]), scatter)


def _problem(views: ViewStack, model: ScaleFree, priors: Priors) -> Adjustment:
    departures = Departures.of(views.points, views.pixels, model.image_size, model.centre)
    return Adjustment(views, model, priors.rows(model.image_size), Noise.of(views, priors), departures)


def _few(
    problem: Adjustment, original: NDArray[np.intp], priors: Priors
) -> tuple[Adjustment, NDArray[np.intp]]:
    """Leave copies out, which tell of the boards' poses what their originals do, and would take many starts.

    Returns
    -------
    problem : Adjustment
        Of the views left, each with the weight of its copies.
    place : (V,) which of them each view repeats
    """
    kept, place, times = np.unique(original, return_inverse=True, return_counts=True)
    if len(kept) == len(place):
        return problem, np.arange(len(place))
    views = take(problem.views, kept)
    views = views._replace(weights=views.weights * np.sqrt(times)[:, None])
    assert isinstance(problem.model, ScaleFree)
    return _problem(views, problem.model, priors), place


def _repeated(state: Geometry, place: NDArray[np.intp]) -> Geometry:
    """Give copies the pose of the view at some place, which each repeats."""
    return state._replace(rotation=state.rotation[:, place], position=state.position[:, place])


def _departing(state: Geometry) -> Geometry:
    """Add the departures of board and lens to the unknowns, zero."""
    return state._replace(theta=np.pad(state.theta, ((0, 0), (0, COUNT))))


def _descend(problem: Adjustment, start: Geometry) -> Minimum[Geometry]:
    """Find the lowest minimum that some starts lead to."""
    assert problem.noise is not None
    several = problem.believing(problem.noise.repeat(len(start.theta)))
    return minimise(several, start, _FINE, lead=HOPELESS).best()


def _lower(one: Minimum[Geometry], other: Minimum[Geometry]) -> Minimum[Geometry]:
    return other if other.objective[0] < one.objective[0] else one


def _doubtful(problem: Adjustment, found: Minimum[Geometry], lowest_scatter: float) -> bool:
    """Whether a minimum leaves more than the data would, or contradicts a prior."""
    noise, priors = problem.noise, problem.constraint
    assert noise is not None
    assert isinstance(priors, PriorRows)
    scatter = float(noise.scatter(found.equations.squares)[0])
    contradicted = bool(priors.distance(found.state.theta[0]).max() > CONTRADICTED)
    return scatter > COMPUTED_PX and (contradicted or scatter > ELSEWHERE * lowest_scatter)


def _unprejudiced(problem: Adjustment, starts: Geometry) -> Geometry:
    """Find where all starts would lead, were little known of cameras but their focal length and distortion.

    A t prior has walls near its middle and is flat beyond: where the camera lies far out, boards tilted the
    wrong way, or a long lens, can explain the views at less cost on the way there, with no way on.
    """
    noise, priors = problem.noise, problem.constraint
    assert noise is not None
    assert isinstance(priors, PriorRows)
    source, arrangement = _arrangements(starts, priors)
    wide = replace(problem, constraint=priors.widened(WIDE), noise=noise.repeat(len(source)))
    found = minimise(wide, _departing(_arranged(starts, source)), _COARSE, lead=HOPELESS)
    return _best_of_each(found, arrangement).state


def _settled(problem: Adjustment, found: Minimum[Geometry]) -> tuple[Adjustment, Geometry, float]:
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
    assert isinstance(priors, PriorRows)
    assert isinstance(model, ScaleFree)
    assert noise is not None
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


def _ahead(problem: Adjustment, noise: Noise, found: Minimum[Geometry]) -> tuple[float, float]:
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
    priors = problem.constraint
    assert isinstance(priors, PriorRows)
    prior_squares = priors.squares(found.state.theta + shared)
    noise = noise.repeat(len(sigma))
    return float(noise.scatter(squares)[-1]), float(noise.objective(squares, prior_squares).min())


def _starts(views: ViewStack, model: ScaleFree, priors: Priors) -> Geometry:
    """Every focal length, with the first pose of all views and with the second (C * F * 2).

    One view says little of the distortion, so that each kind of lenses, of C, may have a minimum of its own
    and is a start; more views settle it.
    """
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
    R, t = np.swapaxes(R, 1, 2), np.swapaxes(t, 1, 2)  # (F, 2, V, ...)
    lenses, count = Lenses.of(priors.radial), len(views.points)
    radial = np.moveaxis(lenses.means(model.diagonal / 2 / f)[0], 1, 0)  # (C, F, ...)
    if count > 1:
        radial = np.tensordot(lenses.share, radial, 1)[None]
    theta = np.zeros((len(radial), len(f), 2, 8))
    theta[..., 0], theta[..., 4:6] = np.log(f)[:, None], radial[:, :, None]
    R, t = (np.tile(part, (len(radial), *[1] * (part.ndim - 1))) for part in (R, t))
    return Geometry(theta.reshape(-1, 8), R.reshape(-1, count, 3, 3), t.reshape(-1, count, 3))


def _arrangements(start: Geometry, priors: PriorRows) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Combine the poses that each view has with a focal length.

    Returns
    -------
    source : (N, V)
        From which start each view is taken.
    arrangement : (N,)
        The same for the same poses and, with one view, kind of lenses, whatever the focal length.
    """
    views = start.rotation.shape[1]
    poses = list(product((0, 1), repeat=views)) if views <= ENUMERATED_VIEWS else [(0,) * views, (1,) * views]
    lenses = np.arange(len(start.theta) // 2)
    source = 2 * lenses[:, None, None] + np.array(poses, dtype=np.intp)
    kind = lenses * (len(priors.lenses.share) if views == 1 else 1) // len(lenses)
    arrangement = kind[:, None] * len(poses) + np.arange(len(poses))
    return source.reshape(-1, views), arrangement.ravel()


def _contenders(problem: Adjustment, start: Geometry, place: NDArray[np.intp]) -> Geometry:
    """Let the starts descend, and keep the best of each arrangement of the boards that is not hopeless.

    With one view the kind of lenses that a start has is part of the arrangement. The departures of board and
    lens are too small to matter before; they are zero.

    Given how the boards are tilted, to this side or to that, the camera has one minimum; the valley from
    focal length to focal length is walked by :meth:`Adjustment.retract`. So the focal lengths from which one
    step leads lowest stand for all.
    """
    priors, noise = problem.constraint, problem.noise
    assert noise is not None
    assert isinstance(priors, PriorRows)
    problem = replace(problem, noise=noise.known(), departures=None)
    # Each view is linearised once for each focal length and pose, and then combined.
    equations = problem.linearise(start)
    source, arrangement = _arrangements(start, priors)
    equations = NormalEquations(_of_views(equations.groups, source), equations.shared[source[:, 0]])
    allowed = np.flatnonzero(np.isfinite(equations.squares))
    if not len(allowed):
        alone = np.flatnonzero(~np.isfinite(equations.groups[..., -1, -1]).any(axis=0))
        # Views are counted as they were given, copies among them.
        number = np.flatnonzero(place == alone[0])[0] + 1 if len(alone) else 0
        which = f"view {number} of {len(place)}" if number else "these views"
        raise DegenerateViews(
            f"No camera has {which} in front of it; check that object and image points belong together, and "
            "that more than one of the points is off the line through the others."
        )
    equations, arrangement, source = take(equations, allowed), arrangement[allowed], source[allowed]
    variance = problem.variance(equations.squares[:1]).repeat(len(allowed))
    damping = np.full(len(allowed), _COARSE.damping)
    # Rounding can make the difference of two huge costs negative.
    foreseen = equations.cost(variance) - solve(equations, variance, damping)[2]
    kept = _lowest(foreseen, arrangement, RUNNERS)
    kept = kept[foreseen[kept] <= PROMISING * foreseen.min() + HOPELESS]
    arrangement, source = arrangement[kept], source[kept]
    several = problem.believing(noise.known().repeat(len(kept)))
    found = minimise(
        several, _arranged(start, source), _COARSE, lead=HOPELESS, equations=take(equations, kept)
    )
    return _departing(_best_of_each(found, arrangement).state)


def _best_of_each(found: Minimum[Geometry], arrangement: NDArray[np.intp]) -> Minimum[Geometry]:
    """Keep the lowest minimum of each arrangement that is not hopeless."""
    kept = _lowest(found.objective, arrangement, 1)
    return found.take(kept[found.objective[kept] <= found.objective.min() + HOPELESS])


def _arranged(start: Geometry, source: NDArray[np.intp]) -> Geometry:
    """Starts (C) whose views each are those of the starts `source` (C, V)."""
    return Geometry(
        start.theta[source[:, 0]], _of_views(start.rotation, source), _of_views(start.position, source)
    )


def _of_views(values: Array, source: NDArray[np.intp]) -> Array:
    """Combine what there is of each view (B, V, ...) from the starts (C, V)."""
    return values[source, np.arange(source.shape[1])]


def _lowest(values: Array, kinds: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """Items with the lowest values of each kind, `count` of them."""
    order = np.lexsort((values, kinds))
    kinds = kinds[order]
    place = np.arange(len(kinds)) - np.searchsorted(kinds, kinds)
    return order[place < count]
