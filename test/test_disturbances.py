"""The study of errors that the estimator does not know of."""

from __future__ import annotations

import numpy as np
import pytest
from disturbances import DISTURBANCES, run
from scenes import BOARD, CAMERA, SIZE, pose
from synthetic import Scene


@pytest.mark.parametrize("name", DISTURBANCES)
def test_a_disturbance_moves_the_points_a_little(name: str) -> None:
    scene = Scene(CAMERA, SIZE, BOARD, np.stack([pose(40, 30), pose(35, 120)]))
    off = DISTURBANCES[name](scene, np.random.default_rng(2)) - scene.pixels(BOARD.points)
    largest = np.linalg.norm(off, axis=2).max()
    assert (largest == 0) == (name == "nothing")
    assert largest < 100


def test_a_drawn_set() -> None:
    quiet, stretched = run(("nothing", 1, 2)), run(("squares 0.5 %", 1, 2))
    assert abs(quiet.z) < 3
    assert abs(stretched.z) > abs(quiet.z)
    assert np.isfinite(run(("real", 1, None)).z)
