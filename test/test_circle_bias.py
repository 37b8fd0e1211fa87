from __future__ import annotations

import numpy as np
import pytest
from circle_pictures import ASYMMETRIC, BARREL, CAMERA, SIZE, SYMMETRIC, pose
from numpy.typing import NDArray
from scenes import assert_derivative, differences

from fewcal.boards import AsymmetricCircleGrid, CircleGrid
from fewcal.camera import Camera
from fewcal.circle_bias import _CIRCLE, _ellipses, _missed, circle_centres, fit_plane_image

Array = NDArray[np.float64]

SPACING = 0.02


def seen(board: CircleGrid | AsymmetricCircleGrid, camera: Camera, T: Array, radius: float) -> Array:
    """Outlines (N, 16, 2) of the circles of a board."""
    outlines = board.points[:, None] + np.c_[radius * _CIRCLE, np.zeros(16)]
    return camera.project(outlines, T)


def test_an_ellipse_has_the_centre_and_the_covariance_of_its_conic() -> None:
    H = np.array([[300, 20, 100], [-10, 250, 80], [0.3, 0.5, 1.0]])
    centre, radius = np.array([0.4, 0.7]), 0.1
    mapped = np.c_[centre + radius * _CIRCLE, np.ones(16)] @ H.T
    middle, covariance = _ellipses(mapped[None, :, :2] / mapped[None, :, 2:])
    circle = np.block([[np.eye(2), -centre[:, None]], [-centre, centre @ centre - radius**2]])
    conic = np.linalg.inv(H).T @ circle @ np.linalg.inv(H)
    expected = -np.linalg.solve(conic[:2, :2], conic[:2, 2])
    level = expected @ conic[:2, :2] @ expected - conic[2, 2]
    np.testing.assert_allclose(middle[0], expected, rtol=1e-12)
    np.testing.assert_allclose(covariance[0], np.linalg.inv(conic[:2, :2]) * level / 4, rtol=1e-9)


@pytest.mark.parametrize("board", [SYMMETRIC, ASYMMETRIC], ids=str)
@pytest.mark.parametrize("share", [0.25, 0.4])
@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_perspective_is_taken_off_exactly(
    board: CircleGrid | AsymmetricCircleGrid, tilt: float, share: float
) -> None:
    T = pose(board, tilt)
    centres, covariances = _ellipses(seen(board, CAMERA, T, share * SPACING))
    true = CAMERA.project(board.points, T)
    points, radius = circle_centres(board.points[:, :2] / SPACING, centres, covariances, SIZE[::-1])
    assert radius == pytest.approx(share, rel=1e-5)
    np.testing.assert_allclose(points, true, atol=1e-5)
    if tilt:
        assert np.abs(centres - true).max() > 0.03


@pytest.mark.parametrize("k1", [-0.35, -0.2, 0.1])
@pytest.mark.parametrize("off_centre_px", [0.0, 15.0])
@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_distortion_is_taken_off_but_for_a_few_thousandths(
    k1: float, off_centre_px: float, tilt: float
) -> None:
    camera = Camera(350.0, 350.0, 319.5 + off_centre_px, 239.5, [k1, k1 * k1, 0.0, 0.0, 0.0])
    T = pose(SYMMETRIC, tilt, camera=camera)
    centres, covariances = _ellipses(seen(SYMMETRIC, camera, T, 0.35 * SPACING))
    true = camera.project(SYMMETRIC.points, T)
    points, _ = circle_centres(SYMMETRIC.points[:, :2], centres, covariances, SIZE[::-1])
    before, after = (np.sqrt(np.mean((p - true) ** 2)) for p in (centres, points))
    assert after < 0.006
    assert after < 0.04 * before


def test_errors_of_single_centres_hardly_move_the_others() -> None:
    T = pose(ASYMMETRIC, 45, camera=BARREL)
    centres, covariances = _ellipses(seen(ASYMMETRIC, BARREL, T, 0.5 * SPACING))
    error = np.random.default_rng(0).normal(0, 0.1, centres.shape)
    plane = ASYMMETRIC.points[:, :2]
    points, _ = circle_centres(plane, centres, covariances, SIZE[::-1])
    moved, _ = circle_centres(plane, centres + error, covariances, SIZE[::-1])
    assert np.sqrt(np.mean((moved - points - error) ** 2)) < 0.01


@pytest.mark.parametrize("camera", [CAMERA, BARREL], ids=["pinhole", "barrel"])
def test_the_map_goes_through_the_points(camera: Camera) -> None:
    pixels = camera.project(SYMMETRIC.points, pose(SYMMETRIC, 30, camera=camera))
    image = fit_plane_image(SYMMETRIC.points[:, :2], pixels, SIZE[::-1])
    missed = np.abs(image(SYMMETRIC.points[:, :2]) - pixels).max()
    if camera is CAMERA:
        assert missed < 1e-6
        np.testing.assert_allclose(image.division, 0, atol=1e-6)
    else:
        assert missed < 0.1  # another model of the lens
        assert image.division[0] < -0.3
        np.testing.assert_allclose(image.centre, BARREL.intrinsics[2:], atol=1)


def test_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(0)
    plane, found = rng.uniform(-1, 1, (9, 2)), rng.uniform(-0.7, 0.7, (9, 2))
    parameters = np.array([0.5, 0.1, 0.02, -0.08, 0.4, 0.05, 0.1, -0.2, -0.3, 0.1, 0.03, -0.02])

    def missed(p: Array) -> Array:
        return _missed(p, plane, found)[0]

    assert_derivative(_missed(parameters, plane, found)[1], differences(missed, parameters, 1e-6))
