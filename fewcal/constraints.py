"""Soft constraints: each a block of residual rows with its Jacobian beside it.

A row is in units of its own standard deviation, so that half the sum of squares is a negative log-likelihood
and no weight is left to choose. :class:`Priors` holds what is known about a camera before it has seen a
board, fitted on 253 real cameras (doc/estimator.md says how); every field can be replaced.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from .checks import is_covariance, require_numbers, require_pair
from .errors import InvalidInput
from .least_squares import diagonal
from .scale_mixture import Tails

Array = NDArray[np.float64]

ASPECT_TOLERANCE_PX = 50.0
"""The constant a of eq 29, pixels, as in the paper's experiments (section 5)."""
STIFFNESS = 0.7
"""Least curvature of a t prior along its argument, as a share of Gauss-Newton's."""
LARGEST_EXPONENT = 50.0
"""Bound of the exponent of eq 29; beyond it the penalty would overflow long before it mattered."""


@dataclass(frozen=True)
class Normal:
    """Normal distribution.

    Parameters
    ----------
    mean, sd : float
        In the unit of the quantity; sd above zero.
    """

    mean: float
    sd: float

    def __post_init__(self) -> None:
        require_numbers("Normal", [self.mean], positive=[self.sd])

    @property
    def nu(self) -> float:
        """Degrees of freedom of the t distribution that it is."""
        return math.inf

    @property
    def scale(self) -> float:
        """Standard deviation, as :class:`StudentT` calls it."""
        return self.sd


@dataclass(frozen=True)
class StudentT:
    """Student's t distribution: like a normal one near its mean, but a value far out is not impossible.

    Parameters
    ----------
    nu : float
        Degrees of freedom, above zero.
    scale : float
        In the unit of the quantity, above zero.
    mean : float
    """

    nu: float
    scale: float
    mean: float = 0.0

    def __post_init__(self) -> None:
        require_numbers("StudentT", [self.mean], positive=[self.nu, self.scale])


Distribution: TypeAlias = Normal | StudentT
"""The prior of one number."""


@dataclass(frozen=True)
class RadialPrior:
    """Bivariate t of the scale-free radial terms (a1, a2), whose mean depends on the lens.

    Long lenses tend to pincushion and short ones to barrel: with x = ln(f / W) - ln `reference`, clipped to
    [-1, 1], the mean is `intercept` + `slope` x.

    Parameters
    ----------
    nu : float
    intercept, slope : (2,) of a1 and a2
    covariance : (2, 2) scale matrix, as nested tuples
    reference : float
        f / W at which x is zero.
    """

    nu: float = 2.5
    intercept: tuple[float, float] = (-0.107, 0.0219)
    slope: tuple[float, float] = (0.287, -0.0875)
    covariance: tuple[tuple[float, float], tuple[float, float]] = ((0.0125, -0.0044), (-0.0044, 0.0019))
    reference: float = 0.85

    def __post_init__(self) -> None:
        require_numbers("RadialPrior", [], positive=[self.nu, self.reference])
        require_pair("RadialPrior.intercept", self.intercept)
        require_pair("RadialPrior.slope", self.slope)
        if not is_covariance(self.covariance):
            raise InvalidInput("RadialPrior.covariance must be a symmetric positive definite 2x2 matrix.")

    def mean(self, log_focal_over_width: Array) -> tuple[Array, Array]:
        """Mean (B, 2) of (a1, a2) for a focal length, and its derivative by the log focal length."""
        x = log_focal_over_width - math.log(self.reference)
        slope = np.where(np.abs(x) < 1, 1.0, 0.0)[:, None] * np.array(self.slope)
        return np.array(self.intercept) + np.clip(x, -1, 1)[:, None] * np.array(self.slope), slope


