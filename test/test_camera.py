from __future__ import annotations

import pickle

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import assert_derivative, differences

from fewcal.camera import (
    Camera,
    project,
    project_jacobians,
    project_pixel_model,
)
from fewcal.distortion import distort, distort_jacobians, fold_radius, undistort
from fewcal.errors import InvalidInput, ModelFoldsOver

Array = NDArray[np.float64]

WIDTH, HEIGHT = 1280, 960
PIXELS = np.stack(np.meshgrid(np.linspace(0, WIDTH - 1, 33), np.linspace(0, HEIGHT - 1, 25)), axis=-1)
"""(25, 33, 2) pixels over the whole image, its corners among them."""


def between(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


@st.composite
def cameras(draw: st.DrawFn, k1: float = 0.5, k2: float = 0.5, k3: float = 0.2) -> Camera:
    fx = draw(between(400, 4000))
    distortion = [draw(between(-bound, bound)) for bound in (k1, k2, 0.01, 0.01, k3)]
    return Camera(
        fx, fx * draw(between(0.9, 1.1)), draw(between(540, 740)), draw(between(380, 580)), distortion
    )


BATCH, POINTS = (2, 3), 5


@pytest.fixture
def points() -> Array:
    """(2, 3, 5, 3) points in front of the camera, metres."""
    return np.random.default_rng(1).uniform([-0.4, -0.4, 0.8], [0.4, 0.4, 1.6], (*BATCH, POINTS, 3))


@pytest.fixture
def intrinsics() -> Array:
    """(2, 3, 4) fx, fy, cx, cy, another camera in every place of the batch."""
    return np.random.default_rng(2).uniform([700, 700, 600, 400], [1300, 1300, 700, 500], (*BATCH, 4))


@pytest.fixture
def distortion() -> Array:
    """(2, 3, 5) plumb_bob coefficients."""
    return np.random.default_rng(3).uniform(-1, 1, (*BATCH, 5)) * [0.3, 0.2, 0.01, 0.01, 0.1]


# --- project and unproject are inverse ---------------------------------------------------------------------


@given(cameras())
def test_every_ray_found_for_a_pixel_projects_onto_it(camera: Camera) -> None:
    rays = camera.unproject(PIXELS, folded="nan")
    seen = np.isfinite(rays).all(axis=-1)
    np.testing.assert_allclose(camera.project(rays)[seen], PIXELS[seen], rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=-1), 1, atol=1e-12)


