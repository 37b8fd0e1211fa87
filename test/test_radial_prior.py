from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import differences

from fewcal.errors import InvalidInput
from fewcal.radial_prior import LENSES, WIDEST, Lenses, RadialPrior, powers

Array = NDArray[np.float64]
ROUND = ((1.0, 0.0), (0.0, 1.0))


def test_a_kind_lies_about_its_terms_and_grows_with_the_corner() -> None:
    kinds = (RadialPrior(2.0, ROUND, (0.1, -0.2), share=3.0), RadialPrior(2.0, ROUND, growth=(-0.3, 0.05)))
    lenses = Lenses.of(kinds)
    np.testing.assert_allclose(lenses.share, [0.75, 0.25])
    means, slopes = lenses.means(np.array([0.5, 0.8]))
    np.testing.assert_allclose(means[:, 0], [[0.1, -0.2]] * 2)
    np.testing.assert_allclose(means[1, 1], [-0.3 * 0.8**1.5, 0.05 * 0.8**2])
    assert (slopes[:, 0] == 0).all()


@pytest.mark.parametrize("corner", [0.01, 0.4, 1.0, 1.99, 2.01, 30.0])
def test_slope_by_the_focal_length(corner: float) -> None:
    log_focal = np.zeros(1)

    def means(at: Array) -> Array:
        return Lenses.of(LENSES).means(corner / np.exp(at))[0]

    slope = Lenses.of(LENSES).means(np.array([corner]))[1]
    np.testing.assert_allclose(slope[0], differences(means, log_focal, 1e-6)[0, ..., 0], atol=1e-8)
    assert (slope[0] == 0).all() == (corner > WIDEST)


def test_powers_end_where_lenses_do() -> None:
    np.testing.assert_allclose(powers(np.array([0.5, 5.0])), [[0.5**1.5, 0.25], [WIDEST**1.5, WIDEST**2]])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("nu", 0.0),
        ("nu", math.inf),
        ("share", 0.0),
        ("terms", (math.nan, 0.0)),
        ("growth", (0.0, math.inf)),
        ("covariance", ((1.0, 2.0), (2.0, 1.0))),
    ],
)
def test_numbers_that_are_no_prior(name: str, value: object) -> None:
    with pytest.raises(InvalidInput):
        RadialPrior(**{"nu": 2.0, "covariance": ROUND, name: value})  # type: ignore[arg-type]
