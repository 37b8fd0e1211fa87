"""Heavy-tailed priors as normal ones whose precisions are unknown."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Tails(NamedTuple):
    """Priors as normal rows of unknown precision, S unknowns in K rows of G distributions.

    A distribution has one row or two. Of the first C distributions one holds, and it is not known which: the
    others have a precision of zero.

    Attributes
    ----------
    z : (K,)
        Distance from the centre in scales, at the estimate.
    by_unknowns : (K, S)
    group : (K,) of int
        To which distribution a row belongs; rows of one share its precision.
    nu : (G,)
        Degrees of freedom; infinite for a normal distribution, whose precision is 1.
    height : (C,)
        Logarithm of the probability of each of the first distributions times its density at its mean.
    """

    z: Array
    by_unknowns: Array
    group: NDArray[np.intp]
    nu: Array
    height: Array = np.zeros(0)


def expected_precisions(tails: Tails) -> Callable[[Array], Array]:
    """Expected precision (K,) of each row of the priors, for the expected squares (K,) of their z."""
    group, tail = tails.group, 1 / tails.nu
    size = np.bincount(group)
    factor, own = 1 + size * tail, slice(len(tails.height))
    half = (tails.nu[own] + size[own]) / 2

    def precisions(squares: Array) -> Array:
        q = np.bincount(group, squares) * tail
        precision = factor / (1 + q)
        if len(half) > 1:
            log_share = tails.height - half * np.log1p(q[own])
            share = np.exp(log_share - log_share.max())
            precision[own] *= share / share.sum()
        found: Array = precision[group]
        return found

    return precisions
