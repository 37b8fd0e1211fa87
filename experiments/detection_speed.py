"""Time the detector against OpenCV's on the same frames, and print the ratios.

    python experiments/detection_speed.py [--runs 9]

A rendered 1920x1080 frame with a 9x6 board among clutter, and the same scene without a board, which is most
of a live stream. Medians of the ratios of runs side by side.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np

from fewcal import BoardNotFound, Camera, Chessboard, detect
from fewcal.rendering import clutter, render
from fewcal.virtual_camera import board_pose

SIZE = (1920, 1080)
CAMERA = Camera(1800.0, 1800.0, 959.5, 539.5, [-0.1, 0.02, 0.0, 0.0, 0.0])
BOARD = Chessboard(9, 6, 0.025)


def seconds(detector: Callable[[np.ndarray], object], image: np.ndarray) -> float:
    """Wall time of one detection."""
    start = time.perf_counter()
    detector(image)
    return time.perf_counter() - start


def ours(image: np.ndarray) -> bool:
    """Whether fewcal finds the board."""
    try:
        detect(image, BOARD)
    except BoardNotFound:
        return False
    return True


def theirs(image: np.ndarray) -> bool:
    """Whether OpenCV does."""
    return bool(cv2.findChessboardCornersSB(image, (BOARD.columns, BOARD.rows))[0])


def main() -> None:
    """Print one line a frame."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=9)
    runs = parser.parse_args().runs
    background = clutter(SIZE, np.random.default_rng(1))
    T = board_pose(30, 20, 15, 0.6, (0.1, 0.0625))
    frames = {
        "with a board": render(CAMERA, SIZE, BOARD, T, background=background),
        "without": render(CAMERA, SIZE, None, None, background=background),
    }
    for name, image in frames.items():
        pairs = [(seconds(ours, image), seconds(theirs, image)) for _ in range(runs)]
        ratio = np.median([a / b for a, b in pairs])
        print(
            f"{name:13s} found: {ours(image)!s:5s} fewcal {1e3 * min(a for a, _ in pairs):6.1f} ms, "
            f"findChessboardCornersSB {1e3 * min(b for _, b in pairs):6.1f} ms, median ratio {ratio:.3f}"
        )


if __name__ == "__main__":
    main()
