from __future__ import annotations

import numpy as np
from board_pictures import CAMERA, pose
from marker_pictures import CHARUCO

from fewcal.marker_geometry import largest_board, local_frames, map_grid

REACH = 2.1 * CHARUCO.square_size
MARKERS = CHARUCO.marker_corners


def shown(plane: np.ndarray, tilt: float = 40.0) -> np.ndarray:
    flat = np.column_stack([plane.reshape(-1, 2), np.zeros(plane.size // 2)])
    return CAMERA.project(flat, pose(CHARUCO, 48, tilt, 30, 20)).reshape(plane.shape)


def test_all_markers_of_a_board_fit() -> None:
    pixels = shown(MARKERS) + np.random.default_rng(0).uniform(-0.7, 0.7, MARKERS.shape)
    assert largest_board(MARKERS, pixels, REACH).all()


def test_a_marker_with_a_wrong_number_does_not() -> None:
    pixels = shown(MARKERS)
    plane = MARKERS.copy()
    plane[[2, 9]] = plane[[14, 3]]
    assert np.flatnonzero(~largest_board(plane, pixels, REACH)).tolist() == [2, 9]


def test_of_two_boards_the_larger_part_is_taken() -> None:
    pixels = shown(MARKERS)
    plane = np.concatenate([MARKERS, MARKERS[:6]])
    both = np.concatenate([pixels, pixels[:6] + np.array([400.0, 100.0])])
    np.testing.assert_array_equal(largest_board(plane, both, REACH), np.arange(len(plane)) < len(MARKERS))


def test_no_marker_is_no_board() -> None:
    assert largest_board(MARKERS[:0], MARKERS[:0], REACH).shape == (0,)
    assert largest_board(MARKERS[:1], shown(MARKERS[:1]), REACH).all()


def test_frames_are_those_of_the_plane() -> None:
    plane = MARKERS.reshape(-1, 2)
    wanted = CHARUCO.points[:, :2]
    frames = local_frames(plane, shown(plane), np.ones(len(plane)), wanted)
    np.testing.assert_allclose(frames[:, :2, 2], shown(wanted), atol=1e-6)
    step = np.array([0.013, -0.008])
    moved = frames @ np.append(step, 1.0)
    np.testing.assert_allclose(moved[:, :2] / moved[:, 2:], shown(wanted + step), atol=1e-6)


def test_what_is_far_from_all_that_is_known_has_no_frame() -> None:
    row = MARKERS[:3].reshape(-1, 2)
    wanted = np.array([[0.1, 0.04], [0.1, 5.0]])  # all that is nearest to the second lies in one line
    frames = local_frames(row, shown(row), np.ones(len(row)), wanted, within=0.1)
    np.testing.assert_allclose(frames[0, :2, 2], shown(wanted[:1])[0], atol=1e-6)
    assert np.isnan(frames[1]).all()


def test_a_grid_is_mapped_into_quadrangles() -> None:
    points = map_grid(shown(MARKERS), np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(points[:, [0, 0, 2, 2], [0, 2, 2, 0]], shown(MARKERS), atol=1e-6)
    np.testing.assert_allclose(points[:, 1, 1], shown(MARKERS.mean(axis=1)), atol=1e-6)


def test_a_quadrangle_seen_edge_on_shows_nothing_and_harms_nothing() -> None:
    line = np.array([[10.0, 10], [20, 10], [30, 10], [15, 10]])
    both = map_grid(np.stack([line, shown(MARKERS)[0]]), np.array([0.0, 1.0]))
    assert np.isfinite(both).all()
    np.testing.assert_allclose(both[1, [0, 0, 1, 1], [0, 1, 1, 0]], shown(MARKERS)[0], atol=1e-6)
