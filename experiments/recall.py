"""How many boards are found where finding them is hard, beside OpenCV, on rendered images; a markdown table.

    python experiments/recall.py [--trials 10] [--only shadow] [--keep DIR]

A chessboard, turned and placed at random as in detection.py, under one difficulty after the other: what lies
behind it and before it, the light, the lens, the sensor. Every detector of detectors.py sees the same images.
A board counts as found when the corners are within 2 px rms of where they are. wrong counts the answers of
fewcal that are not; missed the boards that any other detector finds and fewcal does not.
"""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from detection import BOARD, FOUND_PX, barrel_camera, place, rms
from detectors import DETECTORS
from numpy.typing import NDArray

from fewcal import Camera, Chessboard
from fewcal.rendering import Conditions, clutter, render

Array = NDArray[np.float64]
Light = NDArray[np.float32]
"""Brightness of an image, (H, W): 1 is what saturates it."""
Image = NDArray[np.uint8]

EVEN = Conditions(blur_px=0.0, read_noise=0.0, full_well=np.inf, light_slope=0.2, vignetting=0.1)
"""Blur and noise come last, after what happens before the lens."""


class Scene(NamedTuple):
    """A board before a camera.

    Attributes
    ----------
    board : Chessboard
    camera : Camera
    T_camera_board : (4, 4)
    rng : numpy.random.Generator
        Decides what happens to it.
    """

    board: Chessboard
    camera: Camera
    T_camera_board: Array
    rng: np.random.Generator

    def outline(self, margin: float) -> Array:
        """Outline (K, 2), pixels, of the squares and a margin, in squares; dense, as the lens bends it."""
        ends = np.array([[-1.0, -1.0], [self.board.columns, self.board.rows]]) + margin * np.array(
            [[-1], [1]]
        )
        (left, top), (right, bottom) = ends
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom], [left, top]])
        along = np.concatenate([np.linspace(a, b, 50) for a, b in itertools.pairwise(corners)])
        return self.pixels(along)

    def pixels(self, squares: Array) -> Array:
        """Pixels (K, 2) of points of the board (K, 2), in squares from the first corner."""
        points = np.column_stack([squares * self.board.square_size, np.zeros(len(squares))])
        return self.camera.project(points, self.T_camera_board)

    def middle(self) -> Array:
        """Give one pixel (2,) within the board."""
        return self.pixels(self.rng.uniform((0, 0), (self.board.columns - 1, self.board.rows - 1))[None])[0]


Effect = Callable[[Light, Scene], Light]


def table(margin: float, reflectance: float) -> Effect:
    """Cut the board out, with a margin of so many squares, and lay it on a table."""

    def cut(image: Light, scene: Scene) -> Light:
        paper = _polygon(image.shape, scene.outline(margin))
        return image * paper + np.float32(reflectance) * (1 - paper)

    return cut


def hands(image: Light, scene: Scene) -> Light:
    """Let four thumbs reach over the margin into the outer squares, not as far as the corners."""
    n, m = scene.board.columns, scene.board.rows
    for side in range(4):
        along = scene.rng.uniform(0, (n if side % 2 else m) - 1)
        tip = {0: (-0.5, along), 1: (along, -0.5), 2: (n - 0.5, along), 3: (along, m - 0.5)}[side]
        far = np.array(tip) + 2.0 * np.array([(-1, 0), (0, -1), (1, 0), (0, 1)][side])
        ends = np.rint(16 * scene.pixels(np.array([tip, far]))).astype(int)
        width = 0.6 * np.linalg.norm(ends[1] - ends[0]) / 32
        image = image.copy()
        cv2.line(image, ends[0].tolist(), ends[1].tolist(), 0.4, max(1, round(width)), cv2.LINE_AA, 4)
    return image


def shadow(image: Light, scene: Scene) -> Light:
    """Let a sharp shadow across the board take three quarters of the light."""
    return image * (1 - np.float32(0.75) * _half_plane(image.shape, scene))


def blinds(image: Light, scene: Scene) -> Light:
    """Let sunlight through a blind: stripes as wide as a square and a half, a third as bright."""
    y, x = np.indices(image.shape)
    about = scene.rng.uniform(0, np.pi)
    width = 1.5 * _square_px(scene)
    stripe = np.sin(np.pi * (x * np.cos(about) + y * np.sin(about)) / width)
    return image * (1 - np.float32(0.67) * np.clip(0.5 + width * stripe / 4, 0, 1)).astype(np.float32)


def gloss(strength: float) -> Effect:
    """Add the image of a lamp, three squares wide."""

    def add(image: Light, scene: Scene) -> Light:
        y, x = np.indices(image.shape)
        u, v = scene.middle()
        width = 1.5 * _square_px(scene)
        lamp = strength * np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * width**2))
        return image + lamp.astype(np.float32)

    return add


