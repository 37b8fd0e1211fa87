from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scenes import CAMERA, SIZE, differences, pose

from fewcal.adjustment import Adjustment, Geometry
from fewcal.board_bend import NU, SCALE, with_bend, with_bend_prior
from fewcal.boards import Chessboard
from fewcal.constraints import Priors
from fewcal.parametrisation import ScaleFree
from fewcal.views import View, stack_views

Array = NDArray[np.float64]

BOARD = Chessboard(9, 6, 0.025).points
POSES = [pose(40, 20), pose(25, 110)]


def pixels(bend: Array) -> Array:
    """Where a board is seen whose points are lifted by a parabola along either side, (V, N, 2)."""
    half = np.ptp(BOARD, axis=0)[:2] / 2
    along = (BOARD[:, :2] - BOARD[:, :2].mean(axis=0)) / half
    lift = 2 * np.hypot(*half) * (along**2 @ bend)
    bent = BOARD + lift[:, None] * [0, 0, 1]
    return np.stack([CAMERA.project(bent, T) for T in POSES])


def test_columns_of_the_bend_against_differences() -> None:
    views = stack_views([View(BOARD, seen) for seen in pixels(np.zeros(2))])
    model = ScaleFree(SIZE)
    theta = model.theta(np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]]))
    rotation = np.stack([T[:3, :3] for T in POSES])
    position = np.stack([T[:3, 3] for T in POSES]) + (rotation @ views.centroid[..., None])[..., 0]
    problem = Adjustment(views, model, Priors().rows(max(SIZE)))
    plain = problem.rows(Geometry(theta[None], rotation[None], position[None]), 0.5)
    rows = with_bend(plain, views.points)
    expected = np.moveaxis(differences(pixels, np.zeros(2), np.full(2, 1e-6)), 2, 1) / 0.5
    np.testing.assert_allclose(
        rows.by_camera[..., 8:], expected.reshape(len(POSES), -1, 2), rtol=1e-6, atol=1e-3
    )
    np.testing.assert_array_equal(rows.by_camera[..., :8], plain.by_camera)


def test_prior_of_the_bend_comes_after_those_of_the_camera() -> None:
    camera = Priors().rows(1280.0).tails(np.zeros(8))
    tails = with_bend_prior(camera)
    np.testing.assert_array_equal(tails.by_unknowns[:8, :8], camera.by_unknowns)
    np.testing.assert_array_equal(tails.by_unknowns[8:], np.eye(10)[8:] / SCALE)
    np.testing.assert_array_equal(tails.z[8:], 0)
    np.testing.assert_array_equal(tails.nu[tails.group[8:]], NU)
    assert tails.group[8] != tails.group[9], "one side may bend and the other not"
