from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import assert_derivative, differences

from fewcal.camera import Camera, project_pixel_model
from fewcal.parametrisation import SHIFT, Parametrisation, PixelModel, ScaleFree

Array = NDArray[np.float64]

FREE = ScaleFree((1280, 960))
RNG = np.random.default_rng(4)
SPREAD = np.array([0.3, 0.01, 0.02, 0.02, 0.1, 0.05, 0.002, 0.002])
THETA = RNG.normal(size=(2, 8)) * SPREAD + [np.log(1100), 0, 0, 0, -0.05, 0.01, 0, 0]
RAYS = RNG.uniform(-0.4, 0.4, (2, 3, 2, 5))
IN_PIXELS = np.array([1, 1, 1, 1, 1, 1e-7, 1e-13, 1e-5, 1e-5])
PAPER = RNG.uniform(-1, 1, (2, 9)) * IN_PIXELS * [50, 50, 20, 20, 5, 1, 1, 1, 1] + [
    *(1100.0, 1120.0, 640.0, 480.0),
    *np.zeros(5),
]


def projected(model: Parametrisation, rays: Array, theta: Array) -> tuple[Array, Array, Array]:
    """Pixels, and their derivatives by a shift of the point at unit depth and by the unknowns."""
    columns = np.full((*rays.shape[:2], SHIFT + model.size + 1, *rays.shape[2:]), np.nan)
    model.project(rays, theta, columns)
    return columns[:, :, -1], columns[:, :, :SHIFT], columns[:, :, SHIFT:-1]


def points(rays: Array) -> Array:
    """(N, 3) on the rays (2, N)."""
    return np.column_stack([rays.T, np.ones(rays.shape[1])])


@given(
    f=st.floats(200, 9000),
    aspect=st.floats(0.9, 1.1),
    centre=st.tuples(st.floats(0, 1280), st.floats(0, 960)),
    distortion=st.tuples(*[st.floats(-1, 1)] * 4),
)
def test_theta_inverts_natural(
    f: float, aspect: float, centre: tuple[float, float], distortion: tuple[float, ...]
) -> None:
    natural = np.array([f, f * aspect, *centre, *distortion])
    np.testing.assert_allclose(FREE.natural(FREE.theta(natural)), natural, rtol=1e-11, atol=1e-11)


def test_the_unknowns_are_what_the_priors_speak_of() -> None:
    natural = np.array([1000.0, 1010.0, 659.5, 463.5, -0.2, 0.1, 0.001, -0.002])
    rc = 800 / 1000
    expected = [np.log(1000), np.log(1.01), 20 / 1600, -16 / 1600]
    expected += [-0.2 * rc**2, 0.1 * rc**4, 0.001 * rc, -0.002 * rc]
    np.testing.assert_allclose(FREE.theta(natural), expected, rtol=1e-12)


def test_the_unknowns_do_not_depend_on_resolution() -> None:
    # The centre of the first pixel is (0, 0), so that doubling maps c to 2 (c + 1/2) - 1/2.
    natural = FREE.natural(THETA)
    doubled = natural.copy()
    doubled[:, :2] *= 2
    doubled[:, 2:4] = 2 * (natural[:, 2:4] + 0.5) - 0.5
    found = ScaleFree((2560, 1920)).theta(doubled)
    np.testing.assert_allclose(found[:, 0] - np.log(2), THETA[:, 0], rtol=1e-12)
    np.testing.assert_allclose(found[:, 1:], THETA[:, 1:], rtol=1e-9, atol=1e-14)


def random_covariance(sd: Array) -> Array:
    """Of correlated unknowns with these standard deviations."""
    rows = np.random.default_rng(5).normal(size=(12, 8))
    covariance = rows.T @ rows
    scale = sd / np.sqrt(np.diagonal(covariance))
    return covariance * scale * scale[:, None]


def test_a_small_spread_is_that_of_the_derivative() -> None:
    covariance = random_covariance(1e-5 * SPREAD)
    J = FREE.natural_jacobian(THETA[0])
    expected = J @ covariance @ J.T
    scale = np.sqrt(np.diagonal(expected))
    found = FREE.natural_spread(THETA[0], covariance)
    np.testing.assert_allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-6)


def test_a_large_spread_is_that_of_what_is_drawn() -> None:
    covariance = random_covariance(np.array([0.4, 0.01, 0.02, 0.02, 0.05, 0.05, 0.001, 0.001]))
    drawn = np.random.default_rng(6).multivariate_normal(THETA[0], covariance, 400_000)
    off = FREE.natural(drawn) - FREE.natural(THETA[0])
    expected = np.sqrt((off**2).mean(axis=0))
    found = np.sqrt(np.diagonal(FREE.natural_spread(THETA[0], covariance)))
    # k2 goes with the fourth power of the focal length.
    others = [0, 1, 2, 3, 4, 6, 7]
    np.testing.assert_allclose(found[others] / expected[others], 1, atol=0.02)


