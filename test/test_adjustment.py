from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import BOARD, CAMERA, SIZE, assert_derivative, differences, geometry, pose, view
from scipy.spatial.transform import Rotation

from fewcal.adjustment import Adjustment, Geometry, rotation_from_vector
from fewcal.boards import Chessboard
from fewcal.constraints import Priors
from fewcal.parametrisation import PixelModel, ScaleFree
from fewcal.views import View, stack_views

Array = NDArray[np.float64]

FREE = ScaleFree(SIZE)
SMALL = Chessboard(5, 4, 0.04)
"""Fewer points than the other board, so that its view is padded."""
POSES = [pose(40, 20), pose(35, 130, 60, points=SMALL.points)]
VIEWS = stack_views([view(POSES[0]), view(POSES[1], SMALL.points)])
THETA = FREE.theta(np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]]))
PAPER = np.array([1100.0, 1120.0, 640.0, 480.0, 2.0, -1e-7, 2e-14, 3e-7, -5e-7])


def free_priors(theta: Array) -> tuple[Array, Array]:
    return Priors().rows(theta, max(SIZE))


def none(theta: Array) -> tuple[Array, Array]:
    return np.zeros((len(theta), 0)), np.zeros((len(theta), 0, theta.shape[1]))


def state(theta: Array) -> Geometry:
    """Two starts: the true poses, and poses a little off."""
    first, second = geometry(POSES[:1]), geometry(POSES[1:], SMALL.points)
    rotation, position = (np.concatenate(parts, axis=1) for parts in zip(first, second, strict=True))
    rng = np.random.default_rng(3)
    off = rotation_from_vector(rng.normal(scale=0.05, size=(1, 2, 3))) @ rotation
    shifted = position + rng.normal(scale=0.01, size=(1, 2, 3))
    return Geometry(theta, np.concatenate([rotation, off]), np.concatenate([position, shifted]))


CASES: list[tuple[Adjustment, Geometry, Array]] = [
    (
        Adjustment(VIEWS, FREE, free_priors, np.array([0.3, 0.5])),
        state(np.stack([THETA, THETA + 0.01])),
        np.full(8, 1e-6),
    ),
    (
        Adjustment(VIEWS, PixelModel(tangential=True), none, np.array([1.0, 0.2])),
        state(np.stack([PAPER, PAPER * 1.02])),
        1e-2 * np.array([1, 1, 1, 1, 1, 1e-7, 1e-13, 1e-5, 1e-5]),
    ),
]


@pytest.mark.parametrize(("problem", "at", "step"), CASES)
def test_jacobian_by_camera(problem: Adjustment, at: Geometry, step: Array) -> None:
    still = np.zeros((2, 2, 6))

    def rows(shared: Array) -> Array:
        return problem.rows(problem.retract(at, shared, still)).r

    zero = np.zeros((2, problem.model.size))
    assert_derivative(problem.rows(at).by_camera, differences(rows, zero, step))

    def prior(shared: Array) -> Array:
        return problem.rows(problem.retract(at, shared, still)).prior

    analytic = problem.rows(at).prior_by_camera
    # A step well below the width of the narrowest prior.
    numeric = differences(prior, zero, 1e-2 * step)
    assert analytic.shape == numeric.shape
    if analytic.size:
        assert_derivative(analytic, numeric, 1e-5)


@pytest.mark.parametrize(("problem", "at", "step"), CASES)
def test_jacobian_by_turn_and_shift_of_each_board(problem: Adjustment, at: Geometry, step: Array) -> None:
    def rows(local: Array) -> Array:
        return problem.rows(problem.retract(at, np.zeros((2, problem.model.size)), local)).r

    numeric = differences(rows, np.zeros((2, 2, 6)), 1e-6)
    assert_derivative(problem.rows(at).by_pose, numeric)


