from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import CAMERA, SIZE, differences, noisy, views_at

from fewcal.adjustment import Rows
from fewcal.camera import Camera
from fewcal.constraints import Priors
from fewcal.map_estimator import estimate_map
from fewcal.posterior import (
    NAMES,
    Posterior,
    covariance_from_rows,
    determined_share,
    gaussian_covariance,
    posterior,
    projection_std,
)
from fewcal.tails import Tails
from fewcal.views import stack_views

Array = NDArray[np.float64]


def random_rows(seed: int, views: int = 3, points: int = 12, size: int = 8) -> Rows:
    """Rows of a random problem; units of the unknowns differ by decades."""
    rng = np.random.default_rng(seed)
    units, pose_units = 10.0 ** rng.uniform(-3, 3, size), 10.0 ** rng.uniform(-3, 3, 6)
    return Rows(
        rng.normal(size=(views, 2 * points)),
        rng.normal(size=(views, 2 * points, size)) * units,
        rng.normal(size=(views, 2 * points, 6)) * pose_units,
    )


def random_prior(rows: Rows) -> Array:
    """(8, S) rows of a prior in the units of the others."""
    return np.random.default_rng(9).normal(size=(8, 8)) * np.linalg.norm(rows.by_camera, axis=(0, 1)) / 8


def dense(rows: Rows, prior: Array) -> Array:
    """Jacobian of everything: the camera's unknowns first, then six for each view."""
    views, count, size = rows.by_camera.shape
    J = np.zeros((views * count + len(prior), size + 6 * views))
    for v in range(views):
        J[v * count : (v + 1) * count, :size] = rows.by_camera[v]
        J[v * count : (v + 1) * count, size + 6 * v : size + 6 * (v + 1)] = rows.by_pose[v]
    J[views * count :, :size] = prior
    return J


def inverse(information: Array) -> Array:
    """Inverse of a symmetric matrix, scaled to a unit diagonal first."""
    scale = 1 / np.sqrt(np.diagonal(information))
    return np.linalg.inv(information * scale[:, None] * scale) * scale[:, None] * scale


def assert_alike(found: Array, expected: Array, tolerance: float = 1e-8) -> None:
    """Agreement of two covariances in units of the standard deviations."""
    scale = 1 / np.sqrt(np.diagonal(expected))
    np.testing.assert_allclose(
        found * scale[:, None] * scale, expected * scale[:, None] * scale, atol=tolerance
    )


# --- covariance of rows ------------------------------------------------------------------------------------


@given(st.integers(0, 10_000))
def test_covariance_from_rows_inverts_the_information(seed: int) -> None:
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(20, 5)) * 10.0 ** rng.uniform(-6, 6, 5)
    assert_alike(covariance_from_rows(J), inverse(J.T @ J))


def test_covariance_of_almost_dependent_columns_where_normal_equations_fail() -> None:
    # Two unknowns whose difference the rows hold by 1e-9 only: J'J is singular in double precision.
    J = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-9], [1.0, 1.0 - 1e-9]])
    assert covariance_from_rows(J)[0, 0] == pytest.approx(1 / (2 * 1e-18), rel=1e-5)


