from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import SIZE, differences

from fewcal.camera import Camera, project_pixel_model
from fewcal.pixel_camera import from_plumb_bob, nearest_plumb_bob, plumb_bob_jacobian

Array = NDArray[np.float64]

SQUARE = Camera(1200.0, 1200.0, 650.0, 470.0, [-0.2, 0.08, 0.001, -0.002, 0.0])
RAYS = np.concatenate(
    [
        np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 15), np.linspace(-0.4, 0.4, 11)), axis=-1),
        np.ones((11, 15, 1)),
    ],
    axis=-1,
).reshape(-1, 3)
IN_PIXELS = np.array([1, 1, 1, 1, 1, 1e-7, 1e-13, 1e-5, 1e-5])
PAPER = np.array([1180.0, 1240.0, 640.0, 480.0, 0.0, -1.5e-7, 4e-14, 3e-6, -5e-6])


def paper_pixels(intrinsics: Array, coefficients: Array) -> Array:
    return project_pixel_model(RAYS, intrinsics, coefficients)


def related(theta: Array) -> Array:
    """fx, fy, cx, cy, K1, K2, p1, p2 by the relation of the two models for f = sqrt(fx fy)."""
    fx, fy, u0, v0, _, k1, k2, k3, k4 = theta
    f = np.sqrt(fx * fy)
    return np.array([fx, fy, u0, v0, k1 * f**2, k2 * f**4, k4 * f, k3 * f])


def test_square_pixels_make_the_two_models_one() -> None:
    coefficients = from_plumb_bob(SQUARE)
    K1, K2, p1, p2, _ = SQUARE.distortion
    np.testing.assert_allclose(coefficients, [K1 / 1200**2, K2 / 1200**4, p2 / 1200, p1 / 1200])
    intrinsics = np.append(SQUARE.intrinsics, 0.0)
    np.testing.assert_allclose(paper_pixels(intrinsics, coefficients), SQUARE.project(RAYS), atol=1e-9)


def test_nearest_plumb_bob_inverts_from_plumb_bob_for_square_pixels() -> None:
    found = nearest_plumb_bob(np.append(SQUARE.intrinsics, 0.0), from_plumb_bob(SQUARE), SIZE)
    np.testing.assert_array_equal(found.intrinsics, SQUARE.intrinsics)
    np.testing.assert_allclose(found.distortion, SQUARE.distortion, rtol=1e-9, atol=1e-15)


def test_otherwise_nearest_plumb_bob_projects_more_alike_than_the_relation_does() -> None:
    found = nearest_plumb_bob(PAPER[:5], PAPER[5:], SIZE)
    np.testing.assert_array_equal(found.intrinsics, PAPER[:4])
    plain = Camera(*PAPER[:4], np.append(related(PAPER)[4:], 0.0))
    wanted = paper_pixels(PAPER[:5], PAPER[5:])
    inside = ((wanted >= 0) & (wanted <= np.array(SIZE) - 1)).all(axis=1)
    error = [np.sqrt(((c.project(RAYS) - wanted)[inside] ** 2).mean()) for c in (found, plain)]
    assert error[0] < 0.95 * error[1]
    assert error[0] < 0.5


def test_skew_has_no_counterpart_and_does_not_disturb_the_rest() -> None:
    straight = nearest_plumb_bob(PAPER[:5], PAPER[5:], SIZE)
    skewed = nearest_plumb_bob(PAPER[:5] + 3.0 * np.eye(5)[4], PAPER[5:], SIZE)
    np.testing.assert_array_equal(skewed.intrinsics, straight.intrinsics)
    offset = np.abs(skewed.project(RAYS) - straight.project(RAYS)).max()
    assert 0 < offset < 3.0 * 0.5 + 1


@pytest.mark.parametrize("aspect", [1.0, 1.05])
def test_plumb_bob_jacobian(aspect: float) -> None:
    theta = PAPER.copy()
    theta[1] = theta[0] * aspect
    analytic, numeric = plumb_bob_jacobian(theta), differences(related, theta, 1e-2 * IN_PIXELS)
    assert analytic.shape == (8, 9)
    # Each coefficient in its own unit, so that the small ones count too.
    scale = IN_PIXELS * [100, 100, 1, 1, 1, 1, 1, 1, 1]
    size = np.abs(numeric * scale).max(axis=1, keepdims=True)
    np.testing.assert_allclose(analytic * scale / size, numeric * scale / size, atol=1e-6)
