from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import assert_derivative, differences
from scipy.special import logsumexp
from scipy.stats import multivariate_t
from scipy.stats import t as student

from fewcal.constraints import PRIOR_ROWS, Distribution, Normal, Priors, StudentT
from fewcal.posterior import covariance_from_rows
from fewcal.radial_prior import LENSES, RadialPrior

Array = NDArray[np.float64]

SIZE = (1280, 960)
CORNER = 800.0 / 1088.0
"""rc of the cameras below: half a diagonal of 1600 px over fx = 0.85 * 1280 px."""
Z = np.concatenate([[0.0], *(s * np.geomspace(1e-9, 1e4, 80) for s in (1, -1))])
"""Standardised values from the middle of a prior to far beyond all cameras."""


def cameras(column: int, values: Array) -> Array:
    """(B, 8) unknowns that differ in one."""
    theta = np.zeros((len(values), 8))
    theta[:, 0] = math.log(1088)
    theta[:, column] = values
    return theta


# --- one number --------------------------------------------------------------------------------------------


def own(prior: Distribution, values: Array) -> Array:
    """-2 ln of the density of one prior over its greatest, here of the aspect ratio."""
    theta = cameras(1, values)
    rows, without = Priors(log_aspect=prior).rows(SIZE), Priors(log_aspect=Normal(0, 1e30)).rows(SIZE)
    return rows.squares(theta) - without.squares(theta)


@given(nu=st.floats(0.5, 30), scale=st.floats(1e-4, 10), mean=st.floats(-1, 1))
def test_the_density_of_a_t_prior(nu: float, scale: float, mean: float) -> None:
    values = mean + scale * Z
    expected = student.logpdf(mean, nu, mean, scale) - student.logpdf(values, nu, mean, scale)
    np.testing.assert_allclose(0.5 * own(StudentT(nu, scale, mean), values), expected, rtol=1e-9, atol=1e-10)


def test_a_t_prior_of_many_degrees_of_freedom_is_normal() -> None:
    values = np.linspace(-3, 3, 13)
    np.testing.assert_allclose(own(StudentT(1e9, 0.4, 0.1), values), own(Normal(0.1, 0.4), values), rtol=1e-6)
    np.testing.assert_allclose(own(Normal(0.1, 0.4), values), ((values - 0.1) / 0.4) ** 2, rtol=1e-9)


# --- radial distortion -------------------------------------------------------------------------------------


@given(
    a1=st.floats(-1, 1),
    a2=st.floats(-1, 1),
    stretch=st.floats(0.2, 4),
    share=st.floats(0.05, 0.95),
)
def test_the_density_of_the_radial_terms_is_that_of_the_mixture(
    a1: float, a2: float, stretch: float, share: float
) -> None:
    kinds = (replace(LENSES[0], share=share), replace(LENSES[1], share=1 - share))
    focal = 1088 * stretch
    theta = np.array([[math.log(focal), 0, 0, 0, a1, a2, 0, 0]])

    def log_density(at: Array) -> float:
        corner = min(CORNER / stretch, 2.0)
        power = np.array([corner**1.5, corner**2])
        means = [np.array(kind.terms) + np.array(kind.growth) * power for kind in kinds]
        parts = [
            np.log(kind.share) + multivariate_t(mean, kind.covariance, df=kind.nu).logpdf(at)
            for kind, mean in zip(kinds, means, strict=True)
        ]
        return float(logsumexp(parts))

    rows = Priors(radial=kinds).rows(SIZE)
    moved = theta + np.array([[0, 0, 0, 0, 0.03, -0.02, 0, 0]])
    found = 0.5 * (rows.squares(moved) - rows.squares(theta))[0]
    expected = log_density(theta[0, 4:6]) - log_density(moved[0, 4:6])
    assert found == pytest.approx(expected, rel=1e-7, abs=1e-9)


def test_one_kind_of_lenses_is_a_t() -> None:
    kind = RadialPrior(2.5, ((0.01, -0.003), (-0.003, 0.002)), (-0.1, 0.02))
    rows = Priors(radial=(kind,)).rows(SIZE)
    theta = np.array([math.log(1088), 0, 0, 0, -0.1, 0.02, 0, 0])
    assert rows.distance(theta)[4] == pytest.approx(0, abs=1e-7)
    theta[4] += 0.3
    density = multivariate_t(kind.terms, kind.covariance, df=kind.nu)
    expected = 2 * (density.logpdf(kind.terms) - density.logpdf(theta[4:6]))
    assert rows.squares(theta[None])[0] == pytest.approx(expected + rows.distance(theta)[0] ** 2)


# --- all priors --------------------------------------------------------------------------------------------


def random_cameras(spread: float, size: int = 8) -> Array:
    """(20, size) unknowns, drawn so many scales about the middle of the priors."""
    rng = np.random.default_rng(2)
    scale = np.array([0.4, 0.0022, 0.0134, 0.0154, 0.06, 0.04, 0.0011, 0.0011, 5e-4, 5e-4, 0.008, 7e-4])
    middle = np.array([math.log(1280 * 0.85), 0, 0, 0, -0.05, 0.01, 0, 0, 0, 0, 0, 0])
    return (middle + spread * scale * rng.uniform(-1, 1, (20, 12)))[:, :size]


