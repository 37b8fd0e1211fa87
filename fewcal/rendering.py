"""Images of a board with known truth, as a real camera would take them.

A pixel is what falls on its area, so each pixel's footprint is carried through the true distortion onto the
board. Where it lies inside one shape it has that shape's grey; where an edge crosses it, the share of each
grey is counted on a lattice of samples. Blur of the lens and of motion, light, noise and quantisation follow
in the order in which a camera applies them.

The board is what :meth:`Board.draw` draws, on a white sheet of paper, and behind it the background.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RectBivariateSpline

from .boards import Board
from .drawing import Drawing
from .errors import InvalidInput

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

BLACK, WHITE = 0.06, 0.86
"""Reflectance of laser print on office paper: toner is not black, nor paper white."""
PLAIN_BACKGROUND = 0.35
"""Reflectance of an empty scene, a dull wall."""
MARGIN = 0.1
"""White paper beyond the board and the margin that it needs, as a share of their shorter side."""
_SAMPLES, _STRIDE = 89, 55
"""Neighbouring Fibonacci numbers make a lattice whose samples are apart in every direction, so that an edge
of any direction is placed to about 1/89 px in each pixel, where a square lattice of as many manages 1/9."""
_RAY_GRID_PX = 16
"""Spacing of the exact rays; a cubic spline between them is true to 1e-6 px for any real lens."""
_BLOCK = 1 << 15
"""Edge pixels sampled at a time, which bounds the memory."""


def _fibonacci_lattice() -> Array:
    """Spread (_SAMPLES, 2) offsets over a pixel's area, evenly and about its centre."""
    index = np.arange(_SAMPLES)
    return (np.stack([index, index * _STRIDE % _SAMPLES], axis=1) + 0.5) / _SAMPLES - 0.5


_LATTICE = _fibonacci_lattice()


class Projector(Protocol):
    """A camera that knows the pixel of a point and the direction of a pixel."""

    def project(self, points: ArrayLike, T_camera_board: ArrayLike | None = None) -> Array:
        """Give the pixels (..., 2) of points (..., 3)."""

    def unproject(self, pixels: ArrayLike, *, folded: str = "raise") -> Array:
        """Give unit vectors (..., 3) of pixels (..., 2), NaN for none when `folded` is "nan"."""

    def __hash__(self) -> int:
        """Let the rays of a camera be kept."""


@dataclass(frozen=True)
class Conditions:
    """Under what conditions an image is taken; the defaults are a decent machine-vision camera indoors.

    Parameters
    ----------
    blur_px : float
        Gaussian blur of the lens, one sigma, pixels.
    motion_px, motion_deg : float
        Length (pixels) of the way the whole image moves during the exposure, as when the camera is shaken,
        and its direction from the u axis towards v, degrees. The pose holds at mid-exposure.
    exposure : float
        Share of the grey scale at which full reflectance in full light arrives.
    black_level : float
        Grey level of darkness.
    vignetting : float
        Share of light lost in the corners of the image, against its middle; grows with the squared radius.
    light_slope, light_deg : float
        Share by which the light falls across the image, and the side the light comes from, degrees as above.
    full_well : float
        Electrons at full scale, which sets the shot noise; infinite for none.
    read_noise : float
        Noise in darkness, one sigma, grey levels.
    bit_depth : int
        Bits of the sensor, at most 8; the image has 8 bits, the lower ones empty.
    """

    blur_px: float = 0.7
    motion_px: float = 0.0
    motion_deg: float = 0.0
    exposure: float = 0.9
    black_level: float = 4.0
    vignetting: float = 0.25
    light_slope: float = 0.2
    light_deg: float = 200.0
    full_well: float = 10_000.0
    read_noise: float = 0.8
    bit_depth: int = 8

    def __post_init__(self) -> None:
        for part in fields(self):
            value = getattr(self, part.name)
            signed = part.name.endswith("_deg")
            if not (math.isfinite(value) or part.name == "full_well") or (value < 0 and not signed):
                raise InvalidInput(f"{part.name} must be a number of at least zero, not {value!r}.")
        if not 1 <= self.bit_depth <= 8:
            raise InvalidInput(f"bit_depth must be 1 to 8, not {self.bit_depth!r}.")
        if self.full_well == 0:
            raise InvalidInput("full_well must be above zero electrons; math.inf leaves shot noise out.")


