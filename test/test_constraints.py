from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import assert_derivative, differences
from scipy.stats import multivariate_t
from scipy.stats import t as student

from fewcal.constraints import (
    ASPECT_TOLERANCE_PX,
    LARGEST_EXPONENT,
    PRIOR_ROWS,
    Distribution,
    Normal,
    Priors,
    RadialPrior,
    StudentT,
    exponential_penalty,
)
from fewcal.errors import InvalidInput

Array = NDArray[np.float64]

Z = np.concatenate([[0.0], *(s * np.geomspace(1e-9, 1e4, 80) for s in (1, -1))])
"""Standardised values from the middle of a prior to far beyond all cameras."""


# --- one number --------------------------------------------------------------------------------------------


def row(prior: Distribution, values: Array) -> tuple[Array, Array]:
    """Row of one prior and its derivative for some values of the unknown, here the aspect ratio."""
    theta = np.zeros((len(values), 8))
    theta[:, 1] = values
    r, J = Priors(log_aspect=prior).rows(1280)(theta)
    return r[:, 1], J[:, 1, 1]


@pytest.mark.parametrize(
    "prior", [Normal(-0.21, 0.4), StudentT(2.0, 0.0022), StudentT(3.0, 0.0134, 0.5), StudentT(1.25, 0.0011)]
)
def test_jacobian_of_one_row(prior: Distribution) -> None:
    for z in Z:
        # A step in proportion, so that both the flat middle and the long tail are resolved.
        step = 1e-5 * prior.scale * max(1.0, abs(z))
        value = np.array([prior.mean + z * prior.scale])
        slope = row(prior, value)[1]
        numeric = differences(lambda at: row(prior, at)[0], value, step)[0]
        np.testing.assert_allclose(slope, numeric, rtol=1e-5)


@given(nu=st.floats(0.5, 30), scale=st.floats(1e-4, 10), mean=st.floats(-1, 1))
def test_half_the_squared_row_of_a_t_prior_is_its_negative_log_density(
    nu: float, scale: float, mean: float
) -> None:
    values = mean + scale * Z
    r, _ = row(StudentT(nu, scale, mean), values)
    expected = student.logpdf(mean, nu, mean, scale) - student.logpdf(values, nu, mean, scale)
    np.testing.assert_allclose(0.5 * r**2, expected, rtol=1e-9, atol=1e-12)
    # Far out the density sees mean + scale z, which has lost some digits of z.
    np.testing.assert_array_equal(np.sign(r), np.sign(values - mean))


def test_a_t_prior_of_many_degrees_of_freedom_is_normal() -> None:
    values = np.linspace(-3, 3, 13)
    t, normal = row(StudentT(1e9, 0.4, 0.1), values), row(Normal(0.1, 0.4), values)
    np.testing.assert_allclose(t, normal, rtol=1e-6)


# --- radial distortion -------------------------------------------------------------------------------------


def radial_rows(prior: RadialPrior, values: Array) -> tuple[Array, Array]:
    """Rows (B, 2) and Jacobian (B, 2, 3) of the radial terms for ln(f / W), a1, a2."""
    theta = np.zeros((len(values), 8))
    theta[:, [0, 4, 5]] = values
    r, J = Priors(radial=prior).rows(1)(theta)
    assert (J[:, 4:6, [1, 2, 3, 6, 7]] == 0).all()
    return r[:, 4:6], J[:, 4:6][:, :, [0, 4, 5]]


def at_offset(prior: RadialPrior, log_focal: Array, w: Array) -> Array:
    """(B, 3) ln(f / W), a1, a2 that lie w (B, 2) standard deviations from the mean."""
    mean, _ = prior.mean(log_focal)
    return np.column_stack([log_focal, mean + w @ np.linalg.cholesky(np.array(prior.covariance)).T])


