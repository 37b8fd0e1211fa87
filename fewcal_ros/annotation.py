"""The picture that a person looks at while showing a board: corners, residuals, views so far, verdict."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from enum import Enum

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fewcal.calibration import Calibration
from fewcal.grey import GreyImage
from fewcal.views import View

Picture = NDArray[np.uint8]

WIDTH_PX = 960
"""Width of the picture: that of a teach pendant's screen, and little to send thirty times a second."""
HEIGHT_PX = 2 * WIDTH_PX
"""Largest height of the image in it; a narrow one does not fill the width."""
RESIDUAL_SCALE = 100.0
"""Residuals are tenths of a pixel and less; a hundred times as long they can be seen."""
FONT_PX = 26
"""Height of a line of text on a picture of WIDTH_PX; it can be read at an arm's length."""
LINES = 6
"""Lines below the picture, always as many, so that the size of the picture does not change."""

GREEN, AMBER, RED = (80, 200, 60), (0, 180, 255), (60, 60, 240)
WHITE, VIOLET = (240, 240, 240), (255, 110, 190)
_SHIFT = 4
"""OpenCV takes positions in 1/16 px."""


class Mood(Enum):
    """Colour of the text, BGR: usable, under way, failed."""

    GOOD = GREEN
    UNDER_WAY = AMBER
    BAD = RED


def annotate(
    grey: GreyImage,
    lines: Sequence[str],
    mood: Mood,
    found: View | None = None,
    kept: bool = False,
    calibration: Calibration | None = None,
) -> Picture:
    """Draw what was found in an image and where the calibration stands.

    Parameters
    ----------
    grey : (H, W) array of uint8 or uint16
    lines : sequence of str
        What to write below the image; the first in the colour of the mood.
    mood : Mood
    found : View, optional
        The board in this image; green when it was kept, amber when not.
    kept : bool
    calibration : Calibration, optional
        Its views are drawn as outlines, their residuals RESIDUAL_SCALE times as long as they are.

    Returns
    -------
    (H', WIDTH_PX, 3) array of uint8, BGR
    """
    height, width = grey.shape
    scale = min(WIDTH_PX / width, HEIGHT_PX / height)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(_eight_bit(grey), size, interpolation=way)
    shown = np.asarray(cv2.cvtColor(small, cv2.COLOR_GRAY2BGR), np.uint8)
    if calibration is not None and calibration.image_size == (width, height):
        _draw_views(shown, calibration, scale)
    if found is not None:
        _draw_corners(shown, found, scale, GREEN if kept else AMBER)
    framed = np.zeros((len(shown), WIDTH_PX, 3), np.uint8)
    framed[:, : size[0]] = shown
    return np.vstack([framed, _panel(lines, mood)])


def _eight_bit(grey: GreyImage) -> Picture:
    """Stretch 16 bit to what there is in the image: sensors of 10 or 12 bit would be black otherwise."""
    if grey.dtype == np.uint8:
        return np.asarray(grey, np.uint8)
    brightest = max(1, int(grey.max()))
    return np.asarray(cv2.convertScaleAbs(grey, alpha=255 / brightest), np.uint8)


def _draw_corners(picture: Picture, view: View, scale: float, colour: tuple[int, int, int]) -> None:
    points = _fixed(view.image_points, scale)
    cv2.polylines(picture, [points], False, colour, 1, cv2.LINE_AA, _SHIFT)
    for point in points:
        cv2.circle(picture, point.tolist(), 4 << _SHIFT, colour, 1, cv2.LINE_AA, _SHIFT)
    cv2.circle(picture, points[0].tolist(), 8 << _SHIFT, colour, 2, cv2.LINE_AA, _SHIFT)


def _draw_views(picture: Picture, calibration: Calibration, scale: float) -> None:
    for view, pose in zip(calibration.views, calibration.board_poses, strict=True):
        hull = cv2.convexHull(view.image_points.astype(np.float32))[:, 0]
        cv2.polylines(picture, [_fixed(hull, scale)], True, WHITE, 1, cv2.LINE_AA, _SHIFT)
        projected = calibration.camera.project(view.object_points, pose)
        tips = view.image_points + RESIDUAL_SCALE * (view.image_points - projected)
        sound = np.asarray(np.isfinite(tips).all(axis=1))
        lines = np.stack(
            [_fixed(view.image_points, scale), _fixed(np.where(sound[:, None], tips, 0), scale)], 1
        )
        cv2.polylines(picture, list(lines[sound]), False, VIOLET, 1, cv2.LINE_AA, _SHIFT)


def _fixed(points: ArrayLike, scale: float) -> NDArray[np.int32]:
    """Pixels of the image to sixteenths of pixels of the picture."""
    moved = (np.asarray(points, np.float64) + 0.5) * scale - 0.5
    fixed: NDArray[np.int32] = np.round(np.clip(moved, -1e4, 1e5) * 2**_SHIFT).astype(np.int32)
    return fixed


def _panel(lines: Sequence[str], mood: Mood) -> Picture:
    panel = np.full((LINES * FONT_PX + 12, WIDTH_PX, 3), 30, np.uint8)
    wrapped = [(part, i) for i, line in enumerate(lines) for part in textwrap.wrap(line, 78)][:LINES]
    for row, (text, i) in enumerate(wrapped):
        colour = mood.value if i == 0 else WHITE
        place = (10, (row + 1) * FONT_PX)
        cv2.putText(panel, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.66, colour, 1, cv2.LINE_AA)
    return panel
