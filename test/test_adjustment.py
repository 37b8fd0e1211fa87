from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import BOARD, CAMERA, SIZE, assert_derivative, differences, geometry, pose, view
from scipy.spatial.transform import Rotation

from fewcal.adjustment import LARGEST_FOCAL_STEP, POSE, Adjustment, Geometry, rotation_from_vector
from fewcal.boards import Chessboard
from fewcal.constraints import Priors
from fewcal.departures import Departures
from fewcal.noise import Noise
from fewcal.parametrisation import PixelModel, ScaleFree
from fewcal.views import View, stack_views

Array = NDArray[np.float64]

FREE = ScaleFree(SIZE)
SMALL = Chessboard(5, 4, 0.04)
"""Fewer points than the other board, so that its view is padded."""
POSES = [pose(40, 20), pose(35, 130, 60, points=SMALL.points)]
VIEWS = stack_views([view(POSES[0]), view(POSES[1], SMALL.points)])
PRIORS = Priors().rows(SIZE)
THETA = FREE.theta(np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]]))
PAPER = np.array([1100.0, 1120.0, 640.0, 480.0, 2.0, -1e-7, 2e-14, 3e-7, -5e-7])


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
        Adjustment(VIEWS, FREE, PRIORS),
        state(np.stack([THETA, THETA + 0.01])),
        np.full(8, 1e-6),
    ),
    (
        Adjustment(
            VIEWS, FREE, PRIORS, departures=Departures.of(VIEWS.points, VIEWS.pixels, SIZE, FREE.centre)
        ),
        state(np.append([THETA, THETA + 0.01], [[2e-3, -5e-3, 0.02, 3e-3], [0, 0, 0, 0]], axis=1)),
        np.full(12, 1e-6),
    ),
    (
        Adjustment(VIEWS, PixelModel(tangential=True), none),
        state(np.stack([PAPER, PAPER * 1.02])),
        1e-2 * np.array([1, 1, 1, 1, 1, 1e-7, 1e-13, 1e-5, 1e-5]),
    ),
]


def residuals(problem: Adjustment, at: Geometry) -> Array:
    """(B, V, 2, N) pixels."""
    return problem.jacobian(at)[:, :, -1]


@pytest.mark.parametrize(("problem", "at", "step"), CASES)
def test_jacobian_by_camera(problem: Adjustment, at: Geometry, step: Array) -> None:
    still = np.zeros((2, 2, 6))
    zero = np.zeros_like(at.theta)
    numeric = differences(lambda shared: residuals(problem, problem.retract(at, shared, still)), zero, step)
    assert_derivative(np.moveaxis(problem.jacobian(at)[:, :, POSE:-1], 2, -1), numeric)


@pytest.mark.parametrize(("problem", "at", "step"), CASES)
def test_jacobian_by_turn_and_shift_of_each_board(problem: Adjustment, at: Geometry, step: Array) -> None:
    zero = np.zeros_like(at.theta)
    numeric = differences(
        lambda local: residuals(problem, problem.retract(at, zero, local)), np.zeros((2, 2, 6)), 1e-6
    )
    assert_derivative(np.moveaxis(problem.jacobian(at)[:, :, :POSE], 2, -1), numeric)


@pytest.mark.parametrize(("problem", "at", "step"), CASES)
def test_normal_equations_are_those_of_the_rows(problem: Adjustment, at: Geometry, step: Array) -> None:
    found = problem.linearise(at)
    for b in range(2):
        rows = problem.rows(Geometry(*(part[b : b + 1] for part in at)), 0.5)
        for v in range(2):
            columns = np.column_stack([rows.by_pose[v], rows.by_camera[v], rows.r[v]]) * 0.5
            np.testing.assert_allclose(found.groups[b, v], columns.T @ columns, rtol=1e-9, atol=1e-9)
        r, J = (part[b] for part in problem.constraint(at.theta))
        gradient = r @ J
        np.testing.assert_allclose(
            found.shared[b, -1, :-1], gradient, rtol=1e-9, atol=1e-9 * abs(gradient).max(initial=0)
        )
    variance = np.array([0.3, 0.5])
    squares = (residuals(problem, at) ** 2).sum(axis=(1, 2, 3))
    np.testing.assert_allclose(found.squares, squares)
    expected = 0.5 * (squares / variance + found.shared_squares)
    np.testing.assert_allclose(found.cost(variance), expected)


