"""How well the corners of boards with markers are located, on rendered images whose truth is known.

    python experiments/marker_boards.py [--trials 6]

The images are those of experiments/detection.py, with a ChArUco board and an AprilGrid in the place of the
chessboard; OpenCV's CharucoDetector (with and without sub-pixel refinement of the markers, whichever is
better) sees the same ones. rms is over both coordinates of all corners found, z that of the error over the
sigma which fewcal reports, found the share of the corners of the board.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import cv2
import numpy as np
from detection import FOUND_PX, USUAL, Image, Shot, rms, take
from numpy.typing import NDArray

from fewcal import Board, BoardNotFound, detect, parse_board

Array = NDArray[np.float64]

CHARUCO = parse_board("charuco:7x5:0.04:0.03:DICT_5X5_100")
APRILGRID = parse_board("aprilgrid:6x4:0.03:0.3:tag36h11")
DECENT = replace(USUAL, square_px=60.0)
CASES = (
    DECENT,
    replace(DECENT, name="squares 30 px", square_px=30.0),
    replace(DECENT, name="squares 120 px", square_px=120.0),
    replace(DECENT, name="tilt 60 deg", tilt_deg=(60.0, 60.0)),
    replace(DECENT, name="blur 2 px").under(blur_px=2.0),
    replace(DECENT, name="noise 8 levels").under(read_noise=8.0),
    replace(DECENT, name="barrel 20 %", barrel=0.2, tilt_deg=(0.0, 20.0)),
    replace(DECENT, name="overexposed 2 times").under(exposure=2.33),
)


def ours(shot: Shot, board: Board) -> tuple[Array, Array]:
    """Error (M, 2) and sigma (M,) of the corners that fewcal finds."""
    try:
        view = detect(shot.image, board)
    except BoardNotFound:
        return np.empty((0, 2)), np.empty(0)
    points = board.points
    index = np.linalg.norm(points[:, None] - view.object_points, axis=2).argmin(axis=0)
    assert view.sigma is not None
    return view.image_points - shot.truth[index], view.sigma


def opencv(image: Image, truth: Array) -> Array:
    """Error (M, 2) of the corners that CharucoDetector finds, the better of two ways."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((7, 5), 0.04, 0.03, dictionary)
    tried = []
    for way in (cv2.aruco.CORNER_REFINE_NONE, cv2.aruco.CORNER_REFINE_SUBPIX):
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = way
        corners, ids, _, _ = cv2.aruco.CharucoDetector(board, detectorParams=parameters).detectBoard(image)
        if ids is not None and len(ids):
            tried.append(corners.reshape(-1, 2) - truth[np.ravel(ids)])
    return min(tried, key=rms, default=np.empty((0, 2)))


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=6, help="images of each board under each condition")
    trials = parser.parse_args().trials
    print(
        "| condition | ChArUco: fewcal | CharucoDetector | z | found, both | AprilGrid: fewcal | z | found |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for case in CASES:
        rng = np.random.default_rng(1)
        shots = [take(case, rng, CHARUCO, CHARUCO.square_size) for _ in range(trials)]
        charuco = [ours(shot, CHARUCO) for shot in shots]
        theirs = np.concatenate([opencv(shot.image, shot.truth) for shot in shots])
        tags = [ours(shot, APRILGRID) for shot in (take(case, rng, APRILGRID, 0.03) for _ in range(trials))]
        count = trials * len(CHARUCO.points), trials * len(APRILGRID.points)
        mine, marks = (np.concatenate([error for error, _ in each]) for each in (charuco, tags))
        z, z_tags = (
            rms(np.concatenate([error / sigma[:, None] for error, sigma in each])) for each in (charuco, tags)
        )
        assert max(np.abs(mine).max(), np.abs(marks).max()) < FOUND_PX, "a corner was taken for another"
        print(
            f"| {case.name} | **{rms(mine):.3f}** | {rms(theirs):.3f} | {z:.2f} "
            f"| {len(mine) / count[0]:.0%}, {len(theirs) / count[0]:.0%} "
            f"| **{rms(marks):.3f}** | {z_tags:.2f} | {len(marks) / count[1]:.0%} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
