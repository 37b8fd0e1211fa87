"""What the studies give to mrcal; mrcal itself where it is installed."""

from __future__ import annotations

import mrcal_camera
import numpy as np
import pytest
from scenes import SIZE, noisy, views_at

import fewcal

CAMERA = fewcal.Camera(1100.0, 1102.0, 645.0, 476.0, [-0.12, 0.03, 0.0, 0.0, 0.0])
TILTS = ((40, 30), (35, 120), (30, -60), (25, 200))


def test_a_chessboard_is_a_full_lattice() -> None:
    views = views_at(*TILTS, camera=CAMERA)
    observations, spacing = mrcal_camera.lattice(views)
    assert spacing == pytest.approx(0.025)
    assert observations.shape == (4, 6, 9, 3)
    np.testing.assert_array_equal(observations[1].reshape(-1, 3)[:, :2], views[1].image_points)
    assert (observations[..., 2] > 0).all()


def test_points_that_are_missing_weigh_nothing() -> None:
    board = fewcal.parse_board("acircles:4x11:0.02")
    points = board.points
    whole = fewcal.View(points, 1000 * points[:, :2])
    part = fewcal.View(points[5:20], 1000 * points[5:20, :2])
    observations, spacing = mrcal_camera.lattice([whole, part])
    assert spacing == pytest.approx(0.02)
    assert [(seen[..., 2] > 0).sum() for seen in observations] == [44, 15]


def test_points_on_no_lattice_are_refused() -> None:
    points = np.random.default_rng(0).uniform(size=(20, 2))
    with pytest.raises(fewcal.DegenerateViews, match="no square lattice"):
        mrcal_camera.lattice([fewcal.View(points, points)])


@pytest.mark.skipif(not mrcal_camera.AVAILABLE, reason="needs mrcal")
@pytest.mark.parametrize("warp", [True, False])
def test_mrcal_finds_the_camera(warp: bool) -> None:
    found = mrcal_camera.calibrate(noisy(views_at(*TILTS, camera=CAMERA), 0.05, 1), SIZE, warp)
    assert found.fx == pytest.approx(CAMERA.fx, rel=0.01)
    assert found.distortion[0] == pytest.approx(CAMERA.distortion[0], abs=0.02)
