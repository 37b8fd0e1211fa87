"""Which real chessboards are found, beside OpenCV, and whether in the order of the object; a markdown table.

    python experiments/real_detection.py DIR [--each]

DIR holds one folder a camera: images/, meta.json ({"board": {"type": "chessboard", "cols": 9, "rows": 6}},
interior corners) and, where there are any, corners.npz with reference corners (names, view_ptr, img). Every
detector of detectors.py sees every image. Printed for each camera:

found
    images in which each detector finds the board.
missed
    boards that any other detector finds, or the reference holds, and fewcal does not.
order
    images in which fewcal's corners are those of the object: not mirrored, the square beyond the first corner
    black where only one order has it so, and the same corners as the reference, or as the first of the others
    that finds the board, up to the turns in which the board's corners look the same.
from SB, from classic
    distance of fewcal's corners from those of findChessboardCornersSB with CALIB_CB_ACCURACY and
    CALIB_CB_EXHAUSTIVE, and of findChessboardCorners followed by cornerSubPix, pixels: median over all
    corners, and the median over the images of the largest. No detector is the truth here.
time
    median over the images of fewcal's time over that of findChessboardCornersSB without flags.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from detection import corner_sub_pix
from detectors import DETECTORS, Image
from numpy.typing import NDArray

from fewcal import BoardNotFound, Chessboard, detect

Array = NDArray[np.float64]

SAME_SHARE = 0.25
"""Corners closer than this share of a square are the same."""


@dataclass
class Tally:
    """What came out of the images of one camera."""

    images: int = 0
    found: dict[str, int] = field(default_factory=lambda: dict.fromkeys(DETECTORS, 0))
    missed: list[str] = field(default_factory=list)
    in_order: int = 0
    distances: dict[str, list[Array]] = field(default_factory=lambda: {"SB exhaustive": [], "classic": []})
    ratios: list[float] = field(default_factory=list)

    def add(self, name: str, image: Image, board: Chessboard, reference: Array | None) -> None:
        """Let every detector look at an image."""
        self.images += 1
        corners, seconds = {}, {}
        for detector, find in DETECTORS.items():
            start = time.perf_counter()
            corners[detector] = find(image, board)
            seconds[detector] = time.perf_counter() - start
            self.found[detector] += corners[detector] is not None
        self.ratios.append(seconds["fewcal"] / seconds["SB"])
        ours = corners.pop("fewcal")
        others = [reference, *corners.values()]
        known = next((other for other in others if other is not None), None)
        if ours is None:
            self.missed += [name] * (known is not None)
            return
        self.in_order += is_in_order(image, ours, board) and (known is None or _is_same(ours, known, board))
        for detector, distances in self.distances.items():
            other = corners[detector]
            if other is not None and _is_same(ours, other, board):
                other = corner_sub_pix(image, other, board) if detector == "classic" else other
                distances.append(np.linalg.norm(ours - _turned_to(ours, other, board), axis=1))

    def row(self, name: str) -> str:
        """One line of the table."""
        cells = [name, str(self.images), *(str(count) for count in self.found.values())]
        cells += [str(len(self.missed)), f"{self.in_order} of {self.found['fewcal']}"]
        for distances in self.distances.values():
            largest = [each.max() for each in distances]
            cells.append(
                f"{np.median(np.concatenate(distances)):.2f}, {np.median(largest):.2f}" if distances else "-"
            )
        cells.append(f"{np.median(self.ratios):.2f}")
        return f"| {' | '.join(cells)} |"


def is_in_order(image: Image, corners: Array, board: Chessboard) -> bool:
    """Whether corners (N, 2) are not mirrored, and the square beyond the first is black where that can be."""
    H, _ = cv2.findHomography(board.points[:, :2].copy(), corners)
    mirrored = np.linalg.det(H) * (H[2] @ np.append(board.points[:, :2].mean(axis=0), 1.0)) < 0
    row, column = np.indices((board.rows - 1, board.columns - 1))
    grid = corners.reshape(board.rows, board.columns, 2)
    middles = (grid[:-1, :-1] + grid[1:, 1:] + grid[:-1, 1:] + grid[1:, :-1]) / 4
    v, u = np.rint(middles).astype(int).reshape(-1, 2).T[::-1]
    grey = image[v, u].reshape(row.shape)
    like_first = (row + column) % 2 == 0  # on the same diagonal as the square beyond the first corner
    black_first = grey[like_first].mean() < grey[~like_first].mean()
    # Where the counts differ by an even number, the board looks the same from both ends.
    settled = (board.columns - board.rows) % 2 == 1
    return bool(not mirrored and (black_first or not settled))


def _turned_to(ours: Array, other: Array, board: Chessboard) -> Array:
    """Give the corners of another detector in that order in which they are nearest to ours."""
    grid = other.reshape(board.rows, board.columns, 2)
    turns = [np.rot90(grid, k) for k in range(4)]
    orders = [turn.reshape(-1, 2) for turn in turns if turn.shape == grid.shape]
    return min(orders, key=lambda order: float(np.abs(order - ours).sum()))


def _is_same(ours: Array, other: Array, board: Chessboard) -> bool:
    """Whether these are the same corners, each in its place, in an order that is not mirrored."""
    distance = np.linalg.norm(ours - _turned_to(ours, other, board), axis=1)
    grid = ours.reshape(board.rows, board.columns, 2)
    square = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    return bool(np.median(distance) < SAME_SHARE * square)


def references(folder: Path) -> dict[str, Array]:
    """Reference corners (N, 2) by the name of the image."""
    path = folder / "corners.npz"
    if not path.exists():
        return {}
    data = np.load(path, allow_pickle=False)
    bounds = data["view_ptr"]
    return {
        name: data["img"][a:b]
        for name, a, b in zip(data["names"].astype(str).tolist(), bounds[:-1], bounds[1:], strict=True)
    }


def sets(folder: Path) -> Iterator[tuple[Path, Chessboard]]:
    """Give the folders of the cameras that looked at a chessboard."""
    for path in sorted(folder.glob("*/meta.json")):
        board = json.loads(path.read_text())["board"]
        if board["type"] == "chessboard":
            yield path.parent, Chessboard(board["cols"], board["rows"], board.get("square_m") or 1.0)


def why_not(image: Image, board: Chessboard) -> str:
    """Say why fewcal does not find a board."""
    try:
        detect(image, board)
    except BoardNotFound as error:
        return str(error)
    return "found"


def main() -> None:
    """Print the table, and what was missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", default="", help="cameras whose name holds this")
    parser.add_argument("--each", action="store_true", help="also say why fewcal found no board in an image")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    names = [*DETECTORS, "missed", "order", "from SB, px", "from classic, px", "time"]
    print(f"| camera | images | {' | '.join(names)} |")
    print("|---" * (len(names) + 2) + "|")
    for folder, board in sets(options.folder):
        if options.only not in folder.name:
            continue
        tally, reference = Tally(), references(folder)
        reasons = []
        for path in sorted((folder / "images").iterdir()):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                continue
            found = tally.found["fewcal"]
            tally.add(path.name, np.asarray(image, dtype=np.uint8), board, reference.get(path.name))
            if tally.found["fewcal"] == found:
                reasons.append(f"{path.name}: {why_not(np.asarray(image, dtype=np.uint8), board)}")
        print(tally.row(folder.name), flush=True)
        if options.each:
            print(*reasons, sep="\n")


if __name__ == "__main__":
    main()
