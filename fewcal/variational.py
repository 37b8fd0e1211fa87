"""The middle of a posterior whose priors have heavy tails, instead of its highest point.

A t prior is a normal one of unknown precision, and the kind of a lens is unknown. At the highest point both
are taken as if the camera were known exactly: a prior that is narrow for some cameras draws the estimate to
its middle, however wide the posterior, and the kind of lenses with the narrower prior wins. So the posterior
is replaced by the product of a normal distribution of the unknowns and one of the precisions and kinds that
comes nearest to it (variational Bayes; Bishop 2006, chapter 10), which is symmetric about its middle.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .scale_mixture import Tails, whitened

Array = NDArray[np.float64]

_STEPS = 200
_SETTLED = 1e-6
"""Change of the middle at which it is found, standard deviations."""


class Middle(NamedTuple):
    """The normal distribution of the unknowns that comes nearest to the posterior.

    Attributes
    ----------
    step : (S,) from the estimate to its mean
    covariance : (S, S)
    """

    step: Array
    covariance: Array


def middle(J: Array, r: Array, tails: Tails, squares: Array | None = None) -> Middle | None:
    """Find the normal distribution of the unknowns that comes nearest to the posterior.

    Either distribution in turn is updated by the expectation over the other one: precisions are those of the
    t priors at the expected squares of their rows, E|z|^2 = |E z|^2 + trace of the covariance of z.

    Parameters
    ----------
    J : (M, S), r : (M,)
        Rows of the data in units of their standard deviation, linear in the step from the estimate.
    tails : Tails
    squares : (K,), optional
        Squares of the rows of the priors to start from; those at the estimate when left out.

    Returns
    -------
    Middle
        None where nothing holds an unknown.
    """
    first = _precision(tails, tails.z**2 if squares is None else squares)
    near = np.sqrt(first)
    _, inverse, y = whitened(
        np.concatenate([J, near[:, None] * tails.by_unknowns]), np.concatenate([r, near * tails.z])
    )
    if not np.isfinite(inverse).all():
        return None
    # In e = T step + y, where the first posterior is a unit normal, the others are well-conditioned too.
    W = tails.by_unknowns @ inverse
    z = tails.z - W @ y
    e, covariance, unit = np.zeros(len(y)), np.eye(len(y)), np.eye(len(y))
    for _ in range(_STEPS):
        before = e
        more = _precision(tails, (z + W @ e) ** 2 + ((W @ covariance) * W).sum(axis=1)) - first
        covariance = np.linalg.inv(unit + (W.T * more) @ W)
        e = -covariance @ (W.T @ (more * z))
        if np.abs(e - before).max() < _SETTLED:
            break
    return Middle(inverse @ (e - y), inverse @ covariance @ inverse.T)


def contradictions(J: Array, r: Array, tails: Tails) -> Array:
    """How far each normal prior is from what everything else says, in standard deviations of the two together.

    A prior that is stated surely leaves no residual at the estimate, whatever the others say, and priors with
    heavy tails give way to it there. So the middle is found anew without it, from the middle of all others.

    Parameters
    ----------
    J : (M, S), r : (M,)
        Rows of the data, see :func:`middle`.
    tails : Tails

    Returns
    -------
    (K,) zero for t priors, which give way themselves, and where nothing else speaks of what a prior says.
    """
    found = np.zeros(len(tails.z))
    for row in np.flatnonzero(np.isinf(tails.nu[tails.group])):
        kept = (np.arange(len(found)) != row).astype(float)
        others = tails._replace(z=kept * tails.z, by_unknowns=kept[:, None] * tails.by_unknowns)
        without = middle(J, r, others, squares=np.zeros(len(found)))
        if without is not None:
            by_unknowns = tails.by_unknowns[row]
            z = tails.z[row] + by_unknowns @ without.step
            found[row] = z / np.sqrt(1 + by_unknowns @ without.covariance @ by_unknowns)
    return found


def _precision(tails: Tails, squares: Array) -> Array:
    """Expected precision (K,) of each row of the priors, for the expected squares (K,) of their z."""
    size = np.bincount(tails.group)
    squares = np.bincount(tails.group, squares)
    heavy = np.isfinite(tails.nu)
    nu = np.where(heavy, tails.nu, 1.0)
    precision = np.where(heavy, (nu + size) / (nu + squares), 1.0)
    if len(tails.height) > 1:
        own = slice(len(tails.height))
        log_share = tails.height - (nu[own] + size[own]) / 2 * np.log1p(squares[own] / nu[own])
        share = np.exp(log_share - log_share.max())
        precision[own] *= share / share.sum()
    return precision[tails.group]