@pytest.mark.parametrize("size", [8, 12])
@pytest.mark.parametrize("spread", [0.1, 1.0, 30.0])
def test_the_quadratic_model_has_value_and_slope_of_the_density(spread: float, size: int) -> None:
    rows, theta = Priors().rows(SIZE), random_cameras(spread, size)
    model = rows.quadratic(theta)
    np.testing.assert_allclose(model[:, size, size], rows.squares(theta), rtol=1e-12)
    step = 1e-5 * np.ptp(theta, axis=0)
    numeric = differences(lambda at: 0.5 * rows.squares(at), theta, step)
    assert_derivative(model[:, size, :size], numeric, 1e-6)
    np.testing.assert_allclose(model, np.swapaxes(model, 1, 2), rtol=1e-12, atol=1e-9)


def test_the_rows_have_the_slope_of_the_density() -> None:
    rows, theta = Priors().rows(SIZE), random_cameras(2.0, 12)
    r, J = rows(theta)
    np.testing.assert_allclose(
        (r[:, None] @ J)[:, 0], rows.quadratic(theta)[:, 12, :12], rtol=1e-9, atol=1e-9
    )


def test_the_quadratic_model_has_the_curvature_of_the_density_near_the_middle_of_a_kind() -> None:
    rows = Priors(radial=LENSES[1:]).rows(SIZE)
    theta = random_cameras(0.05)
    theta[:, 4:6] += np.array([-0.294 * CORNER**1.5, 0.078 * CORNER**2]) - [-0.05, 0.01]
    numeric = differences(lambda at: rows.quadratic(at)[:, 8, :8], theta, 1e-7)
    assert_derivative(rows.quadratic(theta)[:, 4:8, 4:8], numeric[:, 4:8, 4:8], 1e-2)


@pytest.mark.parametrize("spread", [1.0, 30.0])
def test_the_quadratic_model_is_convex(spread: float) -> None:
    hessian = Priors().rows(SIZE).quadratic(random_cameras(spread))[:, :8, :8]
    scale = np.sqrt(np.diagonal(hessian, axis1=1, axis2=2))
    assert np.linalg.eigvalsh(hessian / scale[:, None] / scale[:, :, None]).min() > 1e-3


@pytest.mark.parametrize("column", range(8))
def test_each_distance_speaks_of_what_it_is_named_after(column: int) -> None:
    names = ["focal length", "aspect ratio", "principal point x", "principal point y"]
    names += ["radial distortion"] * 2 + ["tangential distortion"] * 2
    both = {"principal point x", "principal point y"}
    theta = np.array([math.log(1000), 0.001, 0.01, -0.02, -0.18, 0.04, 0.0005, -0.0003])
    moved = theta.copy()
    moved[column] += 0.01
    rows = Priors().rows(SIZE)
    differs = np.abs(rows.distance(theta) - rows.distance(moved)) > 1e-9
    # A long lens is expected to distort less, so the focal length moves the radial terms as well.
    expected = {names[column]} | ({"radial distortion"} if column == 0 else set())
    # And a centre that is off in x may well be off in y.
    expected |= both if names[column] in both else set()
    assert {PRIOR_ROWS[i] for i in np.flatnonzero(differs)} == expected


def test_tails_are_the_rows_of_each_prior() -> None:
    theta = np.array([6.8, 0.004, 0.03, -0.02, -0.3, 0.2, 0.004, -0.001, 7e-4, -2e-4, 0.01, 3e-4])
    rows = Priors().rows(SIZE)
    tails = rows.tails(theta)
    np.testing.assert_allclose(tails.nu, [1.5, 3, np.inf, 1.15, 1.7, 0.9, 2, 2, 1, 2])
    np.testing.assert_array_equal(tails.group, [0, 0, 2, 3, 4, 4, 1, 1, 5, 5, 6, 7, 8, 9])
    alone = rows.tails(theta[:8])
    np.testing.assert_array_equal(alone.z, tails.z[:10])
    np.testing.assert_array_equal(alone.nu, tails.nu[:6])
    assert_derivative(tails.by_unknowns, differences(lambda x: rows.tails(x).z, theta, 1e-6), 1e-6)
    together = np.bincount(tails.group, tails.z**2)[2:]
    nu = np.where(np.isinf(tails.nu), 1e12, tails.nu)[2:]
    expected = np.sqrt(nu * np.log1p(together / nu))
    np.testing.assert_allclose(rows.distance(theta)[[0, 1, 2, 6, 8, 9, 10, 11]], expected, rtol=1e-3)


