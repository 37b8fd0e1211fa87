from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import BOARD, SIZE, assert_derivative, differences, pose, views_at

from fewcal.camera import Camera
from fewcal.errors import DegenerateViews
from fewcal.homography import (
    DISTANCE_OFFSET_PX,
    _Entries,
    _HomographyProblem,
    homographies,
    refine_homographies,
)
from fewcal.views import stack_views

Array = NDArray[np.float64]

PINHOLE = Camera(1000.0, 1010.0, 600.0, 500.0)
CENTRE = np.array(SIZE) / 2
PLANE = (BOARD.points[:, :2] - BOARD.points[:, :2].mean(axis=0)).T
ONES = np.ones((2, PLANE.shape[1]))
POSES = np.stack([pose(40, 20, camera=PINHOLE), pose(55, 200, 30, camera=PINHOLE)])


def transform(H: Array, points: Array) -> Array:
    """Map (..., 2, N) points by (..., 3, 3) homographies."""
    mapped = H[..., :2] @ points + H[..., 2:]
    return mapped[..., :2, :] / mapped[..., 2:, :]


def exact() -> tuple[Array, Array, Array]:
    """Board points (2, 2, N), pixels (2, 2, N) and the homographies (2, 3, 3) between them."""
    about_centroid = np.eye(3)
    about_centroid[:2, 2] = BOARD.points[:, :2].mean(axis=0)
    H = PINHOLE.matrix @ POSES[:, :3][:, :, [0, 1, 3]] @ about_centroid
    pixels = np.stack([PINHOLE.project(BOARD.points, T).T for T in POSES])
    return np.stack([PLANE, PLANE]), pixels, H / H[:, 2:, 2:]


def objective(H: Array, source: Array, target: Array, centre: Array) -> Array:
    """Eq 15 of the paper, for each view."""
    squares = ((transform(H, source) - target) ** 2).sum(axis=-2)
    radius = np.linalg.norm(target - centre[:, None], axis=-2)
    total: Array = (squares / (DISTANCE_OFFSET_PX + radius)).sum(axis=-1)
    return total


# --- the linear solution -----------------------------------------------------------------------------------


def test_an_exact_homography_is_found() -> None:
    source, target, H = exact()
    found = homographies(source, target, ONES)
    np.testing.assert_allclose(found / np.abs(H), H / np.abs(H), rtol=1e-9)
    np.testing.assert_allclose(transform(found, source), target, atol=1e-9)


