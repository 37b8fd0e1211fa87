from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import BOARD, CAMERA, SIZE, noisy, pose, view, views_at

from fewcal.boards import Chessboard
from fewcal.calibration import METHODS, Calibration, calibrate
from fewcal.camera import Camera, project_pixel_model
from fewcal.constraints import Normal, Priors
from fewcal.departures import axial_remainder, lens_remainder, radial_terms
from fewcal.errors import DegenerateViews, InvalidInput
from fewcal.posterior import NAMES
from fewcal.verdict import Thresholds
from fewcal.views import View

Array = NDArray[np.float64]

FIVE = ((40, 30), (35, 120), (30, -60), (20, 80), (45, 200))
SQUARE = Camera(1100.0, 1100.0, 650.0, 470.0, [-0.12, 0.03, 0.0006, -0.0004, 0.0])
RADIAL = Camera(1100.0, 1100.0, 650.0, 470.0, [-0.12, 0.03, 0.0, 0.0, 0.0])
few = settings(max_examples=3, derandomize=True)
"""Each example is two calibrations."""


def parameters(camera: Camera) -> Array:
    return np.concatenate([camera.intrinsics, camera.distortion])


def assert_recovered(found: Calibration, camera: Camera, poses: list[Array]) -> None:
    np.testing.assert_allclose(found.camera.intrinsics, camera.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(found.camera.distortion, camera.distortion, rtol=1e-5, atol=1e-6)
    for T, expected in zip(found.board_poses, poses, strict=True):
        np.testing.assert_allclose(T, expected, atol=1e-6)
    assert found.rms < 1e-6
    np.testing.assert_allclose(found.view_rms, 0, atol=1e-6)


@cache
def sound() -> Calibration:
    """Two noisy views."""
    return calibrate(noisy(views_at(*FIVE[:2]), 0.2, 1), SIZE)


@cache
def face_on() -> Calibration:
    return calibrate(noisy(views_at((0, 0)), 0.2, 1), SIZE)


# --- exact views are explained exactly ---------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 5])
def test_map_recovers_an_everyday_camera(count: int) -> None:
    found = calibrate(views_at(*FIVE[:count]), SIZE)
    assert_recovered(found, CAMERA, [pose(*tilt) for tilt in FIVE[:count]])
    assert found.verdict.usable, found.verdict
    np.testing.assert_allclose(found.tilts_deg, [tilt for tilt, _ in FIVE[:count]], atol=1e-6)


@pytest.mark.parametrize(
    ("camera", "size"),
    [
        (Camera(420.0, 419.5, 318.0, 243.0, [-0.28, 0.07, 0.0002, 0.0001, 0.0]), (640, 480)),
        (Camera(3100.0, 3104.0, 1980.0, 1090.0, [0.04, -0.05, -0.0005, 0.0008, 0.0]), (3840, 2160)),
        (Camera(900.0, 902.0, 365.0, 640.0, [0.0, 0.0, 0.0, 0.0, 0.0]), (720, 1280)),
    ],
)
def test_map_recovers_other_cameras_from_two_views(camera: Camera, size: tuple[int, int]) -> None:
    poses = [pose(*tilt, camera=camera, size=size) for tilt in FIVE[:2]]
    found = calibrate([view(T, camera=camera) for T in poses], size)
    assert_recovered(found, camera, poses)
    assert found.image_size == size


def test_boards_in_any_plane_of_any_size_with_any_number_of_points() -> None:
    small, large = Chessboard(5, 4, 0.04).points, Chessboard(13, 9, 0.03).points
    turn = pose(50, 70, 20)[:3, :3]
    lifted = large @ turn.T + [0.3, -0.2, 1.0]
    poses = [pose(*FIVE[0], points=small), pose(*FIVE[1], points=large), pose(*FIVE[2])]
    views = [view(poses[0], small), View(lifted, view(poses[1], large).image_points), view(poses[2])]
    lift = np.eye(4)
    lift[:3, :3], lift[:3, 3] = turn, [0.3, -0.2, 1.0]
    poses[1] = poses[1] @ np.linalg.inv(lift)
    assert_recovered(calibrate(views, SIZE), CAMERA, poses)
    flat = [View(v.object_points[:, :2], v.image_points) for v in (views[0], views[2])]
    assert_recovered(calibrate(flat, SIZE), CAMERA, [poses[0], poses[2]])


def test_sigma_for_each_point() -> None:
    rng = np.random.default_rng(2)
    poses = [pose(*tilt) for tilt in FIVE[:2]]
    exact = [view(T) for T in poses]
    sigmas = [rng.uniform(0.02, 2.0, len(v)) for v in exact]
    weighted = [View(v.object_points, v.image_points, s) for v, s in zip(exact, sigmas, strict=True)]
    assert_recovered(calibrate(weighted, SIZE), CAMERA, poses)
    scattered = [
        v.image_points + s[:, None] * rng.normal(size=(54, 2)) for v, s in zip(exact, sigmas, strict=True)
    ]
    errors = []
    for given_sigma in (sigmas, [None, None]):
        views = [View(BOARD.points, p, s) for p, s in zip(scattered, given_sigma, strict=True)]
        errors.append(abs(calibrate(views, SIZE).camera.fx - CAMERA.fx))
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize("tilts", [FIVE[:2], FIVE[:3], ((1.2, 0), (40, 20))])
def test_zhu2020_recovers_square_pixels(tilts: tuple[tuple[float, float], ...]) -> None:
    found = calibrate(views_at(*tilts, camera=SQUARE), SIZE, method="zhu2020")
    assert_recovered(found, SQUARE, [pose(*tilt, camera=SQUARE) for tilt in tilts])
    assert found.skew == pytest.approx(0, abs=1e-6)
    assert found.determined is None
    assert found.prior_conflicts == {}


def test_zhang_recovers_three_views() -> None:
    found = calibrate(views_at(*FIVE[:3], camera=RADIAL), SIZE, method="zhang")
    assert_recovered(found, RADIAL, [pose(*tilt, camera=RADIAL) for tilt in FIVE[:3]])
    assert found.skew == pytest.approx(0, abs=1e-6)


def test_map_recovers_the_papers_camera_whose_distortion_acts_on_pixels() -> None:
    # fx and fy differ by more than those of real cameras, so that the two distortion models differ.
    intrinsics, coefficients = np.array([1100.0, 1108.0, 640, 470, 0]), np.array([-1e-7, 2e-14, 0, 0])
    poses = [pose(*tilt) for tilt in FIVE[:2]]
    points = [BOARD.points @ T[:3, :3].T + T[:3, 3] for T in poses]
    views = [View(BOARD.points, project_pixel_model(X, intrinsics, coefficients)) for X in points]
    found = calibrate(views, SIZE)
    np.testing.assert_allclose(found.camera.intrinsics, intrinsics[:4], rtol=1e-5)
    np.testing.assert_allclose(found.pixel_distortion[:2], coefficients[:2], rtol=1e-3)


# --- what must not matter ----------------------------------------------------------------------------------


@few
@given(seed=st.integers(0, 1000), count=st.integers(1, 3))
def test_scaling_the_image_scales_the_camera(seed: int, count: int) -> None:
    # Noise below the fixed model error, and the prior of the noise scaled with it.
    views = noisy(views_at(*FIVE[:count]), 0.03, seed)
    doubled = [View(v.object_points, 2 * (v.image_points + 0.5) - 0.5) for v in views]
    one = calibrate(views, SIZE, priors=Priors(corner_sigma_px=(0.03, 1.0)))
    two = calibrate(doubled, (2560, 1920), priors=Priors(corner_sigma_px=(0.06, 1.0)))
    expected = one.camera.intrinsics * 2 + [0, 0, 0.5, 0.5]
    np.testing.assert_allclose(two.camera.intrinsics, expected, rtol=1e-6)
    np.testing.assert_allclose(two.camera.distortion, one.camera.distortion, atol=1e-6)
    np.testing.assert_allclose(two.board_poses, one.board_poses, atol=1e-6)
    assert two.focal_std == pytest.approx(one.focal_std, rel=1e-4)
    assert two.rms == pytest.approx(2 * one.rms, rel=1e-6)


@few
@given(seed=st.integers(0, 1000), count=st.integers(1, 3), factor=st.sampled_from([1e-3, 0.4, 39.37]))
def test_scaling_the_board_scales_translations_only(seed: int, count: int, factor: float) -> None:
    views = noisy(views_at(*FIVE[:count]), 0.2, seed)
    one = calibrate(views, SIZE)
    two = calibrate([View(v.object_points * factor, v.image_points) for v in views], SIZE)
    np.testing.assert_allclose(parameters(two.camera), parameters(one.camera), rtol=1e-6, atol=1e-7)
    for T, scaled in zip(one.board_poses, two.board_poses, strict=True):
        np.testing.assert_allclose(scaled[:3, :3], T[:3, :3], atol=1e-6)
        np.testing.assert_allclose(scaled[:3, 3], T[:3, 3] * factor, rtol=1e-5, atol=1e-7 * factor)
    assert two.verdict == one.verdict


@few
@given(seed=st.integers(0, 1000), count=st.sampled_from([1, 2, 4]))
def test_the_order_of_views_and_points_does_not_matter(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    views = noisy(views_at(*FIVE[:count]), 0.2, seed)
    order = rng.permutation(count)
    shuffled = []
    for i in order:
        points = rng.permutation(54)
        shuffled.append(View(views[i].object_points[points], views[i].image_points[points]))
    one, two = calibrate(views, SIZE), calibrate(shuffled, SIZE)
    np.testing.assert_allclose(parameters(two.camera), parameters(one.camera), rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(np.stack(two.board_poses), np.stack(one.board_poses)[order], atol=1e-6)
    np.testing.assert_allclose(two.view_rms, one.view_rms[order], rtol=1e-5)


@few
@given(seed=st.integers(0, 1000), count=st.sampled_from([1, 2, 4]), turned=st.booleans())
def test_turning_or_mirroring_the_picture_turns_or_mirrors_the_camera(
    seed: int, count: int, turned: bool
) -> None:
    # Half a turn of the picture, or board and picture in a mirror. The priors know neither.
    views = noisy(views_at(*FIVE[:count]), 0.2, seed)
    board, image = ([1, 1, 1], [-1, -1]) if turned else ([-1, 1, 1], [-1, 1])
    border = np.array([SIZE[0] - 1, SIZE[1] - 1 if turned else 0])
    other = [View(v.object_points * board, v.image_points * image + border) for v in views]
    one, two = calibrate(views, SIZE), calibrate(other, SIZE)
    k1, k2, p1, p2, _ = one.camera.distortion
    np.testing.assert_allclose(two.camera.intrinsics[:2], one.camera.intrinsics[:2], rtol=1e-5)
    np.testing.assert_allclose(
        two.camera.intrinsics[2:] * image + border, one.camera.intrinsics[2:], atol=1e-2
    )
    expected = [k1, k2, p1 * image[1], p2 * image[0], 0]
    np.testing.assert_allclose(two.camera.distortion, expected, rtol=1e-4, atol=1e-5)
    assert two.std == pytest.approx(one.std, rel=1e-3)
    assert two.verdict.usable == one.verdict.usable


@few
@given(seed=st.integers(0, 1000), quarters=st.integers(1, 3), shift=st.floats(-100, 100))
def test_which_corner_the_board_is_counted_from_does_not_matter(
    seed: int, quarters: int, shift: float
) -> None:
    views = noisy(views_at(*FIVE[:2]), 0.2, seed)
    quarter = np.linalg.matrix_power(np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]), quarters)
    other = [View(v.object_points @ quarter + shift, v.image_points) for v in views]
    one, two = calibrate(views, SIZE), calibrate(other, SIZE)
    np.testing.assert_allclose(parameters(two.camera), parameters(one.camera), rtol=1e-5, atol=1e-5)
    # The points that error bars are averaged over know x from y.
    assert two.focal_std == pytest.approx(one.focal_std, rel=0.02)


# --- error bars --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilts", [FIVE[:1], FIVE[:2]])
def test_errors_lie_within_their_error_bars(tilts: tuple[tuple[float, float], ...]) -> None:
    exact = views_at(*tilts)
    z = []
    for seed in range(10):
        found = calibrate(noisy(exact, 0.3, seed), SIZE)
        assert found.std is not None
        truth, estimate = parameters(CAMERA)[:8], parameters(found.camera)[:8]
        z.append((estimate - truth) / [found.std[name] for name in NAMES])
    z_all = np.abs(np.array(z))
    assert (z_all < 3).mean() > 0.97
    assert (z_all[:, 0] < 3).all()
    # Nor may they be so wide that they say nothing.
    assert z_all.max() > 0.3


def test_names_and_units_of_the_error_bars() -> None:
    found = sound()
    assert found.std is not None
    assert found.covariance is not None
    assert found.determined is not None
    assert tuple(found.std) == NAMES
    sd = np.sqrt(np.diagonal(found.covariance))
    np.testing.assert_allclose(list(found.std.values())[2:], sd[2:])
    axial = found.departures[2] * axial_remainder(
        SIZE, found.camera.intrinsics[2:], radial_terms(found.camera, SIZE)
    )
    expected = np.hypot(sd[:2], axial * found.camera.intrinsics[:2])
    np.testing.assert_allclose([found.std["fx"], found.std["fy"]], expected)
    assert found.focal_std == pytest.approx(found.std["fx"] / found.camera.fx)
    assert 0.0005 < found.focal_std < 0.02
    np.testing.assert_allclose(found.covariance, found.covariance.T, rtol=1e-9)
    assert set(found.determined) == {
        "focal length",
        "aspect ratio",
        "principal point x",
        "principal point y",
        "radial distortion",
        "tangential distortion",
    }
    assert all(0 <= share <= 1 for share in found.determined.values())
    assert found.determined["focal length"] > 0.99
    assert found.prior_conflicts == {}


def test_sigma_px_follows_the_noise() -> None:
    for sigma in (0.1, 0.5):
        found = calibrate(noisy(views_at(*FIVE[:2]), sigma, 4), SIZE)
        assert 1.5 * sigma < found.sigma_px < 4 * sigma
        assert found.rms == pytest.approx(np.sqrt(2) * sigma, rel=0.2)
        total = np.sqrt((found.view_rms**2).mean())
        assert found.rms == pytest.approx(total)


@pytest.mark.parametrize("method", METHODS)
def test_rms_is_the_distance_of_projected_and_observed_points(method: str) -> None:
    # Few views, so that zhang finds a large skew, which no camera_info holds.
    found = calibrate(noisy(views_at(*FIVE[:2]), 0.3, 5), SIZE, method=method)
    for v, T, rms in zip(found.views, found.board_poses, found.view_rms, strict=True):
        offset = found.camera.project(v.object_points, T) - v.image_points
        assert rms == pytest.approx(np.sqrt((offset**2).sum(axis=1).mean()), rel=1e-6)


def test_projection_is_known_best_where_the_board_was() -> None:
    found = sound()
    w, h = SIZE
    corners = found.projection_std([[0, 0], [w - 1, 0], [0, h - 1], [w - 1, h - 1]])
    centre = found.projection_std([[(w - 1) / 2, (h - 1) / 2]])
    assert (centre > 0).all()
    assert found.projection_std(np.zeros((0, 2))).shape == (0,)
    assert corners.min() > centre[0]
    assert (face_on().projection_std([[0, 0], [640, 480]]) > [1.0, 0.0]).all()


def test_projection_is_as_wrong_as_the_lens_departs_from_the_model() -> None:
    found = sound()
    corners = np.array([[0.0, 0.0], [1279.0, 959.0]])
    own = found.projection_std(corners)
    departing = replace(found, departures=np.array([0.0, 0.0, 0.2, 0.0]))
    radial = radial_terms(found.camera, SIZE)
    shift = lens_remainder(corners.T[None], SIZE, found.camera.intrinsics[2:], radial)[0]
    np.testing.assert_allclose(
        departing.projection_std(corners), np.hypot(own, 0.2 * np.hypot(*shift)), rtol=1e-3
    )
    assert (departing.projection_std(corners) > 5).all()


def fisheye_views(field_deg: float) -> list[View]:
    """Views through a lens whose image height is proportional to the angle, so wide along the diagonal."""
    f = np.hypot(*SIZE) / np.radians(field_deg)
    seen = []
    for tilt, about, shift in (
        (40, 30, (-200, 60)),
        (35, 120, (220, -80)),
        (45, 250, (60, 120)),
        (30, 0, (0, 0)),
    ):
        T = pose(tilt, about, shift_px=shift, span=0.6, camera=Camera(f, f, 639.5, 479.5))
        X = BOARD.points @ T[:3, :3].T + T[:3, 3]
        off = np.hypot(X[:, 0], X[:, 1])
        seen.append(
            View(BOARD.points, X[:, :2] * (f * np.arctan2(off, X[:, 2]) / off)[:, None] + [639.5, 479.5])
        )
    return noisy(seen, 0.15, 3)


@pytest.mark.parametrize("field_deg", [150, 170])
def test_a_fisheye_is_no_lens_of_this_model(field_deg: float) -> None:
    found = calibrate(fisheye_views(field_deg), SIZE)
    assert not found.verdict.usable
    assert found.prior_conflicts["remainder of the lens"] > 2.5


@pytest.mark.parametrize("field_deg", [60, 90, 105])
def test_the_focal_length_of_a_wide_lens_is_that_on_its_axis(field_deg: float) -> None:
    truth = np.hypot(*SIZE) / np.radians(field_deg)
    found = calibrate(fisheye_views(field_deg), SIZE)
    assert found.std is not None
    for name in ("fx", "fy"):
        assert abs(getattr(found.camera, name) - truth) < 2 * found.std[name]
        assert found.std[name] < 0.02 * truth


def test_a_board_that_is_bent_too_much_is_named() -> None:
    bent = BOARD.points + np.outer(((BOARD.points[:, 0] - 0.1) / 0.1) ** 2 * 0.002, [0, 0, 1])
    poses = [pose(*tilt) for tilt in FIVE[:2]]
    seen = noisy([View(BOARD.points, CAMERA.project(bent, T)) for T in poses], 0.15, 3)
    found = calibrate(seen, SIZE)
    assert any("bend of the board contradicts" in reason for reason in found.verdict.reasons)
    assert found.determined is not None
    assert "bend of the board" not in found.determined


def test_face_on_the_focal_length_is_as_uncertain_as_before() -> None:
    for found in (face_on(), calibrate(views_at((0, 0)), SIZE)):
        assert found.focal_std is not None
        assert found.determined is not None
        # The prior alone leaves 0.46: a factor of exp(0.40) either way.
        assert 0.2 < found.focal_std < 0.6
        assert found.verdict.reasons[0].startswith("Fronto-parallel")
        assert f"The focal length is known to {100 * found.focal_std:.0f} %" in found.verdict.reasons[1]
        # The noise tells what it can: the aspect ratio is seen face on.
        assert found.determined["focal length"] < 0.8
        assert found.determined["aspect ratio"] > 0.5


def test_a_users_own_focal_length_is_kept_face_on() -> None:
    found = calibrate(noisy(views_at((0, 0)), 0.2, 2), SIZE, priors=Priors(focal_px=(1100, 22)))
    assert found.focal_std == pytest.approx(0.02, rel=0.1)
    assert found.camera.fx == pytest.approx(1100, rel=0.01)


def test_a_false_focal_length_is_a_conflict() -> None:
    views, own = sound().views, Priors(focal_px=(600, 30))
    found = calibrate(views, SIZE, priors=own)
    assert found.prior_conflicts["focal length"] > 3
    assert found.camera.fx == pytest.approx(1100, rel=0.02)
    assert found.verdict.usable, "the data have settled the focal length"
    doubtful = calibrate(views, SIZE, priors=own, thresholds=Thresholds(settled_share=1.1))
    assert any("focal length contradicts" in reason for reason in doubtful.verdict.reasons)


@pytest.mark.parametrize("views", [1, 2, 5])
@pytest.mark.parametrize("sd", [0.03, 0.005, 1e-3, 1e-4, 1e-6])
def test_a_false_focal_length_is_not_usable_however_surely_it_is_stated(views: int, sd: float) -> None:
    # The surer a prior the less is left of it at the estimate; the points are what it has to be held against.
    seen = noisy(views_at(*FIVE[:views]), 0.2, 1)
    found = calibrate(seen, SIZE, priors=Priors(focal_px=(1300, 1300 * sd)))
    assert not found.verdict.usable or found.camera.fx == pytest.approx(1100, rel=0.01)
    assert found.prior_conflicts["focal length"] > 3
    right = calibrate(seen, SIZE, priors=Priors(focal_px=(1100, 1100 * sd)))
    assert right.prior_conflicts == {}


@pytest.mark.parametrize(("stated", "sd"), [(2000, 1), (300, 3), (1800, 18), (1500, 1), (600, 0.1)])
def test_a_focal_length_far_from_the_truth_is_named_whatever_else_gives_way(stated: float, sd: float) -> None:
    found = calibrate(noisy(views_at(*FIVE[:2]), 0.2, 1), SIZE, priors=Priors(focal_px=(stated, sd)))
    assert found.prior_conflicts["focal length"] > 3
    assert not found.verdict.usable or found.camera.fx == pytest.approx(1100, rel=0.02)


def test_squares_that_were_stated_falsely_are_a_conflict() -> None:
    views = noisy(views_at(*FIVE), 0.1, 1)
    # What is stated is a board of other squares than were printed.
    false = [View(view.object_points * np.array([1.005, 1, 1]), view.image_points) for view in views]
    square = Priors(print_stretch=Normal(0.0, 1e-4))
    (reason,) = calibrate(false, SIZE, priors=square).verdict.reasons
    assert "stretch of the print contradicts" in reason
    assert calibrate(views, SIZE, priors=square).verdict.usable


def test_a_conflict_far_out_in_the_tail_of_a_prior_is_not_settled() -> None:
    # A t prior is nearly flat out there; measured at the estimate it seems to have said nothing.
    views = noisy(views_at((40, 30), (35, 120)), 0.2, 0)
    found = calibrate(views, SIZE, priors=Priors(focal_px=(600, 12)))
    assert found.determined is not None
    assert found.determined["aspect ratio"] < 0.9
    assert not found.verdict.usable
    assert any("aspect ratio contradicts" in reason for reason in found.verdict.reasons)


def test_a_conflict_is_what_the_thresholds_say() -> None:
    own, patient = Priors(focal_px=(600, 30)), Thresholds(conflict=1e3)
    assert calibrate(sound().views, SIZE, priors=own).prior_conflicts
    assert calibrate(sound().views, SIZE, priors=own, thresholds=patient).prior_conflicts == {}


def test_one_view_outside_the_image_is_enough() -> None:
    first, second = noisy(views_at((40, 30), (35, 120)), 0.1, 1)
    off = View(second.object_points, second.image_points + np.array([500.0, 0.0]))
    reasons = calibrate([first, off], SIZE).verdict.reasons
    assert any("Points lie outside the image" in reason for reason in reasons)


def test_a_cropped_image_contradicts_the_priors() -> None:
    # The left third of the image is cut off after the picture was taken.
    views = [View(v.object_points, v.image_points - [430, 0]) for v in noisy(views_at(*FIVE[:3]), 0.2, 5)]
    found = calibrate(views, (850, 960))
    assert found.prior_conflicts["principal point x"] > 2.5
    undecided = calibrate(views, (850, 960), thresholds=Thresholds(settled_share=1.1))
    assert any("principal point x contradicts" in reason for reason in undecided.verdict.reasons)


def test_zhang_has_no_error_bars() -> None:
    found = calibrate(noisy(views_at(*FIVE[:3], camera=RADIAL), 0.1, 3), SIZE, method="zhang")
    assert (found.std, found.focal_std, found.covariance, found.determined) == (None, None, None, None)
    with pytest.raises(InvalidInput, match='"zhang" reports no uncertainty; use "map"'):
        found.projection_std([[0, 0]])
    assert not found.verdict.usable
    assert "no error bars" in found.verdict.reasons[0]


def test_zhu2020_has_error_bars_that_follow_the_noise() -> None:
    # So many views that the penalty of eq 29, which knows nothing of the noise, hardly matters.
    exact = views_at(*FIVE, camera=SQUARE)
    quiet, loud = (calibrate(noisy(exact, sigma, 3), SIZE, method="zhu2020") for sigma in (0.2, 2.0))
    assert quiet.focal_std is not None
    assert loud.focal_std is not None
    for found in (quiet, loud):
        assert abs(found.camera.fx / 1100 - 1) < 3 * (found.focal_std or 0)
        assert (found.projection_std([[0, 0], [640, 480]]) > 0).all()
    assert 0.0005 < quiet.focal_std < 0.01
    assert loud.focal_std / quiet.focal_std == pytest.approx(loud.sigma_px / quiet.sigma_px, rel=0.2)


def test_copies_tell_zhu2020_nothing_new() -> None:
    seen = noisy(views_at(*FIVE[:2], camera=SQUARE), 0.3, 2)
    once, often = (calibrate(seen * count, SIZE, method="zhu2020") for count in (1, 20))
    assert often.focal_std == pytest.approx(once.focal_std, rel=0.1)
    np.testing.assert_allclose(often.sigma_px, once.sigma_px, rtol=0.05)


def test_too_few_points_for_every_unknown_of_zhu2020() -> None:
    corners = [0, 8, 45, 53]
    (v,) = views_at(FIVE[0])
    found = calibrate([View(v.object_points[corners], v.image_points[corners])], SIZE, method="zhu2020")
    assert found.focal_std == np.inf
    assert np.isinf(found.projection_std([[0, 0]])).all()
    assert not found.verdict.usable


def test_four_points_are_enough_for_map() -> None:
    corners = [0, 8, 45, 53]
    (v,) = views_at(FIVE[0])
    found = calibrate([View(v.object_points[corners], v.image_points[corners])], SIZE)
    assert found.focal_std is not None
    assert abs(found.camera.fx / CAMERA.fx - 1) < 3 * found.focal_std
    assert found.rms < 0.5


# --- distortion in pixels ----------------------------------------------------------------------------------


# --- verdict -----------------------------------------------------------------------------------------------

DEGENERATE = {
    "Fronto-parallel": [pose(1, 0), pose(2, 90)],
    "The same view again": [pose(30, 0), pose(30, 0), pose(30, 0)],
    "Parallel planes": [pose(30, 0), pose(30, 0, shift_px=(200, 100), span=0.3)],
    "Turn about the normal": [pose(30, 0), pose(30, 0, 60)],
    "Board too small": [pose(40, 30, span=0.1), pose(35, 120, span=0.1)],
}


PLANES = {"z = 0": [0, 1, 2], "x = 0": [2, 0, 1], "y = 0": [1, 2, 0], "mirrored": [1, 0, 2]}
"""Coordinates of a board in the order in which it lies in other planes of its frame."""


def in_plane(views: list[View], plane: str) -> list[View]:
    return [View(each.object_points[:, PLANES[plane]], each.image_points) for each in views]


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("reason", DEGENERATE)
def test_degenerate_arrangements_are_named(reason: str, plane: str) -> None:
    views = noisy([view(T) for T in DEGENERATE[reason]], 0.2, 6)
    found = calibrate(in_plane(views, plane), SIZE)
    assert not found.verdict.usable
    named = [any(text.startswith(name) for text in found.verdict.reasons) for name in DEGENERATE]
    assert named == [name == reason for name in DEGENERATE]


@pytest.mark.parametrize("plane", PLANES)
@pytest.mark.parametrize("tilts", [FIVE[:1], FIVE[:2], ((0, 0), (35, 60)), FIVE])
def test_sound_arrangements_are_usable(tilts: tuple[tuple[float, float], ...], plane: str) -> None:
    found = calibrate(in_plane(noisy(views_at(*tilts), 0.1, 7), plane), SIZE)
    assert found.verdict.usable, found.verdict
    assert found.verdict.reasons == ()
    np.testing.assert_allclose(found.tilts_deg, [tilt for tilt, _ in tilts], atol=1)


def test_thresholds_can_be_changed() -> None:
    assert sound().verdict.usable
    strict = calibrate(sound().views, SIZE, thresholds=Thresholds(focal_std=1e-4))
    assert not strict.verdict.usable
    assert "0.01 % is asked" in strict.verdict.reasons[0]
    lenient = calibrate(face_on().views, SIZE, thresholds=Thresholds(focal_std=0.6, tilt_deg=0.0))
    assert lenient.verdict.usable


def test_a_folding_model_is_named() -> None:
    lens = Camera(700.0, 700.0, 639.5, 479.5, [-0.45, 0.0, 0.0, 0.0, 0.0])
    found = calibrate(views_at(*FIVE[:3], camera=lens, span=0.3), SIZE)
    assert any("folds over" in reason for reason in found.verdict.reasons)


def test_pixels_of_a_wrong_shape() -> None:
    for pixels in ([0.0, 0.0], [[0.0, 0.0, 1.0]]):
        with pytest.raises(InvalidInput, match=r"pixels must have shape \(N, 2\)"):
            sound().projection_std(pixels)


def test_points_that_lie_too_close_are_named() -> None:
    (seen,) = views_at((40, 30))
    middle = seen.image_points.mean(axis=0)
    speck = View(seen.object_points, middle + 1e-9 * (seen.image_points - middle))
    with pytest.raises(DegenerateViews, match="so close together that rounding hides how"):
        calibrate([speck], SIZE)


def test_one_parallel_view_does_not_excuse_a_false_focal_length() -> None:
    seen = noisy(views_at((40, 30), (1, 0)), 0.2, 1)
    assert "focal length" in calibrate(seen, SIZE, priors=Priors(focal_px=(1150.0, 1.0))).prior_conflicts


def test_a_result_cannot_be_changed() -> None:
    found = sound()
    assert found.covariance is not None
    for array in (*found.board_poses, found.view_rms, found.departures, found.covariance, found.tilts_deg):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