@given(cameras())
@example(Camera(400, 400, 540, 380, [0, 0.48102833, 0, 0, -0.1575306]))  # Newton's iteration alone cycles
def test_a_ray_inside_the_fold_is_found_again(camera: Camera) -> None:
    # With p1 and p2 the fold is no circle, so that the rays stay well inside of the radial one.
    radius = min(1.5, 0.8 * float(fold_radius(camera.distortion)))
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    xy = radius * np.linspace(0, 1, 9)[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    rays = np.concatenate([xy, np.ones((*xy.shape[:-1], 1))], axis=-1)
    d_xy, _ = distort_jacobians(xy, camera.distortion)
    assume(np.linalg.det(d_xy).min() > 0.05 and d_xy[..., 0, 0].min() > 0)
    found = camera.unproject(camera.project(rays))
    np.testing.assert_allclose(found[..., :2] / found[..., 2:], xy, rtol=0, atol=1e-8)


@given(cameras(k1=0.1, k2=0.02, k3=0.001))
def test_a_mild_lens_has_a_ray_for_every_pixel(camera: Camera) -> None:
    wide = np.hypot(WIDTH, HEIGHT) / camera.fx
    assume(wide < 1.2 and fold_radius(camera.distortion) > 1.5 * wide)
    np.testing.assert_allclose(camera.project(camera.unproject(PIXELS)), PIXELS, rtol=0, atol=1e-6)


def test_a_wide_lens_is_inverted_where_fixed_point_iteration_diverges() -> None:
    # cv2.undistortPoints with its default of 5 fixed point steps is off by up to 600 px here.
    camera = Camera(400, 400, 639.5, 479.5, [0.5, 0.4, 0.001, -0.001, 0.1])
    np.testing.assert_allclose(camera.project(camera.unproject(PIXELS)), PIXELS, rtol=0, atol=1e-6)


def test_unproject_of_the_principal_point_looks_ahead() -> None:
    camera = Camera(800, 820, 640, 480, [-0.2, 0.1, 0, 0, 0])
    np.testing.assert_allclose(camera.unproject([640.0, 480.0]), [0, 0, 1], atol=1e-15)


# --- where the model folds over ----------------------------------------------------------------------------


def test_a_pixel_beyond_the_fold_is_refused_with_the_radius() -> None:
    camera = Camera(600, 600, 639.5, 479.5, [-0.4, 0, 0, 0, 0])
    r = 1 / np.sqrt(1.2)
    assert camera.fold_radius_px == pytest.approx(600 * r * (1 - 0.4 * r * r))
    with pytest.raises(
        ModelFoldsOver, match=r"folds over 365 px from the principal point; \d+ of 825 pixels"
    ):
        camera.unproject(PIXELS)
    folded = np.isnan(camera.unproject(PIXELS, folded="nan")[..., 0])
    distance = np.hypot(PIXELS[..., 0] - camera.cx, PIXELS[..., 1] - camera.cy)
    np.testing.assert_array_equal(folded, distance > camera.fold_radius_px)


def test_tangential_distortion_moves_the_fold_and_the_rays_up_to_it_are_found() -> None:
    lens = np.array([0.03, 0, 0, 0.015, -0.04])
    fold = float(fold_radius(lens))
    xy = np.array([[0.9 * fold, 0.0], [-0.9 * fold, 0.0]])
    distorted = distort(xy, lens)
    radial_limit = distort(np.array([[fold, 0.0]]), lens * [1, 1, 0, 0, 1])[0, 0]
    assert distorted[0, 0] > radial_limit, "p2 has pushed the first point farther than the radial model goes"
    np.testing.assert_allclose(undistort(distorted, lens), xy, atol=1e-10)


def test_a_pixel_beyond_the_fold_is_not_given_a_ray_of_the_next_sheet() -> None:
    # r (1 - 1.2 r^2 + 0.5 r^4) rises to 0.38 at the fold, falls, and rises again for good.
    lens = np.array([-1.2, 0.5, 0, 0, 0])
    assert np.isnan(undistort(np.array([[0.5, 0.0], [0.0, 5.0]]), lens)).all()


def test_a_lens_that_never_folds_says_so() -> None:
    assert Camera(600, 600, 640, 480, [0.3, 0.1, 0, 0, 0]).fold_radius_px == np.inf


# --- Jacobians ---------------------------------------------------------------------------------------------


def test_project_jacobians(points: Array, intrinsics: Array, distortion: Array) -> None:
    result = project_jacobians(points, intrinsics, distortion)
    np.testing.assert_allclose(result.pixels, project(points, intrinsics, distortion), rtol=1e-14)
    for analytic, function, at, step in (
        (result.d_points, lambda at: project(at, intrinsics, distortion), points, 1e-6),
        (result.d_intrinsics, lambda at: project(points, at, distortion), intrinsics, 1e-2),
        (result.d_distortion, lambda at: project(points, intrinsics, at), distortion, 1e-5),
    ):
        assert_derivative(analytic, differences(function, at, step))


def test_leading_axes_give_what_each_camera_gives_alone(
    points: Array, intrinsics: Array, distortion: Array
) -> None:
    together = project_jacobians(points, intrinsics, distortion)
    alone = project_jacobians(points[1, 2], intrinsics[1, 2], distortion[1, 2])
    for whole, part in zip(together, alone, strict=True):
        np.testing.assert_allclose(whole[1, 2], part, rtol=1e-13)


# --- other descriptions of the same camera -----------------------------------------------------------------


@given(
    f=between(300, 4000),
    paper=st.tuples(between(-0.4, 0.4), between(-0.2, 0.2), between(-0.01, 0.01), between(-0.01, 0.01)),
)
def test_pixel_model_of_square_pixels_is_plumb_bob(f: float, paper: tuple[float, ...]) -> None:
    # x = X / f makes k1 of the paper K1 / f^2, k2 K2 / f^4, and its k3, k4 are p2 / f, p1 / f.
    K1, K2, p2, p1 = paper
    points = np.random.default_rng(6).uniform([-0.4, -0.4, 0.8], [0.4, 0.4, 1.6], (POINTS, 3))
    in_pixels = np.array([K1 / f**2, K2 / f**4, p2 / f, p1 / f])
    np.testing.assert_allclose(
        project_pixel_model(points, np.array([f, f, 640, 480, 0]), in_pixels),
        project(points, np.array([f, f, 640, 480]), np.array([K1, K2, p1, p2, 0])),
        rtol=1e-12,
        atol=1e-11,
    )


@given(cameras())
def test_projection_agrees_with_opencv(camera: Camera) -> None:
    points = np.random.default_rng(7).uniform([-0.5, -0.5, 0.8], [0.5, 0.5, 1.6], (50, 3))
    rvec, tvec = np.array([0.2, -0.3, 0.1]), np.array([0.05, -0.02, 0.3])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(rvec)[0], tvec
    expected, _ = cv2.projectPoints(points, rvec, tvec, camera.matrix, camera.distortion)
    np.testing.assert_allclose(camera.project(points, T), expected.reshape(-1, 2), rtol=0, atol=1e-8)


# --- what the camera takes and refuses ---------------------------------------------------------------------


def test_points_that_are_not_in_front_have_no_image() -> None:
    camera = Camera(800, 800, 640, 480)
    pixels = camera.project([[0.1, 0.2, 1.0], [0.1, 0.2, 0.0], [0.1, 0.2, -1.0]])
    np.testing.assert_array_equal(np.isnan(pixels), [[False, False], [True, True], [True, True]])


@pytest.mark.parametrize("shape", [(3,), (1, 3), (0, 3), (2, 4, 3)])
def test_shapes_are_kept(shape: tuple[int, ...]) -> None:
    camera = Camera(800, 810, 640, 480, [-0.1, 0, 0, 0, 0])
    pixels = camera.project(np.ones(shape))
    assert pixels.shape == (*shape[:-1], 2)
    assert camera.unproject(pixels).shape == shape


@pytest.mark.parametrize(
    "arguments",
    [
        (0, 800, 640, 480),
        (800, -800, 640, 480),
        (800, 800, np.nan, 480),
        (np.inf, 800, 640, 480),
        (800, 800, 640, 480, [0, 0, 0, 0]),
        (800, 800, 640, 480, [0, 0, np.nan, 0, 0]),
        ([1, 2], [1, 2], [1, 2], [0, 2]),
    ],
)
def test_numbers_that_are_no_camera(arguments: tuple[float, ...]) -> None:
    with pytest.raises(InvalidInput):
        Camera(*arguments)  # type: ignore[arg-type]


def test_arrays_of_a_wrong_shape() -> None:
    camera = Camera(800, 800, 640, 480)
    for call in (
        lambda: camera.project(np.ones((4, 2))),
        lambda: camera.unproject(np.ones((4, 3))),
        lambda: camera.unproject(1.0),
        lambda: camera.project(np.ones((4, 3)), np.eye(3)),
    ):
        with pytest.raises(InvalidInput, match="shape"):
            call()


def test_a_camera_cannot_be_changed_through_its_arrays() -> None:
    given_distortion = np.zeros(5)
    camera = Camera(800, 800, 640, 480, given_distortion)
    given_distortion[0] = 1
    assert camera.distortion[0] == 0
    with pytest.raises(ValueError, match="read-only"):
        camera.distortion[0] = 1
    camera.matrix[0, 0] = 1
    assert camera.matrix[0, 0] == 800


def test_a_camera_that_was_pickled_cannot_be_changed_either() -> None:
    camera = pickle.loads(pickle.dumps(Camera(500.0, 501.0, 320.0, 240.0, [-0.2, 0.1, 0, 0, 0])))
    assert camera.intrinsics.tolist() == [500, 501, 320, 240]
    assert not camera.distortion.flags.writeable


def test_a_model_that_folds_beyond_all_numbers_gives_no_ray() -> None:
    # Three coefficients so small that the fold is not found, and a pixel that the last one sends back.
    camera = Camera(1000.0, 1000.0, 640.0, 360.0, [-1e-16, -1e-30, 0.0, 0.0, -1e-40])
    assert np.isnan(camera.unproject([[1e12, 0.0]], folded="nan")).any()


def test_what_is_no_array_of_numbers_is_named() -> None:
    camera = Camera(600.0, 600.0, 320.0, 240.0)
    for wrong in ("abc", [[1, 2, 3], [1]]):
        with pytest.raises(InvalidInput, match="points must be an array of numbers"):
            camera.project(wrong)  # type: ignore[arg-type]
        with pytest.raises(InvalidInput, match="pixels must be an array of numbers"):
            camera.unproject(wrong)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="T_camera_board must be an array of numbers"):
        camera.project([1, 2, 3], "pose")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="fx, fy, cx and cy must be an array of numbers"):
        Camera("a", 1, 1, 1)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="distortion must be an array of numbers"):
        Camera(1, 1, 1, 1, "abcde")  # type: ignore[arg-type]


def test_pixels_that_are_not_finite_are_not_said_to_fold_over() -> None:
    camera = Camera(600.0, 600.0, 320.0, 240.0)
    with pytest.raises(InvalidInput, match="pixels holds a value that is not finite"):
        camera.unproject([[1.0, 2.0], [np.nan, 0.0]])
    assert np.isnan(camera.unproject([np.nan, 0.0], folded="nan")).any()
    with pytest.raises(InvalidInput, match="folded must be"):
        camera.unproject([1.0, 1.0], folded="maybe")


@pytest.mark.filterwarnings("error")
def test_a_grazing_ray_is_no_reason_for_a_warning() -> None:
    lens = Camera(1000.0, 1010.0, 640.0, 480.0, [-0.3, 0.1, 1e-3, -1e-3, 0.0])
    assert lens.project([[1.0, 0.0, 1e-80], [np.inf, 0.0, 1.0]]).shape == (2, 2)