def lines(image: Light, scene: Scene) -> Light:
    """Draw a fine grid over the scene behind, as tiles or shelves make it."""
    paper = _polygon(image.shape, scene.outline(0.3))
    step = 1.3 * _square_px(scene)
    y, x = np.indices(image.shape)
    tiles = 0.35 + 0.3 * ((x // step + y // step) % 2)
    return (image * paper + tiles * (1 - paper)).astype(np.float32)


def _half_plane(shape: tuple[int, ...], scene: Scene) -> Light:
    y, x = np.indices(shape)
    about, (u, v) = scene.rng.uniform(0, 2 * np.pi), scene.middle()
    beyond = (x - u) * np.cos(about) + (y - v) * np.sin(about)
    return np.clip(0.5 + beyond / 2, 0, 1).astype(np.float32)


def _polygon(shape: tuple[int, ...], outline: Array) -> Light:
    mask = np.zeros(shape, np.uint8)
    cv2.fillPoly(mask, [np.rint(16 * outline).astype(np.int32)], 255, cv2.LINE_AA, 4)
    return mask.astype(np.float32) / 255


def _square_px(scene: Scene) -> float:
    a, b = scene.pixels(np.array([[0.0, 0.0], [1.0, 0.0]]))
    return float(np.linalg.norm(a - b))


@dataclass(frozen=True)
class Case:
    """A difficulty.

    Parameters
    ----------
    name : str
    board : Chessboard
    width : int
        Of the image, pixels; it is three quarters as high.
    tilt_deg : (float, float)
        Drawn between these.
    square_px : float
        Square at the middle of the board, seen face on.
    barrel : float
        Share by which the lens draws the corner of the image inwards.
    cluttered : bool
        Whether there are things behind the board.
    effects : tuple of functions
        What happens between the board and the lens.
    blur_px, noise : float
        Of lens and sensor, pixels and grey levels.
    motion_squares : float
        Length of the motion along a diagonal of the image, squares.
    exposure : float
        Share of the grey scale at which white arrives.
    jpeg : int, optional
        Quality of compression.
    """

    name: str
    board: Chessboard = BOARD
    width: int = 640
    tilt_deg: tuple[float, float] = (0.0, 40.0)
    square_px: float = 30.0
    barrel: float = 0.0
    cluttered: bool = False
    effects: tuple[Effect, ...] = ()
    blur_px: float = 0.8
    noise: float = 2.0
    motion_squares: float = 0.0
    exposure: float = 0.9
    jpeg: int | None = None

    def take(self, rng: np.random.Generator) -> tuple[Image, Array]:
        """Render an image; and where its corners are (N, 2)."""
        size = (self.width, round(0.75 * self.width))
        camera = barrel_camera(size, self.barrel)
        T = place(self.board, camera, size, self.tilt_deg, self.square_px, rng)
        scene = Scene(self.board, camera, T, rng)
        behind = clutter(size, rng) if self.cluttered else None
        sharp = render(
            camera, size, self.board, T, replace(EVEN, light_deg=rng.uniform(0, 360)), background=behind
        )
        light = sharp.astype(np.float32) / 255
        for effect in self.effects:
            light = effect(light, scene)
        return self._expose(light, rng), camera.project(self.board.points, T)

    def _expose(self, light: Light, rng: np.random.Generator) -> Image:
        """Pass light through lens and sensor."""
        if self.motion_squares:
            length = max(2, round(self.motion_squares * self.square_px / np.sqrt(2)))
            light = cv2.filter2D(light, -1, np.eye(length, dtype=np.float32) / length)
        light = cv2.GaussianBlur(light, (0, 0), self.blur_px) * (self.exposure / EVEN.exposure)
        grey = np.clip(np.rint(255 * light + rng.normal(0, self.noise, light.shape)), 0, 255).astype(np.uint8)
        if self.jpeg is None:
            return grey
        _, packed = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg])
        return np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)


