"""Pictures of boards with markers, shared by the tests of their detectors."""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import CAMERA, SIZE, pose
from numpy.typing import NDArray

from fewcal.boards import Board, Charuco
from fewcal.camera import Camera
from fewcal.detection import Detection
from fewcal.rendering import Conditions, render
from fewcal.views import View

Array = NDArray[np.float64]

REAL = os.environ.get("FEWCAL_REAL_DATA")
"""Where the real data sets are; none when not set."""

needs_markers = pytest.mark.skipif(
    not hasattr(cv2, "aruco"), reason="this OpenCV has no markers; those from 4.7, and those with contrib, do"
)
CHARUCO = Charuco(7, 5, 0.04, 0.03, "DICT_5X5_100")


@lru_cache(maxsize=64)
def marker_picture(
    board: Any,
    square_px: float,
    tilt_deg: float = 0,
    about_deg: float = 0,
    roll_deg: float = 0,
    shift_px: tuple[float, float] = (0, 0),
    camera: Camera = CAMERA,
    conditions: Conditions = Conditions(),
) -> tuple[NDArray[np.uint8], Array]:
    """Give an image and the true place of each of ``board.points``, in the image or not."""
    T = pose(board, square_px, tilt_deg, about_deg, roll_deg, shift_px)
    return render(camera, SIZE, board, T, conditions), camera.project(board.points, T)


def two_parts() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two views that make a good camera, the board beyond the lower right and the upper left border."""
    return (
        marker_picture(CHARUCO, 70, 40, 10, shift_px=(210, 130))[0],
        marker_picture(CHARUCO, 70, 40, 100, shift_px=(-200, -130))[0],
    )


def real_views(name: str, board: Board) -> Iterator[tuple[View, Array, Array]]:
    """Give for each image of a real data set what is found, and the points and pixels that others found."""
    folder = Path(str(REAL)) / "sets" / name
    reference = np.load(folder / "corners.npz")
    parts = [slice(*ends) for ends in itertools.pairwise(reference["view_ptr"])]
    for part, image_name in zip(parts, reference["names"].astype(str), strict=True):
        if (folder / "images" / image_name).exists():
            image: Any = cv2.imread(str(folder / "images" / image_name))
            yield board.detect(image).view, reference["obj"][part], reference["img"][part]


def indices(board: Board, found: Detection) -> NDArray[np.intp]:
    """Which of ``board.points`` were found."""
    away = np.linalg.norm(board.points[:, None] - found.view.object_points, axis=2)
    assert away.min(axis=0).max() < 1e-12
    return np.argmin(away, axis=0)


def errors(board: Board, found: Detection, true: Array) -> Array:
    """(N, 2) found less true, pixels."""
    return np.asarray(found.view.image_points - true[indices(board, found)])
