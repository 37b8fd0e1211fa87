"""Corners located to a few hundredths of a pixel, with what that location is worth.

Around one corner c the image is modelled as two blurred edges that cross,

    I(x) = (a + b P(x - c + s^2 g)) (1 + g . (x - c)),     P = E1 E2 + 4 cos(n1, n2) phi(t1) phi(t2)

with ti = ni . x / si the distance from an edge in units of its blur, Ei = erf(ti / sqrt 2) and phi the normal
density; the normals n1, n2 of the edges, the blur s1, s2 of each (Gaussian sd, px: defocus, motion and the
pixel itself) and its mean square s^2, the brightness a, the contrast b and the slope g of the light.

The second term of P is what an even blur makes of edges that are not at right angles, to first order. The
shift s^2 g is what it does in light that falls off, where F(x) (1 + g . x) gains s^2 g . grad F; without it
corners would be drawn to the darker side. All ten parameters of all corners are fitted at once
over the pixels of a window that follows the squares in size and foreshortening. What the model leaves out is
symmetric about c, as the model is, and does not move it: glare that eats into the black squares, gamma, the
ends of a skew blur.

Where the bright squares have a marker inside, at a distance g from their edges, the black border of it is
part of the model: with d the distances from the two edges and Phi the normal distribution function, P becomes
P - 2 [Phi((d1 - g1) / s1) Phi((d2 - g2) / s2) + Phi((-d1 - g3) / s1) Phi((-d2 - g4) / s2)], the sign of d2
being such that both are in the bright squares. The bits inside are left out of the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .grid import local_axes
from .saddle_points import Image
from .window_fit import FAR, NEAR, Pixels, Windows, blurred_step, cut_windows, fit_windows, thinned

Array = NDArray[np.float64]
Edge = tuple[Pixels, Pixels]
"""Distances from an edge, and its blur."""

WINDOW_SHARE = 0.42
"""Half width of the window as a share of the square, each way: clear of the next edge with its blur."""
MAX_RADIUS_PX = 10
"""Largest half width: 20 px of each edge; more would cost time and see the edges bend by distortion."""
MIN_RADIUS_PX = 2.0
"""Smallest half width: below it ten parameters have hardly more pixels than themselves."""
MIN_EXPLAINED = 0.6
"""Share of the window's variance that the model must explain: 0.95 and more at a clean corner."""
MIN_CONTRAST_SHARE = 0.2
"""Least step of brightness at a corner, as a share of the board's median: light falls off and glare
fills dark squares."""
MIN_BLUR_PX, MAX_BLUR_PX = 0.3, 30.0
"""A pixel is itself a blur of 0.29 px; beyond 30 px no window resolves the edge."""
FREE_MARGIN_BLURS = 2.0
"""What is left out of the window is blurred into it: so many sd."""
SHARP_PX = 0.75
"""Blur of a sharp image, sd."""
BAND_PX = 4.0
"""Half width that the bands along the edges need to show the blur; up to it they are let into the marker,
whose edges run a little apart from those of the square by perspective."""
MIN_FREE_PX = 1.0
"""Least half width of these bands: they show both sides of the edge."""
STRONG_PERCENT = 90
"""Percentile of the contrasts that is that of a corner, whatever covers the others."""
COARSE_PIXELS = 100
"""Pixels of a window that suffice to come close: ten for each parameter."""
_PARAMETERS = 10
_LOWER, _UPPER = np.full((2, _PARAMETERS), [[-np.inf], [np.inf]])
_LOWER[4:6], _UPPER[4:6] = MIN_BLUR_PX, MAX_BLUR_PX


@dataclass(frozen=True)
class Squares:
    """What is printed in the squares that meet at a corner.

    Attributes
    ----------
    marker : float
        Distance of the markers in the bright squares from their edges, as a share of the square; infinite for
        none.
    known : float
        How far from the edges that holds, as a share of the square: what lies farther from both edges is not
        looked at.
    blur : float
        By how much it is blurred, sd, pixels.
    """

    marker: float = math.inf
    known: float = math.inf
    blur: float = SHARP_PX


