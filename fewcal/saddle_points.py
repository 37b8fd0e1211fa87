"""Saddle points of the brightness that look like the meeting of four squares.

Around a corner of a chessboard the brightness falls along one diagonal and rises along the other, so that
the determinant of its Hessian is strongly negative there, and near zero along straight edges:

    S = Ixy^2 - Ixx Iyy > 0

For a step of height A (grey levels) blurred by sigma, S^(1/2) = A / (pi sigma^2) at a square corner. A peak
of S counts as a corner when the brightness on a small circle about it changes sign exactly four times and is
the same at opposite points: that tells a corner from an edge, a blob and the end of a line.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Image = NDArray[np.uint8] | NDArray[np.uint16] | NDArray[np.float32]

BLUR_PX = 1.0
"""Gaussian blur before derivatives: removes pixel noise, and leaves squares of 4 px half their contrast."""
PEAK_RADIUS_PX = 2
"""Two corners are at least this far apart, in either axis: squares below 4 px are left to a finer image."""
RING_RADIUS_PX = 3.0
"""Circle of the four-sector test: inside the four squares as long as these are above 3 px."""
RING_SAMPLES = 24
"""Samples on the circle: 15 deg each, a fifth of the sector that a board tilted by 60 deg may narrow to."""
MIN_CONTRAST = 0.03
"""Faintest step between black and white, as a share of the image's own range: 8 of 255 grey levels."""
RANGE_PERCENT = (1, 99)
"""Percentiles that bound the image's range: a hot pixel or a lamp is not part of it."""
_EVERY = 4
"""Pixels that the percentiles look at, each way."""
MAX_ASYMMETRY = 0.35
"""Odd share of the energy on the circle: 0 at an ideal corner, 1 on an edge, about 0.5 at a T junction."""
MAX_CENTRE_SHARE = 0.42
"""How far the centre may be from half way between dark and bright, as a share of the step: it is there at a
corner, off by 0.2 where the bright squares are overexposed, and by 0.5 on a stripe as wide as the circle."""
MAX_PEAKS = 2000
"""Peaks looked at, strongest first: bounds the time on gravel and foliage; a board has a few hundred."""


@dataclass(frozen=True, eq=False)
class SaddlePoints:
    """Corner candidates of one image.

    Attributes
    ----------
    points : (N, 2)
        Pixels, the centre of the first pixel at (0, 0).
    edges : (N, 2)
        Directions of the two edges, radians from x towards y. The sector swept from the first to the
        second is dark, and so is the opposite one.
    contrast : (N,)
        Brightness of the bright sectors less that of the dark ones, grey levels.
    peaks : (P, 2)
        All peaks of the saddle response that were looked at, with four sectors or not, pixels: on a board
        with markers the corners of their bits as well.
    strength : (P,)
        S^(1/2) there, grey levels / px^2: proportional to the step of a corner.
    """

    points: Array
    edges: Array
    contrast: Array
    peaks: Array
    strength: Array


def find_saddle_points(image: Image) -> SaddlePoints:
    """Find the points of an image where four sectors alternate between dark and bright.

    Parameters
    ----------
    image : (H, W) array
        Grey levels.
    """
    if min(image.shape) < 4 * RING_RADIUS_PX:
        return SaddlePoints(*(np.empty(shape) for shape in ((0, 2), (0, 2), 0, (0, 2), 0)))
    smooth = np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR_PX), dtype=np.float32)
    low, high = np.percentile(smooth[::_EVERY, ::_EVERY], RANGE_PERCENT)
    min_contrast = MIN_CONTRAST * float(high - low)
    return _with_four_sectors(smooth, *_peaks(smooth, min_contrast), min_contrast)