@pytest.mark.parametrize("size", [0.0, 1e-7, 1e-4, 1e-3, 2e-3, 0.1, 1.0, 5.0, 300.0])
@pytest.mark.parametrize("x", [-3.0, -1.01, -0.99, 0.0, 0.5, 0.99, 1.01, 3.0])
def test_jacobian_of_the_radial_rows_on_both_sides_of_the_clip_and_near_the_mean(
    size: float, x: float
) -> None:
    prior = RadialPrior()
    angle = np.linspace(0.1, 2 * np.pi, 7)
    w = size * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    values = at_offset(prior, np.full(7, math.log(prior.reference) + x), w)
    _, J = radial_rows(prior, values)
    numeric = differences(lambda at: radial_rows(prior, at)[0], values, 1e-6)
    np.testing.assert_allclose(J, numeric, atol=3e-6 * np.abs(numeric).max())
    if abs(x) > 1:
        assert (J[..., 0] == 0).all(), "beyond the clip the focal length has no say"
    else:
        assert np.abs(J[..., 0]).max() > 1e-3 / (1 + size)


@given(x=st.floats(-2, 2), nu=st.floats(0.5, 20), size=st.sampled_from([0.0, 1e-6, 1e-3, 0.3, 3.0, 100.0]))
def test_half_the_squared_radial_rows_are_the_negative_log_density(x: float, nu: float, size: float) -> None:
    prior = replace(RadialPrior(), nu=nu)
    log_focal = math.log(prior.reference) + x
    direction = np.array([[0.6, -0.8]])
    values = at_offset(prior, np.array([log_focal]), size * direction)
    r, _ = radial_rows(prior, values)
    mean = np.array(prior.intercept) + np.clip(x, -1, 1) * np.array(prior.slope)
    density = multivariate_t(mean, prior.covariance, df=nu)
    expected = density.logpdf(mean) - density.logpdf(values[0, 1:])
    np.testing.assert_allclose(0.5 * (r**2).sum(), expected, rtol=1e-7, atol=1e-12)


# --- all priors --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("focal_px", [None, (1200.0, 12.0)])
def test_jacobian_of_all_priors(focal_px: tuple[float, float] | None) -> None:
    rng = np.random.default_rng(1)
    priors = Priors(focal_px=focal_px)
    spread = np.array([0.4, 0.01, 0.05, 0.05, 0.2, 0.1, 0.005, 0.005, 0.001, 0.001, 0.02])
    theta = rng.normal(size=(20, 11)) * spread
    theta[:, 0] += math.log(1000)
    r, J = priors.rows(1280)(theta)
    without = priors.rows(1280)(theta[:, :8])
    np.testing.assert_allclose(without[0], r[:, :8], rtol=1e-12)
    np.testing.assert_allclose(without[1], J[:, :8, :8], rtol=1e-12)
    numeric = differences(lambda at: priors.rows(1280)(at)[0], theta, 1e-5 * spread)
    assert_derivative(J, numeric, 3e-7)


def random_cameras(spread: float) -> Array:
    """(20, 8) unknowns, drawn so many scales about the middle of the priors."""
    rng = np.random.default_rng(2)
    scale = np.array([0.4, 0.0022, 0.0134, 0.0154, 0.11, 0.04, 0.0011, 0.0011])
    middle = [math.log(1280 * 0.85), 0, 0, 0, -0.107, 0.0219, 0, 0]
    return middle + spread * scale * rng.uniform(-1, 1, (20, 8))


