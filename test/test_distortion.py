from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from scenes import assert_derivative, differences

from fewcal.distortion import (
    DEGREE,
    POLYNOMIAL,
    distort,
    distort_jacobians,
    fold_radius,
    monomials,
    surely_invertible,
    undistort,
)

Array = NDArray[np.float64]

BATCH, POINTS = (2, 3), 7


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


@pytest.fixture
def distortion() -> Array:
    """(2, 3, 5) plumb_bob coefficients."""
    return np.random.default_rng(3).uniform(-1, 1, (*BATCH, 5)) * [0.3, 0.2, 0.01, 0.01, 0.1]


def test_undistort_takes_a_batch_of_lenses(distortion: Array) -> None:
    xy = np.random.default_rng(4).uniform(-0.4, 0.4, (*BATCH, POINTS, 2))
    np.testing.assert_allclose(undistort(distort(xy, distortion), distortion), xy, atol=1e-12)


@given(hnp.arrays(np.float64, 3, elements=between(-2, 2)))
def test_fold_radius_is_the_first_zero_of_the_slope(k: Array) -> None:
    assume(np.all((np.abs(k) > 1e-3) | (k == 0)))
    lens = np.array([k[0], k[1], 0, 0, k[2]])

    def slope(r: Array) -> Array:
        step = 1e-6

        def radial(at: Array) -> Array:
            return distort(np.stack([at, np.zeros_like(at)], axis=-1), lens)[..., 0]

        return (radial(r + step) - radial(r - step)) / (2 * step)

    fold = float(fold_radius(lens))
    end = fold if np.isfinite(fold) else 20.0
    assert np.all(slope(np.linspace(0, end, 400)[:-1]) > -1e-6), "it turns back before the radius reported"
    if np.isfinite(fold):
        steepness = abs(slope(np.array([fold * 1.01]))[0]) + 1
        assert abs(slope(np.array([fold]))[0]) < 1e-5 * steepness * (1 + fold**6)


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        ([0, 0, 0, 0, 0], np.inf),
        ([0.3, 0.1, 0, 0, 0.1], np.inf),
        ([-0.3, 0, 0, 0, 0], 1 / np.sqrt(0.9)),
        ([0, -0.2, 0, 0, 0], 1.0),
        ([0, 0, 0, 0, -1 / 7], 1.0),
        ([1.0, -0.8, 0, 0, 0], 1.0),
    ],
)
def test_fold_radius_of_known_lenses(lens: list[float], expected: float) -> None:
    assert float(fold_radius(np.array(lens, dtype=float))) == pytest.approx(expected, rel=1e-9)


def test_fold_radius_takes_a_batch() -> None:
    lenses = np.zeros((2, 3, 5))
    lenses[1, :, 0] = -0.3
    np.testing.assert_allclose(fold_radius(lenses), [[np.inf] * 3, [1 / np.sqrt(0.9)] * 3])


def test_distort_jacobians(distortion: Array) -> None:
    xy = np.random.default_rng(4).uniform(-0.5, 0.5, (*BATCH, POINTS, 2))
    d_points, d_coefficients = distort_jacobians(xy, distortion)
    assert_derivative(d_points, differences(lambda at: distort(at, distortion), xy, 1e-6))
    assert_derivative(d_coefficients, differences(lambda at: distort(xy, at), distortion, 1e-6))


def test_the_polynomial_is_distort_and_its_derivatives() -> None:
    rng = np.random.default_rng(7)
    points, k = rng.uniform(-1, 1, (2, POINTS)), rng.normal(size=4) * 0.1
    terms = np.tensordot(np.append(1, k), POLYNOMIAL, 1).reshape(3, 2, 13)
    distorted, by_x, by_y = terms @ monomials(points)
    with_k3 = np.append(k, 0.0)
    d_points, d_coefficients = distort_jacobians(points.T, with_k3)
    np.testing.assert_allclose(distorted.T, distort(points.T, with_k3), rtol=1e-12)
    np.testing.assert_allclose(np.stack([by_x.T, by_y.T], axis=-1), d_points, atol=1e-12)
    by_coefficients = POLYNOMIAL[1:, :2] @ monomials(points)
    np.testing.assert_allclose(by_coefficients, d_coefficients[..., :4].T, atol=1e-12)
    along = terms[0] * DEGREE @ monomials(points)
    np.testing.assert_allclose(along, by_x * points[0] + by_y * points[1], atol=1e-12)


@given(
    k=st.tuples(between(-0.6, 0.6), between(-0.4, 0.4), between(-0.2, 0.2)),
    p=st.tuples(between(-0.02, 0.02), between(-0.02, 0.02)),
    radius=between(0.1, 1.5),
)
def test_what_is_surely_invertible_is_inverted(
    k: tuple[float, float, float], p: tuple[float, float], radius: float
) -> None:
    coefficients = np.array([k[0], k[1], *p, k[2]])
    assume(surely_invertible(radius, coefficients))
    angle = np.linspace(0, 2 * np.pi, 12)
    circle = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    assert np.isfinite(undistort(circle, coefficients)).all()


def test_ordinary_lenses_are_surely_invertible_and_folded_ones_are_not() -> None:
    assert surely_invertible(0.8, np.array([-0.25, 0.08, 1e-3, -1e-3, 0.0]))
    assert not surely_invertible(0.8, np.array([-0.4, 0.0, 0.0, 0.0, 0.0]))
