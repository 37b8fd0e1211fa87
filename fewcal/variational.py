"""The middle of a posterior whose priors have heavy tails, instead of its highest point.

A t prior is a normal one of unknown precision, and the kind of a lens is unknown. At the highest point both
are what they would be were the camera known exactly, so that a prior with a sharp middle draws the estimate
there, however wide the posterior is. So the posterior is replaced by the product of a normal distribution of
the unknowns and one of precisions and kinds that comes nearest to it (variational Bayes; Bishop 2006, chapter
10), and the mean of the normal one is taken.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .scale_mixture import moments, whitened
from .tails import Tails, expected_precisions

Array = NDArray[np.float64]

_STEPS = 200
"""Updates at most; fifteen are usual."""
_CONVERGED = 1e-4
"""Change of the middle at which it is found, standard deviations."""
SLIGHT = 0.01
"""Share of a prior in what is known of its quantity, below which the rest says the same without it."""


class Middle(NamedTuple):
    """The normal distribution of the unknowns that comes nearest to the posterior.

    Attributes
    ----------
    step : (S,) from the estimate to its mean
    covariance : (S, S)
    length : float
        Of the step, in standard deviations of the distribution.
    squares : (K,)
        Expected squares of the rows of the priors.
    variance : float
        Of the rows of the data, relative to what they came with.
    """

    step: Array
    covariance: Array
    length: float
    squares: Array
    variance: float


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def middle(
    J: Array,
    r: Array,
    tails: Tails,
    squares: Array | None = None,
    variance: Callable[[float], float] = lambda left: 1.0,
) -> Middle | None:
    """Find the normal distribution of the unknowns that comes nearest to the posterior.

    Either distribution in turn is updated by the expectation over the other one: precisions are those of the
    t priors at the expected squares of their rows, E|z|^2 = |E z|^2 + trace of the covariance of z. The
    variance of the data follows what is left of their rows.

    Parameters
    ----------
    J : (M, S), r : (M,)
        Rows of the data in units of their standard deviation, linear in the step from the estimate.
    tails : Tails
    squares : (K,), optional
        Squares of the rows of the priors to start from; those at the estimate when left out.
    variance : callable
        Variance of the rows of the data for a sum of their squares.

    Returns
    -------
    Middle
        None where nothing holds an unknown, or rounding decides.
    """
    expected = tails.z**2 if squares is None else squares
    precisions = expected_precisions(tails)
    first = precisions(expected)
    near = np.sqrt(first)
    _, inverse, y = whitened(
        np.concatenate([J, near[:, None] * tails.by_unknowns]), np.concatenate([r, near * tails.z])
    )
    if not np.isfinite(inverse).all():
        return None
    # In e = T step + y, where the first posterior is a unit normal, the others are well-conditioned too.
    W = tails.by_unknowns @ inverse
    z = tails.z - W @ y
    of_data, left = J @ inverse, r - J @ (inverse @ y)
    e: Array = np.zeros(len(y))
    unit: Array = np.eye(len(y))
    covariance: Array = unit
    v = 1.0
    for _ in range(_STEPS):
        before = e
        expected = (z + W @ e) ** 2 + np.maximum(((W @ covariance) * W).sum(axis=1), 0)
        v = variance(float(np.sum((left + of_data @ e) ** 2)))
        more = precisions(expected) - first / v
        information = unit / v + (W.T * more) @ W
        try:
            covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
        except np.linalg.LinAlgError:
            return None
        e = -covariance @ (W.T @ (more * z))
        if not np.isfinite(e).all():
            return None
        if np.abs(e - before).max() < _CONVERGED:
            break
    length = math.sqrt(max(float((e - y) @ information @ (e - y)), 0.0))
    return Middle(inverse @ (e - y), inverse @ covariance @ inverse.T, length, expected, v)


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def contradictions(J: Array, r: Array, tails: Tails, covariance: Array) -> Array:
    """How far each normal prior is from what all others say, in standard deviations of the two together.

    A prior that is stated surely leaves no residual at the estimate, whatever the others say, and priors with
    heavy tails give way to it there. So the middle is found anew without it, from the middle of all others.

    Parameters
    ----------
    J : (M, S), r : (M,)
        Rows of the data, see :func:`middle`.
    tails : Tails
    covariance : (S, S)
        Of the unknowns, with all priors.

    Returns
    -------
    (K,) zero for t priors, which give way themselves, and where nothing else speaks of what a prior says.
    """
    found = np.zeros(len(tails.z))
    for row in np.flatnonzero(np.isinf(tails.nu[tails.group])):
        by_unknowns = tails.by_unknowns[row]
        if by_unknowns @ covariance @ by_unknowns < SLIGHT:
            found[row] = tails.z[row]
            continue
        kept = np.arange(len(found)) != row
        others = tails._replace(z=kept * tails.z, by_unknowns=kept[:, None] * tails.by_unknowns)
        without = middle(J, r, others, squares=np.zeros(len(found)))
        if without is not None:
            z = tails.z[row] + by_unknowns @ without.step
            at = others._replace(z=others.z + others.by_unknowns @ without.step)
            # Of the normal distribution this would be too small: it does not count the tails of the others.
            variance = float(by_unknowns @ moments(J, r + J @ without.step, at).covariance @ by_unknowns)
            found[row] = z / math.sqrt(1 + variance) if variance >= 0 else 0.0
    return found
