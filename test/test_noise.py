from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import noisy, views_at

from fewcal.constraints import Priors
from fewcal.noise import ABSORBED, CORRELATION, MODEL_ERROR_PX, Noise, total_sigma
from fewcal.views import stack_views

Array = NDArray[np.float64]

VIEWS = stack_views(noisy(views_at((40, 30), (35, 120)), 0.2, 1))
FREEDOM = 2 * 108 - 2 * 6 - 8


def squares(scatter: float) -> Array:
    return np.array([FREEDOM * scatter**2])


def test_degrees_of_freedom() -> None:
    assert Noise.of(VIEWS, Priors()).freedom == FREEDOM
    weights = VIEWS.weights.copy()
    weights[0, :4] = 0
    assert Noise.of(VIEWS._replace(weights=weights), Priors()).freedom == FREEDOM - 8


@pytest.mark.parametrize("residual", [0.0, 1e-4, 0.02, 0.2, 3.0, 1e3])
@pytest.mark.parametrize("prior", [(0.25, 1.0), (0.25, 0.1), (2.0, 0.3)])
def test_scatter_is_the_most_probable_one(residual: float, prior: tuple[float, float]) -> None:
    noise = Noise.of(VIEWS, Priors(corner_sigma_px=prior))
    n = FREEDOM / CORRELATION**2

    def negative_log(s: Array) -> Array:
        return n * (np.log(s) + residual**2 / (2 * s**2)) + 0.5 * (np.log(s / prior[0]) / prior[1]) ** 2

    found = noise.scatter(squares(residual))
    for factor in (0.9999, 1.0001):
        assert negative_log(found)[0] < negative_log(found * factor)[0]


@pytest.mark.parametrize("strength", np.geomspace(1e-3, 30, 9))
def test_scatter_solves_its_equation_however_prior_and_residuals_are_balanced(strength: float) -> None:
    spread = np.sqrt(strength * CORRELATION**2 / (2 * FREEDOM))
    noise = Noise.of(VIEWS, Priors(corner_sigma_px=(0.25, spread)))
    for q in np.geomspace(1e-4, 100, 50):
        s = noise.scatter(squares(q))[0]
        n = FREEDOM / CORRELATION**2
        left = n * (1 - q**2 / s**2) + np.log(s / 0.25) / spread**2
        assert abs(left) < 1e-9 * (n + n * q**2 / s**2 + abs(np.log(s / 0.25)) / spread**2)


def test_scatter_follows_the_residuals_and_a_known_one_does_not() -> None:
    noise = Noise.of(VIEWS, Priors())
    for residual in (0.05, 0.2, 1.0):
        assert noise.scatter(squares(residual))[0] == pytest.approx(residual, rel=0.05)
        assert noise.known().scatter(squares(residual))[0] == pytest.approx(0.25)
        for sigma in (0.01, 0.3, 0.5, 3.0):
            assert np.sqrt(noise.known(sigma).variance(squares(residual))[0]) == pytest.approx(sigma)
    firm = Noise.of(VIEWS, Priors(corner_sigma_px=(0.3, 1e-4)))
    assert firm.scatter(squares(1.0))[0] == pytest.approx(0.3, rel=0.01)


def test_total_sigma_adds_correlation_and_model_error() -> None:
    assert total_sigma(np.array([0.2]))[0] == pytest.approx(np.hypot(CORRELATION * 0.2, MODEL_ERROR_PX))
    assert total_sigma(np.array([0.001]))[0] == pytest.approx(np.hypot(CORRELATION, ABSORBED) * 0.001)
    noise = Noise.of(VIEWS, Priors())
    q = squares(0.2)
    np.testing.assert_allclose(noise.variance(q), total_sigma(noise.scatter(q)) ** 2)


def test_objective_prefers_small_residuals_and_likely_cameras() -> None:
    noise = Noise.of(VIEWS, Priors()).repeat(3)
    objective = noise.objective(FREEDOM * np.array([0.2, 0.3, 0.2]) ** 2, np.array([4.0, 4.0, 6.0]))
    assert objective[0] < objective[1]
    assert objective[2] - objective[0] == pytest.approx(1)


def test_take_and_repeat() -> None:
    noise = Noise.of(VIEWS, Priors()).repeat(2)._replace(median=np.array([0.1, 0.4]))
    np.testing.assert_array_equal(noise.take(np.array([1])).median, 0.4)
    assert all(len(part) == 2 for part in noise)
