from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import BOARD, pose

from fewcal.camera import Camera
from fewcal.homography import homographies
from fewcal.planar_pose import planar_poses

Array = NDArray[np.float64]

NORMALISED = Camera(1.0, 1.0, 0.0, 0.0)
CAMERA = Camera(1000.0, 1000.0, 640.0, 480.0)
PLANE = (BOARD.points[:, :2] - BOARD.points[:, :2].mean(axis=0)).T
WEIGHTS = np.ones(PLANE.shape[1])


def seen(*T: Array) -> tuple[Array, Array, Array, Array]:
    """True rotations, positions of the centroid, and the two poses found, of each view."""
    stacked = np.stack(T)
    R = stacked[:, :3, :3]
    position = stacked[:, :3, 3] + R @ BOARD.points.mean(axis=0)
    rays = np.stack([NORMALISED.project(BOARD.points, each).T for each in T])
    plane, weights = np.stack([PLANE] * len(T)), np.stack([WEIGHTS] * len(T))
    H = homographies(plane, rays, weights)
    return R, position, *planar_poses(H, plane, rays, weights)


def errors(R: Array, t: Array, T: Array) -> Array:
    """Root mean square reprojection error of both poses, normalised coordinates."""
    X = R[..., :2] @ PLANE + t[..., None]
    offset = X[..., :2, :] / X[..., 2:, :] - NORMALISED.project(BOARD.points, T).T
    error: Array = np.sqrt((offset**2).sum(axis=-2).mean(axis=-1))
    return error


@given(
    tilt=st.floats(3, 75),
    about=st.floats(0, 360),
    roll=st.floats(0, 360),
    x=st.floats(-400, 400),
    y=st.floats(-300, 300),
)
def test_the_first_pose_is_the_truth_and_the_second_mirrors_its_tilt(
    tilt: float, about: float, roll: float, x: float, y: float
) -> None:
    T = pose(tilt, about, roll, shift_px=(x, y), camera=CAMERA)
    R_true, t_true, R, t = seen(T)
    np.testing.assert_allclose(R[0, 0], R_true[0], atol=1e-6)
    np.testing.assert_allclose(t[0, 0], t_true[0], atol=1e-6)
    # IPPE: the two normals lie to either side of the line of sight to the centroid.
    sight = t_true[0] / np.linalg.norm(t_true[0])
    mirrored = 2 * (R_true[0, :, 2] @ sight) * sight - R_true[0, :, 2]
    np.testing.assert_allclose(R[0, 1, :, 2], mirrored, atol=1e-6)
    np.testing.assert_allclose(R[0] @ np.swapaxes(R[0], 1, 2), np.stack([np.eye(3)] * 2), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R[0]), 1)
    first, second = errors(R[0], t[0], T)
    assert first <= second


def test_far_away_the_second_pose_explains_the_view_nearly_as_well() -> None:
    second = []
    for span in (0.5, 0.05):
        T = pose(35, 50, span=span, camera=CAMERA)
        *_, R, t = seen(T)
        angle = np.degrees(np.arccos((np.trace(R[0, 0].T @ R[0, 1]) - 1) / 2))
        assert angle == pytest.approx(70, abs=3), "twice the tilt"
        second.append(errors(R[0], t[0], T)[1] / span)
    assert second[1] < 0.15 * second[0]
    assert second[1] < 0.01


def test_face_on_both_poses_are_one() -> None:
    R_true, t_true, R, t = seen(pose(0, camera=Camera(1000.0, 1000.0, 639.5, 479.5)))
    np.testing.assert_allclose(R[0], np.stack([R_true[0]] * 2), atol=1e-5)
    np.testing.assert_allclose(t[0], np.stack([t_true[0]] * 2), atol=1e-5)


def test_every_view_is_ordered_by_its_own_error_and_equals_itself_alone() -> None:
    T = [pose(tilt, about, camera=CAMERA) for tilt, about in ((20, 0), (40, 100), (60, 220))]
    *_, R, t = seen(*T)
    for i, each in enumerate(T):
        first, second = errors(R[i], t[i], each)
        assert first < second
        *_, R_alone, t_alone = seen(each)
        np.testing.assert_allclose(R[i], R_alone[0], atol=1e-9)
        np.testing.assert_allclose(t[i], t_alone[0], atol=1e-9)


def test_points_of_weight_zero_are_left_out() -> None:
    T = pose(40, 20, camera=CAMERA)
    exact = NORMALISED.project(BOARD.points, T).T
    used = np.arange(PLANE.shape[1]) < 30
    plane, rays = np.where(used, PLANE, 9.0), np.where(used, exact, -5.0)
    weights = used.astype(float)
    H = homographies(PLANE[None], exact[None], WEIGHTS[None])
    R, t = planar_poses(H, plane[None], rays[None], weights[None])
    np.testing.assert_allclose(R[0, 0], T[:3, :3], atol=1e-8)
    np.testing.assert_allclose(t[0, 0], T[:3, 3] + T[:3, :3] @ BOARD.points.mean(axis=0), atol=1e-8)


def test_leading_axes_for_several_cameras() -> None:
    T = np.stack([pose(40, 20, camera=CAMERA), pose(30, 140, camera=CAMERA)])
    rays = np.stack([NORMALISED.project(BOARD.points, each).T for each in T])
    plane, weights = np.stack([PLANE] * 2), np.stack([WEIGHTS] * 2)
    H = homographies(plane, rays, weights)
    f = np.array([1.0, 1.7])[:, None, None, None]
    H = np.stack([np.diag([each, each, 1.0]) @ H for each in f.ravel()])
    R, t = planar_poses(H, plane, rays * f, weights)
    assert (R.shape, t.shape) == ((2, 2, 2, 3, 3), (2, 2, 2, 3))
    np.testing.assert_allclose(R[0, :, 0], T[:, :3, :3], atol=1e-8)
    R_alone, t_alone = planar_poses(H[1], plane, 1.7 * rays, weights)
    np.testing.assert_allclose(R[1], R_alone, atol=1e-12)
    np.testing.assert_allclose(t[1], t_alone, atol=1e-12)
    np.testing.assert_allclose(1.7 * t[1, :, 0, 2], t[0, :, 0, 2], rtol=0.02)