def _peaks(smooth: NDArray[np.float32], min_contrast: float) -> tuple[Array, Array]:
    """Strongest local maxima of the saddle response to a fraction of a pixel, and its square root there."""
    Ixx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=1)
    Iyy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=1)
    Ixy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=1, scale=0.25)
    response = Ixy * Ixy - Ixx * Iyy
    size = 2 * PEAK_RADIUS_PX + 1
    highest = cv2.dilate(response, np.ones((size, size), np.uint8))
    # The differences above see a blur of about 0.5 px^2 more; half the ideal response admits sharp angles.
    faintest = (0.5 * min_contrast / (np.pi * (BLUR_PX**2 + 0.5))) ** 2
    flat = np.flatnonzero((response >= highest) & (response > max(faintest, 1e-9)))
    if len(flat) > MAX_PEAKS:
        flat = flat[np.argpartition(response.ravel()[flat], -MAX_PEAKS)[-MAX_PEAKS:]]
    y, x = np.unravel_index(np.sort(flat), response.shape)
    inside = (x > 0) & (y > 0) & (x < smooth.shape[1] - 1) & (y < smooth.shape[0] - 1)
    y, x = y[inside], x[inside]
    gradient = (
        np.stack([smooth[y, x + 1] - smooth[y, x - 1], smooth[y + 1, x] - smooth[y - 1, x]], axis=1) / 2
    )
    # The saddle is where the gradient vanishes: solve H d = -g, never further than the peak itself is sharp.
    a, b, c = Ixx[y, x], Iyy[y, x], Ixy[y, x]
    determinant = a * b - c * c
    offset = np.stack(
        [c * gradient[:, 1] - b * gradient[:, 0], c * gradient[:, 0] - a * gradient[:, 1]], axis=1
    )
    offset = np.clip(offset / determinant[:, None], -1.0, 1.0)
    strength = np.sqrt(response[y, x].astype(np.float64))
    return np.stack([x, y], axis=1) + np.asarray(offset, dtype=np.float64), strength


def _with_four_sectors(
    smooth: NDArray[np.float32], peaks: Array, strength: Array, min_contrast: float
) -> SaddlePoints:
    """Keep the peaks around which dark and bright alternate four times, and measure their edges."""
    half = RING_SAMPLES // 2
    angles = np.arange(RING_SAMPLES)[:, None] * (2 * np.pi / RING_SAMPLES)
    x, y = peaks.T
    ring = np.stack([x + RING_RADIUS_PX * np.cos(angles), y + RING_RADIUS_PX * np.sin(angles)], axis=-1)
    values = sample(smooth, ring)  # one column a peak: so the sums below run along many of them at a time
    even = (values[:half] + values[half:]) / 2
    odd = (values[:half] - values[half:]) / 2
    middle = (even.max(axis=0) + even.min(axis=0)) / 2
    centre = sample(smooth, peaks) - middle
    even = even - middle
    step = even.max(axis=0) - even.min(axis=0)
    energy = np.sum(even**2, axis=0) + np.sum(odd**2, axis=0)
    following = np.roll(even, -1, axis=0)
    following[-1] = even[0]  # half a turn further the circle repeats itself
    falls, rises = (even > 0) & (following <= 0), (even <= 0) & (following > 0)
    good = (
        (falls.sum(axis=0) == 1)
        & (rises.sum(axis=0) == 1)
        & (np.sum(odd**2, axis=0) < MAX_ASYMMETRY * energy)
        & (step > min_contrast)
        & (np.abs(centre) < MAX_CENTRE_SHARE * step)
    )
    even, following, falls, rises = (part[:, good] for part in (even, following, falls, rises))
    into_dark, into_bright = _crossing(even, following, falls), _crossing(even, following, rises)
    edges = np.stack([into_dark, into_bright], axis=1) * (np.pi / half)
    return SaddlePoints(peaks[good], edges, step[good], peaks, strength)


def _crossing(value: Array, following: Array, where: NDArray[np.bool_]) -> Array:
    """Position, in samples, at which each column passes through zero."""
    index = np.argmax(where, axis=0)[None]
    before, after = np.take_along_axis(value, index, 0), np.take_along_axis(following, index, 0)
    return np.asarray((index + before / (before - after))[0], dtype=np.float64)


def sample(image: Image, points: Array) -> Array:
    """Brightness at points between pixels, bilinear; beyond the edge the outermost pixel repeats.

    Parameters
    ----------
    image : (H, W) array
    points : (..., 2)
        Pixels.

    Returns
    -------
    (...) grey levels.
    """
    flat = np.ascontiguousarray(points.reshape(-1, 2), dtype=np.float32)
    height, width = image.shape
    x = np.clip(flat[:, 0], 0, width - 1)
    y = np.clip(flat[:, 1], 0, height - 1)
    x0 = np.minimum(x.astype(np.intp), width - 2)
    y0 = np.minimum(y.astype(np.intp), height - 2)
    fx, fy = x - x0, y - y0
    start = y0 * width + x0
    pixels = image.ravel()
    top = pixels[start] * (1 - fx) + pixels[start + 1] * fx
    bottom = pixels[start + width] * (1 - fx) + pixels[start + width + 1] * fx
    return np.asarray(top * (1 - fy) + bottom * fy, dtype=np.float64).reshape(points.shape[:-1])
