"""Pictures of boards with known corners, shared by the tests of the detector."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fewcal.boards import Chessboard
from fewcal.camera import Camera
from fewcal.rendering import Conditions, render

SIZE = (640, 480)
BOARD = Chessboard(9, 6, 0.025)
CAMERA = Camera(600.0, 600.0, 319.5, 239.5)

Array = NDArray[np.float64]


def pose(
    board: Chessboard,
    square_px: float,
    tilt_deg: float = 0,
    about_deg: float = 0,
    roll_deg: float = 0,
    shift_px: tuple[float, float] = (0, 0),
) -> Array:
    """Pose that shows the middle of the board at the middle of the image, squares of a given size."""
    about = np.radians(about_deg)
    tilt, _ = cv2.Rodrigues(np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))
    roll, _ = cv2.Rodrigues(np.radians(roll_deg) * np.array([0.0, 0.0, 1.0]))
    depth = CAMERA.fx * board.square_size / square_px
    T = np.eye(4)
    T[:3, :3] = tilt @ roll
    T[:3, 3] = np.array([shift_px[0] / CAMERA.fx, shift_px[1] / CAMERA.fx, 1.0]) * depth
    T[:3, 3] -= T[:3, :3] @ board.points.mean(axis=0)
    return T


def picture(
    T_camera_board: Array,
    board: Chessboard = BOARD,
    camera: Camera = CAMERA,
    size: tuple[int, int] = SIZE,
    seed: int = 0,
    **conditions: Any,
) -> tuple[NDArray[np.uint8], Array]:
    """Give an image and the true corners in the order of ``board.points``."""
    image = render(
        camera, size, board, T_camera_board, Conditions(**conditions), rng=np.random.default_rng(seed)
    )
    return image, camera.project(board.points, T_camera_board)
