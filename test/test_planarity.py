from __future__ import annotations

import numpy as np
import pytest
from board_pictures import BOARD, SIZE, pose

from fewcal.camera import Camera
from fewcal.corner_refinement import RefinedCorners
from fewcal.planarity import planar_residuals


def corners(points: np.ndarray) -> RefinedCorners:
    grid = points.reshape(6, 9, 2)
    one = np.ones(grid.shape[:2])
    return RefinedCorners(grid, 0.02 * one, np.ones_like(grid), one, one)


@pytest.mark.parametrize("k1", [-0.3, -0.1, 0.0, 0.3])
@pytest.mark.parametrize("tilt", [0, 25, 50])
def test_any_lens_passes(k1: float, tilt: float) -> None:
    camera = Camera(350.0, 350.0, 319.5, 239.5, np.array([k1, 0.05, 0.001, -0.001, 0.0]))
    points = camera.project(BOARD.points, pose(BOARD, 55, tilt, 40, 15))
    residuals, allowed = planar_residuals(corners(points), SIZE[::-1])
    assert (np.linalg.norm(residuals, axis=2) < 0.5 * allowed).all()


def test_bent_paper_passes() -> None:
    bent = BOARD.points.copy()
    bent[:, 2] = 0.004 * np.sin(bent[:, 0] / 0.2 * np.pi)  # 4 mm over 200 mm
    points = Camera(600.0, 600.0, 319.5, 239.5).project(bent, pose(BOARD, 45, 35, 90))
    residuals, allowed = planar_residuals(corners(points), SIZE[::-1])
    assert (np.linalg.norm(residuals, axis=2) < 0.5 * allowed).all()


@pytest.mark.parametrize("wrong", [0, 4, 22, 53])
@pytest.mark.parametrize("k1", [-0.3, 0.0])
def test_a_wrong_corner_is_told_from_its_neighbours(wrong: int, k1: float) -> None:
    camera = Camera(350.0, 350.0, 319.5, 239.5, np.array([k1, 0.05, 0.0, 0.0, 0.0]))
    points = camera.project(BOARD.points, pose(BOARD, 45, 20, 40, 15))
    points[wrong] += [12.0, -9.0]
    residuals, allowed = planar_residuals(corners(points), SIZE[::-1])
    bad = np.linalg.norm(residuals, axis=2).ravel() > allowed.ravel()
    assert np.flatnonzero(bad).tolist() == [wrong]
    np.testing.assert_allclose(residuals.reshape(-1, 2)[wrong], [12.0, -9.0], atol=4.0)


def test_uncertainty_excuses_no_corner_that_left_its_square() -> None:
    points = Camera(600.0, 600.0, 319.5, 239.5).project(BOARD.points, pose(BOARD, 36, 20, 40))
    points[22] += [0.0, 40.0]
    found = corners(points)
    found.sigma[2, 4] = 18.0
    residuals, allowed = planar_residuals(found, SIZE[::-1])
    assert np.linalg.norm(residuals[2, 4]) > 2 * allowed[2, 4]
    found.points[2, 4, 1] -= 30.0  # within its own square it may be as uncertain as it says
    residuals, allowed = planar_residuals(found, SIZE[::-1])
    assert (np.linalg.norm(residuals, axis=2) < allowed).all()
