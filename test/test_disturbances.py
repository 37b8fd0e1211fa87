"""The study of errors that the estimator does not know of."""

from __future__ import annotations

import numpy as np
import pytest
from disturbances import DISTURBANCES, run
from scenes import BOARD, CAMERA, SIZE, pose
from synthetic import Scene

OTHERS = ("two cameras", "zoom of one view 0.8")
"""Of which some views are of another camera."""


@pytest.mark.parametrize("name", DISTURBANCES)
def test_a_disturbance_moves_the_points_a_little(name: str) -> None:
    scene = Scene(CAMERA, SIZE, BOARD, np.stack([pose(40, 30), pose(35, 120)]))
    off = DISTURBANCES[name](scene, np.random.default_rng(2)) - scene.pixels(BOARD.points)
    largest = np.linalg.norm(off, axis=2).max()
    assert (largest == 0) == (name == "nothing")
    assert (largest < 50) == (name not in OTHERS)


def test_squares_that_are_not_square_show_in_the_focal_length() -> None:
    quiet, stretched = (
        np.abs([run((name, number, 2, None)).z for number in range(12)])
        for name in ("nothing", "squares 0.5 %")
    )
    assert np.all(quiet < 3)
    assert np.median(stretched) > np.median(quiet)
    assert np.isfinite(run(("real", 1, None, None)).z)


def test_views_that_no_camera_suits_are_not_usable() -> None:
    # Draw 93 asks for a bend without which the board would lie behind the camera.
    for number in (93, 94, 95):
        assert not run(("zoom of one view 0.8", number, 2, None)).usable


def test_squares_that_are_stated_to_be_square_and_are_not_are_found_out() -> None:
    stated = [
        sum(run((name, number, 5, 1e-5)).usable for number in range(8))
        for name in ("nothing", "squares 0.5 %")
    ]
    assert stated[0] >= 6
    assert stated[1] <= 1