IDEAL = Conditions(
    blur_px=0.0, black_level=0.0, vignetting=0.0, light_slope=0.0, full_well=math.inf, read_noise=0.0
)
"""A perfect lens and sensor: area sampling and rounding to 8 bits are all that remain."""


def render(
    camera: Projector,
    image_size: tuple[int, int],
    board: Board | None,
    T_camera_board: ArrayLike | None,
    conditions: Conditions = Conditions(),
    *,
    background: ArrayLike | None = None,
    rng: np.random.Generator | None = None,
    oversampling: int = 1,
) -> NDArray[np.uint8]:
    """Take a picture of a board.

    Parameters
    ----------
    camera : Projector
        The true camera, such as :class:`fewcal.Camera`. Its rays are kept, so that further images are fast.
    image_size : (int, int)
        Width and height, pixels.
    board : Board, optional
        None for an image without a board.
    T_camera_board : array_like, (4, 4) or (K, 4, 4), optional
        Pose that maps board coordinates into the camera frame, or several at even times during the exposure:
        a board that moves before a scene at rest. None for an image without a board.
    conditions : Conditions, optional
        Blur, motion, light, noise.
    background : array_like, (H, W), optional
        Reflectance behind the board, 0 to 1, such as :func:`clutter` makes. Plain grey when left out.
    rng : numpy.random.Generator, optional
        Source of the noise; seeded with 0 when left out, so that the same call gives the same image.
    oversampling : int
        The lens blurs what is on a grid so many times as fine as the pixels. With 1 a blur below a pixel is
        coarse, which displaces corners by up to 0.01 px; 3 leaves less than 0.001 px, at nine times the cost.

    Returns
    -------
    (H, W) uint8 grey image; the centre of its first pixel is (0, 0).

    Raises
    ------
    InvalidInput
        When the board shows its back, or shapes disagree.
    """
    width, height = _checked_size(image_size)
    scene = np.full((height, width), PLAIN_BACKGROUND, np.float32)
    if background is not None:
        scene = np.array(background, dtype=np.float32)
        if scene.shape != (height, width):
            raise InvalidInput(f"background must have shape {(height, width)}, not {scene.shape}.")
    if oversampling > 1:
        scene = np.kron(scene, np.ones((oversampling, oversampling), np.float32))
    if board is not None and T_camera_board is not None:
        poses = np.asarray(T_camera_board, dtype=np.float64)
        if poses.ndim not in (2, 3) or poses.shape[-2:] != (4, 4) or not np.isfinite(poses).all():
            raise InvalidInput(
                "T_camera_board must be finite, of shape (4, 4), or (K, 4, 4) for a moving board."
            )
        scene = _painted(scene, camera, board, poses.reshape(-1, 4, 4), oversampling)
    return _expose(
        _through_lens(scene, conditions, oversampling), conditions, rng or np.random.default_rng(0)
    )


def clutter(image_size: tuple[int, int], rng: np.random.Generator, pieces: int = 60) -> Floats:
    """Make a background: a mottled wall with boxes, rods and cables before it.

    Parameters
    ----------
    image_size : (int, int)
        Width and height, pixels.
    rng : numpy.random.Generator
        Decides everything.
    pieces : int
        Number of boxes and rods.

    Returns
    -------
    (H, W) float32 reflectance, 0 to 1.
    """
    width, height = _checked_size(image_size)
    mottle = rng.uniform(-0.12, 0.12, (6, 8)).astype(np.float32)
    scene = 0.4 + cv2.resize(mottle, (width, height), interpolation=cv2.INTER_CUBIC).astype(np.float32)
    centres = rng.uniform(0, (width, height), (pieces, 2))
    halves = rng.uniform(0.005, 0.12, (pieces, 2)) ** 1.3 * width
    angles = rng.normal(0, 0.15, pieces) + rng.integers(0, 4, pieces) * math.pi / 2
    greys = rng.uniform(0.05, 0.9, pieces)
    # Drawing takes fixed-point vertices, so the boxes' edges are placed to 1/16 px.
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    turn = np.array([[np.cos(angles), -np.sin(angles)], [np.sin(angles), np.cos(angles)]]).transpose(2, 0, 1)
    outlines = (square * halves[:, None]) @ turn.transpose(0, 2, 1) + centres[:, None]
    for outline, grey in zip(np.round(outlines * 16).astype(np.int32), greys.tolist(), strict=True):
        cv2.fillConvexPoly(scene, outline, grey, lineType=cv2.LINE_8, shift=4)
    # What stands away from the board is out of focus; it also removes the staircase of the drawing.
    blurred = cv2.GaussianBlur(scene, (0, 0), 1.5)
    return np.clip(blurred, 0, 1).astype(np.float32)