def test_the_true_camera_leaves_no_residual_and_padding_none_at_all() -> None:
    problem, at, _ = CASES[0]
    columns = problem.jacobian(at)
    np.testing.assert_allclose(columns[0, :, -1], 0, atol=1e-9)
    assert np.abs(columns[1, :, -1]).max() > 1
    assert (columns[:, 1, ..., len(SMALL.points) :] == 0).all()
    assert (columns[:, 0, ..., len(SMALL.points) :] != 0).any()


def test_rows_are_in_units_of_their_noise() -> None:
    problem, at, _ = CASES[0]
    # The second start: camera and poses off by some pixels.
    off = Geometry(*(part[1:] for part in at))
    rows, wider = problem.rows(off, 1.0), problem.rows(off, 2.0)
    for one, two in zip(rows, wider, strict=True):
        np.testing.assert_allclose(two, one / 2)
    np.testing.assert_allclose(residuals(problem, off)[0].reshape(2, -1), rows.r)


def test_a_noise_gives_variance_and_objective() -> None:
    problem = CASES[0][0]
    noise = Noise.of(VIEWS, Priors()).repeat(2)
    squares, prior = np.array([10.0, 20.0]), np.array([1.0, 2.0])
    np.testing.assert_array_equal(problem.variance(squares), 1)
    np.testing.assert_array_equal(problem.objective(squares, prior), [5.5, 11])
    noisy = problem.believing(noise)
    np.testing.assert_array_equal(noisy.variance(squares), noise.variance(squares))
    np.testing.assert_array_equal(noisy.objective(squares, prior), noise.objective(squares, prior))


def test_relative_weights_of_points() -> None:
    sigma = np.where(np.arange(54) < 20, 0.1, 1.0)
    weighted = stack_views([View(BOARD.points, CAMERA.project(BOARD.points, POSES[0]), sigma)])
    even = stack_views([view(POSES[0])])
    at = Geometry(THETA[None] + 0.01, *geometry(POSES[:1]))
    r = [residuals(Adjustment(v, FREE, PRIORS), at)[0, 0] for v in (weighted, even)]
    ratio = r[0] / r[1]
    np.testing.assert_allclose(ratio, ratio[:, [0] * 20 + [-1] * 34])
    assert ratio[0, 0] > 3 * ratio[0, -1]


def test_a_board_in_another_plane_is_the_same_board() -> None:
    turn = pose(50, 70, 20)[:3, :3]
    tilted = stack_views([View(BOARD.points @ turn.T, view(POSES[0]).image_points)])
    rotation, position = geometry(POSES[:1])
    # The board's own axes are turned back first; the plane's are those of the state.
    at = Geometry(THETA[None], rotation @ turn.T @ tilted.plane, position)
    np.testing.assert_allclose(residuals(Adjustment(tilted, FREE, PRIORS), at), 0, atol=1e-9)


def test_a_step_of_the_focal_length_is_bounded() -> None:
    problem, at, _ = CASES[0]
    shared, local = np.zeros((2, 8)), np.zeros((2, 2, 6))
    shared[:, 0], shared[:, 1] = (-4 * LARGEST_FOCAL_STEP, 0.5), 0.1
    to = problem.retract(at, shared, local)
    np.testing.assert_allclose((to.theta - at.theta)[:, 0], [-LARGEST_FOCAL_STEP, 0.5])
    np.testing.assert_allclose((to.theta - at.theta)[:, 1], [0.1 / 4, 0.1])


def test_a_board_behind_the_camera_is_not_allowed() -> None:
    problem, at, _ = CASES[0]
    behind = at.position.copy()
    behind[1, 0, 2] *= -1
    np.testing.assert_array_equal(
        np.isfinite(problem.linearise(at._replace(position=behind)).squares), [True, False]
    )


def test_take_keeps_some_starts() -> None:
    problem = CASES[0][0]
    assert problem.take(np.array([1])) is problem
    noise = Noise(np.array([100.0, 50.0]), np.array([0.2, 0.3]), np.array([1.0, 0.0]))
    kept = problem.believing(noise).take(np.array([1]))
    squares = np.array([30.0, 40.0])
    np.testing.assert_array_equal(kept.variance(squares[1:]), noise.variance(squares)[1:])


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


def test_steps_of_the_papers_focal_length_are_pixels_without_a_bound() -> None:
    problem, at, _ = CASES[2]
    shared = np.zeros((2, 9))
    shared[:, 0] = 300.0
    to = problem.retract(at, shared, np.zeros((2, 2, 6)))
    np.testing.assert_allclose((to.theta - at.theta)[:, 0], 300)
    np.testing.assert_array_equal(to.position, at.position)
