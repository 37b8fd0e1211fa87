"""Precisions of heavy-tailed priors, drawn about where views and priors together have them.

The precision lambda of a t prior of d unknowns is chi-squared with nu degrees of freedom over nu before there
are data. Were those of all other priors known, its density would be that of

    lambda^((nu + d) / 2) exp(-nu lambda / 2) |I + m S|^(-1/2) exp(-m z'(I + m S)^-1 z / 2)  over ln(lambda)

with m its difference from a reference, S and z the covariance and the mean of its rows there. Each is drawn
from this density, tabulated, with the others at the reference; the weights of the draws make up for the
difference, which is slight: of real cameras a hundred draws are worth as much as eighty of the posterior.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .tails import Tails

Array = NDArray[np.float64]

DRAWS = 128
"""Sets of precisions averaged over."""
CELLS = 48
"""Of the table of a density."""
TILT = 0.15
"""Power of the variance that a prior leaves to its unknowns by which its density is multiplied. A standard
deviation is decided by rare, low precisions; weights that differ more cost less than to have few of them."""
SPARED = 0.1
"""Share of the draws that go to each of the alternatives as often, however unlikely they are."""
LOWEST = -23.0
"""Logarithm of the lowest precision over that at the estimate or 1; a prior 1e5 times as wide says nothing
more."""


class Draws(NamedTuple):
    """Sets of precisions.

    Attributes
    ----------
    precision : (M, G)
    log_weight : (M,)
        Logarithm of the density of the precisions before there are data, times the normalisation of the
        normal rows, over the density from which they were drawn.
    """

    precision: Array
    log_weight: Array


def draw(tails: Tails, z: Array, covariance: Array, reference: Array) -> Draws:
    """Draw sets of precisions, always the same ones for the same views.

    Which of the alternatives holds is drawn as often as the data make it likely.

    Parameters
    ----------
    tails : Tails
    z : (K,), covariance : (K, K)
        Of the rows of the priors, given the data and the reference.
    reference : (K,)
        Precision of each row.
    """
    kinds, heavy = len(tails.height), np.isfinite(tails.nu)
    nu, size = tails.nu[heavy], np.bincount(tails.group)[heavy]
    table = _tabulated(tails, z, covariance, reference, heavy)
    points = _even_points(DRAWS, len(nu) + 1)
    logarithm, log_density = table.draw(points[:, :-1])
    precision = np.ones((DRAWS, len(heavy)))
    precision[:, heavy] = np.exp(logarithm)
    log_weight = logarithm * (nu + size) / 2 - nu / 2 * precision[:, heavy] - log_density
    if kinds > 1:
        own = slice(kinds)
        constant = tails.height + nu[own] / 2 * np.log(nu[own] / 2) - _log_gamma(nu[own] / 2)
        log_evidence = constant + table.log_evidence[own]
        likely = np.exp(log_evidence - log_evidence.max())
        chance = SPARED / kinds + (1 - SPARED) * likely / likely.sum()
        holds = np.searchsorted(np.cumsum(chance)[:-1], points[:, -1])[:, None] == np.arange(kinds)
        precision[:, own] *= holds
        log_weight[:, own] = np.where(holds, log_weight[:, own] + constant - np.log(chance), 0.0)
    return Draws(precision, log_weight.sum(axis=1))


class _Table(NamedTuple):
    """Densities over the logarithm of the precision of H distributions, linear in each cell of a table.

    Attributes
    ----------
    low, step : (H,)
        First edge and width of the cells.
    density : (CELLS + 1, H)
        At the edges of the cells; it need not integrate to 1.
    log_evidence : (H,)
        Logarithm of the integral of each density before it was tilted.
    """

    low: Array
    step: Array
    density: Array
    log_evidence: Array

    def draw(self, points: Array) -> tuple[Array, Array]:
        """Bring points (M, H) in the unit cube to these densities, and tell the logarithms of these there."""
        columns = np.arange(len(self.low))
        below = np.zeros_like(self.density)
        np.cumsum(self.density[:-1] + self.density[1:], axis=0, out=below[1:])
        whole = below[-1]
        # One search for all: the edges of each distribution lie beyond those of the one before.
        edges = (below / whole + columns).T.ravel()
        cell = np.searchsorted(edges, points + columns, side="right") - 1 - columns * len(below)
        cell = np.clip(cell, 0, CELLS - 1)
        left, right = self.density[cell, columns], self.density[cell + 1, columns]
        doubled = points * whole - below[cell, columns]
        here = np.sqrt(np.maximum(left * left + (right - left) * doubled, 1e-60))
        logarithm = self.low + self.step * (cell + doubled / (left + here))
        return logarithm, np.log(2 * here / (whole * self.step))


def _tabulated(
    tails: Tails, z: Array, covariance: Array, reference: Array, heavy: NDArray[np.bool_]
) -> _Table:
    """Tabulate the density of the precision of each distribution that has heavy tails."""
    group, nu = tails.group, tails.nu[heavy]

    def summed(values: Array) -> Array:
        """Over the rows of each distribution."""
        return np.asarray(np.bincount(group, values)[heavy], dtype=np.float64)

    own = covariance * (group[:, None] == group)
    size, trace = summed(np.ones(len(z))), summed(np.diagonal(own))
    # Of a matrix of one row or two: what is left of the square of its trace is twice its determinant.
    determinant = (trace * trace - summed((own * own).sum(axis=1))) / 2
    squares, through = summed(z * z), summed(z * (own @ z))
    at = np.log((nu + size) / (nu + summed(tails.z**2)))
    low = np.minimum(at, 0) + np.maximum(LOWEST, -6 * np.sqrt(2 / nu) - 14 / nu)
    high = np.maximum(at, 0) + np.log(1 + 4 * np.sqrt(2 / nu) + 14 / nu)
    step = (high - low) / CELLS
    logarithm = low + step * np.arange(CELLS + 1)[:, None]
    precision = np.exp(logarithm)
    more = precision - summed(reference) / size
    held = np.maximum(1 + more * (trace + more * determinant), 1e-12)
    exponent = more * (squares * (1 + more * trace) - more * through) / held
    log_density = logarithm * (nu + size) / 2 - nu / 2 * precision - 0.5 * (np.log(held) + exponent)
    highest = log_density.max(axis=0)
    density = np.exp(log_density - highest)
    log_evidence = highest + np.log(density.sum(axis=0) * step)
    density *= (np.maximum(trace + 2 * more * determinant, 1e-300) / held) ** TILT
    return _Table(low, step, np.maximum(density, 1e-30), log_evidence)


def _log_gamma(values: Array) -> Array:
    """Logarithm of the gamma function of a few values."""
    return np.array([math.lgamma(value) for value in values])


@lru_cache(maxsize=16)
def _even_points(count: int, dimension: int) -> Array:
    """Points (M, D) in the unit cube, evenly spread: one in each of M slices along every axis.

    In the order of the additive recurrence of the generalised golden ratio, the root of
    x^(D + 1) = x + 1 (Roberts 2018), whose points themselves leave the ends of some axes empty.
    """
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (dimension + 1))
    steps = ratio ** -np.arange(1.0, dimension + 1)
    recurrence = (np.arange(1, count + 1)[:, None] * steps) % 1
    points: Array = (recurrence.argsort(axis=0).argsort(axis=0) + 0.5) / count
    points.setflags(write=False)
    return points
