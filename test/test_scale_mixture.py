from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import gamma, qmc
from scipy.stats import t as student

from fewcal.scale_mixture import POINTS, Tails, _even_points, gamma_quantile, moments

Array = NDArray[np.float64]


def one(nu: float, z: float, scale: float = 1.0) -> Tails:
    """A prior of one unknown, whose estimate lies z scales from its centre."""
    return Tails(np.array([z]), np.array([[1 / scale]]), np.array([0]), np.array([nu]))


def integrated(nu: float, z: float, sd: float, off: float) -> float:
    """Second moment about the estimate of a t prior times a normal likelihood, by quadrature."""
    x = np.linspace(-200, 200, 400_001)
    density = student.pdf(x + z, nu) * np.exp(-0.5 * ((x + off) / sd) ** 2)
    return float((density * x**2).sum() / density.sum())


@pytest.mark.parametrize("shape", [0.5, 0.875, 1.25, 1.75, 5.0, 60.0])
def test_gamma_quantile(shape: float) -> None:
    share = np.linspace(0.002, 0.998, 99)
    np.testing.assert_allclose(gamma_quantile(share, shape), gamma.ppf(share, shape), rtol=1e-3)


@pytest.mark.parametrize("dimension", [1, 4, 9])
def test_points_spread_more_evenly_than_random_ones(dimension: int) -> None:
    points = _even_points(POINTS, dimension)
    assert points.shape == (POINTS, dimension)
    assert ((points > 0) & (points < 1)).all()
    random = np.random.default_rng(0).uniform(size=points.shape)
    assert qmc.discrepancy(points) < 0.7 * qmc.discrepancy(random)


@pytest.mark.parametrize("nu", [1.25, 2.0, 3.0, 30.0])
@pytest.mark.parametrize(
    ("z", "sd", "off"), [(0, 0.3, 0), (0, 1, 0), (0, 3, 0), (3, 0.5, 0.1), (-8, 1, -0.3)]
)
def test_moment_of_one_unknown_is_that_of_its_posterior(nu: float, z: float, sd: float, off: float) -> None:
    found = moments(np.array([[1 / sd]]), np.array([off / sd]), one(nu, z))
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(np.sqrt(integrated(nu, z, sd, off)), rel=0.08)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
@pytest.mark.parametrize("sd", [0.1, 0.5, 3.0])
def test_of_two_alternatives_each_counts_as_it_is_likely(share: float, sd: float) -> None:
    # Two t, one of them three times as wide, both at some distance from the estimate.
    nu, scale, z = np.array([2.0, 5.0]), np.array([0.3, 0.9]), np.array([1.0, -1.5])
    height = np.log(np.array([share, 1 - share]) / scale)
    tails = Tails(z, 1 / scale[:, None], np.array([0, 1]), nu, height)
    # The density at the mean of a t in one dimension depends on its nu, of a bivariate one it does not.
    tails = tails._replace(height=height + [student.logpdf(0, each) for each in nu])
    found = moments(np.array([[1 / sd]]), np.array([0.2 / sd]), tails)
    x = np.linspace(-60, 60, 400_001)
    density = sum(
        part * student.pdf(x / s + at, n) / s
        for part, s, at, n in zip((share, 1 - share), scale, z, nu, strict=True)
    ) * np.exp(-0.5 * ((x + 0.2) / sd) ** 2)
    expected = np.sqrt((density * x**2).sum() / density.sum())
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(expected, rel=0.1)


def test_a_normal_prior_is_exact() -> None:
    found = moments(np.array([[2.0]]), np.array([0.0]), one(np.inf, 0.0, 0.5))
    assert found.covariance[0, 0] == pytest.approx(1 / 8, rel=1e-12)
    np.testing.assert_array_equal(found.precision, [1])


def test_units_do_not_matter() -> None:
    rng = np.random.default_rng(1)
    J, r, K, z = rng.normal(size=(9, 4)), rng.normal(size=9), rng.normal(size=(4, 4)), rng.normal(size=4)
    group, nu = np.array([0, 1, 1, 2]), np.array([2.0, 3.0, np.inf])
    unit = np.array([1e-6, 1.0, 1e3, 1e5])
    plain = moments(J, r, Tails(z, K, group, nu))
    scaled = moments(J / unit, r, Tails(z, K / unit, group, nu))
    np.testing.assert_allclose(scaled.covariance, plain.covariance * np.outer(unit, unit), rtol=1e-9)
    np.testing.assert_allclose(scaled.precision, plain.precision, rtol=1e-9)
    assert plain.precision[1] == plain.precision[2], "rows of one distribution share its precision"


def test_a_prior_that_the_data_contradict_is_taken_for_wide() -> None:
    J, r = np.array([[10.0]]), np.zeros(1)
    precision = [moments(J, r, one(2.0, z)).precision[0] for z in (0.0, 2.0, 20.0)]
    np.testing.assert_allclose(precision, [3 / 2, 3 / 6, 3 / 402], rtol=0.1)


def test_almost_dependent_columns_where_normal_equations_fail() -> None:
    J = np.array([[1e9, 1e9], [1e9, 1e9 + 1.0]])
    wide = Tails(np.zeros(2), np.eye(2) * 1e-3, np.arange(2), np.array([np.inf, np.inf]))
    found = moments(J, np.zeros(2), wide).covariance
    assert found[0, 0] == pytest.approx(2, rel=1e-4)


def test_what_nothing_holds_is_infinitely_uncertain() -> None:
    tails = Tails(np.zeros(1), np.array([[1.0, 0.0]]), np.array([0]), np.array([2.0]))
    assert np.isinf(moments(np.zeros((3, 2)), np.zeros(3), tails).covariance).all()