@pytest.mark.parametrize("spread", [0.0, 0.1, 1.0, 30.0])
def test_the_quadratic_model_has_value_and_slope_of_the_rows(spread: float) -> None:
    rows, theta = Priors().rows(1280), random_cameras(spread)
    r, J = rows(theta)
    model = rows.quadratic(theta)
    np.testing.assert_allclose(model[:, 8, 8], (r * r).sum(axis=1), rtol=1e-12)
    gradient = (r[:, None] @ J)[:, 0]
    np.testing.assert_allclose(model[:, 8, :8], gradient, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(model, np.swapaxes(model, 1, 2), rtol=1e-12, atol=1e-9)


def test_the_quadratic_model_has_the_curvature_of_the_density_near_the_middle() -> None:
    rows, theta = Priors().rows(1280), random_cameras(0.05)
    numeric = differences(lambda at: rows.quadratic(at)[:, 8, :8], theta, 1e-7)
    assert_derivative(rows.quadratic(theta)[:, :8, :8], numeric, 1e-5)


def test_the_quadratic_model_stays_convex_far_out() -> None:
    hessian = Priors().rows(1280).quadratic(random_cameras(30.0))[:, :8, :8]
    scale = np.sqrt(np.diagonal(hessian, axis1=1, axis2=2))
    assert np.linalg.eigvalsh(hessian / scale[:, None] / scale[:, :, None]).min() > 0.01


@pytest.mark.parametrize("column", range(8))
def test_each_row_speaks_of_what_it_is_named_after(column: int) -> None:
    names = ["focal length", "aspect ratio", "principal point x", "principal point y"]
    names += ["radial distortion"] * 2 + ["tangential distortion"] * 2
    theta = np.array([[math.log(1000), 0.001, 0.01, -0.02, -0.1, 0.02, 0.0005, -0.0003]])
    moved = theta.copy()
    moved[0, column] += 0.01
    changed = {
        PRIOR_ROWS[i] for i in np.flatnonzero(Priors().rows(1280)(theta)[0] != Priors().rows(1280)(moved)[0])
    }
    # A long lens is expected to distort less, so the focal length moves the radial rows as well.
    assert changed == {names[column]} | ({"radial distortion"} if column == 0 else set())


def test_tails_are_the_rows_before_the_gain_of_their_heavy_tails() -> None:
    theta = np.array([6.8, 0.004, 0.03, -0.02, -0.3, 0.2, 0.004, -0.001, 7e-4, -2e-4, 0.01])
    rows = Priors().rows(1280.0)
    tails = rows.tails(theta)
    np.testing.assert_allclose(tails.nu, [np.inf, 2, 3, 3, 2.5, 1.25, 1.25, 2, 2, 1])
    np.testing.assert_array_equal(tails.group, [0, 1, 2, 3, 4, 4, 5, 6, 7, 8, 9])
    alone = rows.tails(theta[:8])
    np.testing.assert_array_equal(alone.z, tails.z[:8])
    np.testing.assert_array_equal(alone.nu, tails.nu[:7])
    assert_derivative(tails.by_unknowns, differences(lambda x: rows.tails(x).z, theta, 1e-6), 1e-6)
    r, _ = rows(theta[None])
    together = np.bincount(tails.group, tails.z**2)
    dimension, nu = np.bincount(tails.group), np.where(np.isinf(tails.nu), 1e12, tails.nu)
    expected = (nu + dimension) * np.log1p(together / nu)
    np.testing.assert_allclose(np.bincount(tails.group, r[0] ** 2), expected, rtol=1e-3)


def test_the_users_own_focal_length_replaces_the_prior() -> None:
    theta = np.zeros((3, 8))
    theta[:, 0] = np.log([1200.0, 1212.0, 1188.0])
    r, _ = Priors(focal_px=(1200, 12)).rows(1280)(theta)
    np.testing.assert_allclose(r[:, 0], [0, 1, -1], atol=0.01)
    without, _ = Priors().rows(1280)(theta)
    np.testing.assert_array_equal(r[:, 1:], without[:, 1:])
    np.testing.assert_allclose(without[:, 0], (theta[:, 0] - math.log(1280) + 0.21) / 0.4)


def test_priors_can_be_replaced_one_by_one() -> None:
    for field in fields(Priors):
        if field.name in ("focal_px", "corner_sigma_px", "radial"):
            continue
        own = replace(Priors(), **{field.name: Normal(0.1, 0.2)})
        differs = own.rows(1280)(np.zeros((1, 11)))[0] != Priors().rows(1280)(np.zeros((1, 11)))[0]
        assert 1 <= differs.sum() <= 2, field.name


@pytest.mark.parametrize(
    "build",
    [
        lambda: Normal(0.0, 0.0),
        lambda: Normal(math.nan, 1.0),
        lambda: StudentT(0.0, 1.0),
        lambda: StudentT(3.0, -1.0),
        lambda: StudentT(3.0, math.inf),
        lambda: RadialPrior(nu=0.0),
        lambda: RadialPrior(reference=-1.0),
        lambda: RadialPrior(slope=(math.nan, 0.0)),
        lambda: RadialPrior(covariance=((1.0, 2.0), (2.0, 1.0))),
        lambda: Priors(focal_px=(1200.0, 0.0)),
        lambda: Priors(focal_px=(-1200.0, 10.0)),
        lambda: Priors(focal_px=(1200.0,)),  # type: ignore[arg-type]
        lambda: Priors(corner_sigma_px=(0.2, math.inf)),
        lambda: Priors(focal_px=1200.0),  # type: ignore[arg-type]
        lambda: Priors(focal_px=("1200", "12")),  # type: ignore[arg-type]
        lambda: Priors(log_aspect=0.01),  # type: ignore[arg-type]
        lambda: Priors(board_bend=None),  # type: ignore[arg-type]
        lambda: Priors(radial=Normal(0.0, 1.0)),  # type: ignore[arg-type]
        lambda: RadialPrior(slope=(0.0,)),  # type: ignore[arg-type]
        lambda: RadialPrior(covariance="wide"),  # type: ignore[arg-type]
        lambda: Normal(None, 1.0),  # type: ignore[arg-type]
        lambda: Normal(0.0, 1e-300),
    ],
)
def test_numbers_that_are_no_prior(build: object) -> None:
    with pytest.raises(InvalidInput):
        build()  # type: ignore[operator]


# --- the paper's constraint --------------------------------------------------------------------------------


def penalty(focal: Array, views: int) -> Array:
    return exponential_penalty(focal[:, 0], focal[:, 1], views)[0][:, None]


@pytest.mark.parametrize("views", [1, 2, 7])
def test_the_squared_row_is_the_constraint_of_eq_29_less_a_constant(views: int) -> None:
    d = np.linspace(-400, 400, 41)
    r, _ = exponential_penalty(1000 + d, np.full_like(d, 1000), views)
    expected = views * np.exp(d**2 / (2 * ASPECT_TOLERANCE_PX**2))
    np.testing.assert_allclose(r**2 + views, expected, rtol=1e-12)
    np.testing.assert_array_equal(np.sign(r), np.sign(d))


@pytest.mark.parametrize("d", [0.0, 1e-6, -0.01, 1.0, -30.0, 200.0, -450.0, 499.0])
def test_jacobian_of_the_constraint(d: float) -> None:
    focal = np.array([[1000 + d, 1000.0]])
    _, J = exponential_penalty(focal[:, 0], focal[:, 1], 3)
    numeric = differences(lambda at: penalty(at, 3), focal, 1e-3)[:, 0]
    np.testing.assert_allclose(J, numeric, rtol=1e-6)


def test_far_away_the_constraint_is_finite_and_points_back() -> None:
    limit = ASPECT_TOLERANCE_PX * math.sqrt(2 * LARGEST_EXPONENT)
    d = np.array([limit, 1e4, -1e4, 1e8])
    r, J = exponential_penalty(1000 + d, np.full_like(d, 1000), 2)
    np.testing.assert_allclose(np.abs(r), math.sqrt(2 * math.expm1(LARGEST_EXPONENT)))
    assert np.isfinite(J).all()
    assert (J[:, 0] > 0).all()
    np.testing.assert_array_equal(J[:, 1], -J[:, 0])