PLAIN = Squares()


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """Corners of a grid, located at full resolution; NaN where none was looked for.

    Attributes
    ----------
    points : (R, C, 2)
        Pixels, the centre of the first pixel at (0, 0).
    sigma : (R, C)
        One sd of a point in either direction, pixels.
    blur : (R, C, 2)
        Gaussian sd of the edge along the row and along the column, pixels.
    contrast : (R, C)
        Half the step from dark to bright, grey levels; its sign tells which two of the four squares are dark.
    explained : (R, C)
        Share of the brightness variance that the model explains, at most 1.
    """

    points: Array
    sigma: Array
    blur: Array
    contrast: Array
    explained: Array

    @property
    def good(self) -> NDArray[np.bool_]:
        """(R, C) whether the image shows a corner of this board there at all."""
        step = np.where(np.indices(self.contrast.shape).sum(axis=0) % 2 == 0, self.contrast, -self.contrast)
        explained = self.explained > MIN_EXPLAINED
        # What covers most of a board may be flat: that is explained, but has no contrast.
        strongest = np.percentile(np.abs(step[explained]), STRONG_PERCENT) if explained.any() else 0.0
        strong = explained & (np.abs(step) > MIN_CONTRAST_SHARE * strongest)
        if not strong.any():
            return strong
        usual = np.median(step[strong])
        enough = step * np.sign(usual) > MIN_CONTRAST_SHARE * abs(usual)
        return np.asarray(explained & enough)

    def updated(self, other: RefinedCorners, where: NDArray[np.bool_]) -> RefinedCorners:
        """Give the same corners, with others where (R, C)."""
        pairs = ((getattr(self, part.name), getattr(other, part.name)) for part in fields(self))
        return RefinedCorners(
            *(np.where(where.reshape(where.shape + (1,) * (own.ndim - 2)), new, own) for own, new in pairs)
        )


def refine_corners(
    image: Image,
    grid: Array,
    frames: Array | None = None,
    squares: Squares = PLAIN,
    coarse: bool = False,
) -> RefinedCorners:
    """Locate the corners of a grid to sub-pixel accuracy.

    Parameters
    ----------
    image : (H, W) array
        Grey levels at full resolution.
    grid : (R, C, 2)
        Approximate corners, pixels, to within a fifth of a square; NaN for those to leave out.
    frames : (R, C, 3, 3), optional
        Homography from the plane of the board, in squares along row and column from the corner, to pixels
        from it. Taken from the neighbours, all of which must be known, when left out.
    squares : Squares
        What is in them.
    coarse : bool
        Whether a part of the pixels is enough.
    """
    if frames is None:
        frames = affine_frames(grid)
    known = np.isfinite(grid).all(axis=-1)
    p, (sigma, explained) = np.full((*known.shape, _PARAMETERS), np.nan), np.full((2, *known.shape), np.nan)
    if known.any():
        p[known], sigma[known], explained[known] = _fit(image, grid[known], frames[known], squares, coarse)
    return RefinedCorners(p[..., :2], sigma, p[..., 4:6], p[..., 7], explained)


def affine_frames(grid: Array) -> Array:
    """Frames (R, C, 3, 3) of the corners of a grid (R, C, 2), all of which are known."""
    frames = np.zeros((*grid.shape[:2], 3, 3))
    frames[..., :2, 0], frames[..., :2, 1] = local_axes(grid)
    frames[..., 2, 2] = 1
    return frames