CASES = (
    Case("usual"),
    Case("barrel 30 %", barrel=0.3, square_px=40.0, tilt_deg=(0.0, 20.0)),
    Case("barrel 40 %", barrel=0.4, square_px=36.0, tilt_deg=(0.0, 30.0)),
    Case("tilt 60 deg", tilt_deg=(60.0, 60.0)),
    Case("tilt 70 deg", tilt_deg=(70.0, 70.0)),
    Case("shadow", effects=(shadow,)),
    Case("two shadows", effects=(shadow, shadow)),
    Case("blinds", effects=(blinds,)),
    Case("clutter", cluttered=True),
    Case("tiles", effects=(lines,)),
    Case("clutter, shadow", cluttered=True, effects=(shadow,)),
    Case("gloss", effects=(gloss(0.5),)),
    Case("strong gloss", effects=(gloss(0.8),)),
    Case("dark table", effects=(table(0.25, 0.04),)),
    Case("thin margin, dark table", effects=(table(0.06, 0.04),)),
    Case("no margin, dark table", effects=(table(0.0, 0.04),)),
    Case("no margin, grey table", effects=(table(0.0, 0.4),)),
    Case("no margin, white table", effects=(table(0.0, 0.85),)),
    Case("no margin, clutter", cluttered=True, effects=(table(0.0, 0.04),)),
    Case("hands", effects=(table(0.3, 0.2), hands)),
    Case("JPEG 30", jpeg=30, cluttered=True),
    Case("JPEG 15", jpeg=15, cluttered=True),
    Case("JPEG 30, squares 12 px", jpeg=30, square_px=12.0, cluttered=True),
    Case("motion 0.3 squares", motion_squares=0.3),
    Case("motion 0.5 squares", motion_squares=0.5),
    Case("blur 3 px", blur_px=3.0),
    Case("blur 3 px, squares 15 px", blur_px=3.0, square_px=15.0),
    Case("blur 8 px, squares 60 px", blur_px=8.0, square_px=60.0, width=1280),
    Case("noise 15 levels", noise=15.0),
    Case("dark, noise 4 levels", exposure=0.12, noise=4.0),
    Case("overexposed 2 times", exposure=2.3),
    Case("overexposed 3 times", exposure=3.5, blur_px=1.2),
    Case("squares 10 px, 1080p", width=1920, square_px=10.0, cluttered=True),
    Case("squares 8 px, 1080p", width=1920, square_px=8.0, cluttered=True),
    Case("squares 6 px, 1080p", width=1920, square_px=6.0, cluttered=True),
    Case("squares 12 px, 12 MP", width=4000, square_px=12.0, cluttered=True),
    Case("squares 150 px, 1080p", width=1920, square_px=150.0, tilt_deg=(0.0, 20.0)),
    *(
        Case(f"{columns}x{rows}", Chessboard(columns, rows, 0.025), square_px=min(60.0, 480 / (columns + 3)))
        for columns, rows in ((4, 3), (3, 3), (5, 4), (7, 7), (11, 8), (14, 10), (20, 14))
    ),
    Case("20x14, 1280 px", Chessboard(20, 14, 0.025), 1280, square_px=45.0, cluttered=True),
    Case(
        "20x14, barrel 30 %",
        Chessboard(20, 14, 0.025),
        1280,
        square_px=45.0,
        barrel=0.3,
        tilt_deg=(0.0, 20.0),
    ),
)


def is_right(found: Array | None, truth: Array, board: Chessboard) -> bool:
    """Whether these are the corners, in any order in which the board looks the same."""
    if found is None:
        return False
    grid = truth.reshape(board.rows, board.columns, 2)
    turns = [np.rot90(grid, k) for k in range(4)]
    return any(rms(found - turn.reshape(-1, 2)) < FOUND_PX for turn in turns if turn.shape == grid.shape)


def row(case: Case, trials: int, rng: np.random.Generator, keep: Path | None) -> str:
    """Let every detector look at the images of a case; one line of the table."""
    counts = dict.fromkeys([*DETECTORS, "wrong", "missed"], 0)
    for trial in range(trials):
        image, truth = case.take(rng)
        found = {name: detector(image, case.board) for name, detector in DETECTORS.items()}
        right = {name: is_right(corners, truth, case.board) for name, corners in found.items()}
        for name in DETECTORS:
            counts[name] += right[name]
        counts["wrong"] += found["fewcal"] is not None and not right["fewcal"]
        counts["missed"] += any(right.values()) and not right["fewcal"]
        if keep and not right["fewcal"]:
            keep.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(keep / f"{case.name} {trial}.png".replace(" ", "_")), image)
    return f"| {case.name} | {' | '.join(map(str, counts.values()))} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=10, help="images of each case (default 10)")
    parser.add_argument("--only", default="", help="cases whose name holds this")
    parser.add_argument("--keep", type=Path, help="folder for the images that fewcal misses")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"| {' | '.join(['difficulty', *DETECTORS, 'wrong', 'missed'])} |")
    print("|---" * (len(DETECTORS) + 3) + "|")
    for number, case in enumerate(CASES):
        if options.only not in case.name:
            continue
        print(row(case, options.trials, np.random.default_rng(number), options.keep), flush=True)


if __name__ == "__main__":
    main()
