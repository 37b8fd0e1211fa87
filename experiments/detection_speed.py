"""Time the detector against OpenCV's on the same frames, and print the ratios.

    python experiments/detection_speed.py [--runs 9]

A rendered 1920x1080 frame with a board among clutter, and the same scene without a board, which is most of a
live stream, each beside findChessboardCornersSB looking for a 9x6 chessboard in the same frame. Medians of
the ratios of runs side by side.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial

import cv2
import numpy as np

from fewcal import Board, BoardNotFound, Camera, detect, parse_board
from fewcal.rendering import clutter, render
from fewcal.virtual_camera import board_pose

SIZE = (1920, 1080)
CAMERA = Camera(1800.0, 1800.0, 959.5, 539.5, [-0.1, 0.02, 0.0, 0.0, 0.0])
BOARDS = tuple(
    parse_board(text)
    for text in (
        "chessboard:9x6:0.025",
        "charuco:7x5:0.04:0.03:DICT_5X5_100",
        "aprilgrid:6x4:0.03:0.3:tag36h11",
    )
)


def seconds(detector: Callable[[], object]) -> float:
    """Wall time of one detection."""
    start = time.perf_counter()
    detector()
    return time.perf_counter() - start


def ours(image: np.ndarray, board: Board) -> bool:
    """Whether fewcal finds the board."""
    try:
        detect(image, board)
    except BoardNotFound:
        return False
    return True


def theirs(image: np.ndarray) -> bool:
    """Whether OpenCV finds a chessboard."""
    return bool(cv2.findChessboardCornersSB(image, (9, 6))[0])


def main() -> None:
    """Print one line a frame."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=9)
    runs = parser.parse_args().runs
    background = clutter(SIZE, np.random.default_rng(1))
    empty = render(CAMERA, SIZE, None, None, background=background)
    for board in BOARDS:
        T = board_pose(30, 20, 15, 0.6, board.points.mean(axis=0)[:2])
        frames = {"with": render(CAMERA, SIZE, board, T, background=background), "without": empty}
        for name, image in frames.items():
            found = ours(image, board)
            pairs = [
                (seconds(partial(ours, image, board)), seconds(partial(theirs, image))) for _ in range(runs)
            ]
            mine, sb = np.min(pairs, axis=0) * 1e3
            ratio = np.median([a / b for a, b in pairs])
            print(
                f"{board!s:35s} {name:8s} found: {found!s:5s} fewcal {mine:6.1f} ms, "
                f"findChessboardCornersSB {sb:6.1f} ms, median ratio {ratio:.3f}"
            )


if __name__ == "__main__":
    main()
