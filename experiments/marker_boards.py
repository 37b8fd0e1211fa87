"""How well the corners of boards with markers are located, on rendered images whose truth is known.

    python experiments/marker_boards.py [--trials 6]

The images are those of experiments/detection.py, with a ChArUco board or an AprilGrid in the place of the
chessboard. Other detectors see the same ones, as far as they are installed (fewcal needs none of them):

CharucoDetector
    OpenCV's, with and without sub-pixel refinement of the markers, whichever is better.
calib-targets
    detect_charuco of the package calib-targets.
aprilgrid
    Detector of the package aprilgrid, which reads tags with Kalibr's border of two bits.
pupil-apriltags
    The AprilTag library without decimation. It reads tags with a border of one bit, so that it is shown, and
    fewcal beside it, the same grid printed with such. Its pixel (0, 0) is centred at (0.5, 0.5).

rms is over both coordinates of all corners found, z that of the error over the sigma which fewcal reports,
found the share of the corners of the board, time the median over the images of a detector's time over that of
fewcal, one thread each. Errors beyond 2 px, which are other corners, are counted as not found.
"""

from __future__ import annotations

import argparse
import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from types import ModuleType
from typing import Any

import cv2
import numpy as np
from detection import FOUND_PX, USUAL, Case, Image, rms, take
from numpy.typing import NDArray

from fewcal import AprilGrid, Board, BoardNotFound, Charuco, detect

Array = NDArray[np.float64]
Detector = Callable[[Image, Array], Array]
"""Given an image and where the corners of the board are, errors (M, 2) of those found."""


class NarrowBorder(AprilGrid):
    """An AprilGrid as the AprilTag library has its tags."""

    drawn_border_bits = 1


CHARUCO = Charuco(7, 5, 0.04, 0.03, "DICT_5X5_100")
APRILGRID = AprilGrid(6, 4, 0.03, 0.3, "tag36h11")
NARROW = NarrowBorder(6, 4, 0.03, 0.3, "tag36h11")
DECENT = replace(USUAL, square_px=60.0)
CASES = (
    DECENT,
    replace(DECENT, name="squares 20 px", square_px=20.0),
    replace(DECENT, name="squares 20 px, blur 1.5 px", square_px=20.0).under(blur_px=1.5),
    replace(DECENT, name="squares 30 px", square_px=30.0),
    replace(DECENT, name="squares 30 px, blur 1.5 px", square_px=30.0).under(blur_px=1.5),
    replace(DECENT, name="squares 120 px", square_px=120.0),
    replace(DECENT, name="tilt 60 deg", tilt_deg=(60.0, 60.0)),
    replace(DECENT, name="blur 2 px").under(blur_px=2.0),
    replace(DECENT, name="noise 8 levels").under(read_noise=8.0),
    replace(DECENT, name="barrel 20 %", barrel=0.2, tilt_deg=(0.0, 20.0)),
    replace(DECENT, name="overexposed 2 times").under(exposure=2.33),
)


def installed(module: str) -> ModuleType | None:
    """A module, if it is installed."""
    try:
        return importlib.import_module(module)
    except ImportError:
        return None


def opencv(image: Image, truth: Array) -> Array:
    """Errors of the corners that CharucoDetector finds, the better of two ways."""
    tried = []
    for detector in _opencv_detectors():
        corners, ids, _, _ = detector.detectBoard(image)
        if ids is not None and len(ids):
            tried.append(corners.reshape(-1, 2) - truth[np.ravel(ids)])
    return min(tried, key=rms, default=np.empty((0, 2)))


@lru_cache(maxsize=1)
def _opencv_detectors() -> list[Any]:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    board = cv2.aruco.CharucoBoard((CHARUCO.columns, CHARUCO.rows), 0.04, 0.03, dictionary)
    detectors = []
    for way in (cv2.aruco.CORNER_REFINE_NONE, cv2.aruco.CORNER_REFINE_SUBPIX):
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = way
        detectors.append(cv2.aruco.CharucoDetector(board, detectorParams=parameters))
    return detectors


def calib_targets(image: Image, truth: Array) -> Array:
    """Errors of the corners that calib-targets finds."""
    ct: Any = installed("calib_targets")
    board = ct.CharucoBoardSpec(
        rows=CHARUCO.rows,
        cols=CHARUCO.columns,
        cell_size=1.0,
        marker_size_rel=0.75,
        dictionary=CHARUCO.dictionary,
        marker_layout=ct.MarkerLayout.OPENCV_CHARUCO,
    )
    parameters = ct.CharucoParams(
        board=board, px_per_square=60.0, chessboard=ct.ChessboardParams(), min_marker_inliers=4
    )
    try:
        corners = ct.detect_charuco(image, params=parameters).corners
    except RuntimeError:
        return np.empty((0, 2))
    return np.array([corner.position - truth[corner.id] for corner in corners]).reshape(-1, 2)