@pytest.mark.parametrize(("problem", "at", "step"), CASES)
def test_normal_equations_are_those_of_the_rows(problem: Adjustment, at: Geometry, step: Array) -> None:
    rows, found = problem.rows(at), problem.linearise(at)
    for b in range(2):
        J = np.concatenate([rows.by_camera[b].reshape(-1, problem.model.size), rows.prior_by_camera[b]])
        r = np.concatenate([rows.r[b].ravel(), rows.prior[b]])
        assert found.cost[b] == pytest.approx(0.5 * r @ r, rel=1e-12, abs=1e-20)
        np.testing.assert_allclose(found.H_shared[b], J.T @ J, rtol=1e-9, atol=1e-9 * np.abs(J.T @ J).min())
        np.testing.assert_allclose(found.g_shared[b], J.T @ r, rtol=1e-7, atol=1e-12 * np.abs(J.T @ J).max())
        for v in range(2):
            P = rows.by_pose[b, v]
            np.testing.assert_allclose(found.H_cross[b, v], rows.by_camera[b, v].T @ P, rtol=1e-7, atol=1e-3)
            np.testing.assert_allclose(found.H_local[b, v], P.T @ P, rtol=1e-9, atol=1e-3)
            np.testing.assert_allclose(found.g_local[b, v], P.T @ rows.r[b, v], rtol=1e-7, atol=1e-6)


def test_the_true_camera_leaves_no_residual_and_padding_none_at_all() -> None:
    problem, at, _ = CASES[0]
    rows = problem.rows(at)
    np.testing.assert_allclose(rows.r[0], 0, atol=1e-9)
    assert np.abs(rows.r[1]).max() > 1
    padded = 2 * len(SMALL.points)
    for part in (rows.r, rows.by_camera, rows.by_pose):
        assert (part[:, 1, padded:] == 0).all()
        assert (part[:, 0, padded:] != 0).any()


def test_rows_are_in_units_of_their_noise_and_squares_are_in_pixels() -> None:
    problem, at, _ = CASES[0]
    wider = replace(problem, sigma=2 * problem.sigma)
    np.testing.assert_allclose(wider.rows(at).r, problem.rows(at).r / 2)
    np.testing.assert_allclose(wider.squares(at), problem.squares(at))
    # The second start: camera and poses off by some pixels.
    r = problem.rows(at).r[1] * problem.sigma[1]
    np.testing.assert_allclose(problem.squares(at)[1], (r**2).sum(axis=1))


def test_relative_weights_of_points() -> None:
    sigma = np.where(np.arange(54) < 20, 0.1, 1.0)
    weighted = stack_views([View(BOARD.points, CAMERA.project(BOARD.points, POSES[0]), sigma)])
    even = stack_views([view(POSES[0])])
    at = Geometry(THETA[None] + 0.01, *geometry(POSES[:1]))
    r = [Adjustment(v, FREE, free_priors, np.ones(1)).rows(at).r.reshape(54, 2) for v in (weighted, even)]
    ratio = r[0] / r[1]
    np.testing.assert_allclose(ratio, ratio[[0] * 20 + [-1] * 34])
    assert ratio[0, 0] > 3 * ratio[-1, 0]


def test_a_board_behind_the_camera_is_not_allowed() -> None:
    problem, at, _ = CASES[0]
    behind = at.position.copy()
    behind[1, 0, 2] *= -1
    np.testing.assert_array_equal(
        np.isfinite(problem.linearise(at._replace(position=behind)).cost), [True, False]
    )


def test_take_keeps_some_starts() -> None:
    problem, at, _ = CASES[0]
    second = np.array([1])
    alone = problem.take(second).linearise(Geometry(*(part[second] for part in at)))
    for part, whole in zip(alone, problem.linearise(at), strict=True):
        np.testing.assert_allclose(part[0], whole[1], rtol=1e-9, atol=1e-9)


@given(
    direction=st.tuples(*[st.floats(-1, 1)] * 3),
    angle=st.sampled_from([0.0, 1e-12, 9e-5, 1.1e-4, 1e-3, 0.5, 2.0, np.pi - 1e-6, np.pi, 4.0]),
)
def test_rotation_from_vector(direction: tuple[float, float, float], angle: float) -> None:
    vector = np.array(direction) / max(float(np.linalg.norm(direction)), 1e-9) * angle
    R = rotation_from_vector(vector)
    np.testing.assert_allclose(R, Rotation.from_rotvec(vector).as_matrix(), rtol=0, atol=1e-14)
    both = rotation_from_vector(np.stack([vector, -vector]))
    np.testing.assert_allclose(both, [R, R.T], rtol=0, atol=1e-14)