@pytest.mark.parametrize("nu", [0.9, 1.7, 5.0])
def test_as_many_cameras_lie_farther_out_as_with_a_normal_prior(nu: float) -> None:
    rng = np.random.default_rng(4)
    drawn = rng.normal(size=(2000, 2)) * np.sqrt(nu / rng.chisquare(nu, (2000, 1)))
    rows = Priors(principal_point_x=StudentT(nu, 1.0), principal_point_y=StudentT(nu, 1.0)).rows(SIZE)
    theta = np.zeros(8)
    distance = np.array([rows.distance(np.concatenate([theta[:2], at, theta[4:]]))[2] for at in drawn])
    for bound in (1.0, 2.0, 2.5):
        assert (distance > bound).mean() == pytest.approx(math.exp(-(bound**2) / 2), abs=0.03)


def test_the_radial_terms_lie_as_far_out_as_from_the_nearest_kind_of_lenses() -> None:
    rows = Priors().rows(SIZE)
    theta = np.array([math.log(1088), 0, 0, 0, 0.012, -0.0161, 0, 0])
    assert rows.distance(theta)[4] == pytest.approx(0, abs=1e-7)
    theta[4:6] = -0.294 * CORNER**1.5, 0.078 * CORNER**2
    np.testing.assert_allclose(rows.distance(theta)[4:6], 0, atol=1e-7)
    nu, covariance = LENSES[1].nu, np.array(LENSES[1].covariance)
    step = np.array([0.02, 0.0])
    theta[4:6] += step
    expected = math.sqrt(nu * math.log1p(step @ np.linalg.inv(covariance) @ step / nu))
    np.testing.assert_allclose(rows.distance(theta)[4:6], expected)


@pytest.mark.parametrize("columns", [(2, 3), (6, 7)])
def test_two_unknowns_of_one_t_prior_have_its_density(columns: tuple[int, int]) -> None:
    priors = Priors()
    t = {2: priors.principal_point_x, 6: priors.tangential}[columns[0]]
    density = multivariate_t([0, 0], t.scale**2 * np.eye(2), df=t.nu)
    at = t.scale * np.array([[0, 0], [1, 0], [0.6, -0.8], [3, 20], [-100, 5]])
    theta = cameras(0, np.full(len(at), math.log(1088)))
    theta[:, columns] = at
    expected = density.logpdf([0, 0]) - density.logpdf(at)
    squares = priors.rows(SIZE).squares(theta)
    np.testing.assert_allclose(0.5 * (squares - squares[0]), expected, rtol=1e-9, atol=1e-9)


def test_a_centre_known_in_x_says_nothing_of_y() -> None:
    rows = Priors(principal_point_x=Normal(0.0, 0.001)).rows(SIZE)
    theta = np.array([math.log(1088), 0, 0.0, 0.02, 0, 0, 0, 0])
    moved = theta + 0.002 * (np.arange(8) == 2)
    expected = 2.0 * (np.arange(8) == 2)
    np.testing.assert_allclose(rows.distance(moved) - rows.distance(theta), expected, atol=1e-9)


def test_the_normal_prior_is_as_wide_as_the_kinds_of_lenses_together() -> None:
    theta = np.array([math.log(1088), 0, 0, 0, -0.1, 0.02, 0, 0])
    normal = Priors(log_focal_over_width=Normal(-0.16, 1e-6)).rows(SIZE).normal(theta)
    rng = np.random.default_rng(3)
    mean = np.array([[0.012, -0.0161], [-0.294 * CORNER**1.5, 0.078 * CORNER**2]])
    drawn = [
        rng.multivariate_normal(mean[i], LENSES[i].covariance, int(1e5 * LENSES[i].share)) for i in (0, 1)
    ]
    expected = np.cov(np.concatenate(drawn).T)
    np.testing.assert_allclose(covariance_from_rows(normal)[4:6, 4:6], expected, rtol=0.03)


@pytest.mark.parametrize("factor", [1.0, 20.0])
def test_widened_t_priors_of_the_camera_are_those_of_a_larger_scale(factor: float) -> None:
    def wide(prior: Distribution) -> Distribution:
        return StudentT(prior.nu, factor * prior.scale, prior.mean) if isinstance(prior, StudentT) else prior

    own = Priors(log_aspect=StudentT(2.0, 0.003, mean=0.01), principal_point_y=Normal(0.0, 0.02))
    larger = {
        name: wide(getattr(own, name))
        for name in (
            "log_aspect", "principal_point_x", "principal_point_y", "tangential",
        )
    }  # fmt: skip
    cameras = np.random.default_rng(3).normal(0, 0.05, (5, 12))
    expected = replace(own, **larger).rows((1280, 960)).squares(cameras)
    np.testing.assert_allclose(own.rows((1280, 960)).widened(factor).squares(cameras), expected, rtol=1e-12)


def test_the_normal_prior_of_one_kind_of_lenses_is_that_kind() -> None:
    theta = np.array([6.8, 0.004, 0.03, -0.02, -0.3, 0.2, 0.004, -0.001, 7e-4, -2e-4, 0.01, 3e-4])
    known = Priors(radial=LENSES[1:]).rows(SIZE)
    np.testing.assert_allclose(known.normal(theta), known.tails(theta).by_unknowns, atol=1e-9)
