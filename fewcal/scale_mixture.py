"""Heavy-tailed priors without a Gaussian approximation at the mode.

A t distribution is a normal one whose precision lambda is unknown, chi-squared over its degrees of freedom.
Given the precisions of all priors everything is normal, the linearised data too, so that the posterior is an
average of normal distributions over a few precisions, weighted by how likely the data make them
(Rao-Blackwell). The curvature at the mode alone would call a prior of scale s as narrow as
s sqrt(nu / (nu + 1)), and far from its centre as wide as one likes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .precision_draws import draw
from .tails import Tails, expected_precisions

Array = NDArray[np.float64]

ORDER = 1.5
"""Order of the mean of the standard deviations of all parts that is reported. The root mean square, 2, of
what a t prior with nu <= 2 leaves is infinite, were it not for the data: two of it hold .95 of the errors and
one .75. The mean, 1, holds .71 and .935; between them both are what they are of a normal distribution."""


class Moments(NamedTuple):
    """What is left of the unknowns about the estimate.

    Attributes
    ----------
    covariance : (S, S)
        About the estimate rather than about the mean, so that it is the error of the estimate that it tells.
        Along each of its axes the standard deviation is the mean of order :data:`ORDER` of those of all
        parts; infinite where nothing holds an unknown, or rounding has left none.
    precision : (K,)
        Mean precision of each row of the priors.
    """

    covariance: Array
    precision: Array


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def moments(J: Array, r: Array, tails: Tails) -> Moments:
    """Average over the precisions of the priors.

    Parameters
    ----------
    J : (M, S), r : (M,)
        Rows of the data in units of their standard deviation, linear in the step from the estimate.
    tails : Tails
    """
    reference = expected_precisions(tails)(tails.z**2)
    near = np.sqrt(reference)
    T, inverse, y = whitened(
        np.concatenate([J, near[:, None] * tails.by_unknowns]), np.concatenate([r, near * tails.z])
    )
    if not np.isfinite(inverse).all():
        return Moments(np.full(T.shape, np.inf), reference)
    # In e = T step + y, where the reference is a unit normal, all other precisions are well-conditioned too.
    W = tails.by_unknowns @ inverse
    z = tails.z - W @ y
    precision, log_weight = draw(tails, z, W @ W.T, reference)
    more = precision[:, tails.group].T - reference[:, None]  # (K, M)
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
        return Moments(np.full(T.shape, np.inf), reference)
    return Moments(root @ root.T, (weight @ precision)[tails.group])


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