def test_distortion_and_focal_length_unknown_together_spread_with_both() -> None:
    theta = THETA[0] * np.array([1, 1, 1, 1, 0, 0, 0, 0])
    covariance = np.diag(np.array([0.4, 0.01, 0.02, 0.02, 0.05, 0.05, 0.001, 0.001]) ** 2)
    found = FREE.natural_spread(theta, covariance)
    # k1 = a1 / rc^2, and the mean of exp(4 x) for a normal x of deviation s is exp(8 s^2).
    expected = covariance[4, 4] * FREE.natural_jacobian(theta)[4, 4] ** 2 * np.exp(8 * 0.4**2)
    assert found[4, 4] == pytest.approx(expected, rel=0.02)


def test_what_is_not_known_at_all_spreads_without_end() -> None:
    assert np.isinf(FREE.natural_spread(THETA[0], np.full((8, 8), np.inf))).all()
    assert not np.isnan(FREE.natural_spread(THETA[0], random_covariance(1e4 * SPREAD))).any()


def test_natural_jacobian() -> None:
    numeric = differences(FREE.natural, THETA, 1e-5 * SPREAD)
    analytic = FREE.natural_jacobian(THETA)
    # Rows from fx to p2 differ by decades, so that each is held against its own size.
    size = np.abs(numeric).max(axis=(0, 2), keepdims=True)
    np.testing.assert_allclose(analytic / size, numeric / size, atol=1e-7)


@pytest.mark.parametrize(
    ("model", "theta", "steps"),
    [
        (FREE, THETA, 1e-4 * SPREAD),
        (FREE._replace(in_pixels=True), THETA, 1e-4 * SPREAD),
        (PixelModel(tangential=True), PAPER, 1e-2 * IN_PIXELS),
        (PixelModel(tangential=False), PAPER[:, :7], 1e-2 * IN_PIXELS[:7]),
    ],
)
def test_jacobians_of_the_projection(model: Parametrisation, theta: Array, steps: Array) -> None:
    pixels, by_shift, by_theta = projected(model, RAYS, theta)
    assert pixels.shape == RAYS.shape
    for axis in range(2):
        step = np.zeros((2, 1))
        step[axis] = 1e-6
        ahead, back = (projected(model, RAYS + side * step, theta)[0] for side in (1, -1))
        assert_derivative(by_shift[:, :, axis], (ahead - back) / 2e-6)
    ahead, back = (projected(model, RAYS / (1 + side * 1e-6), theta)[0] for side in (1, -1))
    assert_derivative(by_shift[:, :, 2], (ahead - back) / 2e-6)
    numeric = differences(lambda at: projected(model, RAYS, at)[0], theta, steps)
    assert_derivative(np.moveaxis(by_theta, 2, -1), numeric)


def test_scale_free_projection_is_that_of_the_camera() -> None:
    pixels = projected(FREE, RAYS, THETA)[0]
    for b, values in enumerate(FREE.natural(THETA)):
        camera = Camera(*values[:4], np.append(values[4:], 0.0))
        for v in range(3):
            np.testing.assert_allclose(pixels[b, v].T, camera.project(points(RAYS[b, v])), rtol=1e-12)


def test_scale_free_projection_in_pixels_is_that_of_the_paper() -> None:
    model = FREE._replace(in_pixels=True)
    pixels, natural, coefficients = (
        projected(model, RAYS, THETA)[0],
        model.natural(THETA),
        model.pixel_coefficients(THETA),
    )
    for b in range(2):
        intrinsics = np.append(natural[b, :4], 0.0)
        expected = project_pixel_model(points(RAYS[b, 0]), intrinsics, coefficients[b])
        np.testing.assert_allclose(pixels[b, 0].T, expected, rtol=1e-12)
    # For square pixels the two models are one.
    square = THETA * [1, 0, 1, 1, 1, 1, 1, 1]
    np.testing.assert_allclose(
        projected(model, RAYS, square)[0], projected(FREE, RAYS, square)[0], rtol=1e-12
    )


def test_the_pixel_model_is_the_papers_with_and_without_k3_and_k4() -> None:
    both, radial = PixelModel(tangential=True), PixelModel(tangential=False)
    assert (both.size, radial.size) == (9, 7)
    np.testing.assert_array_equal(both.coefficients(PAPER), PAPER[:, 5:])
    np.testing.assert_array_equal(radial.coefficients(PAPER[:, :7]), PAPER[:, 5:] * [1, 1, 0, 0])
    for model, theta, kept in ((both, PAPER, [1, 1, 1, 1]), (radial, PAPER[:, :7], [1, 1, 0, 0])):
        expected = project_pixel_model(points(RAYS[1, 0]), PAPER[1, :5], PAPER[1, 5:] * kept)
        np.testing.assert_allclose(projected(model, RAYS, theta)[0][1, 0].T, expected, rtol=1e-12)
