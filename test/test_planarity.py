from __future__ import annotations

import numpy as np
import pytest
from board_pictures import BOARD, SIZE, pose

from fewcal.camera import Camera
from fewcal.corner_refinement import RefinedCorners
from fewcal.planarity import planar_residuals, plane_residuals


def corners(points: np.ndarray) -> RefinedCorners:
    grid = points.reshape(6, 9, 2)
    one = np.ones(grid.shape[:2])
    return RefinedCorners(grid, 0.02 * one, np.ones_like(grid), one, one)


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.0, 0.3])
@pytest.mark.parametrize("tilt", [0, 25, 50])
def test_any_lens_passes(k1: float, tilt: float) -> None:
    camera = Camera(350.0, 350.0, 319.5, 239.5, np.array([k1, 0.05, 0.001, -0.001, 0.0]))
    points = camera.project(BOARD.points, pose(BOARD, 55, tilt, 40, 15))
    residuals, allowed, _ = planar_residuals(corners(points), SIZE[::-1])
    assert (np.linalg.norm(residuals, axis=2) < 0.5 * allowed).all()


def test_bent_paper_passes() -> None:
    bent = BOARD.points.copy()
    bent[:, 2] = 0.004 * np.sin(bent[:, 0] / 0.2 * np.pi)  # 4 mm over 200 mm
    points = Camera(600.0, 600.0, 319.5, 239.5).project(bent, pose(BOARD, 45, 35, 90))
    residuals, allowed, _ = planar_residuals(corners(points), SIZE[::-1])
    assert (np.linalg.norm(residuals, axis=2) < 0.5 * allowed).all()


@pytest.mark.parametrize("wrong", [0, 4, 22, 53])
@pytest.mark.parametrize("k1", [-0.3, 0.0])
def test_a_wrong_corner_is_told_from_its_neighbours(wrong: int, k1: float) -> None:
    camera = Camera(350.0, 350.0, 319.5, 239.5, np.array([k1, 0.05, 0.0, 0.0, 0.0]))
    points = camera.project(BOARD.points, pose(BOARD, 45, 20, 40, 15))
    points[wrong] += [12.0, -9.0]
    residuals, allowed, _ = planar_residuals(corners(points), SIZE[::-1])
    bad = np.linalg.norm(residuals, axis=2).ravel() > allowed.ravel()
    assert np.flatnonzero(bad).tolist() == [wrong]
    np.testing.assert_allclose(residuals.reshape(-1, 2)[wrong], [12.0, -9.0], atol=4.0)


def test_uncertainty_excuses_no_corner_that_left_its_square() -> None:
    points = Camera(600.0, 600.0, 319.5, 239.5).project(BOARD.points, pose(BOARD, 36, 20, 40))
    points[22] += [0.0, 40.0]
    found = corners(points)
    found.sigma[2, 4] = 18.0
    residuals, allowed, _ = planar_residuals(found, SIZE[::-1])
    assert np.linalg.norm(residuals[2, 4]) > 2 * allowed[2, 4]
    found.points[2, 4, 1] -= 30.0  # within its own square it may be as uncertain as it says
    residuals, allowed, _ = planar_residuals(found, SIZE[::-1])
    assert (np.linalg.norm(residuals, axis=2) < allowed).all()


@pytest.mark.parametrize("wrong", [4, 22, 31])
def test_a_corner_that_stands_out_from_the_others_says_by_how_much(wrong: int) -> None:
    points = Camera(600.0, 600.0, 319.5, 239.5).project(BOARD.points, pose(BOARD, 45, 20, 40, 15))
    points += np.random.default_rng(wrong).normal(0, 0.02, points.shape)
    assert not planar_residuals(corners(points), SIZE[::-1])[2].any()
    points[wrong] += [0.4, -0.3]
    residuals, allowed, outlying = planar_residuals(corners(points), SIZE[::-1])
    assert (np.linalg.norm(residuals, axis=2) < allowed).all()
    assert np.flatnonzero(outlying).tolist() == [wrong]
    assert outlying.ravel()[wrong] == pytest.approx(0.5, rel=0.3)


def test_scatter_that_all_points_share_makes_none_stand_out() -> None:
    points = Camera(600.0, 600.0, 319.5, 239.5).project(BOARD.points, pose(BOARD, 45, 20, 40, 15))
    points += np.random.default_rng(0).uniform(-0.5, 0.5, points.shape)  # 15 times what sigma says
    assert not planar_residuals(corners(points), SIZE[::-1])[2].any()


def test_few_points_do_not_tell_which_stands_out() -> None:
    plane = BOARD.points[:20, :2]
    pixels = Camera(600.0, 600.0, 319.5, 239.5).project(BOARD.points[:20], pose(BOARD, 45, 20, 40, 15))
    pixels[7] += 1.0
    _, _, outlying = plane_residuals(plane, pixels, np.full(20, 45.0), np.full(20, 0.02), SIZE[::-1])
    assert not outlying.any()