@dataclass(frozen=True)
class Priors:
    """What is known about the camera before the first view.

    Replace any field: a lens known to be 1200 px within 1 % is ``Priors(focal_px=(1200, 12))``.

    Parameters
    ----------
    focal_px : (float, float), optional
        Mean and standard deviation of fx, pixels. Replaces `log_focal_over_width`.
    log_focal_over_width : Distribution
        Of ln(fx / max(width, height)).
    log_aspect : Distribution
        Of ln(fy / fx).
    principal_point_x, principal_point_y : Distribution
        Of the offset from ((w - 1) / 2, (h - 1) / 2), in image diagonals.
    radial : RadialPrior
        Of a1 = k1 rc^2 and a2 = k2 rc^4, with rc = half the diagonal / fx.
    tangential : Distribution
        Of b1 = p1 rc and b2 = p2 rc.
    board_bend : Distribution
        Of the board's bend along either side, as a share of its diagonal, see :mod:`fewcal.departures`.
    lens_remainder : Distribution
        Of the r^7 term of the lens, in half diagonals at the corner of the image.
    corner_sigma_px : (float, float)
        Median of the corner noise, pixels, and the standard deviation of its logarithm.
    """

    focal_px: tuple[float, float] | None = None
    log_focal_over_width: Distribution = Normal(-0.21, 0.40)
    log_aspect: Distribution = StudentT(2.0, 0.0022)
    principal_point_x: Distribution = StudentT(3.0, 0.0134)
    principal_point_y: Distribution = StudentT(3.0, 0.0154)
    radial: RadialPrior = RadialPrior()
    tangential: Distribution = StudentT(1.25, 0.0011)
    board_bend: Distribution = StudentT(2.0, 5e-4)
    lens_remainder: Distribution = StudentT(1.0, 0.008)
    corner_sigma_px: tuple[float, float] = (0.25, 1.0)

    def __post_init__(self) -> None:
        for name in _SINGLE_PRIORS:
            if not isinstance(getattr(self, name), (Normal, StudentT)):
                raise InvalidInput(f"Priors.{name} must be fewcal.Normal or fewcal.StudentT.")
        if not isinstance(self.radial, RadialPrior):
            raise InvalidInput("Priors.radial must be fewcal.RadialPrior.")
        if self.focal_px is not None:
            require_pair("Priors.focal_px", self.focal_px, positive=True)
        require_pair("Priors.corner_sigma_px", self.corner_sigma_px, positive=True)

    def focal(self, width: float) -> Distribution:
        """Prior of ln(fx / width), width in pixels, the user's own when there is one."""
        if self.focal_px is None:
            return self.log_focal_over_width
        mean, sd = self.focal_px
        return Normal(math.log(mean / width), sd / mean)

    def rows(self, width: float) -> PriorRows:
        """Rows of all priors on the camera, for images whose longer side is `width` pixels."""
        return PriorRows.of(self, width)


