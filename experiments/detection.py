"""How well corners are located, beside OpenCV, on rendered images whose truth is known; a markdown table.

    python experiments/detection.py [--small] [--trials 8]

A 9x6 chessboard, turned and placed at random, under one condition after the other; all else is that of a
decent camera: tilt up to 40 deg, squares of 30 px, blur 0.7 px, noise 2 grey levels. Every detector sees the
same images:

fewcal
    fewcal.detect, the order of the corners being part of the answer.
SB
    findChessboardCornersSB with CALIB_CB_ACCURACY and CALIB_CB_EXHAUSTIVE, the most exact OpenCV has.
sub-pixel
    findChessboardCorners, then cornerSubPix with an 11x11 window (half width 5), or half a square where that
    is less.

rms is the error of a corner over both coordinates, median over the images in which the detector found the
board; ratio is fewcal's over that of the better of OpenCV's, median over the images; found counts boards. z
is the rms of fewcal's error over the sigma it reports (1 is right). Bias is the mean error of fewcal towards
the light, and away from the middle of the image, thousandths of a pixel, with its standard error. ms is the
median time of each detector.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
from detectors import calib_targets
from numpy.typing import NDArray

from fewcal import Board, BoardNotFound, Camera, Chessboard, detect
from fewcal.rendering import Conditions, render
from fewcal.virtual_camera import board_pose

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

BOARD = Chessboard(9, 6, 0.025)
BORDER_PX = 6.0
"""The whole board, to its outermost squares, is at least so far inside the image."""
OVERSAMPLING = 3
"""Blur below a pixel is rendered on a grid so fine; on that of the pixels it would move corners itself."""
FOUND_PX = 2.0
"""A detector whose rms error is larger has found something else."""


@dataclass(frozen=True)
class Case:
    """A condition: what differs from a decent image of a board.

    Parameters
    ----------
    name : str
    tilt_deg : (float, float)
        Drawn between these.
    square_px : float
        Square at the middle of the board, seen face on.
    barrel : float
        Share by which the lens draws the corner of the image inwards.
    light : Conditions
        Blur, noise, light.
    """

    name: str
    tilt_deg: tuple[float, float] = (0.0, 40.0)
    square_px: float = 30.0
    barrel: float = 0.0
    light: Conditions = field(
        default=Conditions(blur_px=0.7, read_noise=2.0, full_well=np.inf, light_slope=0.2, vignetting=0.1)
    )

    def under(self, **light: float) -> Case:
        """Give the same case in another light."""
        return replace(self, light=replace(self.light, **light))


USUAL = Case("usual")
CASES = (
    USUAL,
    *(replace(USUAL, name=f"tilt {tilt} deg", tilt_deg=(tilt, tilt)) for tilt in (0, 20, 40, 60, 70)),
    *(replace(USUAL, name=f"blur {blur} px").under(blur_px=blur) for blur in (0.5, 1.0, 1.5, 2.0)),
    *(replace(USUAL, name=f"noise {noise} levels").under(read_noise=noise) for noise in (1, 4, 8)),
    *(replace(USUAL, name=f"squares {px} px", square_px=px) for px in (8, 12, 20, 60, 120)),
    *(
        replace(USUAL, name=f"barrel {share:.0%}", barrel=share, square_px=40.0, tilt_deg=(0.0, 20.0))
        for share in (0.1, 0.2, 0.3)
    ),
    replace(USUAL, name="light from a side").under(light_slope=0.9),
    replace(USUAL, name="light from a side, blur 2 px").under(light_slope=0.9, blur_px=2.0),
    replace(USUAL, name="overexposed 1.3 times").under(exposure=1.5),
    replace(USUAL, name="overexposed 2 times").under(exposure=2.33),
    replace(USUAL, name="overexposed 2 times, blur 2 px").under(exposure=2.33, blur_px=2.0),
    replace(USUAL, name="overexposed, blur, light from a side").under(
        exposure=2.33, blur_px=2.0, light_slope=0.9
    ),
    replace(USUAL, name="blur 3 px, squares 15 px", square_px=15.0).under(blur_px=3.0),
)
SMALL = tuple(case for case in CASES if case.name in ("usual", "blur 2.0 px", "squares 8 px"))


class Shot(NamedTuple):
    """An image, where its corners are (N, 2), and directions (N, 2): outwards, and towards the light."""

    image: Image
    truth: Array
    outwards: Array
    to_light: Array


class Found(NamedTuple):
    """Corners in the order of the board, and what the detector says of their error, if anything."""

    points: Array
    sigma: Array | None = None


def take(
    case: Case, rng: np.random.Generator, board: Board = BOARD, unit_m: float = BOARD.square_size
) -> Shot:
    """Render a board in a random pose, `unit_m` of it as long as the case has its squares."""
    width = max(640, 16 * round(case.square_px))
    size = (width, round(0.75 * width))
    camera = barrel_camera(size, case.barrel)
    T = place(board, camera, size, case.tilt_deg, case.square_px, rng, unit_m)
    light_deg = rng.uniform(0, 360)
    light = replace(case.light, light_deg=light_deg)
    image = render(camera, size, board, T, light, rng=rng, oversampling=OVERSAMPLING)
    truth = camera.project(board.points, T)
    outwards = truth - camera.intrinsics[2:]
    direction = np.array([np.cos(np.radians(light_deg)), np.sin(np.radians(light_deg))])
    return Shot(
        image,
        truth,
        outwards / np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-9),
        np.broadcast_to(direction, truth.shape),
    )


def place(
    board: Board,
    camera: Camera,
    size: tuple[int, int],
    tilt_deg: tuple[float, float],
    square_px: float,
    rng: np.random.Generator,
    unit_m: float = BOARD.square_size,
) -> Array:
    """Random pose (4, 4) that shows the whole board, `unit_m` of it `square_px` long when seen face on."""
    centre = board.points.mean(axis=0)[:2]
    left, top, right, bottom = board.draw().ink
    outline = np.array([[left, top, 0], [right, top, 0], [right, bottom, 0], [left, bottom, 0]])
    distance = camera.fx * unit_m / square_px
    while True:
        about, roll = rng.uniform(0, 360), rng.uniform(-25, 25)
        T = board_pose(rng.uniform(*tilt_deg), about, roll, distance, centre)
        T[:2, 3] += rng.uniform(-0.15, 0.15, 2) * distance
        seen = camera.project(outline, T)
        if (seen > BORDER_PX).all() and (seen < np.array(size) - BORDER_PX).all():
            return T


def barrel_camera(size: tuple[int, int], barrel: float) -> Camera:
    """Camera whose lens draws the corner of the image inwards by a share of its distance."""
    focal = 1.1 * size[0]
    corner = np.hypot(*size) / 2 / focal / (1 - barrel)  # where it would be without distortion
    return Camera(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2, [-barrel / corner**2, 0, 0, 0, 0])


def ours(image: Image) -> Found | None:
    """Corners that fewcal finds."""
    try:
        view = detect(image, BOARD)
    except BoardNotFound:
        return None
    return Found(view.image_points, view.sigma)


def sector_based(image: Image) -> Found | None:
    """Corners that findChessboardCornersSB finds."""
    flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
    found, corners = cv2.findChessboardCornersSB(image, (BOARD.columns, BOARD.rows), flags=flags)
    return Found(corners.reshape(-1, 2)) if found else None


def sub_pixel(image: Image) -> Found | None:
    """Corners of findChessboardCorners, located by cornerSubPix."""
    found, corners = cv2.findChessboardCorners(image, (BOARD.columns, BOARD.rows))
    return Found(corner_sub_pix(image, corners, BOARD)) if found else None


def corner_sub_pix(image: Image, corners: Array, board: Chessboard) -> Array:
    """Locate corners (N, 2) by cornerSubPix, with an 11x11 window or half a square where that is less."""
    grid = corners.reshape(board.rows, board.columns, 2)
    square = min(np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1))
    half = int(np.clip(square / 2, 1, 5))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-4)
    start = np.array(corners, dtype=np.float32).reshape(-1, 1, 2)
    return np.asarray(cv2.cornerSubPix(image, start, (half, half), (-1, -1), stop)).reshape(-1, 2)


def with_calib_targets(image: Image) -> Found | None:
    """Corners that calib-targets finds."""
    corners = calib_targets(image, BOARD)
    return None if corners is None else Found(corners)


OPENCV: dict[str, Callable[[Image], Found | None]] = {"SB": sector_based, "sub-pixel": sub_pixel}
DETECTORS: dict[str, Callable[[Image], Found | None]] = {"fewcal": ours, **OPENCV}
if importlib.util.find_spec("calib_targets"):
    DETECTORS["calib-targets"] = with_calib_targets


def errors(found: Found | None, shot: Shot, any_order: bool) -> Array | None:
    """Error of each corner (54, 2), pixels; None when the board was not found."""
    if found is None:
        return None
    orders = [found.points]
    if any_order:  # OpenCV may begin at either end
        orders.append(found.points[::-1])
    each = [points - shot.truth for points in orders]
    best = min(each, key=lambda error: float(np.mean(error**2)))
    return best if rms(best) < FOUND_PX else None


def rms(error: Array) -> float:
    """Root mean square of all coordinates."""
    return float(np.sqrt(np.mean(error**2)))


class Tally:
    """What came out of the images of one case."""

    def __init__(self) -> None:
        self.rms: list[dict[str, float]] = []
        self.found = dict.fromkeys(DETECTORS, 0)
        self.seconds: dict[str, list[float]] = {name: [] for name in DETECTORS}
        self.scaled: list[Array] = []
        self.lightwards: list[float] = []
        self.outwards: list[float] = []

    def add(self, shot: Shot) -> None:
        """Let every detector look at an image."""
        of_image = {}
        for name, detector in DETECTORS.items():
            start = time.perf_counter()
            found = detector(shot.image)
            self.seconds[name].append(time.perf_counter() - start)
            error = errors(found, shot, any_order=name != "fewcal")
            if found is None or error is None:
                continue
            self.found[name] += 1
            of_image[name] = rms(error)
            if found.sigma is not None:
                self.scaled.append(error / found.sigma[:, None])
                self.lightwards.append(float(np.mean(np.sum(error * shot.to_light, axis=1))))
                self.outwards.append(float(np.mean(np.sum(error * shot.outwards, axis=1))))
        self.rms.append(of_image)

    def row(self, name: str, trials: int) -> str:
        """One line of the table."""
        median = {
            detector: float(np.median([r[detector] for r in self.rms if detector in r] or [np.nan]))
            for detector in DETECTORS
        }
        # Where only one of them finds the board there is nothing to compare.
        both = [r for r in self.rms if "fewcal" in r and any(d in r for d in OPENCV)]
        ratios = [r["fewcal"] / min(r[d] for d in OPENCV if d in r) for r in both]
        cells = [name]
        cells += [f"{median[detector]:.4f}" for detector in DETECTORS]
        cells.append(f"{np.median(ratios) if ratios else np.nan:.2f}")
        cells.append(f"{rms(np.concatenate(self.scaled)) if self.scaled else np.nan:.2f}")
        cells += [_mean_and_error(values) for values in (self.lightwards, self.outwards)]
        cells.append("/".join(str(self.found[detector]) for detector in DETECTORS) + f" of {trials}")
        cells.append("/".join(f"{1e3 * np.median(self.seconds[detector]):.0f}" for detector in DETECTORS))
        return f"| {' | '.join(cells)} |"


def _mean_and_error(values: list[float]) -> str:
    if len(values) < 2:
        return "nan"
    return f"{1e3 * np.mean(values):+.1f} +- {1e3 * np.std(values, ddof=1) / np.sqrt(len(values)):.1f}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=8, help="images of each condition")
    parser.add_argument("--small", action="store_true", help="three conditions, to see that it runs")
    parser.add_argument("--only", default="", help="conditions whose name holds this")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    names = [f"{name}, rms px" for name in DETECTORS]
    names += ["ratio", "z", "bias to light", "outwards", "found", "ms"]
    print(f"| condition | {' | '.join(names)} |")
    print("|---" * (len(names) + 1) + "|")
    for number, case in enumerate(CASES):
        if (options.small and case not in SMALL) or options.only not in case.name:
            continue
        rng = np.random.default_rng(number)
        tally = Tally()
        for _ in range(options.trials):
            tally.add(take(case, rng))
        print(tally.row(case.name, options.trials), flush=True)


if __name__ == "__main__":
    main()
