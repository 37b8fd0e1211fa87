"""All priors on a camera together: their density, and what an adjustment and the error bars need of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .departures import COUNT
from .least_squares import diagonal
from .radial_prior import GROWTH, WIDEST, Lenses, RadialPrior, powers
from .tails import Tails

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

STIFFNESS = 0.7
"""Least curvature of a t prior along its argument, as a share of Gauss-Newton's."""
RADIAL = [4, 5]
"""The radial terms among the unknowns."""
_UNKNOWNS = 8 + COUNT
_SINGLE = np.array([0, 1, 2, 3, 6, 7, 8, 9, 10, 11])
"""Unknowns but the radial terms."""


class _Density(NamedTuple):
    """The priors at B cameras, row by row.

    Attributes
    ----------
    z : (B, K) distance from the mean in scales
    by_theta : (B, K, S) its derivative
    squares : (B, K) |z|^2 of the prior that the row belongs to
    q : (B, K) the same over nu
    logarithm : (B, K) ln(1 + q) / q
    precision : (B, K) of the normal prior with the same slope
    share : (B, K) probability that this prior is the one that holds: 1 but for the kinds of lenses
    values : (B, K) they sum to -2 ln of the density of each prior over its greatest
    radial : (B,) the same of the mixture of the kinds of lenses
    total : (B,) the same of all priors together
    """

    z: Array
    by_theta: Array
    squares: Array
    q: Array
    logarithm: Array
    precision: Array
    share: Array
    values: Array
    radial: Array
    total: Array


