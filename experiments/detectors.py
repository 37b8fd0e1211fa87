"""Chessboard detectors that are compared: each gives the corners of a whole board in an image, or None.

fewcal
    fewcal.detect
SB, SB exhaustive
    findChessboardCornersSB without flags, and with CALIB_CB_ACCURACY and CALIB_CB_EXHAUSTIVE
classic, classic plain
    findChessboardCorners with its own flags, adaptive threshold and normalised image, and without any
calib-targets
    the detector of the package of that name, where it is installed, with its own settings. It gives whatever
    grid it sees; that is an answer when it has the board's size and no gaps
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from fewcal import BoardNotFound, Chessboard, detect

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Detector = Callable[[Image, Chessboard], Array | None]


def ours(image: Image, board: Chessboard) -> Array | None:
    """Corners (N, 2) that fewcal finds."""
    try:
        return detect(image, board).image_points
    except BoardNotFound:
        return None


def sector_based(flags: int) -> Detector:
    """Give findChessboardCornersSB with these flags."""

    def find(image: Image, board: Chessboard) -> Array | None:
        found, corners = cv2.findChessboardCornersSB(image, (board.columns, board.rows), flags=flags)
        return corners.reshape(-1, 2) if found else None

    return find


def classic(flags: int) -> Detector:
    """Give findChessboardCorners with these flags."""

    def find(image: Image, board: Chessboard) -> Array | None:
        found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows), flags=flags)
        return corners.reshape(-1, 2) if found else None

    return find


def calib_targets(image: Image, board: Chessboard) -> Array | None:
    """Corners (N, 2) that calib-targets finds."""
    import calib_targets

    result = calib_targets.detect_chessboard(image)
    if result is None:
        return None
    places = np.array([(corner.grid.v, corner.grid.u) for corner in result.corners])
    places -= places.min(axis=0)
    grid = np.full((*(places.max(axis=0) + 1), 2), np.nan)
    grid[tuple(places.T)] = [corner.position for corner in result.corners]
    if grid.shape[:2] == (board.columns, board.rows):
        grid = np.rot90(grid)
    whole = grid.shape[:2] == (board.rows, board.columns) and bool(np.isfinite(grid).all())
    return grid.reshape(-1, 2) if whole else None


DETECTORS: dict[str, Detector] = {
    "fewcal": ours,
    "SB": sector_based(0),
    "SB exhaustive": sector_based(cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE),
    "classic": classic(cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE),
    "classic plain": classic(0),
}
if importlib.util.find_spec("calib_targets"):
    DETECTORS["calib-targets"] = calib_targets
