from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, SIZE, geometry, noisy, pose, view, views_at

from fewcal.adjustment import Adjustment, Geometry
from fewcal.camera import Camera
from fewcal.constraints import Priors
from fewcal.least_squares import Stop
from fewcal.map_estimator import (
    ABSORBED,
    CORRELATION,
    ENUMERATED_VIEWS,
    MODEL_ERROR_PX,
    _scatter,
    _starts,
    estimate_map,
    point_sigma,
)
from fewcal.parametrisation import ScaleFree
from fewcal.views import View, stack_views

Array = NDArray[np.float64]

FREE = ScaleFree(SIZE)
TILTS = ((40, 30), (35, 120), (30, -60), (20, 80), (45, 200))
THETA = FREE.theta(np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]]))


def at_the_truth(sigma: float, seed: int, priors: Priors = Priors()) -> tuple[Adjustment, Geometry]:
    """Two views with noise, and the true camera and poses."""
    stack = stack_views(noisy(views_at(*TILTS[:2]), sigma, seed))
    problem = Adjustment(stack, FREE, lambda theta: priors.rows(theta, max(SIZE)), np.ones(1))
    return problem, Geometry(THETA[None], *geometry([pose(*tilt) for tilt in TILTS[:2]]))


# --- the noise ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [0.0, 1e-4, 0.02, 0.2, 3.0])
@pytest.mark.parametrize("prior", [(0.25, 1.0), (0.25, 0.1), (2.0, 0.3)])
def test_scatter_is_the_most_probable_one(sigma: float, prior: tuple[float, float]) -> None:
    priors = Priors(corner_sigma_px=prior)
    problem, at = at_the_truth(sigma, 1, priors)
    squares = float(problem.squares(at).sum())
    freedom = 2 * 108 - 2 * 6 - 8
    n = freedom / CORRELATION**2

    def negative_log(s: Array) -> Array:
        q = squares / freedom
        return n * (np.log(s) + q / (2 * s**2)) + 0.5 * (np.log(s / prior[0]) / prior[1]) ** 2

    found = _scatter(problem, at, priors)
    for factor in (0.99, 1.01):
        assert negative_log(found)[0] < negative_log(found * factor)[0]


def test_scatter_follows_the_residuals_and_a_firm_prior_holds_it() -> None:
    for sigma in (0.05, 0.2, 1.0):
        problem, at = at_the_truth(sigma, 2)
        assert _scatter(problem, at, Priors())[0] == pytest.approx(sigma, rel=0.2)
        firm = Priors(corner_sigma_px=(0.3, 1e-4))
        assert _scatter(problem, at, firm)[0] == pytest.approx(0.3, rel=0.01)


def test_point_sigma_adds_correlation_and_model_error() -> None:
    problem, at = at_the_truth(0.2, 3)
    scatter = _scatter(problem, at, Priors())[0]
    total = np.hypot(CORRELATION * scatter, MODEL_ERROR_PX)
    assert point_sigma(problem, at, Priors())[0] == pytest.approx(total)
    problem, at = at_the_truth(0.001, 3)
    scatter = _scatter(problem, at, Priors())[0]
    total = np.hypot(CORRELATION, ABSORBED) * scatter
    assert point_sigma(problem, at, Priors())[0] == pytest.approx(total)


def test_scatter_does_not_depend_on_the_sigma_it_started_from() -> None:
    problem, at = at_the_truth(0.2, 4)
    other = replace(problem, sigma=np.array([7.0]))
    np.testing.assert_allclose(_scatter(problem, at, Priors()), _scatter(other, at, Priors()))


# --- the starts --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_starts_combine_focal_lengths_with_both_poses_of_each_view(count: int) -> None:
    stack = stack_views(views_at(*TILTS[:count]))
    start = _starts(stack, FREE, Priors(focal_px=(1234.5, 10)))
    focal, times = np.unique(np.round(np.exp(start.theta[:, 0]), 6), return_counts=True)
    assert 1234.5 in focal
    assert focal.min() < 0.7 * 1280
    assert focal.max() > 4 * 1280
    assert (times == (2**count if count <= ENUMERATED_VIEWS else 2)).all()
    assert (start.position[..., 2] > 0).all()
    # One of them is near the truth.
    off = np.abs(start.rotation - geometry([pose(*tilt) for tilt in TILTS[:count]])[0]).max(axis=(1, 2, 3))
    assert off.min() < 0.05
    for v in range(count):
        angles = start.rotation[:, v] @ np.swapaxes(start.rotation[:1, v], -1, -2)
        assert np.trace(angles, axis1=1, axis2=2).min() < 1 + 2 * np.cos(np.radians(25)), "both poses occur"


def test_starts_of_a_board_in_another_plane_are_in_its_own_axes() -> None:
    turn = pose(50, 70, 20)[:3, :3]
    (flat,) = views_at(TILTS[0])
    start = _starts(stack_views([View(flat.object_points @ turn.T, flat.image_points)]), FREE, Priors())
    off = np.abs(start.rotation[:, 0] @ turn - pose(*TILTS[0])[:3, :3]).max(axis=(1, 2))
    assert off.min() < 0.05


# --- the estimate ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("span", [0.08, 0.15, 0.3])
def test_the_right_one_of_both_poses_is_found_for_boards_far_away(span: float) -> None:
    tilts = ((50, 10), (50, 100))
    poses = [pose(*tilt, span=span) for tilt in tilts]
    found = estimate_map(stack_views(noisy([view(T) for T in poses], 0.02, 5)), SIZE, Priors())
    for R, T in zip(found.geometry.rotation[0], poses, strict=True):
        assert np.degrees(np.arccos(min(1.0, (np.trace(R.T @ T[:3, :3]) - 1) / 2))) < 3
    fx = np.exp(found.geometry.theta[0, 0])
    assert fx == pytest.approx(1100, rel=0.1)


@pytest.mark.parametrize("f", [600.0, 5000.0])
def test_lenses_far_from_the_ordinary_are_found(f: float) -> None:
    lens = Camera(f, f, 639.5, 479.5)
    found = estimate_map(
        stack_views(noisy(views_at((45, 30), (40, 120), camera=lens), 0.1, 6)), SIZE, Priors()
    )
    assert np.exp(found.geometry.theta[0, 0]) == pytest.approx(f, rel=0.03)


def test_the_estimate_is_a_minimum_at_its_own_noise() -> None:
    found = estimate_map(stack_views(noisy(views_at(*TILTS[:2]), 0.2, 7)), SIZE, Priors())
    assert found.stop in (Stop.GRADIENT, Stop.STEP, Stop.COST)
    assert found.adjustment.sigma.shape == (1,)
    expected = point_sigma(found.adjustment, found.geometry, Priors())
    np.testing.assert_allclose(found.adjustment.sigma, expected, rtol=0.01)
    cost = found.adjustment.linearise(found.geometry).cost[0]
    rng = np.random.default_rng(8)
    for _ in range(20):
        shared, local = rng.normal(scale=1e-4, size=(1, 8)), rng.normal(scale=1e-5, size=(1, 2, 6))
        nearby = found.adjustment.retract(found.geometry, shared, local)
        assert found.adjustment.linearise(nearby).cost[0] > cost


def test_the_true_camera_is_no_better_than_the_estimate() -> None:
    problem, at = at_the_truth(0.3, 9)
    found = estimate_map(problem.views, SIZE, Priors())
    judged = replace(problem, model=found.adjustment.model, sigma=found.adjustment.sigma)
    assert judged.linearise(found.geometry).cost[0] < judged.linearise(at).cost[0]