@dataclass(frozen=True)
class PriorRows:
    """The priors on a camera.

    Each unknown, or each d that have one prior together, such as the radial terms, is first brought to zero
    mean and unit scale, z. With nu degrees of freedom the density of a prior is then
    (1 + |z|^2 / nu)^(-(nu + d) / 2), and that of a normal one the same with nu infinite. The radial terms
    have a prior for each of C kinds of lenses, and the density of their mixture, since a lens is of one kind.

    There are K = 2 (C - 1) + 12 rows: two for each kind of lenses but the last, and one for each unknown,
    where those of the radial terms belong to the last kind.

    Attributes
    ----------
    whiten, offset, follow : (K, 12), (K,), (K, 2)
        z = whiten theta - offset - follow (rc^1.5, rc^2), see :class:`fewcal.RadialPrior`.
    corner : float
        ln rc + ln fx.
    tail : (K,)
        1 / nu.
    group : (K,)
        Which prior a row belongs to; the kinds of lenses come first.
    factor : (K,)
        (nu + d) / nu.
    together : (K, K)
        1 where two rows belong to the same.
    kinds : (K, C)
        1 where a row belongs to a kind of lenses.
    others : (K,)
        1 where it belongs to none.
    height : (C,)
        ln of the density at the mean of each kind, times its share, for heights that sum to 1.
    lenses : Lenses
    """

    whiten: Array
    offset: Array
    follow: Array
    corner: float
    tail: Array
    group: Indices
    factor: Array
    together: Array
    kinds: Array
    others: Array
    height: Array
    lenses: Lenses

    @classmethod
    def of(
        cls,
        mean: Array,
        scale: Array,
        nu: Array,
        prior: Indices,
        kinds: tuple[RadialPrior, ...],
        corner: float,
    ) -> PriorRows:
        """Gather mean, scale and nu (10,) of the unknowns but the radial terms, and the kinds of lenses.

        Unknowns with the same number as their `prior` (10,), which count from zero, have one together.
        """
        count, lenses = len(kinds), Lenses.of(kinds)
        single = count + prior
        group = np.concatenate([np.repeat(np.arange(count - 1), 2), single[:4], [count - 1] * 2, single[4:]])
        whiten, offset, follow = (
            np.zeros((len(group), _UNKNOWNS)),
            np.zeros(len(group)),
            np.zeros((len(group), 2)),
        )
        tail = np.empty(len(group))
        rows = len(group) - _UNKNOWNS + _SINGLE
        whiten[rows, _SINGLE], offset[rows], tail[rows] = 1 / scale, mean / scale, 1 / nu
        triangles = np.linalg.inv(np.linalg.cholesky(lenses.covariance))
        for kind, triangle in enumerate(triangles):
            pair = np.flatnonzero(group == kind)
            whiten[pair[:, None], RADIAL], tail[pair] = triangle, 1 / kinds[kind].nu
            offset[pair], follow[pair] = triangle @ lenses.terms[kind], triangle * lenses.growth[kind]
        together = (group[:, None] == group).astype(float)
        belongs = (group[:, None] == np.arange(count)).astype(float)
        height = np.log(lenses.share * triangles[:, 0, 0] * triangles[:, 1, 1])
        return cls(
            whiten,
            offset,
            follow,
            corner,
            tail,
            group,
            1 + together.sum(axis=0) * tail,
            together,
            belongs,
            1 - belongs.sum(axis=1),
            height - np.logaddexp.reduce(height),
            lenses,
        )

    def widened(self, factor: float) -> PriorRows:
        """Make the t priors of the camera `factor` times as wide, but those of the radial terms."""
        scale = np.where((self.tail > 0) & (self.others > 0), 1 / factor, 1.0)
        scale[-COUNT:] = 1.0
        return replace(self, whiten=self.whiten * scale[:, None], offset=self.offset * scale)

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Rows of normal priors that have the slope of these at a camera, their precisions held.

        Parameters
        ----------
        theta : (B, S)
            Scale-free camera: ln fx, ln(fy / fx), principal point offset in diagonals (x, y), a1, a2, b1, b2;
            with S = 12 also the departures of board and lens.

        Returns
        -------
        r : (B, K), J : (B, K, S)
        """
        at = self._density(theta)
        root = np.sqrt(at.share * at.precision)
        return root * at.z, root[:, :, None] * at.by_theta

    def squares(self, theta: Array) -> Array:
        """-2 ln of the density of cameras (B, S) over the greatest, (B,)."""
        return self._density(theta).total

    def distance(self, theta: Array) -> Array:
        """How far (S,) each unknown of a camera (S,) lies out, those that have one prior together.

        The radial terms from the nearest kind of lenses. In standard deviations: two unknowns of a t prior
        lie farther out than |z| as often as two of a normal one lie farther out than
        sqrt(nu ln(1 + |z|^2 / nu)), and for one unknown that is nearly so.
        """
        at = self._density(theta[None])
        distance = (at.squares * at.logarithm)[0]
        of_kind = np.where(self.kinds[: len(distance)] > 0, distance[:, None], np.inf).min(axis=0)
        distance = distance[-len(theta) :].copy()
        distance[RADIAL] = of_kind.min()
        return np.asarray(np.sqrt(distance))

    def quadratic(self, theta: Array) -> Array:
        """Second-order model of -2 ln of the density, in the place of [J, r]' [J, r].

        As a squared row a t prior would have too much curvature along z: q / ((1 + q) ln(1 + q)) times
        slope over z, with q = |z|^2 / nu, instead of (1 - q) / (1 + q). That makes the last steps too short.
        But the latter turns negative, and far from the minimum steps become too long before it does, so that
        no less than :data:`STIFFNESS` of the former is taken. A mixture has the mean of the curvatures of
        its parts here, which is no less than its own.

        Parameters
        ----------
        theta : (B, S)

        Returns
        -------
        (B, S + 1, S + 1) symmetric: Hessian and gradient of half of it by `theta`; its value comes last.
        """
        at = self._density(theta)
        size = theta.shape[1]
        slope = at.share * at.precision
        along = np.maximum((1 - at.q) / (1 + at.q), STIFFNESS / ((1 + at.q) * at.logarithm))
        bend = slope * (along - 1) * at.z / np.maximum(at.squares, 1e-300)
        by_z = bend[:, :, None] * at.z[:, None, :] * self.together[: at.z.shape[1], : at.z.shape[1]]
        diagonal(by_z)[...] += slope
        transposed = np.swapaxes(at.by_theta, -1, -2)
        model = np.empty((len(theta), size + 1, size + 1))
        model[:, :-1, :-1] = transposed @ (by_z @ at.by_theta)
        model[:, -1, :-1] = model[:, :-1, -1] = (transposed @ (slope * at.z)[:, :, None])[:, :, 0]
        model[:, -1, -1] = at.total
        return model

    def tails(self, theta: Array) -> Tails:
        """See the priors as normal ones of unknown precision, at one camera (S,)."""
        at = self._density(theta[None])
        group = self.group[: at.z.shape[1]]
        nu = np.empty(group.max() + 1)
        with np.errstate(divide="ignore"):
            nu[group] = 1 / self.tail[: len(group)]
        return Tails(at.z[0], at.by_theta[0], group, nu, self.height)

    def normal(self, theta: Array) -> Array:
        """Rows (S, S) of a normal prior as wide as all of these, at one camera (S,)."""
        means, slopes = self.lenses.means(np.exp(self.corner - theta[0]))
        share = self.lenses.share
        off = means - share @ means
        covariance = np.tensordot(share, self.lenses.covariance, 1) + (share[:, None] * off).T @ off
        triangle = np.linalg.inv(np.linalg.cholesky(covariance))
        unknowns = np.arange(len(theta))
        normal = self.whiten[np.ix_(len(self.group) - _UNKNOWNS + unknowns, unknowns)]
        normal[RADIAL] = 0
        normal[4:6, 4:6], normal[4:6, 0] = triangle, -triangle @ (share @ slopes)
        return normal

    def _density(self, theta: Array) -> _Density:
        size = theta.shape[1]
        rows = slice(len(self.group) - _UNKNOWNS + size)
        whiten, follow, together, kinds = (
            self.whiten[rows, :size],
            self.follow[rows],
            self.together[rows, rows],
            self.kinds[rows],
        )
        corner = np.exp(self.corner - theta[:, 0])
        power = powers(corner)
        z = theta @ whiten.T
        z -= self.offset[rows]
        z -= power @ follow.T
        by_theta = np.empty((len(theta), *whiten.shape))
        by_theta[:] = whiten
        by_theta[:, :, 0] += (power * (corner < WIDEST)[:, None]) @ (follow * GROWTH).T
        own = z * z
        squares = own @ together
        q = squares * self.tail[rows]
        safe = np.maximum(q, 1e-30)
        logarithm = np.log1p(safe) / safe
        factor = self.factor[rows]
        values = factor * logarithm * own
        share = self.height - 0.5 * (values @ kinds)
        highest = share.max(axis=1, keepdims=True)
        share = np.exp(share - highest)
        whole = share.sum(axis=1, keepdims=True)
        radial = np.maximum(-2 * (highest + np.log(whole))[:, 0], 0)
        return _Density(
            z,
            by_theta,
            squares,
            q,
            logarithm,
            factor / (1 + q),
            (share / whole) @ kinds.T + self.others[rows],
            values,
            radial,
            values @ self.others[rows] + radial,
        )
