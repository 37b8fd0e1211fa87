"""How far image points miss the camera: from the scatter of the residuals to the error that counts.

Corner errors are not independent: a bent board, uneven ink and what the lens model leaves out move
neighbouring corners together. So a view of N corners carries the information of fewer: the likelihood is
raised to the power 1 / CORRELATION^2 (a composite likelihood), which is the same as a standard deviation of
CORRELATION times the scatter s of the residuals. On top of it comes the part of the model error that camera
and poses absorb, so that no residual shows it. The scatter itself is unknown, with a log-normal prior.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .constraints import Priors
from .views import ViewStack

Array = NDArray[np.float64]

CORRELATION = 2.0
"""Ratio of the standard deviation that counts to the scatter of the residuals: 0.5 px was found about right
on real boards whose residuals scatter by 0.25 px (doc/estimator.md)."""
MODEL_ERROR_PX = 0.3
"""Model error that camera and poses absorb, pixels: with corners that scatter by less than 0.1 px, error bars
without it are too small by half on real boards (doc/estimator.md)."""
ABSORBED = 3.0
"""Largest ratio of the absorbed model error to the scatter that it leaves; exact data have neither."""
COMPUTED_PX = 0.02
"""Scatter that the corners of no camera stay below, pixels; what is less was computed."""


class Noise(NamedTuple):
    """The noise of some views, for each item of a batch.

    Attributes
    ----------
    freedom : (B,)
        Rows less the unknowns that only data can settle: six a view and eight of the camera.
    median, spread : (B,)
        Of the scatter's prior, pixels, and standard deviation of its logarithm; 0 where it is known.
    """

    freedom: Array
    median: Array
    spread: Array

    @classmethod
    def of(cls, views: ViewStack, priors: Priors) -> Noise:
        """Count the degrees of freedom of some views, copies as one; a batch of one."""
        points = int((views.weights > 0).sum())
        median, spread = priors.corner_sigma_px
        # The mean square of the weights is 1 but for copies.
        share = float((views.weights**2).sum()) / max(points, 1)
        freedom = max(share * (2 * points - 6 * len(views.points)) - 8, 0.0)
        return cls(np.array([freedom]), np.array([median]), np.array([spread]))

    def known(self, sigma: float | None = None) -> Noise:
        """Scatter that is known: that of a total standard deviation in pixels, or the median."""
        median = self.median if sigma is None else np.full_like(self.median, _scatter_behind(sigma))
        return self._replace(median=median, spread=np.zeros_like(self.spread))

    def repeat(self, size: int) -> Noise:
        """The same for every item of a larger batch, from a batch of one."""
        return Noise(*(np.repeat(part, size) for part in self))

    def take(self, items: NDArray[np.intp]) -> Noise:
        """Keep some items."""
        return Noise(*(part[items] for part in self))

    def scatter(self, squares: Array) -> Array:
        """Most probable scatter s (B,), pixels, for sums of squared residuals (B,).

        It solves n (1 - q / s^2) + ln(s / s0) / tau^2 = 0, where n is the number of degrees of freedom over
        CORRELATION^2, q their mean square, s0 the median and tau the spread of the prior. With
        z = 2 tau^2 n + 2 ln(s / s0) that is z e^z = 2 tau^2 n q / s0^2 e^(2 tau^2 n), Lambert's equation, and
        Wright's function gives z for the logarithm of the right side.
        """
        if not self.spread.any():
            return self.median + 0 * squares
        # Not with the package: it would double the time that an import takes.
        from scipy.special import wrightomega

        strength = 2 * self.spread**2 * self.freedom / CORRELATION**2
        with np.errstate(divide="ignore"):
            c = np.log(strength * squares / (np.maximum(self.freedom, 1) * self.median**2)) + strength
        scatter: Array = self.median * np.exp((wrightomega(np.maximum(c, -700.0)) - strength) / 2)
        return scatter

    def variance(self, squares: Array) -> Array:
        """Variance (B,) of an image point of weight 1, px^2, for sums of squared residuals (B,)."""
        return _total_variance(self.scatter(squares))

    def objective(self, squares: Array, prior_squares: Array) -> Array:
        """Negative log posterior of a camera at the scatter that suits it best, up to a constant.

        Parameters
        ----------
        squares, prior_squares : (B,)
            Sums of squares of the residuals, px^2, and of the rows of the priors.
        """
        scatter = self.scatter(squares)
        sigma = total_sigma(scatter)
        deviation = np.log(scatter / self.median) / np.maximum(self.spread, 1e-300)
        informative = self.freedom / CORRELATION**2
        objective: Array = 0.5 * (squares / sigma**2 + prior_squares + deviation**2) + informative * np.log(
            sigma
        )
        return objective


def total_sigma(scatter: Array) -> Array:
    """Standard deviation of an image point that counts, for the scatter of the residuals, pixels."""
    return np.sqrt(_total_variance(scatter))


def _total_variance(scatter: Array) -> Array:
    variance: Array = (CORRELATION * scatter) ** 2 + np.minimum(MODEL_ERROR_PX, ABSORBED * scatter) ** 2
    return variance


def _scatter_behind(sigma: float) -> float:
    """Invert :func:`total_sigma`."""
    scatter = sigma / math.hypot(CORRELATION, ABSORBED)
    if ABSORBED * scatter > MODEL_ERROR_PX:
        scatter = math.sqrt(sigma**2 - MODEL_ERROR_PX**2) / CORRELATION
    return scatter
