"""Heavy-tailed priors without a Gaussian approximation at the mode.

A t distribution is a normal one whose precision lambda is unknown, chi-squared over its degrees of freedom.
Given the precisions of all priors everything is normal, the linearised data too, so that the posterior is an
average of normal distributions over a few precisions, weighted by how likely the data make them
(Rao-Blackwell). The curvature at the mode alone would call a prior of scale s as narrow as
s sqrt(nu / (nu + 1)), and far from its centre as wide as one likes.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POINTS = 128
"""Sets of precisions averaged over."""
ORDER = 1.5
"""Order of the mean of the standard deviations of all parts that is reported. The root mean square, 2, of
what a t prior with nu <= 2 leaves is infinite, were it not for the data: two of it hold .95 of the errors and
one .75. The mean, 1, holds .71 and .935; between them both are what they are of a normal distribution."""
_TABLE = 4096
"""Points of the table that inverts a gamma distribution."""


class Tails(NamedTuple):
    """Priors as normal rows of unknown precision, S unknowns in K rows of G distributions.

    Of the first C distributions one holds, and it is not known which: the others have a precision of zero.

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


class Moments(NamedTuple):
    """What is left of the unknowns about the estimate.

    Attributes
    ----------
    covariance : (S, S)
        About the estimate rather than about the mean, so that it is the error of the estimate that it tells.
        Along each of its axes the standard deviation is the mean of order :data:`ORDER` of those of all
        parts; infinite where nothing holds an unknown.
    precision : (K,)
        Mean precision of each row of the priors.
    """

    covariance: Array
    precision: Array


def moments(J: Array, r: Array, tails: Tails) -> Moments:
    """Average over the precisions of the priors.

    Parameters
    ----------
    J : (M, S), r : (M,)
        Rows of the data in units of their standard deviation, linear in the step from the estimate.
    tails : Tails
    """
    counts = np.bincount(tails.group, minlength=len(tails.nu))
    squares = np.asarray(np.bincount(tails.group, tails.z**2, len(tails.nu)), dtype=np.float64)
    precisions, expected, log_weight = _proposals(tails.nu, counts.astype(float), squares, tails.height)
    near = np.sqrt(expected[tails.group])
    T, inverse, y = whitened(
        np.concatenate([J, near[:, None] * tails.by_unknowns]), np.concatenate([r, near * tails.z])
    )
    if not np.isfinite(inverse).all():
        return Moments(np.full(T.shape, np.inf), near**2)
    # In e = T step + y, where the reference is a unit normal, all other precisions are well-conditioned too.
    W = tails.by_unknowns @ inverse
    z = tails.z - W @ y
    more = (precisions - expected)[:, tails.group].T  # (K, M)
    outer = (W[:, :, None] * W[:, None, :]).reshape(len(W), -1)
    information = (outer.T @ more).reshape(*T.shape, -1) + np.eye(len(T))[..., None]
    covariance, log_determinant = _inverted(information)
    gradient = W.T @ (more * z[:, None])
    e = -(covariance * gradient).sum(axis=1)
    log_weight = log_weight - 0.5 * (log_determinant + (e * gradient).sum(axis=0) + z**2 @ more)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    off = e - y[:, None]
    root = inverse @ _root_of_mixture(covariance, off, weight)
    if not np.isfinite(root).all():
        return Moments(np.full(T.shape, np.inf), near**2)
    return Moments(root @ root.T, (weight @ precisions)[tails.group])


def _root_of_mixture(covariance: Array, off: Array, weight: Array) -> Array:
    """Root (S, S) of the covariance of a mixture, about zero, whose axes are those of its second moment.

    NaN where rounding has left none.

    Parameters
    ----------
    covariance : (S, S, M), off : (S, M), weight : (M,)
        Of the parts, which are normal, and where they lie.
    """
    second = covariance @ weight + (weight * off) @ off.T
    if not np.isfinite(second).all():
        return np.full_like(second, np.nan)
    axes = np.linalg.eigh(second)[1]
    along = (axes[:, None] * axes).reshape(-1, len(axes)).T @ covariance.reshape(-1, len(weight))
    squares = np.maximum(along, 0) + (axes.T @ off) ** 2
    root: Array = axes * (squares ** (ORDER / 2) @ weight) ** (1 / ORDER)
    return root