def _fit(
    image: Image, start: Array, frames: Array, squares: Squares, only_coarse: bool
) -> tuple[Array, Array, Array]:
    """Fit the model at every start; parameters (N, 10), sigma (N,) and share explained (N,)."""
    origin = np.rint(start)
    axes = np.swapaxes(frames[:, :2, :2], 1, 2)
    windows = _windows(image, origin, axes, squares)
    every = max(windows.values.shape[1] // COARSE_PIXELS, 1)
    coarse = thinned(windows, every)
    first = _initial(start - origin, axes, coarse)
    if math.isfinite(squares.marker):
        gaps = (_gaps(first, frames, squares.marker),)
        windows, coarse = windows._replace(constants=gaps), coarse._replace(constants=gaps)
    p, sigma, explained = fit_windows(_model, first, coarse, _LOWER, _UPPER)
    if every > 1 and not only_coarse:
        # Where the blur fills the window a few pixels do not tell it from a displacement.
        near = FREE_MARGIN_BLURS * p[:, 4:6].max(axis=1) < windows.x.max()
        start, damping = np.where(near[:, None], p, first), np.where(near, NEAR, FAR)
        p, sigma, explained = fit_windows(_model, start, windows, _LOWER, _UPPER, damping)
    p[:, :2] += origin
    return p, sigma, explained


def _windows(image: Image, origin: Array, axes: Array, squares: Squares) -> Windows:
    """Pixels around each corner, as far as its squares reach."""
    reach = WINDOW_SHARE * np.abs(axes).sum(axis=1).max()
    radius = int(np.clip(np.ceil(reach), MIN_RADIUS_PX, MAX_RADIUS_PX))
    x, values, inside, _ = cut_windows(image, origin, radius)
    # In units of squares along the two axes of the grid; never narrower than the least radius.
    length = np.linalg.norm(axes, axis=2)
    reach = np.clip(WINDOW_SHARE * length, MIN_RADIUS_PX, MAX_RADIUS_PX)
    unit = axes / np.maximum(length, 1e-9)[..., None]
    along = np.abs(np.swapaxes(np.linalg.pinv(unit), 1, 2) @ x)
    inside *= (along <= reach[..., None]).all(axis=1)
    if squares.known < WINDOW_SHARE:
        margin = FREE_MARGIN_BLURS * squares.blur
        free = np.maximum(squares.known * length - margin, MIN_FREE_PX)
        if math.isfinite(squares.marker):
            free = np.maximum(squares.marker * length - margin, np.minimum(free, BAND_PX))
        inside *= (along <= free[..., None]).any(axis=1)
    return Windows(x, values, inside)


def _initial(offset: Array, axes: Array, windows: Windows) -> Array:
    """Start of the fit: c, two edge angles, two blurs, brightness, contrast, slope of the light."""
    x, values, weights, _ = windows
    p = np.zeros((len(offset), _PARAMETERS))
    p[:, :2] = offset
    p[:, 2:4] = np.arctan2(axes[..., 1], axes[..., 0])
    p[:, 4:6] = np.clip(0.08 * np.linalg.norm(axes, axis=2)[:, ::-1], 0.7, 2.0)
    p[:, 7] = 1.0
    pattern, _ = _model(p.astype(np.float32), x)
    pixels = np.maximum(weights.sum(axis=1), 1)
    mean = np.sum(weights * values, axis=1) / pixels
    power = np.maximum(np.sum(weights * pattern**2, axis=1), 1e-9)
    p[:, 7] = np.sum(weights * pattern * (values - mean[:, None]), axis=1) / power
    p[:, 6] = mean
    return p


def _model(p: Pixels, x: Pixels, gap: Pixels | None = None) -> tuple[Pixels, Pixels]:
    """Brightness (N, P) and its derivatives (N, 10, P) by the parameters; gap (N, 4) is g of the markers."""
    c_x, c_y, angle, other_angle, blur, other_blur, a, b, g_x, g_y = p.T[..., None]
    dx, dy = x[0] - c_x, x[1] - c_y
    light = 1 + g_x * dx + g_y * dy
    variance = (blur * blur + other_blur * other_blur) / 2
    dx, dy = dx + variance * g_x, dy + variance * g_y
    E, by_E, along, t, cos, sin = _edge(dx, dy, angle, blur)
    F, by_F, other_along, other_t, other_cos, other_sin = _edge(dx, dy, other_angle, other_blur)
    skew, by_angle = np.cos(angle - other_angle), np.sin(angle - other_angle)
    both = by_E * by_F * (blur * other_blur)
    checker = E * F + skew * both
    by_E, by_F = by_E * F - both * (skew * t / blur), E * by_F - both * (skew * other_t / other_blur)
    by_blur, by_other_blur = -by_E * t, -by_F * other_t
    if gap is not None:
        added = _markers((t * blur, blur), (other_t * other_blur, other_blur), gap, np.sign(b))
        for total, more in zip((checker, by_E, by_F, by_blur, by_other_blur), added, strict=True):
            total += more
    reflectance = a + b * checker
    contrast = b * light
    by_E *= contrast  # derivatives of the brightness by the distances from the two edges
    by_F *= contrast
    both *= contrast * by_angle
    by_x, by_y = by_E * sin + by_F * other_sin, -by_E * cos - by_F * other_cos
    by_variance = by_x * g_x + by_y * g_y
    J = np.empty((len(p), _PARAMETERS, x.shape[1]), np.float32)
    J[:, 0] = by_x - reflectance * g_x
    J[:, 1] = by_y - reflectance * g_y
    J[:, 2] = -by_E * along - both
    J[:, 3] = -by_F * other_along + both
    J[:, 4] = by_blur * contrast - by_variance * blur
    J[:, 5] = by_other_blur * contrast - by_variance * other_blur
    J[:, 6] = light
    J[:, 7] = light * checker
    J[:, 8] = reflectance * (x[0] - c_x) - by_x * variance
    J[:, 9] = reflectance * (x[1] - c_y) - by_y * variance
    return reflectance * light, J


def _markers(edge: Edge, other: Edge, gap: Pixels, sign: Pixels) -> Pixels:
    """What markers add to E E, and to its derivatives by the distances from the edges and by the blurs.

    The sign (N, 1) is that of the contrast.
    """
    total = np.zeros((5, *edge[0].shape), edge[0].dtype)
    for side, near in ((1, gap[:, :2]), (-1, gap[:, 2:])):
        first, by_first, by_blur = _step(np.float32(side), *edge, near[:, :1])
        second, by_second, by_other_blur = _step(side * sign, *other, near[:, 1:])
        total -= (2 * sign) * np.stack(
            [first * second, by_first * second, first * by_second, by_blur * second, first * by_other_blur]
        )
    return total


def _step(
    side: Pixels | np.float32, distance: Pixels, blur: Pixels, gap: Pixels
) -> tuple[Pixels, Pixels, Pixels]:
    """Phi((side d - g) / s), and its derivatives by d and by s."""
    t = (side * distance - gap) / blur
    E, by_t = blurred_step(t)
    slope = by_t / (2 * blur)
    return 0.5 * (1 + E), side * slope, -slope * t


def _gaps(p: Array, frames: Array, share: float) -> Pixels:
    """Distances (N, 4) of the markers from both edges, pixels: of the one, then of the opposite one."""
    sign = np.where(p[:, 7] > 0, 1.0, -1.0)
    gaps = []
    for side in (1, -1):
        # The first edge is along the row: the side it rises to is that of the next row; for the second edge,
        # along the column, it is that of the column before.
        u, v = -side * sign * share, np.full(len(p), side * share)
        x, y, w = np.moveaxis(frames @ np.stack([u, v, np.ones(len(p))], axis=1)[..., None], 1, 0)[..., 0]
        gaps += [side * _distance(x / w, y / w, p[:, 2]), side * sign * _distance(x / w, y / w, p[:, 3])]
    return np.stack(gaps, axis=1).astype(np.float32)


def _distance(x: Array, y: Array, angle: Array) -> Array:
    """How far points lie to the side of lines through the origin."""
    return y * np.cos(angle) - x * np.sin(angle)


def _edge(
    dx: Pixels, dy: Pixels, angle: Pixels, blur: Pixels
) -> tuple[Pixels, Pixels, Pixels, Pixels, Pixels, Pixels]:
    """E and dE / d distance of one edge, position along it, distance in blurs, cos and sin of its angle."""
    cos, sin = np.cos(angle), np.sin(angle)
    t = (dy * cos - dx * sin) / blur
    E, by_t = blurred_step(t)
    return E, by_t / blur, dx * cos + dy * sin, t, cos, sin