@pytest.mark.parametrize(
    "J",
    [
        np.array([[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]),
        np.array([[1.0, 2.0], [2.0, 4.0], [-1.0, -2.0]]),
        np.ones((1, 2)),
        np.zeros((0, 2)),
    ],
)
def test_what_no_row_holds_is_infinitely_uncertain(J: Array) -> None:
    assert np.isinf(covariance_from_rows(J)).all()


# --- poses eliminated --------------------------------------------------------------------------------------


@pytest.mark.parametrize("points", [4, 6, 7, 12])
def test_gaussian_covariance_is_the_camera_block_of_the_whole_covariance(points: int) -> None:
    rows = random_rows(5, points=points)
    J = dense(rows, random_prior(rows))
    assert_alike(gaussian_covariance(rows, random_prior(rows)), inverse(J.T @ J)[:8, :8], 1e-6)


def at_the_mode(rows: Rows, nu: float) -> tuple[Rows, Tails]:
    """Residuals of nothing, and heavy-tailed priors."""
    tails = Tails(np.zeros(8), random_prior(rows), np.arange(8), np.full(8, nu))
    return rows._replace(r=np.zeros_like(rows.r)), tails


def test_posterior_with_normal_priors_is_the_gaussian_one() -> None:
    rows, tails = at_the_mode(random_rows(6), np.inf)
    found = posterior(rows, tails, tails.by_unknowns)
    K = random_prior(rows)
    assert_alike(found.covariance, gaussian_covariance(rows, K), 1e-6)
    assert_alike(found.prior_covariance, inverse(K.T @ K), 1e-6)
    assert_alike(found.covariance, inverse(found.prior + found.views.sum(axis=0)), 1e-6)


def test_a_posterior_away_from_the_mode_counts_the_distance() -> None:
    rows, tails = at_the_mode(random_rows(6), np.inf)
    off = (
        posterior(random_rows(6), tails, tails.by_unknowns).covariance
        - posterior(rows, tails, tails.by_unknowns).covariance
    )
    values = np.linalg.eigvalsh(off / np.sqrt(np.outer(np.diagonal(off), np.diagonal(off))))
    np.testing.assert_allclose(values, [0] * 7 + [8], atol=1e-6)


def test_a_view_that_says_nothing_determines_nothing() -> None:
    rows, tails = at_the_mode(random_rows(7), 2.0)
    silent = rows._replace(by_camera=np.zeros_like(rows.by_camera), by_pose=np.zeros_like(rows.by_pose))
    result = posterior(silent, tails, tails.by_unknowns)
    assert (np.diagonal(result.covariance) > np.diagonal(result.prior_covariance)).all()
    np.testing.assert_array_equal(determined_share(result), 0)


def test_determined_share_is_the_variance_that_the_data_removed() -> None:
    nothing = np.zeros((0, 2, 2))
    result = Posterior(np.diag([1.0, 4.0]), np.diag([4.0, 4.0]), nothing, np.zeros((2, 2)), np.zeros(2))
    np.testing.assert_allclose(determined_share(result), [0.75, 0])
    # A variance that the tails have made larger than the prior's.
    np.testing.assert_array_equal(determined_share(result._replace(covariance=np.diag([1.0, 9]))), [0.75, 0])


# --- priors against everything else ------------------------------------------------------------------------


def test_only_normal_priors_are_held_against_the_rest() -> None:
    rows = random_rows(3)
    nu = np.array([np.inf, 2, 2, 2, 2, 2, 2, 2])
    tails = Tails(np.ones(8), random_prior(rows), np.arange(8), nu)
    found = posterior(rows, tails, tails.by_unknowns).against_prior
    assert found[0] != 0
    np.testing.assert_array_equal(found[1:], 0)


def test_what_was_known_beforehand_counts_all_kinds_of_lenses_and_how_far_out_the_camera_lies() -> None:
    rows = random_rows(3, size=12)
    # The views are sure of the camera, to 0.001 of each unknown; else they would not hold it far out.
    sure = 1e3 * rows.by_camera / np.linalg.norm(rows.by_camera, axis=(0, 1))
    rows = rows._replace(r=np.zeros_like(rows.r), by_camera=sure)
    known = Priors().rows(SIZE)
    found, far = (
        posterior(rows, known.tails(theta), known.normal(theta))
        for theta in (np.array([7.0, aspect, *np.zeros(10)]) for aspect in (0.0, 0.1))
    )
    normal = known.normal(np.array([7.0, *np.zeros(11)]))
    np.testing.assert_allclose(found.prior_covariance, covariance_from_rows(normal))
    np.testing.assert_allclose(far.prior_covariance, found.prior_covariance)
    assert far.prior[1, 1] < 0.01 * found.prior[1, 1], "a t prior that has given way holds no more"
    np.testing.assert_allclose(far.prior[4:6, 4:6], found.prior[4:6, 4:6])


# --- camera and board --------------------------------------------------------------------------------------


def test_an_estimate_leaves_more_open_than_its_curvature_says() -> None:
    views = stack_views(noisy(views_at((40.0, 20.0)), 0.2, 1))
    found = estimate_map(views, SIZE, Priors())
    rows = found.adjustment.rows(found.geometry, found.sigma)
    known, theta = Priors().rows(SIZE), found.geometry.theta[0]
    result = posterior(rows, known.tails(theta), known.normal(theta))
    assert result.covariance.shape == (12, 12)
    laplace = gaussian_covariance(rows, Priors().rows(SIZE)(found.geometry.theta)[1][0])
    ratio = np.sqrt(np.diagonal(result.covariance) / np.diagonal(laplace))
    assert ((ratio > 1) & (ratio < 6)).all()
    # The tails of the priors add something to what the mean of their precisions leaves.
    typical = inverse(result.prior + result.views.sum(axis=0))
    assert np.sqrt(result.covariance[0, 0] / typical[0, 0]) == pytest.approx(1.2, abs=0.2)


# --- projection error --------------------------------------------------------------------------------------


def test_projection_std_is_the_spread_of_projections_of_a_fixed_direction() -> None:
    pixels = np.array([[0.0, 0.0], [640.0, 470.0], [1279.0, 959.0], [300.0, 900.0]])
    sd = np.array([10.0, 9.0, 3.0, 4.0, 0.01, 0.02, 0.0004, 0.0003])
    rng = np.random.default_rng(8)
    mix = np.eye(8) + 0.3 * rng.normal(size=(8, 8))
    root = sd[:, None] * mix
    rays = CAMERA.unproject(pixels)

    def project(values: Array) -> Array:
        camera = Camera(*values[:4], np.append(values[4:], 0.0))
        return camera.project(rays)

    at = np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]])
    J = differences(project, at, 1e-4 * sd)
    spread = J @ root @ root.T @ np.swapaxes(J, -1, -2)
    expected = np.sqrt(np.linalg.eigvalsh(spread)[:, -1])
    found = projection_std(CAMERA, root @ root.T, pixels)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_projection_std_of_a_principal_point_alone_is_the_same_everywhere() -> None:
    covariance = np.zeros((8, 8))
    covariance[2, 2], covariance[3, 3] = 9.0, 4.0
    pixels = np.random.default_rng(9).uniform([0, 0], np.array(SIZE) - 1, (20, 2))
    np.testing.assert_allclose(projection_std(CAMERA, covariance, pixels), 3)


def test_projection_std_of_what_is_unknown_and_of_what_has_no_ray() -> None:
    corner = np.array([[0.0, 0.0], [640.0, 480.0]])
    assert np.isinf(projection_std(CAMERA, np.full((8, 8), np.inf), corner)).all()
    folded = Camera(600.0, 600.0, 640.0, 480.0, [-0.4, 0, 0, 0, 0])
    np.testing.assert_array_equal(np.isnan(projection_std(folded, np.eye(8), corner)), [True, False])


def test_names() -> None:
    assert NAMES == ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
