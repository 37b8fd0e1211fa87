from __future__ import annotations

import cv2
import numpy as np
import pytest
from circle_pictures import SYMMETRIC, picture, pose
from scenes import assert_derivative, differences

from fewcal.disc_refinement import _model, refine_discs

OFFSETS = np.mgrid[-9:10, -9:10][::-1].reshape(2, -1).astype(float)
PARAMETERS = np.array([0.3, -0.2, 0.03, 0.008, 0.05, 1.1, 120.0, 60.0, 0.004, -0.006])


def test_derivatives_agree_with_differences() -> None:
    q = np.einsum("ip,ij,jp->p", OFFSETS, [[0.03, 0.008], [0.008, 0.05]], OFFSETS) ** 0.5
    x = OFFSETS[:, q > 0.3]  # at the middle of a disc the distance to its edge has no derivative

    def brightness(p: np.ndarray) -> np.ndarray:
        return np.asarray(_model(p[None], x)[0][0], dtype=float)

    _, J = _model(PARAMETERS[None], x)
    steps = 1e-5 * np.maximum(np.abs(PARAMETERS), 1e-2)
    assert_derivative(J[0].T.astype(float), differences(brightness, PARAMETERS, steps), 1e-4)


@pytest.mark.parametrize("band_px", [np.inf, 4.0])
@pytest.mark.parametrize("noise", [1.0, 5.0])
def test_a_disc_is_where_it_is_with_the_error_that_is_said(noise: float, band_px: float) -> None:
    z = []
    for seed in range(4):
        image, true = picture(pose(SYMMETRIC, 0), seed=seed, read_noise=noise)
        radius = 0.3 * np.linalg.norm(true[1] - true[0])
        rough = true + np.random.default_rng(seed).uniform(-1, 1, true.shape)
        covariances = np.tile(1.2 * radius**2 / 4 * np.eye(2), (len(true), 1, 1))
        found = refine_discs(image, rough, covariances, 1.5, band_px)
        assert found.good.all()
        assert np.abs(found.covariances * 4 / radius**2 - np.eye(2)).max() < 0.05
        z.append((found.points - true) / found.sigma[:, None])
    assert 0.7 < np.sqrt(np.mean(np.square(z))) < 1.25


def test_blur_is_measured() -> None:
    image, true = picture(pose(SYMMETRIC, 0), blur_px=1.5)
    radius = 0.3 * np.linalg.norm(true[1] - true[0])
    found = refine_discs(image, true, np.tile(radius**2 / 4 * np.eye(2), (len(true), 1, 1)), 1.5)
    assert np.median(found.blur) == pytest.approx(np.hypot(1.5, 12**-0.5), rel=0.06)


def test_what_is_no_disc_is_not_good() -> None:
    image, true = picture(pose(SYMMETRIC, 0))
    radius = 0.3 * np.linalg.norm(true[1] - true[0])
    u, v = np.rint(true[[12, 40]]).astype(int).T
    image[v[0] - 15 : v[0] + 16, u[0] - 15 : u[0] + 16] = 200
    image[v[1] - 15 : v[1] + 1, u[1] - 15 : u[1] + 16] = 200
    found = refine_discs(image, true, np.tile(radius**2 / 4 * np.eye(2), (len(true), 1, 1)), 1.5)
    assert np.flatnonzero(~found.good).tolist() == [12, 40]


def test_what_covers_a_part_of_a_disc_is_told() -> None:
    image, true = picture(pose(SYMMETRIC, 0))
    radius = 0.3 * np.linalg.norm(true[1] - true[0])
    covariances = np.tile(radius**2 / 4 * np.eye(2), (len(true), 1, 1))
    assert (refine_discs(image, true, covariances, 1.5).covered == 0).all()
    cv2.circle(image, np.rint(true[12] + [radius, 0]).astype(int).tolist(), 4, 255, -1)
    found = refine_discs(image, true, covariances, 1.5)
    assert np.flatnonzero(found.covered).tolist() == [12]
    shift = np.linalg.norm(found.points[12] - true[12])
    assert shift > 20 * found.sigma[0]
    assert 0.3 < shift / found.covered[12] < 3
