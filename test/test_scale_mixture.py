from __future__ import annotations

import warnings

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import gamma as gamma_function
from scipy.stats import gamma
from scipy.stats import t as student

from fewcal.scale_mixture import ORDER, _inverted, moments, whitened
from fewcal.tails import Tails

Array = NDArray[np.float64]


def one(nu: float, z: float, scale: float = 1.0) -> Tails:
    """A prior of one unknown, whose estimate lies z scales from its centre."""
    return Tails(np.array([z]), np.array([[1 / scale]]), np.array([0]), np.array([nu]))


def integrated(priors: list[tuple[float, float, float, float]], sd: float, off: float) -> float:
    """Standard deviation about the estimate of a mixture of t priors times a normal likelihood.

    By quadrature over the precision of each prior: share, nu, scale and z.
    """
    deviation = weight = 0.0
    for share, nu, scale, z in priors:
        logarithm = np.linspace(-40, 8, 100_001)
        each = np.exp(logarithm)
        of_prior = each / scale**2
        precision = 1 / sd**2 + of_prior
        mean = -(off / sd**2 + of_prior * z * scale) / precision
        exponent = off**2 / sd**2 + each * z**2 - precision * mean**2
        density = gamma.pdf(each, nu / 2, scale=2 / nu) * each  # of the logarithm
        likely = share * density * np.sqrt(of_prior / precision) * np.exp(-0.5 * exponent)
        deviation += float((likely * (1 / precision + mean**2) ** (ORDER / 2)).sum())
        weight += float(likely.sum())
    return float((deviation / weight) ** (1 / ORDER))


@pytest.mark.parametrize("nu", [1.25, 2.0, 3.0, 30.0])
@pytest.mark.parametrize(
    ("z", "sd", "off"), [(0, 0.3, 0), (0, 1, 0), (0, 3, 0), (3, 0.5, 0.1), (-8, 1, -0.3)]
)
def test_deviation_of_one_unknown_is_that_of_its_posterior(
    nu: float, z: float, sd: float, off: float
) -> None:
    found = moments(np.array([[1 / sd]]), np.array([off / sd]), one(nu, z))
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(
        integrated([(1.0, nu, 1.0, z)], sd, off), rel=0.02
    )


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
    expected = integrated(list(zip((share, 1 - share), nu, scale, z, strict=True)), sd, 0.2)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_of_a_narrow_and_a_wide_alternative_each_counts_as_it_is_likely(share: float) -> None:
    nu, scale, sd = np.array([3.0, 3.0]), np.array([0.3, 4.0]), 3.0
    height = np.log(np.array([share, 1 - share]) / scale)
    tails = Tails(np.zeros(2), 1 / scale[:, None], np.array([0, 1]), nu, height)
    found = moments(np.array([[1 / sd]]), np.zeros(1), tails)
    expected = integrated(list(zip((share, 1 - share), nu, scale, np.zeros(2), strict=True)), sd, 0.0)
    assert np.sqrt(found.covariance[0, 0]) == pytest.approx(expected, rel=0.04)


@pytest.mark.parametrize("nu", [3.0, 5.0, 30.0])
def test_one_and_two_sigma_hold_nearly_what_they_do_of_a_normal_distribution(
    nu: float,
) -> None:
    sd = np.sqrt(moments(np.array([[1e-3]]), np.zeros(1), one(nu, 0.0)).covariance[0, 0])
    mean = (nu / 2) ** (ORDER / 2) * gamma_function((nu - ORDER) / 2) / gamma_function(nu / 2)
    assert sd == pytest.approx(mean ** (1 / ORDER), rel=0.02)
    within = 2 * student.cdf(sd * np.array([1, 2]), nu) - 1
    assert within == pytest.approx([0.68, 0.95], abs=0.09)
    by_root_mean_square = 2 * student.cdf(np.sqrt(nu / (nu - 2)), nu) - 1
    assert within[0] <= by_root_mean_square + 0.002


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


@pytest.mark.parametrize("size", [1, 2, 5, 9])
def test_many_matrices_are_inverted_at_once(size: int) -> None:
    X = np.random.default_rng(size).normal(size=(7, size, size))
    A = X @ np.swapaxes(X, 1, 2) + np.eye(size)
    inverse, log_determinant = _inverted(np.moveaxis(A, 0, -1).copy())
    np.testing.assert_allclose(np.moveaxis(inverse, -1, 0), np.linalg.inv(A), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(log_determinant, np.linalg.slogdet(A)[1], rtol=1e-9)


def test_columns_that_depend_on_each_other_have_no_inverse() -> None:
    J = np.array([[1.0, 2.0], [2.0, 4.0], [-1.0, -2.0]])
    assert np.isinf(whitened(J, np.zeros(3))[1]).all()


def test_a_camera_beyond_all_cameras_is_infinitely_uncertain() -> None:
    # The estimate lies where no prior holds, and the data do not say that it does.
    z = np.array([1e14, -1e11, 3.0])
    tails = Tails(z, np.array([[1e14, 1e9, 0], [1e9, 1e3, 1], [1, 1, 1.0]]), np.arange(3), np.full(3, 1.5))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = moments(np.full((4, 3), 1e-9), np.zeros(4), tails)
    assert np.isinf(found.covariance).all()