@given(seed=st.integers(0, 10_000), count=st.integers(4, 30))
def test_any_plane_in_front_is_found(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    source = np.concatenate([square, rng.uniform(-1, 1, (count - 4, 2))]).T[None]
    H = np.eye(3) + rng.uniform(-0.3, 0.3, (1, 3, 3))
    H = np.diag([500.0, 500.0, 1.0]) @ H
    found = homographies(source, transform(H, source), np.ones((1, count)))
    np.testing.assert_allclose(transform(found, source), transform(H, source), atol=1e-7)


def test_points_of_weight_zero_are_left_out() -> None:
    source, target, H = exact()
    source, target, weights = source.copy(), target.copy(), ONES.copy()
    source[1, :, 20:], target[1, :, 20:], weights[1, 20:] = 0.7, -123.0, 0.0
    found = homographies(source, target, weights)
    for each in (found, refine_homographies(found, source, target, weights, CENTRE)):
        np.testing.assert_allclose(each / each[:, 2:, 2:], H, rtol=1e-8, atol=1e-8)


def test_a_heavier_point_is_met_more_closely() -> None:
    source, target, _ = exact()
    target = target.copy()
    target[:, :, 7] += 3.0
    heavy = ONES.copy()
    heavy[:, 7] = 100.0
    error = [
        np.linalg.norm(transform(homographies(source, target, w), source) - target, axis=-2)[:, 7]
        for w in (ONES, heavy)
    ]
    assert (error[1] < 0.01 * error[0]).all()


# --- the paper's refinement --------------------------------------------------------------------------------


def test_refinement_lowers_the_objective_of_eq_15_to_a_minimum() -> None:
    views = stack_views(views_at((40, 20), (55, 200)))
    source, target, weights = views.points, views.pixels, views.weights
    start = homographies(source, target, weights)
    refined = refine_homographies(start, source, target, weights, CENTRE)
    before, after = (objective(H, source, target, CENTRE) for H in (start, refined))
    assert (after < 0.99 * before).all()
    for i in range(9):
        for share in (1e-5, -1e-5):
            nearby = refined.copy()
            nearby.reshape(2, 9)[:, i] *= 1 + share
            assert (objective(nearby, source, target, CENTRE) >= after).all()


def test_refinement_takes_a_principal_point_for_each_view() -> None:
    views = stack_views(views_at((40, 20), (55, 200)))
    arguments = views.points, views.pixels, views.weights
    start = homographies(*arguments)
    centres = np.array([[500.0, 300.0], [700.0, 600.0]])
    both = refine_homographies(start, *arguments, centres)
    for i in range(2):
        alone = refine_homographies(start[i : i + 1], *(part[i : i + 1] for part in arguments), centres[i])
        np.testing.assert_allclose(both[i], alone[0], rtol=1e-9, atol=1e-12)
    assert np.abs(both - refine_homographies(start, *arguments, CENTRE)).max() > 1e-6


def test_jacobian_of_the_refinement() -> None:
    rng = np.random.default_rng(3)
    source, target = rng.uniform(-1, 1, (2, 2, 2, 6))
    scale = rng.uniform(0, 2, (2, 6))
    h = np.eye(3).ravel()[:8] + rng.uniform(-0.3, 0.3, (2, 8))
    problem = _HomographyProblem(source, target, scale)

    def rows(at: Array) -> Array:
        H = np.concatenate([at, np.ones((2, 1))], axis=1).reshape(2, 3, 3)
        return ((transform(H, source) - target) * scale[:, None]).reshape(2, -1)

    J, r = differences(rows, h, 1e-6), rows(h)
    found = problem.linearise(_Entries(h))
    np.testing.assert_allclose(found.squares, (r**2).sum(axis=1), rtol=1e-12)
    columns = np.concatenate([J, r[..., None]], axis=2)
    assert_derivative(found.groups[:, 0], np.swapaxes(columns, 1, 2) @ columns)


def test_a_homography_with_a_point_behind_is_not_allowed() -> None:
    source = np.array([[[-1.0, 1, 0, 0], [0, 0, 1, -1]]])
    h = np.array([[1.0, 0, 0, 0, 1, 0, 1.5, 0]])
    problem = _HomographyProblem(source, source, np.ones((1, 4)))
    assert np.isnan(problem.linearise(_Entries(h)).squares).all()
    left_out = _HomographyProblem(source, source, np.array([[0.0, 1, 1, 1]]))
    assert np.isfinite(left_out.linearise(_Entries(h)).squares).all()


# --- views without a homography ----------------------------------------------------------------------------


def test_fewer_than_four_points() -> None:
    source, target, _ = exact()
    weights = ONES.copy()
    weights[1, 3:] = 0
    with pytest.raises(DegenerateViews, match="A view has 3 points; four or more"):
        homographies(source, target, weights)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_collinear_points(angle: float) -> None:
    source, target, _ = exact()
    line = np.linspace(-1, 1, PLANE.shape[1]) * np.array([[np.cos(angle)], [np.sin(angle)]])
    for broken in ((np.stack([PLANE, line]), target), (source, np.stack([target[0], 600 + 300 * line]))):
        with pytest.raises(DegenerateViews, match="collinear"):
            homographies(*broken, ONES)


@pytest.mark.parametrize("fourth", [(1.0, 1.0), (0.0, 1.0)])
def test_four_points_of_which_three_are_collinear(fourth: tuple[float, float]) -> None:
    # Three on a line and one beside it, or two of them the same.
    board = np.array([[(0.0, 0.0), (0.0, 1.0), (1.0, 0.5) if fourth == (0.0, 1.0) else (0.0, 2.0), fourth]])
    board = np.swapaxes(board, 1, 2)
    with pytest.raises(DegenerateViews, match="all but one are on one line"):
        homographies(board, 100 * board + 50, np.ones((1, 4)))


def test_a_board_seen_edge_on_is_collinear() -> None:
    # The board's plane runs through the camera's centre.
    edge_on = PINHOLE.project(BOARD.points, pose(90, 0, shift_px=(0, 20.5), camera=PINHOLE))
    with pytest.raises(DegenerateViews, match="not edge-on"):
        homographies(PLANE[None], edge_on.T[None], ONES[:1])
