"""Fit a model of the brightness to the pixels of many small windows at once.

Every window has its own parameters, the first two of them the location c, and all are fitted together by
Levenberg-Marquardt. Under white noise that is the maximum-likelihood location; its covariance is that of the
fit, with the noise taken from the residuals. A pixel as bright as the brightest of all is taken for
saturated: it says that the model is to be as bright or brighter, and nothing more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Pixels = NDArray[np.float32]
"""Grey levels and what they are compared with: half the memory, and 24 bits are more than cameras have."""
Model = Callable[..., tuple[Pixels, Pixels]]
"""Brightness (N, P) and its derivatives (N, K, P) by the parameters (N, K); it is given these, offsets as in
`Windows`, and what constants of the windows there are."""

FLOOR_PX = 0.0015
"""Least sd of a location: what the models leave out, however low the noise. That of print, paper and lens is
larger, and accounted for with the view."""
QUANTISATION = 1 / 12
"""Variance of rounding to whole grey levels: no image has less noise."""
GOLDEN = 0.382
"""Shift of a row against the one before that spreads pixels evenly, whatever share of them is taken."""
_STEP = (
    0.797884575,
    0.0363355029,
    -3.67832325e-5,
    -5.23155428e-5,
    2.90418183e-6,
    7.29685414e-8,
    -2.09556661e-8,
    1.45808726e-9,
    -5.33053734e-11,
    1.03028665e-12,
    -8.23688737e-15,
)
"""Coefficients of p in :func:`blurred_step`, those of which the derivative is off least, by 1.5e-8."""
_STEP_END = 6.0
"""From here on E is 1."""
FAR, NEAR = 1e-3, 1e-6
"""Damping where the start is rough, and where it is about as good as the fit."""
_ITERATIONS = 14
"""Levenberg-Marquardt steps; 5 to 8 suffice from a good start."""
_CONVERGED = 0.01
"""Squared length of a step in sds of the parameters, below which it changes nothing that matters."""


class Windows(NamedTuple):
    """Pixels around N places.

    Attributes
    ----------
    x : (2, P) or (2, N, P)
        Offsets from the middle of each window, pixels, the same for all windows or different ones.
    values : (N, P)
        Grey levels.
    weights : (N, P)
        1 for pixels that count, 0 for the others.
    constants : tuple of (N, ...)
        What else the model has to know about each.
    """

    x: Pixels
    values: Pixels
    weights: Pixels
    constants: tuple[Pixels, ...] = ()


class WindowFit(NamedTuple):
    """Fitted parameters of N windows.

    Attributes
    ----------
    parameters : (N, K)
        The location, pixels from the middle of the window, comes first.
    sigma : (N,)
        One sd of the location in either direction, pixels.
    explained : (N,)
        Share of the brightness variance that the model explains, at most 1.
    """

    parameters: Array
    sigma: Array
    explained: Array


def blurred_step(t: Pixels) -> tuple[Pixels, Pixels]:
    """E = erf(t / sqrt 2), an edge between -1 and 1 blurred by a sd of 1, and its derivative.

    E is tanh(t p(t^2)) with a polynomial p, to 6e-9 but for rounding, six times as fast as SciPy's.
    """
    near = np.minimum(np.maximum(t, -_STEP_END), _STEP_END)
    squared = near * near
    step = squared * _STEP[-1]
    for coefficient in _STEP[-2:0:-1]:
        step += coefficient
        step *= squared
    step += _STEP[0]
    step *= near
    return np.tanh(step, out=step), np.exp(-0.5 * t * t) * math.sqrt(2 / math.pi)


def cut_windows(image: NDArray[np.generic], middles: Array, radius: int, every: int = 1) -> Windows:
    """Cut squares out of an image (H, W) about whole pixels (N, 2); what lies outside weighs nothing.

    Of the pixels only one in `every` is taken, evenly spread.
    """
    dx, dy = np.mgrid[-radius : radius + 1, -radius : radius + 1].reshape(2, -1)[::-1]
    taken = _evenly_spread(dx, dy, every)
    dx, dy = dx[taken], dy[taken]
    column = middles[:, :1].astype(np.intp) + dx
    row = middles[:, 1:].astype(np.intp) + dy
    height, width = image.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    values = image[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)].astype(np.float32)
    return Windows(np.stack([dx, dy]).astype(np.float32), values, inside.astype(np.float32))


def thinned(windows: Windows, every: int) -> Windows:
    """Keep one in `every` of the pixels of windows that share their offsets, evenly spread."""
    taken = _evenly_spread(windows.x[0], windows.x[1], every)
    return windows._replace(
        x=windows.x[:, taken], values=windows.values[:, taken], weights=windows.weights[:, taken]
    )


def _evenly_spread(dx: NDArray[Any], dy: NDArray[Any], every: int) -> NDArray[np.bool_]:
    """Which of the pixels at whole offsets make one in `every` of them."""
    return np.asarray((dx + max(1, round(GOLDEN * every)) * dy) % every == 0)


def fit_windows(
    model: Model, start: Array, windows: Windows, lower: Array, upper: Array, damping: float | Array = FAR
) -> WindowFit:
    """Fit a model to all windows.

    Parameters
    ----------
    model : callable
        See :data:`Model`.
    start : (N, K)
        Where to begin.
    windows : Windows
    lower, upper : (K,)
        Bounds of the parameters.
    damping : float or (N,)
        Of the first step, as a share of the diagonal of the normal equations: `FAR` or `NEAR`.
    """
    values, weights = windows.values, windows.weights
    ceiling = float(values.max(initial=0))
    p = start.copy()
    damped = np.broadcast_to(damping, len(p)).copy()
    cost, normal, gradient, pixels = _linearise(model, p, windows, ceiling)
    moving = np.arange(len(p))
    for _ in range(_ITERATIONS):
        step = _solve(normal[moving], gradient[moving, :, None], damped[moving])[..., 0]
        noise = np.maximum(cost[moving] / np.maximum(pixels[moving], 1), QUANTISATION)
        trial = np.clip(p[moving] + step, lower, upper)
        # A step that changes nothing that matters is taken, and what it led to not looked at.
        settled = np.sum(step * gradient[moving], axis=1) / noise < _CONVERGED
        p[moving[settled]] = trial[settled]
        moving, trial = moving[~settled], trial[~settled]
        if len(moving) == 0:
            break
        x = windows.x if windows.x.ndim == 2 else windows.x[:, moving]
        constants = tuple(each[moving] for each in windows.constants)
        taken = Windows(x, values[moving], weights[moving], constants)
        trial_cost, trial_normal, trial_gradient, trial_pixels = _linearise(model, trial, taken, ceiling)
        better = trial_cost < cost[moving]
        damped[moving] *= np.where(better, 0.1, 10.0)
        done = moving[better]
        p[done], cost[done] = trial[better], trial_cost[better]
        normal[done], gradient[done] = trial_normal[better], trial_gradient[better]
        pixels[done] = trial_pixels[better]
    count = np.maximum(weights.sum(axis=1), 1)
    mean = np.sum(weights * values, axis=1) / count
    variance = np.sum(weights * (values - mean[:, None]) ** 2, axis=1)
    noise = np.maximum(cost / np.maximum(pixels - p.shape[1], 1), QUANTISATION)
    covariance = _solve(normal, np.broadcast_to(np.eye(p.shape[1]), normal.shape), np.zeros(len(p)))
    spread = np.maximum(covariance[:, 0, 0] + covariance[:, 1, 1], 0) / 2
    sigma = np.sqrt(spread * noise + FLOOR_PX**2)
    return WindowFit(p, sigma, 1 - cost / np.maximum(variance, QUANTISATION * count))


def _linearise(model: Model, p: Array, windows: Windows, ceiling: float) -> tuple[Array, Array, Array, Array]:
    """Sum of squares (N,), normal matrix (N, K, K), right side (N, K) and number of pixels (N,) that tell."""
    x, values, weights, constants = windows
    brightness, J = model(p.astype(np.float32), x, *constants)
    weights = weights * ((values < ceiling) | (brightness < ceiling))
    residual = (values - brightness) * weights
    J *= weights[:, None]  # 0 or 1, as good as its square
    cost = np.einsum("np,np->n", residual, residual, dtype=np.float64)
    normal, gradient = J @ np.swapaxes(J, 1, 2), (J @ residual[..., None])[..., 0]
    return cost, normal.astype(np.float64), gradient.astype(np.float64), weights.sum(axis=1, dtype=np.float64)


def _solve(normal: Array, right: Array, damping: Array) -> Array:
    """Solve damped normal equations, scaled by their diagonal so that units do not matter."""
    scale = np.sqrt(np.maximum(np.einsum("nkk->nk", normal), 1e-20))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    scaled[:, range(normal.shape[-1]), range(normal.shape[-1])] += damping[:, None] + 1e-9
    return np.asarray(np.linalg.solve(scaled, right / scale[:, :, None]) / scale[:, :, None])
