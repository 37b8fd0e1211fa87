from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from test_posterior import assert_alike, inverse, random_rows

from fewcal.elimination import eliminate

Array = NDArray[np.float64]


@pytest.mark.parametrize("seed", range(3))
def test_rows_of_the_camera_hold_the_schur_complement_of_each_view(seed: int) -> None:
    rows = random_rows(seed)
    reduced = eliminate(rows).camera
    assert reduced.shape == (3, 9, 9)
    for v in range(3):
        A, P = np.column_stack([rows.by_camera[v], rows.r[v]]), rows.by_pose[v]
        expected = A.T @ A - A.T @ P @ inverse(P.T @ P) @ P.T @ A
        assert_alike(reduced[v].T @ reduced[v], expected)


@pytest.mark.parametrize("points", [3, 4, 12])
def test_poses_follow_a_camera_as_well_as_they_can(points: int) -> None:
    rows = random_rows(4, points=points)
    camera = np.random.default_rng(1).normal(size=8) / np.linalg.norm(rows.by_camera, axis=(0, 1))
    found = eliminate(rows)
    steps = found.pose_steps(camera)
    for v in range(3):
        left = rows.r[v] + rows.by_camera[v] @ camera
        expected = np.linalg.lstsq(rows.by_pose[v], -left, rcond=None)[0]
        unit = 1 / np.linalg.norm(rows.by_pose[v], axis=0)
        np.testing.assert_allclose(
            steps[v] / unit, expected / unit, atol=1e-8 * np.abs(expected / unit).max()
        )
        # What no pose takes up is left in the rows of the camera.
        remainder = np.sum((left + rows.by_pose[v] @ steps[v]) ** 2)
        assert np.sum((found.camera[v] @ np.append(camera, 1)) ** 2) == pytest.approx(remainder, abs=1e-9)
