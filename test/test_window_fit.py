from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from fewcal.window_fit import NEAR, Windows, blurred_step, cut_windows, fit_windows, thinned

Pixels = NDArray[np.float32]

NONE = np.full(4, np.inf)


def spot(p: Pixels, x: Pixels) -> tuple[Pixels, Pixels]:
    """A Gaussian spot of 2 px on a level: c, height, level."""
    c_x, c_y, height, level = p.T[..., None]
    u, v = x[0] - c_x, x[1] - c_y
    shape = np.exp(-(u * u + v * v) / 8)
    J = np.stack([height * shape * u / 4, height * shape * v / 4, shape, np.ones_like(shape)], axis=1)
    return (height * shape + level).astype(np.float32), J.astype(np.float32)


def spots(noise: float, count: int = 400) -> tuple[Windows, NDArray[np.float64]]:
    rng = np.random.default_rng(0)
    true = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.full(count, 80.0), np.full(count, 40.0)])
    x = np.mgrid[-7:8, -7:8].reshape(2, -1).astype(np.float32)
    values, _ = spot(true.astype(np.float32), x)
    values = (values + noise * rng.standard_normal(values.shape)).astype(np.float32)
    return Windows(x, values, np.ones_like(values)), true


@pytest.mark.parametrize("noise", [1.0, 8.0])
def test_the_location_scatters_as_its_sigma_says(noise: float) -> None:
    windows, true = spots(noise)
    fit = fit_windows(spot, true + np.array([0.5, -0.5, 10, 5]), windows, -NONE, NONE)
    z = (fit.parameters[:, :2] - true[:, :2]) / fit.sigma[:, None]
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.08)
    assert (fit.explained > 0.4).all()


def test_windows_may_each_have_their_own_pixels() -> None:
    windows, true = spots(1.0, 30)
    count = len(true)
    chosen = np.argsort(np.random.default_rng(1).random(windows.values.shape), axis=1)
    own = Windows(
        windows.x[:, chosen], np.take_along_axis(windows.values, chosen, 1), np.ones_like(windows.values)
    )
    assert own.x.shape == (2, count, windows.x.shape[1])
    start = true + np.array([0.5, -0.5, 10, 5])
    common = fit_windows(spot, start, windows, -NONE, NONE)
    np.testing.assert_allclose(
        fit_windows(spot, start, own, -NONE, NONE).parameters, common.parameters, atol=1e-3
    )


def test_a_part_of_the_pixels_brings_close_and_a_step_from_there_suffices() -> None:
    windows, true = spots(1.0, 30)
    few = thinned(windows, 4)
    assert few.values.shape[1] == pytest.approx(windows.values.shape[1] / 4, rel=0.1)
    start = true + np.array([0.5, -0.5, 10, 5])
    whole = fit_windows(spot, start, windows, -NONE, NONE)
    close = fit_windows(spot, start, few, -NONE, NONE)
    assert np.abs(close.parameters - whole.parameters)[:, :2].max() < 5 * close.sigma.max()
    again = fit_windows(spot, close.parameters, windows, -NONE, NONE, damping=NEAR)
    assert (np.abs(again.parameters - whole.parameters)[:, :2] < 0.1 * whole.sigma[:, None]).all()


def test_bounds_hold() -> None:
    windows, true = spots(1.0, 20)
    upper = np.array([np.inf, np.inf, 70.0, np.inf])
    fit = fit_windows(spot, true - [0, 0, 30, 0], windows, -NONE, upper)
    assert fit.parameters[:, 2].max() <= 70


@pytest.mark.parametrize("every", [1, 2, 3, 4, 5, 7, 8, 13])
def test_pixels_are_left_out_evenly(every: int) -> None:
    windows = cut_windows(np.zeros((99, 99)), np.array([[49.0, 49.0]]), 30, every)
    assert windows.x.shape[1] == pytest.approx(61**2 / every, rel=0.02)
    distance = np.linalg.norm(windows.x[:, :, None] - windows.x[:, None], axis=0)
    np.fill_diagonal(distance, np.inf)
    assert distance.min() > 0.7 * np.sqrt(every)


def test_what_lies_outside_the_image_weighs_nothing() -> None:
    image = np.arange(30, dtype=np.uint8).reshape(5, 6)
    windows = cut_windows(image, np.array([[0.0, 0.0], [3.0, 2.0]]), 1)
    assert windows.weights.sum(axis=1).tolist() == [4, 9]
    np.testing.assert_array_equal(windows.values[1].reshape(3, 3), image[1:4, 2:5])
    np.testing.assert_array_equal(windows.x[:, 0], [-1, -1])


def test_a_blurred_step_is_the_error_function() -> None:
    t = np.linspace(-9, 9, 1001)
    step, slope = blurred_step(t.astype(np.float32))
    assert step.dtype == slope.dtype == np.float32
    np.testing.assert_allclose(step, [math.erf(each / math.sqrt(2)) for each in t], atol=2e-7)
    np.testing.assert_allclose(slope, math.sqrt(2 / math.pi) * np.exp(-0.5 * t**2), atol=2e-7)
