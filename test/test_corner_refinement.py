from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from board_pictures import BOARD, CAMERA, SIZE, picture, pose
from marker_pictures import CHARUCO, marker_picture, needs_markers

from fewcal.corner_refinement import Squares, _model, affine_frames, refine_corners
from fewcal.rendering import Conditions, render


@pytest.mark.parametrize("gap", [None, np.array([[1.8, 2.1, 1.5, 2.5]])], ids=["plain", "markers"])
@pytest.mark.parametrize("contrast", [60.0, -60.0])
def test_derivatives_of_the_model(contrast: float, gap: Any) -> None:
    p = np.array([[0.3, -0.2, 0.4, 1.7, 1.2, 0.9, 100.0, contrast, 0.002, -0.003]])
    x: Any = np.stack([g.ravel() for g in np.mgrid[-5:6, -5:6].astype(float)])
    _, J = _model(p, x, gap)
    for k in range(p.shape[1]):
        step = np.zeros_like(p)
        step[0, k] = 1e-5 * max(1.0, abs(p[0, k]))
        numeric = (_model(p + step, x, gap)[0] - _model(p - step, x, gap)[0]) / (2 * step[0, k])
        np.testing.assert_allclose(J[:, k], numeric, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("start_px", [0.0, 1.0, 3.0])
def test_corners_are_reached_from_a_start_that_is_off(start_px: float) -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    grid = true.reshape(6, 9, 2) + start_px * np.random.default_rng(0).uniform(-1, 1, (6, 9, 2))
    corners = refine_corners(image, grid)
    assert corners.good.all()
    assert np.abs(corners.points - true.reshape(6, 9, 2)).max() < 0.06
    assert np.median(corners.blur) == pytest.approx(np.hypot(0.7, 12**-0.5), rel=0.05)


def test_sigma_grows_with_noise_blur_and_small_squares() -> None:
    def sigma(square_px: float, **conditions: float) -> float:
        image, true = picture(pose(BOARD, square_px, 20, 40, 15), **conditions)
        return float(np.median(refine_corners(image, true.reshape(6, 9, 2)).sigma))

    usual = sigma(30, read_noise=2.0)
    assert sigma(30, read_noise=6.0) > 1.6 * usual
    assert sigma(30, read_noise=2.0, blur_px=3.0) > 1.5 * usual
    assert sigma(12, read_noise=2.0) > 1.3 * usual


def test_where_there_is_no_corner_none_is_good() -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    grid = true.reshape(6, 9, 2)
    middle = (grid[:-1, :-1] + grid[1:, 1:]) / 2
    assert refine_corners(image, middle).good.mean() < 0.2
    assert not refine_corners(np.full_like(image, 200), grid).good.any()


def test_corners_outside_the_image_are_not_good() -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    grid = true.reshape(6, 9, 2) - true[4]
    assert not refine_corners(image, grid - 50).good[0].any()


def located(**conditions: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors (54, 2), sigma (54,) and direction of the light (2,) of a board rendered as a lens shows it."""
    tilt = conditions.pop("tilt_deg", 20.0)
    T = pose(BOARD, 36, tilt, 40, 15)
    light = Conditions(**{"full_well": np.inf, "vignetting": 0.0, "light_deg": 30.0, **conditions})
    image = render(CAMERA, SIZE, BOARD, T, light, oversampling=3)
    corners = refine_corners(image, CAMERA.project(BOARD.points, T).reshape(6, 9, 2))
    error = corners.points.reshape(-1, 2) - CAMERA.project(BOARD.points, T)
    angle = np.radians(light.light_deg)
    return error, corners.sigma.ravel(), np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize(
    "conditions",
    [
        {"read_noise": 2.0},
        {"read_noise": 1.0, "blur_px": 0.5},
        {"read_noise": 8.0},
        {"read_noise": 2.0, "blur_px": 2.0},
        {"read_noise": 2.0, "tilt_deg": 68.0},
        {"read_noise": 2.0, "exposure": 1.5},
        {"read_noise": 2.0, "exposure": 2.3, "blur_px": 2.0},
        {"read_noise": 2.0, "exposure": 2.3, "light_slope": 0.8},
    ],
    ids=str,
)
def test_sigma_is_the_scatter_of_the_errors(conditions: dict[str, float]) -> None:
    error, sigma, _ = located(**conditions)
    z = np.sqrt(np.mean((error / sigma[:, None]) ** 2))
    assert 0.75 < z < 1.3  # 108 errors tell it to 7 %


@pytest.mark.parametrize("exposure", [0.9, 2.3])
def test_light_that_falls_off_draws_no_corner(exposure: float) -> None:
    error, sigma, to_light = located(read_noise=0.5, blur_px=2.0, light_slope=0.9, exposure=exposure)
    towards = error @ to_light
    assert abs(towards.mean()) < max(0.002, 3 * np.median(sigma) / np.sqrt(len(towards)))


def test_overexposure_costs_little() -> None:
    def rms(exposure: float) -> float:
        error, _, _ = located(read_noise=2.0, exposure=exposure)
        return float(np.sqrt(np.mean(error**2)))

    assert rms(2.3) < 1.5 * rms(0.9)


def test_corners_that_are_unknown_are_left_out() -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    grid = true.reshape(6, 9, 2).copy()
    whole = refine_corners(image, grid)
    grid[2, 3:] = np.nan
    part = refine_corners(image, grid)
    assert np.isnan(part.points[2, 3:]).all()
    assert part.good.sum() == 48
    np.testing.assert_allclose(part.points[4:], whole.points[4:], atol=1e-3)
    assert not refine_corners(image, np.full_like(grid, np.nan)).good.any()


@needs_markers
def test_a_marker_in_the_square_does_not_shift_the_corner() -> None:
    image, true = marker_picture(CHARUCO, 36, 20, 40, 15, conditions=Conditions(blur_px=1.5))
    grid = true.reshape(4, 6, 2)
    with_marker = refine_corners(image, grid, squares=Squares(0.125, 0.125 + 0.75 / 7))
    plain = refine_corners(image, grid)
    assert with_marker.good.all()
    assert np.abs(with_marker.points - grid).max() < 0.05
    assert np.abs(plain.points - grid).max() > 2 * np.abs(with_marker.points - grid).max()


def test_some_corners_are_located_again_among_the_others() -> None:
    image, true = picture(pose(BOARD, 30, 20, 40, 15))
    grid = true.reshape(6, 9, 2)
    corners = refine_corners(image, grid)
    some = np.zeros((6, 9), dtype=bool)
    some[2, 4] = True
    wrong = corners.updated(refine_corners(image, grid + 9.0), some)
    assert np.linalg.norm(wrong.points[2, 4] - grid[2, 4]) > 3
    np.testing.assert_array_equal(wrong.points[~some], corners.points[~some])
    again = refine_corners(image, np.where(some[..., None], grid, np.nan), affine_frames(grid))
    mended = wrong.updated(again, some)
    np.testing.assert_allclose(mended.points, corners.points, atol=1e-3)
    np.testing.assert_allclose(mended.sigma, corners.sigma, rtol=0.05)


def test_what_lies_beyond_what_is_known_is_not_looked_at() -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15), blur_px=1.5)
    grid = true.reshape(6, 9, 2)
    cells = (grid[:-1, :-1] + grid[1:, 1:]) / 2
    covered = image.copy()
    for x, y in np.rint(cells.reshape(-1, 2)).astype(int):
        covered[y - 9 : y + 10, x - 9 : x + 10] = 150
    inner = (slice(1, -1), slice(1, -1))
    blind = refine_corners(covered, grid)
    known = refine_corners(covered, grid, squares=Squares(known=0.2, blur=1.6))
    assert np.abs(known.points - grid)[inner].max() < 0.05
    assert known.sigma[inner].max() < 0.5 * blind.sigma[inner].max()


def test_a_part_of_the_pixels_comes_close() -> None:
    image, true = picture(pose(BOARD, 36, 20, 40, 15))
    grid = true.reshape(6, 9, 2)
    coarse, fine = (refine_corners(image, grid, coarse=coarse) for coarse in (True, False))
    assert np.abs(coarse.points - grid).max() < 0.06
    assert np.median(coarse.sigma) > 1.5 * np.median(fine.sigma)