@dataclass(frozen=True)
class PriorRows:
    """The rows of all priors on a camera, computed at once.

    Each unknown, or the pair of radial terms, is first brought to zero mean and unit scale, z; a t prior of
    nu degrees of freedom in d dimensions is then r = z sqrt((nu + d) ln(1 + |z|^2 / nu) / |z|^2), and a
    normal one the same with nu infinite.

    Attributes
    ----------
    mean, whiten : (11,) and (11, 11)
        z = whiten (theta - mean), for the mean of the radial terms at its reference focal length.
    slope : (11,)
        Change of z with the clipped logarithm x of the focal length, see :class:`RadialPrior`.
    reference : float
        Of x, as a logarithm in pixels.
    tail : (11,)
        1 / nu.
    """

    mean: Array
    whiten: Array
    slope: Array
    reference: float
    tail: Array

    @classmethod
    def of(cls, priors: Priors, width: float) -> PriorRows:
        """Gather what the rows need."""
        radial = priors.radial
        single = (
            priors.focal(width),
            priors.log_aspect,
            priors.principal_point_x,
            priors.principal_point_y,
            priors.tangential,
            priors.tangential,
            priors.board_bend,
            priors.lens_remainder,
        )
        mean, scale, nu = np.array([(d.mean, d.scale, d.nu) for d in single]).T[:, _SINGLE]
        mean[0] += math.log(width)
        mean[4:6], nu[4:6] = radial.intercept, radial.nu
        whiten = np.diag(1 / scale)
        whiten[4:6, 4:6] = np.linalg.inv(np.linalg.cholesky(np.array(radial.covariance)))
        slope = np.zeros(len(mean))
        slope[4:6] = -whiten[4:6, 4:6] @ np.array(radial.slope)
        return cls(mean, whiten, slope, math.log(width) + math.log(radial.reference), 1 / nu)

    def __call__(self, theta: Array) -> tuple[Array, Array]:
        """Compute the rows.

        Parameters
        ----------
        theta : (B, S)
            Scale-free camera: ln fx, ln(fy / fx), principal point offset in diagonals (x, y), a1, a2, b1, b2;
            with S = 11 also bend along x, bend along y and remainder of the lens.

        Returns
        -------
        r : (B, S), J : (B, S, S)
            In the order of :data:`PRIOR_ROWS`.
        """
        z, by_theta = self._whitened(theta)
        size = z.shape[1]
        together = _TOGETHER[:size, :size]
        gain, bend = _student_gain(z * z @ together, self.tail[:size], _DIMENSION[:size])
        by_z = (bend * z)[:, :, None] * z[:, None, :] * together
        diagonal(by_z)[...] += gain
        return gain * z, by_z @ by_theta

    def quadratic(self, theta: Array) -> Array:
        """Second-order model of twice the negative log density, in the place of [J, r]' [J, r].

        J'J gives a t prior too much curvature along z: q / ((1 + q) ln(1 + q)) times slope over z, with
        q = |z|^2 / nu, instead of (1 - q) / (1 + q). That makes the last steps too short. But the latter
        turns negative, and far from the minimum steps become too long before it does, so that no less than
        :data:`STIFFNESS` of the former is taken.

        Parameters
        ----------
        theta : (B, S)

        Returns
        -------
        (B, S + 1, S + 1) symmetric: Hessian and gradient of half of it by `theta`; its value comes last.
        """
        z, by_theta = self._whitened(theta)
        size = z.shape[1]
        together, tail = _TOGETHER[:size, :size], self.tail[:size]
        squares = z * z @ together
        q = squares * tail
        factor = 1 + _DIMENSION[:size] * tail
        slope = factor / (1 + q)
        safe = np.maximum(q, 1e-30)
        logarithm = np.log1p(safe) / safe
        along = np.maximum((1 - q) / (1 + q), STIFFNESS / ((1 + q) * logarithm))
        by_z = (slope * (along - 1) * z / np.maximum(squares, 1e-300))[:, :, None] * z[:, None, :] * together
        diagonal(by_z)[...] += slope
        transposed = np.swapaxes(by_theta, -1, -2)
        model = np.empty((len(theta), size + 1, size + 1))
        model[:, :-1, :-1] = transposed @ (by_z @ by_theta)
        model[:, -1, :-1] = model[:, :-1, -1] = (transposed @ (slope * z)[:, :, None])[:, :, 0]
        model[:, -1, -1] = (factor * logarithm * z * z).sum(axis=1)
        return model

    def tails(self, theta: Array) -> Tails:
        """See the priors as normal ones of unknown precision, at one camera (S,)."""
        z, by_theta = self._whitened(theta[None])
        group = _GROUP[: len(theta)]
        with np.errstate(divide="ignore"):
            nu = 1 / self.tail[_FIRST[: group[-1] + 1]]
        return Tails(z[0], by_theta[0], group, nu)

    def _whitened(self, theta: Array) -> tuple[Array, Array]:
        """Z of zero mean and unit scale (B, S), and its derivative (B, S, S)."""
        size = theta.shape[1]
        x = theta[:, :1] - self.reference
        whiten, slope = self.whiten[:size, :size], self.slope[:size]
        z = (theta - self.mean[:size]) @ whiten.T + np.minimum(np.maximum(x, -1), 1) * slope
        by_theta = np.empty((len(theta), size, size))
        by_theta[:] = whiten
        by_theta[:, 4:6, 0] = (np.abs(x) < 1) * self.slope[4:6]
        return z, by_theta


