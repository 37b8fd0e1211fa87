"""The radial distortion that lenses have: there are kinds of them, some nearly straight, some with a barrel.

With rc = half the image diagonal / fx, the scale-free radial terms are a1 = k1 rc^2 and a2 = k2 rc^4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .checks import is_covariance, require_numbers, require_pair
from .errors import InvalidInput

Array = NDArray[np.float64]
Pair = tuple[float, float]

WIDEST = 2.0
"""Largest rc up to which the mean follows the focal length, 127 deg across the diagonal."""
GROWTH = np.array([1.5, 2.0])
"""Powers of rc with which a1 and a2 of lenses with a barrel grow. Those of one k1 and k2, 2 and 4, make the
cameras of repositories left out of the fit 1.3 times less likely in the mean."""


@dataclass(frozen=True)
class RadialPrior:
    """Bivariate t of (a1, a2) of one kind of lenses.

    Its mean is (a1, a2) = `terms` + `growth` (rc^1.5, rc^2): lenses that are nearly straight lie about one
    point, those with a barrel the farther out the shorter they are.

    Parameters
    ----------
    nu : float
    covariance : (2, 2) scale matrix, as nested tuples
    terms : (2,) of a1 and a2
    growth : (2,) of a1 and a2 with the powers :data:`GROWTH` of rc
    share : float
        Of the lenses, relative to that of the other kinds.
    """

    nu: float
    covariance: tuple[Pair, Pair]
    terms: Pair = (0.0, 0.0)
    growth: Pair = (0.0, 0.0)
    share: float = 1.0

    def __post_init__(self) -> None:
        require_numbers("RadialPrior", [], positive=[self.nu, self.share])
        require_pair("RadialPrior.terms", self.terms)
        require_pair("RadialPrior.growth", self.growth)
        if not is_covariance(self.covariance):
            raise InvalidInput("RadialPrior.covariance must be a symmetric positive definite 2x2 matrix.")
        for name in ("terms", "growth"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))
        object.__setattr__(self, "covariance", tuple(tuple(map(float, row)) for row in self.covariance))


LENSES = (
    RadialPrior(1.5, ((0.00117, -0.00075), (-0.00075, 0.00086)), terms=(0.012, -0.0161), share=0.61),
    RadialPrior(3.0, ((0.00099, -0.00033), (-0.00033, 0.00016)), growth=(-0.294, 0.078), share=0.39),
)
"""Fitted on 216 real cameras (`experiments/radial_prior.py`)."""


class Lenses(NamedTuple):
    """All kinds of lenses in one set of arrays.

    Attributes
    ----------
    share : (C,) which sum to 1
    covariance : (C, 2, 2)
    terms, growth : (C, 2)
    """

    share: Array
    covariance: Array
    terms: Array
    growth: Array

    @classmethod
    def of(cls, kinds: tuple[RadialPrior, ...]) -> Lenses:
        """Gather them."""
        share, covariance, terms, growth = (
            np.array([getattr(kind, name) for kind in kinds])
            for name in ("share", "covariance", "terms", "growth")
        )
        return cls(share / share.sum(), covariance, terms, growth)

    def means(self, corner: Array) -> tuple[Array, Array]:
        """Mean (..., C, 2) of (a1, a2) of each kind with some rc (...), and its derivative by ln fx."""
        growth = powers(corner)[..., None, :] * self.growth
        slope = np.where(corner < WIDEST, -1.0, 0.0)[..., None, None] * growth * GROWTH
        return self.terms + growth, slope


def powers(corner: Array) -> Array:
    """rc^1.5 and rc^2 (..., 2) for some rc (...), up to the widest."""
    found: Array = np.minimum(corner, WIDEST)[..., None] ** GROWTH
    return found
