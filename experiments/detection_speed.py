"""Time the detector against OpenCV's on frames of any size, watch its memory, and print markdown tables.

    python experiments/detection_speed.py [--boards TEXT ...] [--sizes 1920x1080 ...] [--runs 5]
    python experiments/detection_speed.py --memory 50

A rendered frame with a board among clutter, and the same scene without one, which is most of a live stream.
Every board stands beside findChessboardCornersSB, without flags, on a frame of the same size with a 9x6
chessboard (or none), run right after it. Printed for each board and size: milliseconds with a board and
without, and the medians of the ratios.

`--memory N` prints instead how much the resident memory of the process rises by a first few detections, and
by N more.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# One thread of linear algebra, as the commands have it: the matrices are small. OpenCV keeps all of its own.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np
from numpy.typing import NDArray

from fewcal import Board, BoardNotFound, Camera, Chessboard, detect, parse_board
from fewcal.rendering import clutter, render
from fewcal.virtual_camera import board_pose

Image = NDArray[np.uint8]

SIZES = ((640, 480), (1920, 1080), (4000, 3000))
BOARDS = (
    "chessboard:9x6:0.025",
    "charuco:7x5:0.035:0.026:DICT_5X5_100",
    "aprilgrid:6x4:0.03:0.3:tag36h11",
    "circles:10x7:0.02",
    "acircles:4x11:0.02",
)
OPENCV = Chessboard(9, 6, 0.025)
BOARD_SHARE = 0.4
"""Length of the board, seen face on, as a share of the image's width."""
WARM = 5
"""Detections before memory is held to be that of use."""


def frames(size: tuple[int, int], board: Board) -> tuple[Image, Image]:
    """Render an image with a board, and one without."""
    focal = 0.94 * size[0]
    camera = Camera(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, [-0.1, 0.02, 0.0, 0.0, 0.0])
    points = board.points[:, :2]
    distance = focal * np.ptp(points, axis=0).max() / (BOARD_SHARE * size[0])
    T = board_pose(30, 20, 15, distance, points.mean(axis=0))
    background = clutter(size, np.random.default_rng(1))
    return (
        render(camera, size, board, T, background=background),
        render(camera, size, None, None, background=background),
    )


def seconds(work: Callable[[], object]) -> float:
    """Wall time of a call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def is_found(image: Image, board: Board) -> bool:
    """Whether fewcal finds a board."""
    try:
        detect(image, board)
    except BoardNotFound:
        return False
    return True


def row(size: tuple[int, int], text: str, runs: int) -> str:
    """Time one kind of board; one line of the table."""
    board = parse_board(text)
    pictures = frames(size, board)
    of_opencv = pictures if board == OPENCV else frames(size, OPENCV)
    cells = [f"{size[0]}x{size[1]}", text]
    for ours, theirs in zip(pictures, of_opencv, strict=True):
        found = is_found(ours, board)
        pairs = [
            (
                seconds(lambda image=ours: is_found(image, board)),
                seconds(
                    lambda image=theirs: cv2.findChessboardCornersSB(image, (OPENCV.columns, OPENCV.rows))
                ),
            )
            for _ in range(runs)
        ]
        best, of_sb = (1e3 * min(times) for times in zip(*pairs, strict=True))
        ratio = np.median([a / b for a, b in pairs])
        cells.append(f"{best:.0f} ({'found' if found else 'none'}) | {of_sb:.0f} | {ratio:.2f}")
    return f"| {' | '.join(cells)} |"


def resident_mb() -> float:
    """Resident memory of this process, on Linux."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def memory_row(size: tuple[int, int], text: str, runs: int) -> str:
    """Watch the memory over detections with a board and without, in turn; one line of the table."""
    board = parse_board(text)
    with ProcessPoolExecutor(1) as pool:  # rendering takes more memory, and keeps it
        pictures = pool.submit(frames, size, board).result()
    start = resident_mb()
    for _ in range(WARM):
        for image in pictures:
            is_found(image, board)
    warm = resident_mb()
    for _ in range(runs):
        for image in pictures:
            is_found(image, board)
    return f"| {size[0]}x{size[1]} | {text} | {warm - start:.1f} | {resident_mb() - warm:.1f} |"


def parse_size(text: str) -> tuple[int, int]:
    """Read WIDTHxHEIGHT."""
    width, height = (int(part) for part in text.split("x"))
    return width, height


def main() -> None:
    """Print a line a board and size."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument(
        "--boards", nargs="+", metavar="TEXT", default=BOARDS, help="default: one of each kind"
    )
    parser.add_argument("--sizes", nargs="+", metavar="WxH", type=parse_size, default=SIZES)
    parser.add_argument("--runs", type=int, default=5, help="of each frame (default 5)")
    parser.add_argument("--memory", type=int, metavar="N", help="watch memory over so many rounds instead")
    options = parser.parse_args()
    if options.memory:
        print("| size | board | MB by the first | MB by the others |")
        print("|---|---|---|---|")
    else:
        print("| size | board | with, ms | SB | ratio | without, ms | SB | ratio |")
        print("|---|---|---|---|---|---|---|---|")
    for size in options.sizes:
        for text in options.boards:
            line = memory_row(size, text, options.memory) if options.memory else row(size, text, options.runs)
            print(line, flush=True)


if __name__ == "__main__":
    main()