_SINGLE_PRIORS = (
    "log_focal_over_width",
    "log_aspect",
    "principal_point_x",
    "principal_point_y",
    "tangential",
    "board_bend",
    "lens_remainder",
)
"""Fields of :class:`Priors` that are distributions of one number."""
_SINGLE = np.array([0, 1, 2, 3, 4, 4, 4, 5, 6, 6, 7])
"""Prior of each unknown among the single ones; the radial terms have their own."""
_TOGETHER = np.eye(11)
"""Which rows share one prior: the two radial terms do."""
_TOGETHER[4:6, 4:6] = 1
_DIMENSION = _TOGETHER.sum(axis=0)
_GROUP = np.array([0, 1, 2, 3, 4, 4, 5, 6, 7, 8, 9])
"""The distribution that each row belongs to."""
_FIRST = np.array([0, 1, 2, 3, 4, 6, 7, 8, 9, 10])
"""The first row of each distribution."""

PRIOR_ROWS = (
    "focal length",
    "aspect ratio",
    "principal point x",
    "principal point y",
    "radial distortion",
    "radial distortion",
    "tangential distortion",
    "tangential distortion",
)
"""What each row of :meth:`Priors.rows` speaks of."""


def exponential_penalty(fx: Array, fy: Array, views: int) -> tuple[Array, Array]:
    """Compute the paper's soft constraint n exp((fx - fy)^2 / (2 a^2)) as a residual row (eq 29).

    r = sign(d) sqrt(n expm1(min(d^2 / (2 a^2), 50))) with d = fx - fy has the same minimiser, without the
    constant and without overflow.

    Parameters
    ----------
    fx, fy : (B,) pixels
    views : int
        n of eq 29.

    Returns
    -------
    r : (B,), J : (B, 2) by fx and fy
    """
    d = fx - fy
    exponent = d * d / (2 * ASPECT_TOLERANCE_PX**2)
    bounded = np.minimum(exponent, LARGEST_EXPONENT)
    size = np.sqrt(views * np.expm1(bounded))
    # dr/dd = n exp(e) |d| / (2 a^2 |r|), whose limit at d = 0 is sqrt(n / 2) / a.
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = views * np.exp(bounded) * np.abs(d) / (2 * ASPECT_TOLERANCE_PX**2 * size)
    slope = np.where(size > 0, slope, math.sqrt(views / 2) / ASPECT_TOLERANCE_PX)
    # Past the bound the row is constant; the slope at the bound still points the way back.
    return np.sign(d) * size, np.stack([slope, -slope], axis=-1)


def _student_gain(squares: Array, tail: Array, dimension: Array) -> tuple[Array, Array]:
    """Factor g with |g z|^2 = (nu + d) ln(1 + |z|^2 / nu), and dg / d|z| over |z|; tail is 1 / nu."""
    q = squares * tail
    small = q < 1e-6
    safe = np.where(small, 1.0, q)
    logarithm = np.log1p(safe) / safe
    factor = 1 + dimension * tail
    gain = np.sqrt(factor * np.where(small, 1 - q / 2, logarithm))
    # d(gain^2)/d(squares) = (nu + d) / nu^2 * (1 / (q (1 + q)) - ln(1 + q) / q^2)
    bend = np.where(small, -0.5, (1 / (1 + safe) - logarithm) / safe)
    return gain, factor * tail * bend / gain
