"""Dark discs located to a few hundredths of a pixel, with what that location is worth.

A disc is seen as an ellipse with a blurred edge. Around its centre c, with u = x - c, the image is modelled
as

    I(x) = (a + b E(d(u) / s)) (1 + g . u),     E(t) = erf(t / sqrt 2)
    d(u) = q (q - 1) / |S u|,   q^2 = u^T S u

with the ellipse q = 1, the distance d from it (exact for a circle, else to first order), the blur s (Gaussian
sd, px), the brightness a, the contrast b and the slope g of the light. The model is symmetric about c, and so
is what it leaves out. That the centre of the ellipse is not yet that of the disc is the affair of
:mod:`fewcal.circle_bias`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .saddle_points import Image
from .window_fit import Pixels, Windows, blurred_step, cut_windows, fit_windows

Array = NDArray[np.float64]

MAX_REACH = 1.7
"""How far the window reaches, in radii from the centre: enough white to know it by, and no more."""
MIN_EXPLAINED = 0.7
"""Share of the window's variance that the model must explain: 0.97 and more at a clean disc."""
UNUSUAL = 3.0
"""Times the board's median that a clean disc may leave unexplained. What it leaves beyond that is something
else in its place, such as a finger or glare,"""
COVERED_SHIFT = 0.5
"""and moves the centre by this share of the radius for each unit: white over a share a of the disc moves the
centroid by up to a radii, and leaves some 2 a of the variance unexplained."""
MIN_CONTRAST_SHARE = 0.2
"""Least contrast of a disc, as a share of the board's median."""
MAX_AREA_RATIO = 1.6
"""How much more or less than the others a disc may turn out larger than it was expected."""
MAX_SHIFT = 0.5
"""How far from where it was expected a disc may be found, in radii."""
MIN_BLUR_PX, MAX_BLUR_PX = 0.3, 30.0
"""A pixel is itself a blur of 0.29 px; beyond 30 px no window resolves the edge."""
_PARAMETERS = 10
_LOWER, _UPPER = np.full((2, _PARAMETERS), [[-np.inf], [np.inf]])
_LOWER[[2, 4]] = 1e-6  # both diagonal terms of S: no disc has a radius of 1000 px
_LOWER[5], _UPPER[5] = MIN_BLUR_PX, MAX_BLUR_PX
ENOUGH_PIXELS = 500
"""Pixels near the edge that locate a large disc: twice as many would take a third off a sd of a few
thousandths of a pixel."""
ROUGH_PIXELS = 200
"""Pixels of a disc that locate it to a few hundredths of a pixel."""
MIN_Q = 0.1
"""Share of the radius about the centre in which distances from the edge mean nothing."""
_TINY = np.float32(1e-6)


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Images of discs.

    Attributes
    ----------
    points : (N, 2)
        Centres of the ellipses, pixels, the centre of the first pixel at (0, 0).
    covariances : (N, 2, 2)
        Of the ellipse's area, px^2: the semi-axes are twice the roots of the eigenvalues.
    sigma : (N,)
        One sd of a centre in either direction by the noise, pixels.
    covered : (N,)
        The same by what covers a part of the disc or glares on it, pixels.
    blur : (N,)
        Gaussian sd of the edge, pixels.
    good : (N,)
        Whether the image shows a disc of this board there at all.
    """

    points: Array
    covariances: Array
    sigma: Array
    covered: Array
    blur: Array
    good: NDArray[np.bool_]


def refine_discs(
    image: Image,
    points: Array,
    covariances: Array,
    reach: float,
    band_px: float = math.inf,
    rough: bool = False,
) -> Ellipses:
    """Locate dark discs to sub-pixel accuracy.

    Parameters
    ----------
    image : (H, W) array
        Grey levels.
    points : (N, 2)
        Approximate centres, pixels, to within a third of the radius.
    covariances : (N, 2, 2)
        Approximate shapes, px^2.
    reach : float
        Half the distance between neighbouring centres, in radii.
    band_px : float
        Distance from the edge up to which pixels are looked at: all there is to see of a large disc that is
        nearly located.
    rough : bool
        Whether a few hundredths of a pixel will do, from fewer pixels.
    """
    origin = np.rint(points)
    shapes = np.linalg.inv(4 * covariances).astype(np.float64)
    offset, reach = points - origin, min(MAX_REACH, reach)
    enough = ROUGH_PIXELS if rough else ENOUGH_PIXELS
    windows = _windows(image, origin, offset, shapes, reach, band_px, enough)
    p, sigma, explained = fit_windows(_model, _initial(offset, shapes, windows), windows, _LOWER, _UPPER)
    fitted = p[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    determinant = np.maximum(np.linalg.det(fitted), 1e-12)
    adjugate = p[:, [4, 3, 3, 2]].reshape(-1, 2, 2) * [[1, -1], [-1, 1]]
    found = p[:, :2] + origin
    shift = np.sqrt(np.einsum("ni,nij,nj->n", found - points, shapes, found - points))
    area_ratio = np.sqrt(np.linalg.det(shapes) / determinant)
    contrast = p[:, 7]
    unusual = np.maximum(1 - explained - UNUSUAL * np.median(1 - explained), 0)
    covered = COVERED_SHIFT * unusual * determinant**-0.25
    good = (
        (explained > MIN_EXPLAINED)
        & (contrast > MIN_CONTRAST_SHARE * np.median(contrast))
        & (np.abs(np.log(area_ratio / np.median(area_ratio))) < math.log(MAX_AREA_RATIO))
        & (shift < MAX_SHIFT)
    )
    return Ellipses(found, adjugate / determinant[:, None, None] / 4, sigma, covered, p[:, 5], good)


def _windows(
    image: Image, origin: Array, offset: Array, shapes: Array, reach: float, band_px: float, enough: int
) -> Windows:
    """Pixels of each disc and of the white about it, or of them those near the edge."""
    squared = np.linalg.inv(shapes)
    semi_axis = float(np.sqrt(squared[:, [0, 1], [0, 1]].max()))
    outer, inner = min(reach * semi_axis, semi_axis + band_px), max(semi_axis - band_px, 0)
    largest = np.pi * float(np.sqrt(np.linalg.det(squared).max()))
    every = max(1, round(largest * (outer**2 - inner**2) / semi_axis**2 / enough))
    x, values, weights, _ = cut_windows(image, origin, math.ceil(outer) + 1, every)
    u = x - offset.astype(np.float32)[..., None]
    along = shapes.astype(np.float32) @ u
    q_squared = np.einsum("nip,nip->np", u, along)
    weights *= q_squared < reach**2
    if math.isfinite(band_px):
        q = np.sqrt(q_squared)
        distance = np.abs(q * (q - 1)) / np.sqrt(np.maximum(np.einsum("nip,nip->np", along, along), _TINY))
        weights *= (distance < band_px) & (q > MIN_Q)
    count = int(weights.sum(axis=1).max())
    chosen = np.argsort(weights == 0, axis=1, kind="stable")[:, :count]
    values, weights = (np.take_along_axis(part, chosen, 1) for part in (values, weights))
    return Windows(x[:, chosen], values, weights)


def _initial(offset: Array, shapes: Array, windows: Windows) -> Array:
    """Start of the fit: c, S, blur, brightness, contrast, slope of the light."""
    x, values, weights, _ = windows
    p = np.zeros((len(offset), _PARAMETERS))
    p[:, :2] = offset
    p[:, 2:5] = shapes.reshape(-1, 4)[:, [0, 1, 3]]
    p[:, 5] = 1.0
    u = np.moveaxis(x, 0, 1) - offset.astype(np.float32)[..., None]
    pattern = np.sign(np.einsum("nip,nip->np", u, shapes.astype(np.float32) @ u) - 1)
    pixels = np.maximum(weights.sum(axis=1), 1)
    mean, mean_pattern = np.sum(weights * values, axis=1) / pixels, np.sum(weights * pattern, axis=1) / pixels
    varying = weights * (pattern - mean_pattern[:, None])
    p[:, 7] = np.sum(varying * values, axis=1) / np.maximum(np.sum(varying * pattern, axis=1), 1e-9)
    p[:, 6] = mean - p[:, 7] * mean_pattern
    return p


def _model(p: Pixels, x: Pixels) -> tuple[Pixels, Pixels]:
    """Brightness (N, P) and its derivatives (N, 10, P) by the parameters."""
    c_x, c_y, s_xx, s_xy, s_yy, blur, a, b, g_x, g_y = p.T[..., None]
    u, v = x[0] - c_x, x[1] - c_y
    along_u, along_v = s_xx * u + s_xy * v, s_xy * u + s_yy * v
    # Near the centre d has no derivative; any large distance does there, as the disc is dark to its middle.
    q = np.sqrt(np.maximum(u * along_u + v * along_v, np.float32(MIN_Q**2)))
    h = np.sqrt(np.maximum(along_u * along_u + along_v * along_v, _TINY))
    t = q * (q - 1) / (h * blur)
    E, by_t = blurred_step(t)
    light = 1 + g_x * u + g_y * v
    reflectance = a + b * E
    by_t *= b * light
    by_q, by_h = by_t * (2 * q - 1) / (h * blur * q), -by_t * t / (h * h)  # dq and dh still lack 1 / q, 1 / h
    J = np.empty((len(p), _PARAMETERS, x.shape[-1]), np.float32)
    J[:, 0] = -by_q * along_u - by_h * (s_xx * along_u + s_xy * along_v) - reflectance * g_x
    J[:, 1] = -by_q * along_v - by_h * (s_xy * along_u + s_yy * along_v) - reflectance * g_y
    J[:, 2] = by_q * u * u / 2 + by_h * along_u * u
    J[:, 3] = by_q * u * v + by_h * (along_u * v + along_v * u)
    J[:, 4] = by_q * v * v / 2 + by_h * along_v * v
    J[:, 5] = -by_t * t / blur
    J[:, 6] = light
    J[:, 7] = light * E
    J[:, 8] = reflectance * u
    J[:, 9] = reflectance * v
    return reflectance * light, J