def aprilgrid(image: Image, truth: Array) -> Array:
    """Errors of the corners of the tags that the package aprilgrid finds."""
    found = _aprilgrid_detector().detect(image)
    return tag_errors({tag.tag_id: np.reshape(tag.corners, (4, 2)) for tag in found}, truth)


@lru_cache(maxsize=1)
def _aprilgrid_detector() -> Any:
    package: Any = installed("aprilgrid")
    return package.Detector("t36h11")


def pupil_apriltags(image: Image, truth: Array) -> Array:
    """Errors of the corners of the tags that the AprilTag library finds."""
    found = _pupil_detector().detect(image)
    return tag_errors({tag.tag_id: tag.corners - 0.5 for tag in found}, truth)


@lru_cache(maxsize=1)
def _pupil_detector() -> Any:
    package: Any = installed("pupil_apriltags")
    return package.Detector(families="tag36h11", quad_decimate=1.0)


def tag_errors(tags: dict[int, Array], truth: Array) -> Array:
    """Errors of the corners (4, 2) of tags by number, in whatever order."""
    grid = truth.reshape(APRILGRID.rows, 2, APRILGRID.columns, 2, 2).swapaxes(1, 2).reshape(-1, 4, 2)
    errors = [np.empty((0, 2))]
    for number, corners in tags.items():
        if number < len(grid):
            away = np.linalg.norm(grid[number][:, None] - corners, axis=2)
            errors.append(corners[away.argmin(axis=1)] - grid[number])
    return np.concatenate(errors)


PEERS: tuple[tuple[Board, float, dict[str, tuple[str, Detector]]], ...] = (
    (CHARUCO, 0.04, {"CharucoDetector": ("cv2", opencv), "calib-targets": ("calib_targets", calib_targets)}),
    (APRILGRID, 0.03, {"aprilgrid": ("aprilgrid", aprilgrid)}),
    (NARROW, 0.03, {"pupil-apriltags": ("pupil_apriltags", pupil_apriltags)}),
)
"""Boards, the length that a case calls a square, and who else finds them."""


@dataclass
class Tally:
    """What a detector made of the images of a case: errors of corners, and seconds."""

    errors: list[Array]
    seconds: list[float]

    def cells(self, corners: int) -> list[str]:
        """Columns rms and found of the table."""
        errors = np.concatenate(self.errors)
        errors = errors[np.abs(errors).max(axis=1, initial=0) < FOUND_PX]
        return [f"{rms(errors):.3f}" if len(errors) else "", f"{len(errors) / corners:.0%}"]


def ours(image: Image, board: Board, truth: Array) -> tuple[Array, Array]:
    """Errors (M, 2) and sigma (M,) of the corners that fewcal finds."""
    try:
        view = detect(image, board)
    except BoardNotFound:
        return np.empty((0, 2)), np.empty(0)
    index = np.linalg.norm(board.points[:, None] - view.object_points, axis=2).argmin(axis=0)
    assert view.sigma is not None
    return view.image_points - truth[index], view.sigma


def row(case: Case, board: Board, unit_m: float, peers: dict[str, Detector], trials: int) -> str:
    """One line of the table of a board."""
    rng = np.random.default_rng(1)
    mine, z = Tally([], []), []
    others = {name: Tally([], []) for name in peers}
    for _ in range(trials):
        shot = take(case, rng, board, unit_m)
        ours(shot.image, board, shot.truth)  # what is cached is cached
        start = time.perf_counter()
        error, sigma = ours(shot.image, board, shot.truth)
        mine.seconds.append(time.perf_counter() - start)
        mine.errors.append(error)
        z.append(error / sigma[:, None])
        for name, detector in peers.items():
            start = time.perf_counter()
            others[name].errors.append(detector(shot.image, shot.truth))
            others[name].seconds.append(time.perf_counter() - start)
    corners = trials * len(board.points)
    scaled = np.concatenate(z)
    cells = [case.name, *mine.cells(corners), f"{rms(scaled):.2f}" if len(scaled) else ""]
    for tally in others.values():
        cells += tally.cells(corners)
        cells.append(f"{np.median(np.divide(tally.seconds, mine.seconds)):.1f}")
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=6, help="images of each board under each condition")
    parser.add_argument("--only", default="", help="conditions whose name holds this")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    for board, unit_m, known in PEERS:
        peers = {name: detector for name, (module, detector) in known.items() if installed(module)}
        print(f"\n{type(board).__name__} {board}\n")
        print("| condition | fewcal | found | z |" + "".join(f" {name} | found | time |" for name in peers))
        print("|---|---|---|---|" + "---|---|---|" * len(peers))
        for case in CASES:
            if options.only in case.name:
                print(row(case, board, unit_m, peers, options.trials), flush=True)


if __name__ == "__main__":
    main()