def _proposals(nu: Array, counts: Array, squares: Array, height: Array) -> tuple[Array, Array, Array]:
    """Precisions (M, G), their expectation (G,), and the logarithm of their weight without data (M,).

    They are drawn half-way between the prior, Gamma(nu / 2, rate nu / 2), and the conditional at the
    estimate, Gamma((nu + d) / 2, rate (nu + |z|^2) / 2). Which of the alternatives holds is drawn half-way
    between each as often and what it is at the estimate.
    """
    heavy = np.isfinite(nu)
    precisions, expected = np.ones((POINTS, len(nu))), np.ones(len(nu))
    nu, counts, squares = nu[heavy], counts[heavy], squares[heavy]
    shape, rate = nu / 2 + counts / 4, nu / 2 + squares / 4
    quantiles, spare = _gamma_points(tuple(shape.tolist()))
    precisions[:, heavy], expected[heavy] = quantiles / rate, shape / rate
    # Density of the prior over that of the proposal, times the normalisation of the normal rows.
    log_weight = np.log(quantiles / rate) * (counts / 4) + quantiles / rate * (squares / 4)
    if len(height) > 1:
        own = slice(len(height))
        at_estimate = height - (nu[own] + counts[own]) / 2 * np.log1p(squares[own] / nu[own])
        likely = np.exp(at_estimate - at_estimate.max())
        chance = (1 / len(height) + likely / likely.sum()) / 2
        holds = np.searchsorted(np.cumsum(chance)[:-1], spare)[:, None] == np.arange(len(height))
        constant = height - np.log(chance) + _log_gamma(shape[own]) - shape[own] * np.log(rate[own])
        constant += nu[own] / 2 * np.log(nu[own] / 2) - _log_gamma(nu[own] / 2)
        log_weight[:, own] = np.where(holds, log_weight[:, own] + constant, 0.0)
        precisions[:, own] *= holds
        expected[own] *= chance
    return precisions, expected, log_weight.sum(axis=1)


def _log_gamma(values: Array) -> Array:
    """Logarithm of the gamma function of a few values."""
    return np.array([math.lgamma(value) for value in values])


def _inverted(matrices: Array) -> tuple[Array, Array]:
    """Invert positive definite matrices (S, S, M) in place; also the logarithms (M,) of their determinants.

    By Gauss and Jordan, all matrices at once: a library call for each would take three times as long.
    """
    log_determinant = np.zeros(matrices.shape[2])
    for k in range(len(matrices)):
        factor = matrices[:, k].copy()
        pivot = factor[k].copy()
        log_determinant += np.log(pivot)
        matrices[:, k] = factor[k] = 0
        matrices[k, k] = 1
        matrices[k] /= pivot
        matrices -= factor[:, None] * matrices[k]
    return matrices, log_determinant


def whitened(J: Array, r: Array) -> tuple[Array, Array, Array]:
    """Triangle T (S, S) of J = Q T, its inverse, and Q'r (S,); an infinite inverse where T is singular."""
    size = J.shape[1]
    length = np.linalg.norm(J, axis=0)
    held = bool(np.all(length > 0)) and len(J) >= size
    length = np.where(length > 0, length, 1)
    triangle = np.asarray(np.linalg.qr(np.column_stack([J / length, r]), mode="r"))
    T, y = triangle[:size, :size], triangle[:size, size]
    held = held and bool(np.abs(np.diagonal(T)).min() > np.finfo(float).eps * len(J))
    inverse = np.linalg.inv(T) / length[:, None] if held else np.full((size, size), np.inf)
    return T * length, inverse, y


@lru_cache(maxsize=16)
def _gamma_points(shapes: tuple[float, ...]) -> tuple[Array, Array]:
    """Quantiles (M, G) of gamma distributions of rate 1 at points spread evenly over the unit cube.

    It has one dimension more, which comes second (M,).
    """
    points = _even_points(POINTS, len(shapes) + 1)
    columns = [gamma_quantile(points[:, i], shape) for i, shape in enumerate(shapes)]
    quantiles = np.stack(columns, axis=-1) if columns else np.empty((POINTS, 0))
    quantiles.setflags(write=False)
    return quantiles, points[:, -1]


def _even_points(count: int, dimension: int) -> Array:
    """Additive recurrence of the generalised golden ratio, the root of x^(d + 1) = x + 1 (Roberts 2018)."""
    ratio = 2.0
    for _ in range(60):
        ratio = (1 + ratio) ** (1 / (dimension + 1))
    steps = ratio ** -np.arange(1.0, dimension + 1)
    points: Array = (0.5 + np.arange(1, count + 1)[:, None] * steps) % 1
    return points


def gamma_quantile(share: Array, shape: float) -> Array:
    """Invert the distribution function of Gamma(`shape`, rate 1), to 1e-3 of its value.

    The density of t = ln x, exp(shape t - e^t), is smooth whatever the shape, so that sums integrate it.
    """
    highest = np.log(shape + 20 * np.sqrt(shape) + 40)
    t = np.linspace(np.log(shape + 1) - 4 - 40 / shape, highest, _TABLE)
    log_density = shape * t - np.exp(t)
    density = np.exp(log_density - log_density.max())
    below = np.concatenate([[0], np.cumsum((density[1:] + density[:-1]) / 2)])
    quantile: Array = np.exp(np.interp(share, below / below[-1], t))
    return quantile
