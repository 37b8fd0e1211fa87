"""Where the search sets out: focal lengths, the poses of boards that they allow, and which of them go on."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from .adjustment import Geometry, MapProblem
from .closed_form import simplified_intrinsics
from .constraints import Priors
from .departures import COUNT
from .errors import DegenerateViews
from .homography import homographies
from .least_squares import Minimum, NormalEquations, Tolerances, minimise, solve, take
from .parametrisation import ScaleFree
from .planar_pose import planar_poses
from .prior_rows import PriorRows
from .radial_prior import Lenses
from .views import ViewStack

Array = NDArray[np.float64]

FOCAL_STARTS = (0.6, 1.2, 2.4, 5.0)
"""Focal lengths to start from, in max(width, height): every lens lies within a factor of 1.5 of one."""
FOCAL_LIMITS = (0.05, 100.0)
"""Closed-form focal lengths outside this range, in max(width, height), are no use as starts."""
ENUMERATED_VIEWS = 3
"""Up to here both poses of every view are combined, 2^V starts a focal length; more views settle it."""
HOPELESS = 50.0
"""Difference of the objective at which a minimum is given up: exp(-50) is its share of the probability."""
RUNNERS = 2
"""Focal lengths that set out for each arrangement of the boards."""
PROMISING = 10.0
"""Multiple of the lowest cost foreseen after one step up to which a start sets out, with HOPELESS on top.
With real boards the arrangement that won in the end was foreseen at up to 3.8 times the lowest."""
WIDE = 20.0
"""How many times as wide t priors are where little is to be known of the camera. With 5 nearly twice as many
minima stay missed."""

_COARSE = Tolerances(decrease=0.5, relative=0.0, iterations=25, damping=1e-4)


def starting_points(views: ViewStack, model: ScaleFree, priors: Priors) -> Geometry:
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


def contenders(problem: MapProblem, starts: Geometry, place: NDArray[np.intp]) -> Geometry:
    """Let the starts descend, and keep the best of each arrangement of the boards that is not hopeless.

    With one view the kind of lenses that a start has is part of the arrangement. The departures of board and
    lens are too small to matter before; they are zero.

    Given how the boards are tilted, to this side or to that, the camera has one minimum; the valley from
    focal length to focal length is walked by :meth:`Adjustment.retract`. So the focal lengths from which one
    step leads lowest stand for all.

    Parameters
    ----------
    problem : MapProblem
    starts : Geometry
        See :func:`starting_points`.
    place : (N,)
        Which of the views each of those given is, for the error to count them as they were given.

    Raises
    ------
    DegenerateViews
        When no start leads to a camera with the board in front of it.
    """
    priors, noise = problem.constraint, problem.noise
    problem = replace(problem, noise=noise.known(), departures=None)
    # Each view is linearised once for each focal length and pose, and then combined.
    equations = problem.linearise(starts)
    source, arrangement = _arrangements(starts, priors)
    equations = NormalEquations(_of_views(equations.groups, source), equations.shared[source[:, 0]])
    allowed = np.flatnonzero(np.isfinite(equations.squares))
    if not len(allowed):
        alone = np.flatnonzero(~np.isfinite(equations.groups[..., -1, -1]).any(axis=0))
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
        several, _arranged(starts, source), _COARSE, lead=HOPELESS, equations=take(equations, kept)
    )
    return _departing(_best_of_each(found, arrangement).state)


def unprejudiced(problem: MapProblem, starts: Geometry) -> Geometry:
    """Find where all starts would lead, were little known of cameras but their focal length and distortion.

    A t prior has walls near its middle and is flat beyond: where the camera lies far out, boards tilted the
    wrong way, or a long lens, can explain the views at less cost on the way there, with no way on.
    """
    noise, priors = problem.noise, problem.constraint
    source, arrangement = _arrangements(starts, priors)
    wide = replace(problem, constraint=priors.widened(WIDE), noise=noise.repeat(len(source)))
    found = minimise(wide, _departing(_arranged(starts, source)), _COARSE, lead=HOPELESS)
    return _best_of_each(found, arrangement).state


def _arrangements(starts: Geometry, priors: PriorRows) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Combine the poses that each view has with a focal length.

    Returns
    -------
    source : (N, V)
        From which start each view is taken.
    arrangement : (N,)
        The same for the same poses and, with one view, kind of lenses, whatever the focal length.
    """
    views = starts.rotation.shape[1]
    poses = list(product((0, 1), repeat=views)) if views <= ENUMERATED_VIEWS else [(0,) * views, (1,) * views]
    lenses = np.arange(len(starts.theta) // 2)
    source = 2 * lenses[:, None, None] + np.array(poses, dtype=np.intp)
    kind = lenses * (len(priors.lenses.share) if views == 1 else 1) // len(lenses)
    arrangement = kind[:, None] * len(poses) + np.arange(len(poses))
    return source.reshape(-1, views), arrangement.ravel()


def _departing(state: Geometry) -> Geometry:
    """Add the departures of board and lens to the unknowns, zero."""
    return state._replace(theta=np.pad(state.theta, ((0, 0), (0, COUNT))))


def _best_of_each(found: Minimum[Geometry], arrangement: NDArray[np.intp]) -> Minimum[Geometry]:
    """Keep the lowest minimum of each arrangement that is not hopeless."""
    kept = _lowest(found.objective, arrangement, 1)
    return found.take(kept[found.objective[kept] <= found.objective.min() + HOPELESS])


def _arranged(starts: Geometry, source: NDArray[np.intp]) -> Geometry:
    """Starts (C) whose views each are those of the starts `source` (C, V)."""
    return Geometry(
        starts.theta[source[:, 0]], _of_views(starts.rotation, source), _of_views(starts.position, source)
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