def _painted(scene: Floats, camera: Projector, board: Board, poses: Array, oversampling: int) -> Floats:
    """Mean of the scenes (H, W) with the board at each of the poses (K, 4, 4)."""
    drawing = board.draw()
    rays = _rays(camera, scene.shape[::-1], oversampling)
    total = np.zeros_like(scene)
    for T in poses:
        exposed = scene.copy()
        _paint(exposed, _board_coordinates(rays, T), drawing)
        total += exposed
    return total / np.float32(len(poses))


def _board_coordinates(rays: Array, T: Array) -> Array:
    """Where rays (2, H, W) meet the board: (H, W, 2) metres in the board frame, NaN for nowhere."""
    plane = T[:3, [0, 1, 3]]
    # det [r1 r2 t] = t . (r1 x r2) is positive when the camera sees the printed side.
    if not np.linalg.det(plane) > 0:
        raise InvalidInput("The camera sees the board's back or edge; turn the board's z axis away from it.")
    G = np.linalg.inv(plane)
    x, y, inverse_depth = (G[i, 0] * rays[0] + G[i, 1] * rays[1] + G[i, 2] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse_depth = np.where(inverse_depth > 0, inverse_depth, np.nan)
        return np.stack([x / inverse_depth, y / inverse_depth], axis=-1)


@lru_cache(maxsize=4)
def _rays(camera: Projector, fine_size: tuple[int, ...], oversampling: int) -> Array:
    """(2, H, W) x / z and y / z of each point of a grid finer than the pixels, NaN where there is no ray."""
    every_v, every_u = ((np.arange(n) + 0.5) / oversampling - 0.5 for n in fine_size[::-1])
    v, u = (
        np.linspace(every[0], every[-1], max(5, math.ceil(np.ptp(every) / _RAY_GRID_PX) + 1))
        for every in (every_v, every_u)
    )
    exact = _slopes(camera, v, u)
    if np.isnan(exact).any():  # beyond a fold there is nothing to interpolate between
        return _slopes(camera, every_v, every_u)
    return np.stack([RectBivariateSpline(v, u, plane)(every_v, every_u) for plane in exact])


def _slopes(camera: Projector, v: Array, u: Array) -> Array:
    pixels = np.stack(np.meshgrid(u, v), axis=-1)
    rays = camera.unproject(pixels, folded="nan")
    return np.moveaxis(rays[..., :2] / rays[..., 2:], -1, 0)


def _paint(scene: Floats, position: Array, drawing: Drawing) -> None:
    """Put the board into a scene of reflectances, (H, W), given the board position of each pixel, metres."""
    rim = MARGIN * min(drawing.size)
    paper = np.array(drawing.extent).reshape(2, 2) + np.array([[-rim], [rim]])
    near = np.all((position > paper[0] - rim) & (position < paper[1] + rim), axis=-1)
    rows, columns = np.nonzero(near)
    if len(np.unique(rows)) < 2 or len(np.unique(columns)) < 2:
        return  # too little for a footprint
    box = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    position, near, behind = position[box], near[box], scene[box]
    by_v, by_u = (np.asarray(np.gradient(position, axis=axis)) for axis in (0, 1))
    reach = (np.abs(by_u) + np.abs(by_v)) / 2
    at_rim = np.any(np.abs(position[..., None, :] - paper) <= reach[..., None, :], axis=(-2, -1))
    crossed = near.copy()
    crossed[near] = at_rim[near] | drawing.may_change(position[near], reach[near])
    plain = near & ~crossed
    ink, on_paper = _pattern(position[plain][:, None], drawing, paper)
    behind[plain] = np.where(on_paper, ink, behind[plain][:, None])[:, 0]
    v, u = np.nonzero(crossed)
    for start in range(0, len(v), _BLOCK):
        at = v[start : start + _BLOCK], u[start : start + _BLOCK]
        samples = position[at][:, None] + _LATTICE @ np.stack([by_u[at], by_v[at]], axis=1)
        ink, on_paper = _pattern(samples, drawing, paper)
        share = on_paper.mean(axis=1, dtype=np.float32)
        behind[at] = (ink * on_paper).mean(axis=1, dtype=np.float32) + (1 - share) * behind[at]


def _pattern(samples: Array, drawing: Drawing, paper: Array) -> tuple[Floats, NDArray[np.bool_]]:
    """Reflectance of the print at sets of positions (..., S, 2), and whether there is paper at all."""
    on_paper = np.all((samples >= paper[0]) & (samples < paper[1]), axis=-1)
    return np.where(drawing.is_black(samples), np.float32(BLACK), np.float32(WHITE)), on_paper


def _through_lens(scene: Floats, conditions: Conditions, oversampling: int) -> Floats:
    """What falls on the pixels, given reflectances on a grid so many times as fine."""
    image: NDArray[Any] = scene * _light(scene.shape, conditions)
    if conditions.blur_px > 0:
        sigma = conditions.blur_px * oversampling
        image = cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    if conditions.motion_px > 0:
        kernel = _motion_kernel(conditions.motion_px * oversampling, math.radians(conditions.motion_deg))
        image = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    height, width = image.shape
    blocks = image.reshape(height // oversampling, oversampling, width // oversampling, oversampling)
    return np.asarray(blocks.mean(axis=(1, 3)), dtype=np.float32)


def _expose(image: Floats, conditions: Conditions, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Turn light on pixels (H, W) into grey levels."""
    signal = np.asarray(image, dtype=np.float32) * np.float32(255 * conditions.exposure)
    noise = np.sqrt(np.maximum(signal, 0) * np.float32(255 / conditions.full_well) + conditions.read_noise**2)
    if noise.any():
        signal += noise * rng.standard_normal(signal.shape, dtype=np.float32)
    step = 2 ** (8 - conditions.bit_depth)
    levels = np.round((signal + np.float32(conditions.black_level)) / step) * step
    grey: NDArray[np.uint8] = np.clip(levels, 0, 256 - step).astype(np.uint8)
    return grey


def _light(shape: tuple[int, ...], conditions: Conditions) -> Floats:
    """Illumination times the lens's share of it, (H, W), 1 at most."""
    height, width = shape
    half_diagonal = math.hypot(width, height) / 2
    v = ((np.arange(height) - (height - 1) / 2) / half_diagonal).astype(np.float32)[:, None]
    u = ((np.arange(width) - (width - 1) / 2) / half_diagonal).astype(np.float32)
    angle = math.radians(conditions.light_deg)
    slope = (1 - u * math.cos(angle) - v * math.sin(angle)) / 2
    light = (1 - conditions.light_slope * slope) * (1 - conditions.vignetting * (u * u + v * v))
    return light.astype(np.float32)


def _motion_kernel(length: float, angle: float) -> Floats:
    """Spread of a point that moves evenly over `length` pixels about its middle."""
    half = math.ceil(length / 2) + 1
    along = np.linspace(-length / 2, length / 2, 16 * half)
    u, v = along * math.cos(angle), along * math.sin(angle)
    axis = np.arange(-half, half + 1)
    weights_u = np.maximum(0, 1 - np.abs(u - axis[:, None]))
    weights_v = np.maximum(0, 1 - np.abs(v - axis[:, None]))
    kernel: Floats = (weights_v @ weights_u.T / len(along)).astype(np.float32)
    return kernel


def _checked_size(image_size: tuple[int, int]) -> tuple[int, int]:
    width, height = (int(n) for n in image_size)
    if width < 2 or height < 2:
        raise InvalidInput(f"image_size is width and height in pixels, not {image_size!r}.")
    return width, height
