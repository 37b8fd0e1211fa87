"""Pictures of circle grids with known centres, shared by the tests of their detector."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from board_pictures import CAMERA, SIZE
from numpy.typing import NDArray
from scenes import pose as posed

from fewcal.boards import AsymmetricCircleGrid, CircleGrid
from fewcal.camera import Camera
from fewcal.drawing import Drawing
from fewcal.rendering import Conditions, render

SYMMETRIC = CircleGrid(10, 7, 0.02)
ASYMMETRIC = AsymmetricCircleGrid(4, 11, 0.02)
BARREL = Camera(350.0, 350.0, 319.5, 239.5, [-0.3, 0.09, 0.0, 0.0, 0.0])
"""The corners of the image are drawn in by 30 %."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Printed:
    """A circle grid with circles of any radius, as a share of the distance to the nearest neighbour."""

    board: CircleGrid | AsymmetricCircleGrid
    radius_share: float

    def draw(self) -> Drawing:
        drawing = self.board.draw()
        discs = drawing.discs.copy()
        discs[:, 2] = self.radius_share * self.board.nearest
        return replace(drawing, discs=discs)


def pose(
    board: CircleGrid | AsymmetricCircleGrid,
    tilt_deg: float,
    about_deg: float = 20,
    roll_deg: float = 12,
    span: float = 0.5,
    shift_px: tuple[float, float] = (0, 0),
    camera: Camera = CAMERA,
) -> Array:
    """Pose that shows the middle of the board at the middle of the image."""
    return posed(tilt_deg, about_deg, roll_deg, span, shift_px, board.points, camera, SIZE)


def picture(
    T_camera_board: Array,
    board: CircleGrid | AsymmetricCircleGrid = SYMMETRIC,
    radius_share: float = 0.3,
    camera: Camera = CAMERA,
    seed: int = 0,
    background: Any = None,
    **conditions: Any,
) -> tuple[NDArray[np.uint8], Array]:
    """Give an image and the true centres in the order of ``board.points``."""
    image = render(
        camera,
        SIZE,
        Printed(board, radius_share),  # type: ignore[arg-type]
        T_camera_board,
        Conditions(**conditions),
        background=background,
        rng=np.random.default_rng(seed),
    )
    return image, camera.project(board.points, T_camera_board)


def two_views(board: CircleGrid | AsymmetricCircleGrid) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Two views that make a good camera."""
    return picture(pose(board, 40, 10), board)[0], picture(pose(board, 40, 100), board)[0]
