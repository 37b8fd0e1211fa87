"""Corners located to a few hundredths of a pixel, with what that location is worth.

Around one corner c the image is modelled as two blurred edges that cross,

    I(x) = (a + b P(x - c + s^2 g)) (1 + g . (x - c)),     P = E1 E2 + 4 cos(n1, n2) phi(t1) phi(t2)

with ti = ni . x / si the distance from an edge in units of its blur, Ei = erf(ti / sqrt 2) and phi the normal
density; the normals n1, n2 of the edges, the blur s1, s2 of each (Gaussian sd, px: defocus, motion and the
pixel itself) and its mean square s^2, the brightness a, the contrast b and the slope g of the light.

The second term of P is what an even blur makes of edges that are not at right angles, to first order. The
shift s^2 g is what it does in light that falls off, turning F(x) (1 + g . x) into F(x) (1 + g . x) + s^2 g . grad F:
without it corners would be drawn to the darker side. All ten parameters of all corners are fitted at once over
the pixels of a window that follows the squares in size and foreshortening. What the model leaves out is
symmetric about c, as the model is, and does not move it: glare that eats into the black squares, gamma, the
ends of a skew blur.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .grid import local_axes
from .saddle_points import Image
from .window_fit import Pixels, Windows, cut_windows, fit_windows

Array = NDArray[np.float64]

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
_PARAMETERS = 10
_LOWER, _UPPER = np.full((2, _PARAMETERS), [[-np.inf], [np.inf]])
_LOWER[4:6], _UPPER[4:6] = MIN_BLUR_PX, MAX_BLUR_PX


@dataclass(frozen=True, eq=False)
class RefinedCorners:
    """Corners of a grid, located at full resolution.

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
        usual = np.median(step)
        enough = step * np.sign(usual) > MIN_CONTRAST_SHARE * abs(usual)
        return np.asarray((self.explained > MIN_EXPLAINED) & enough)


def refine_corners(image: Image, grid: Array) -> RefinedCorners:
    """Locate the corners of a grid to sub-pixel accuracy.

    Parameters
    ----------
    image : (H, W) array
        Grey levels at full resolution.
    grid : (R, C, 2)
        Approximate corners, pixels, to within a fifth of a square; all known.
    """
    across, down = local_axes(grid)
    shape = grid.shape[:2]
    axes = np.stack([across, down], axis=-2).reshape(-1, 2, 2)
    p, sigma, explained = _fit(image, grid.reshape(-1, 2), axes)
    p = p.reshape(*shape, _PARAMETERS)
    return RefinedCorners(p[..., :2], sigma.reshape(shape), p[..., 4:6], p[..., 7], explained.reshape(shape))


def _fit(image: Image, start: Array, axes: Array) -> tuple[Array, Array, Array]:
    """Fit the model at every start; parameters (N, 10), sigma (N,) and share explained (N,)."""
    origin = np.rint(start)
    windows = _windows(image, origin, axes)
    p, sigma, explained = fit_windows(
        _model, _initial(start - origin, axes, windows), windows, _LOWER, _UPPER
    )
    p[:, :2] += origin
    return p, sigma, explained


def _windows(image: Image, origin: Array, axes: Array) -> Windows:
    """Pixels around each corner, as far as its squares reach."""
    reach = WINDOW_SHARE * np.abs(axes).sum(axis=1).max()
    radius = int(np.clip(np.ceil(reach), MIN_RADIUS_PX, MAX_RADIUS_PX))
    x, values, inside = cut_windows(image, origin, radius)
    # In units of squares along the two axes of the grid; never narrower than the least radius.
    length = np.linalg.norm(axes, axis=2)
    reach = np.clip(WINDOW_SHARE * length, MIN_RADIUS_PX, MAX_RADIUS_PX)
    unit = axes / np.maximum(length, 1e-9)[..., None]
    along = np.abs(np.swapaxes(np.linalg.pinv(unit), 1, 2) @ x)
    return Windows(x, values, inside * (along <= reach[..., None]).all(axis=1))


def _initial(offset: Array, axes: Array, windows: Windows) -> Array:
    """Start of the fit: c, two edge angles, two blurs, brightness, contrast, slope of the light."""
    x, values, weights = windows
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


def _model(p: Pixels, x: Pixels) -> tuple[Pixels, Pixels]:
    """Brightness (N, P) and its derivatives (N, 10, P) by the parameters."""
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
    reflectance = a + b * checker
    contrast = b * light
    both *= contrast
    # Derivatives of the brightness by the distances from the two edges.
    by_E = by_E * F * contrast - both * (skew * t / blur)
    by_F = by_F * E * contrast - both * (skew * other_t / other_blur)
    both *= by_angle
    J = np.empty((len(p), _PARAMETERS, x.shape[1]), np.float32)
    by_x, by_y = by_E * sin + by_F * other_sin, -by_E * cos - by_F * other_cos
    by_variance = by_x * g_x + by_y * g_y
    J[:, 0] = by_x - reflectance * g_x
    J[:, 1] = by_y - reflectance * g_y
    J[:, 2] = -by_E * along - both
    J[:, 3] = -by_F * other_along + both
    J[:, 4] = -by_E * t - by_variance * blur
    J[:, 5] = -by_F * other_t - by_variance * other_blur
    J[:, 6] = light
    J[:, 7] = light * checker
    J[:, 8] = reflectance * (x[0] - c_x) - by_x * variance
    J[:, 9] = reflectance * (x[1] - c_y) - by_y * variance
    return reflectance * light, J


def _edge(
    dx: Pixels, dy: Pixels, angle: Pixels, blur: Pixels
) -> tuple[Pixels, Pixels, Pixels, Pixels, Pixels, Pixels]:
    """E and dE / d distance of one edge, position along it, distance in blurs, cos and sin of its angle."""
    # Imported here, since it takes longer than all of fewcal, and who has points already needs none of it.
    from scipy.special import erf

    cos, sin = np.cos(angle), np.sin(angle)
    t = (dy * cos - dx * sin) / blur
    slope = np.exp(-0.5 * t * t) * (math.sqrt(2 / math.pi) / blur)
    return erf(t * math.sqrt(0.5)), slope, dx * cos + dy * sin, t, cos, sin
