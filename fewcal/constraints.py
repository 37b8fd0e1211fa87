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

from .checks import require_numbers, require_pair
from .errors import InvalidInput
from .prior_rows import PriorRows
from .radial_prior import LENSES, RadialPrior

Array = NDArray[np.float64]

ASPECT_TOLERANCE_PX = 50.0
"""The constant a of eq 29, pixels, as in the paper's experiments (section 5)."""
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
        Of the offset from ((w - 1) / 2, (h - 1) / 2), in image diagonals. Two t of the same nu are those of
        either coordinate in a bivariate one: a centre that is off in x is likely to be off in y.
    radial : tuple of RadialPrior
        Of a1 = k1 rc^2 and a2 = k2 rc^4, with rc = half the diagonal / fx: the kinds of lenses there are.
    tangential : Distribution
        Of b1 = p1 rc and b2 = p2 rc, either in a bivariate one.
    board_bend : Distribution
        Of the board's bend along either side, as a share of its diagonal, see :mod:`fewcal.departures`.
    lens_remainder : Distribution
        Of the r^7 term of the lens, in half diagonals at the corner of the image.
    print_stretch : Distribution
        Of ln(width / height) of the board's squares as they were printed, 0 where they are square.
    corner_sigma_px : (float, float)
        Median of the corner noise, pixels, and the standard deviation of its logarithm.
    """

    focal_px: tuple[float, float] | None = None
    log_focal_over_width: Distribution = Normal(-0.21, 0.40)
    log_aspect: Distribution = StudentT(1.15, 0.0019)
    principal_point_x: Distribution = StudentT(1.7, 0.0137)
    principal_point_y: Distribution = StudentT(1.7, 0.0137)
    radial: tuple[RadialPrior, ...] = LENSES
    tangential: Distribution = StudentT(0.9, 0.0009)
    board_bend: Distribution = StudentT(2.0, 5e-4)
    lens_remainder: Distribution = StudentT(1.0, 0.008)
    print_stretch: Distribution = StudentT(2.0, 7e-4)
    corner_sigma_px: tuple[float, float] = (0.25, 1.0)

    def __post_init__(self) -> None:
        for name in _SINGLE:
            if not isinstance(getattr(self, name), (Normal, StudentT)):
                raise InvalidInput(f"Priors.{name} must be fewcal.Normal or fewcal.StudentT.")
        if self.focal_px is not None:
            require_pair("Priors.focal_px", self.focal_px, positive=True)
            object.__setattr__(self, "focal_px", tuple(map(float, self.focal_px)))
        require_pair("Priors.corner_sigma_px", self.corner_sigma_px, positive=True)
        object.__setattr__(self, "corner_sigma_px", tuple(map(float, self.corner_sigma_px)))
        kinds = self.radial if isinstance(self.radial, tuple) else ()
        if not kinds or not all(isinstance(each, RadialPrior) for each in kinds):
            raise InvalidInput("Priors.radial must be a tuple of one fewcal.RadialPrior or more.")

    def focal(self, width: float) -> Distribution:
        """Prior of ln(fx / width), width in pixels, the user's own when there is one."""
        if self.focal_px is None:
            return self.log_focal_over_width
        mean, sd = self.focal_px
        return Normal(math.log(mean / width), sd / mean)

    def rows(self, image_size: tuple[int, int]) -> PriorRows:
        """Density of cameras with images of some width and height, pixels."""
        single = (
            self.focal(max(image_size)),
            self.log_aspect,
            self.principal_point_x,
            self.principal_point_y,
            self.tangential,
            self.tangential,
            self.board_bend,
            self.board_bend,
            self.lens_remainder,
            self.print_stretch,
        )
        mean, scale, nu = np.array([(d.mean, d.scale, d.nu) for d in single]).T
        mean[0] += math.log(max(image_size))
        centre_y = 2 if nu[2] == nu[3] else 3
        prior = np.unique([0, 1, 2, centre_y, 4, 4, 5, 6, 7, 8], return_inverse=True)[1]
        return PriorRows.of(mean, scale, nu, prior, self.radial, math.log(math.hypot(*image_size) / 2))


_SINGLE = (
    "log_focal_over_width",
    "log_aspect",
    "principal_point_x",
    "principal_point_y",
    "tangential",
    "board_bend",
    "lens_remainder",
    "print_stretch",
)
"""Fields of :class:`Priors` that are distributions of one number."""

FOCAL = "focal length"
PRIOR_ROWS = (
    FOCAL,
    "aspect ratio",
    "principal point x",
    "principal point y",
    "radial distortion",
    "radial distortion",
    "tangential distortion",
    "tangential distortion",
    "bend of the board",
    "bend of the board",
    "remainder of the lens",
    "stretch of the print",
)
"""What each unknown of :meth:`Priors.rows` is, camera first."""


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
