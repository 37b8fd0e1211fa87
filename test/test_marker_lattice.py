from __future__ import annotations

from itertools import product

import cv2
import numpy as np
import pytest
from board_pictures import CAMERA, SIZE
from marker_pictures import CHARUCO, marker_picture, needs_markers

from fewcal.aprilgrid import AprilGrid
from fewcal.aprilgrid_detection import aprilgrid_layout
from fewcal.boards import Charuco
from fewcal.camera import Camera
from fewcal.charuco_detection import charuco_layout
from fewcal.marker_lattice import find_squares
from fewcal.rendering import Conditions, clutter, render
from fewcal.virtual_camera import board_pose

pytestmark = needs_markers
LAYOUT = charuco_layout(CHARUCO)
GRID = AprilGrid(6, 4, 0.03, 0.3, "tag36h11")


def corners_of(squares: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Where the squares (S, 2) are in the image, upper left corner first."""
    grid = true.reshape(4, 6, 2)
    column, row = squares.T - 1
    return np.stack(
        [grid[row, column], grid[row, column + 1], grid[row + 1, column + 1], grid[row + 1, column]], axis=1
    )


@pytest.mark.parametrize("roll", [0, 100, 185, 275])
@pytest.mark.parametrize("square_px", [20, 48])
def test_all_squares_are_found_in_the_order_of_the_board(square_px: float, roll: float) -> None:
    image, true = marker_picture(CHARUCO, square_px, 30, 40, roll)
    seen = find_squares(image, LAYOUT)
    assert len(seen.squares) == 15
    assert np.abs(seen.pixels - corners_of(seen.squares, true)).max() < 1.0
    assert 0.8 * square_px < seen.square_px <= 1.1 * square_px
    assert seen.votes == len(seen.ids) >= 12
    assert seen.markers_a_step(2) == 7
    assert seen.fitting(LAYOUT) == seen.votes


def test_a_board_whose_bits_cannot_be_read_is_found_all_the_same() -> None:
    image, true = marker_picture(CHARUCO, 22, 20, 40, 10, conditions=Conditions(blur_px=1.8))
    seen = find_squares(image, LAYOUT)
    assert len(seen.ids) < 2 < seen.votes
    assert len(seen.squares) == 15
    assert np.abs(seen.pixels - corners_of(seen.squares, true)).max() < 1.0


def test_a_board_in_two_parts_is_found_in_both() -> None:
    image, true = marker_picture(CHARUCO, 60, 10, 40)
    middle = int(true[:, 0].mean())
    covered = image.copy()
    covered[:, middle - 12 : middle + 12] = 120
    seen = find_squares(covered, LAYOUT)
    assert set(seen.squares[:, 0].tolist()) == {1, 2, 4, 5}
    assert np.abs(seen.pixels - corners_of(seen.squares, true)).max() < 1.0


@pytest.mark.parametrize("cluttered", [False, True])
@pytest.mark.parametrize("size", [(1280, 960), (1920, 1080)])
@pytest.mark.parametrize(
    ("board", "square_px"), [*product([CHARUCO], [20, 24, 32]), *product([GRID], [16, 20, 24])], ids=str
)
def test_small_squares_are_found_in_a_large_image(
    board: Charuco | AprilGrid, square_px: float, size: tuple[int, int], cluttered: bool
) -> None:
    rng = np.random.default_rng([size[0], int(square_px)])
    camera = Camera(size[0], size[0], size[0] / 2, size[1] / 2)
    tilt, about, roll = rng.uniform(0, (40, 360, 360))
    square, layout = (
        (board.square_size, LAYOUT)
        if isinstance(board, Charuco)
        else (board.tag_size, aprilgrid_layout(board))
    )
    T = board_pose(tilt, about, roll, camera.fx * square / square_px, board.points[:, :2].mean(axis=0))
    T[:2, 3] += rng.uniform(-0.3, 0.3, 2) * size / camera.fx * T[2, 3]
    background = clutter(size, rng) if cluttered else np.full(size[::-1], 0.9)
    seen = find_squares(render(camera, size, board, T, background=background), layout)
    assert len(seen.squares) >= 0.9 * layout.whole
    true = camera.project(np.append(layout.quads, np.zeros_like(layout.quads[..., :1]), axis=-1), T)
    assert np.abs(seen.pixels - true[seen.squares[:, 1], seen.squares[:, 0]]).max() < 1.0


def test_where_is_no_board_are_no_squares() -> None:
    for image in (
        render(CAMERA, SIZE, None, None, background=clutter(SIZE, np.random.default_rng(3))),
        np.zeros((20, 20000), np.uint8),
        cv2.flip(marker_picture(CHARUCO, 48, 30, 40)[0], 1),
    ):
        seen = find_squares(image, LAYOUT)
        assert (len(seen.squares), seen.votes, seen.square_px) == (0, 0, 0)
        assert seen.markers_a_step(2) is None
