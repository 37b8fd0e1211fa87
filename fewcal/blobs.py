"""Dark blobs that look like ellipses: candidates for the discs of a circle grid.

What is darker than the mean of its neighbourhood is outlined; an outline is an ellipse when its area is that
of the ellipse with the same second moments.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .saddle_points import RANGE_PERCENT, Image

Array = NDArray[np.float64]

NEIGHBOURHOOD_PX = 25
"""Side of the square whose mean a pixel is compared with. A disc larger than that shows as a ring, whose
outer outline is as good; a larger square would not part the small discs of a tilted board."""
BLUR_PX = 0.5
"""Gaussian blur before: takes noise out of the outlines, and leaves gaps of 2 px open."""
MIN_DARKER = 0.05
"""How much darker than that mean, as a share of the image's own range: 10 of 200 grey levels, above the noise
of most cameras."""
MIN_OUTLINE = 7
"""Pixels of the shortest outline: a disc of 3 px across."""
MAX_FLATTENING = 6.0
"""Largest ratio of the axes of an ellipse: a board tilted by 80 deg."""
ELLIPSE_AREA = (0.88, 1.04)
"""Bounds of an outline's area against that of the ellipse with its moments: 1 for an ellipse, less for
whatever has arms, and a few per cent off where the pixels are coarse."""
MAX_BLOBS = 2000
"""Blobs looked at, largest first: bounds the time on gravel and foliage; a board has a hundred."""
_EVERY = 4
"""Pixels that the percentiles look at, each way."""


@dataclass(frozen=True, eq=False)
class Blobs:
    """Ellipses found in one image.

    Attributes
    ----------
    points : (N, 2)
        Centres, pixels, the centre of the first pixel at (0, 0).
    covariances : (N, 2, 2)
        Of the area of each, px^2: the semi-axes are twice the roots of the eigenvalues.
    """

    points: Array
    covariances: Array


def find_blobs(image: Image) -> Blobs:
    """Find dark ellipses in an image (H, W)."""
    outlines = sorted(_outlines(image), key=len, reverse=True)[:MAX_BLOBS]
    moments = [cv2.moments(outline) for outline in outlines]
    keys = ("m00", "m10", "m01", "mu20", "mu11", "mu02")
    values = np.array([[m[key] for key in keys] for m in moments]).reshape(-1, len(keys)).T
    area, first_x, first_y, xx, xy, yy = values[:, values[0] > 0]
    covariances = np.stack([xx, xy, xy, yy], axis=-1).reshape(-1, 2, 2) / area[:, None, None]
    variances, axes = np.linalg.eigh(covariances)
    root = np.sqrt(np.maximum(variances, 1e-6))
    share = area / (4 * np.pi * root.prod(axis=1))
    # The outline runs through the centres of the outermost pixels, half a pixel inside the edge.
    root += 0.25
    good = (share > ELLIPSE_AREA[0]) & (share < ELLIPSE_AREA[1]) & (root[:, 1] < MAX_FLATTENING * root[:, 0])
    widened = (axes * root[:, None] ** 2) @ np.swapaxes(axes, 1, 2)
    return Blobs(np.stack([first_x, first_y], axis=1)[good] / area[good, None], widened[good])


def _outlines(image: Image) -> list[NDArray[np.int32]]:
    """Outer outlines (K, 1, 2) of what is darker than its neighbourhood."""
    if min(image.shape) < MIN_OUTLINE:
        return []
    smooth = cv2.GaussianBlur(image, (0, 0), BLUR_PX)
    low, high = np.percentile(smooth[::_EVERY, ::_EVERY], RANGE_PERCENT)
    least = max(1.0, MIN_DARKER * float(high - low))
    mean = cv2.blur(smooth, (NEIGHBOURHOOD_PX, NEIGHBOURHOOD_PX))
    dark = (cv2.subtract(mean, smooth) > least).astype(np.uint8)
    # Without their hierarchy, which takes seconds on some patterns; that of a hole runs the other way round.
    found, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    long_enough = [np.asarray(outline, np.int32) for outline in found if len(outline) >= MIN_OUTLINE]
    return [outline for outline in long_enough if cv2.contourArea(outline, oriented=True) < 0]
