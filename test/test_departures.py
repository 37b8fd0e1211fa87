from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import BOARD, CAMERA, SIZE, noisy, pose

import fewcal
from fewcal.constraints import Normal, Priors
from fewcal.departures import (
    STRAIGHT,
    Departures,
    _undistorted,
    axial_remainder,
    lens_remainder,
    lifts,
    radial_terms,
)

Array = NDArray[np.float64]

NONE = Normal(0.0, 1e-9)
FLAT = Priors(board_bend=NONE, lens_remainder=NONE, print_stretch=NONE)
POSES = [pose(40, 20), pose(25, 110), pose(35, 240, span=0.7)]


WIDE = [
    (35, 40, (-250, -150)),
    (30, 130, (250, -150)),
    (35, 220, (-250, 150)),
    (30, 310, (250, 150)),
    (20, 0, (0, 0)),
]


def bent_views(bend: tuple[float, float]) -> list[fewcal.View]:
    """Views of a board that is lifted by these shares of its diagonal along its sides."""
    points = (BOARD.points - BOARD.points.mean(axis=0))[:, :2].T[None]
    lift = np.array(bend) @ lifts(points)[0]
    bent = BOARD.points + lift[:, None] * [0, 0, 1]
    return [fewcal.View(BOARD.points, CAMERA.project(bent, T)) for T in POSES]


def test_a_bend_lifts_the_edges_by_its_share_of_the_diagonal() -> None:
    x, y = (a.ravel() for a in np.meshgrid(np.linspace(-0.4, 0.4, 9), np.linspace(-0.3, 0.3, 7)))
    lift = lifts(np.stack([x, y])[None])[0]
    np.testing.assert_allclose(lift, [(x / 0.4) ** 2, (y / 0.3) ** 2], atol=1e-12)
    part = np.abs(x) < 0.25
    both = lifts(np.stack([[x, y], [np.where(part, x, 0), np.where(part, y, 0)]]))
    np.testing.assert_allclose(both[1, :, part].T, lift[:, part], err_msg="the largest view sets the scale")


@pytest.mark.parametrize("size", [(640, 480), (1920, 1080)])
def test_no_camera_of_the_model_takes_the_remainder_over(size: tuple[int, int]) -> None:
    half = np.hypot(*size) / 2
    grid = np.stack(np.meshgrid(*(np.arange(4.5, length, 10) for length in size))).reshape(2, -1)
    centre = (np.array(size) - 1) / 2 + [60.0, -25.0]
    shift = lens_remainder(grid[None], size, centre)[0] / half
    at = (grid - centre[:, None]) / half
    r = np.hypot(*at)
    along = (shift * at).sum(axis=0)[r > 0] / r[r > 0]
    r = r[r > 0]
    np.testing.assert_allclose(np.hypot(*shift).max(), np.abs(along).max(), err_msg="it is radial")
    for power in (1, 3, 5):
        assert abs(along @ r**power) < 0.05 * np.linalg.norm(along) * np.linalg.norm(r**power)
    others = np.linalg.lstsq(r[:, None] ** [1, 3, 5], along - r**7, rcond=None)
    assert others[1].sum() < 1e-20, "apart from those powers it is r^7"


def test_a_centre_outside_the_image_counts_as_the_place_in_it_that_is_nearest() -> None:
    outside, nearest, corner = np.array([-40.0, 1100.0]), np.array([0.0, SIZE[1]]), np.array([[[3.0], [9.0]]])
    np.testing.assert_array_equal(
        lens_remainder(corner, SIZE, outside), lens_remainder(corner, SIZE, nearest)
    )
    assert axial_remainder(SIZE, outside) == axial_remainder(SIZE, nearest)


def test_a_view_has_the_departures_of_its_points() -> None:
    points, pixels = BOARD.points[None, :, :2].swapaxes(1, 2), np.full((1, 2, 54), 100.0)
    centre = np.array([650.0, 470.0])
    found = Departures.of(points, pixels, SIZE, centre)
    np.testing.assert_array_equal(found.lift, lifts(points))
    np.testing.assert_array_equal(found.shift, lens_remainder(pixels, SIZE, centre))
    np.testing.assert_array_equal(found.stretch, [[points[0, 0] / 2, -points[0, 1] / 2]])
    radial = np.array([-0.1, 0.02])
    moved = found.about(centre + 9, pixels, SIZE, radial)
    other = Departures.of(points, pixels, SIZE, centre + 9, radial)
    np.testing.assert_array_equal(moved.shift, other.shift)
    np.testing.assert_array_equal(moved.lift, other.lift)


@pytest.mark.parametrize("bend", [(4e-3, 0.0), (-2e-3, 3e-3)])
def test_a_bent_board_is_found_bent_and_no_longer_bends_the_camera(bend: tuple[float, float]) -> None:
    errors = []
    for seed in range(3, 7):
        views = noisy(bent_views(bend), 0.1, seed)
        found, flat = fewcal.calibrate(views, SIZE), fewcal.calibrate(views, SIZE, priors=FLAT)
        np.testing.assert_allclose(found.departures[:2], bend, atol=7e-4)
        np.testing.assert_allclose(flat.departures, 0, atol=1e-6)
        errors.append([abs(answer.camera.fx / CAMERA.fx - 1) for answer in (found, flat)])
        assert found.sigma_px < 0.7 * flat.sigma_px
        assert found.rms > 2 * flat.sigma_px / 5, "the camera alone still misses a bent board"
    own, taken_for_flat = np.mean(errors, axis=0)
    assert own < 0.3 * taken_for_flat


def test_a_flat_board_is_found_flat() -> None:
    found = fewcal.calibrate(noisy(bent_views((0.0, 0.0)), 0.1, 4), SIZE)
    assert np.abs(found.departures[:2]).max() < 5e-4


@pytest.mark.parametrize("stretch", [-4e-3, 4e-3])
def test_squares_that_are_longer_than_wide_are_told_from_the_camera(stretch: float) -> None:
    true = BOARD.points * [np.exp(stretch / 2), np.exp(-stretch / 2), 1]
    # A board that is never turned leaves open whether it is the camera that stretches.
    poses = [pose(40, 20), pose(25, 110, 80), pose(35, 240, 130), pose(35, 190, 30)]
    exact = [fewcal.View(BOARD.points, CAMERA.project(true, T)) for T in poses]
    views = noisy(exact, 0.1, 5)
    found, square = fewcal.calibrate(views, SIZE), fewcal.calibrate(views, SIZE, priors=FLAT)
    assert found.departures[3] == pytest.approx(stretch, abs=1.5e-3)
    errors = [abs(answer.camera.fx / CAMERA.fx - 1) for answer in (found, square)]
    assert errors[0] < 0.5 * errors[1]
    assert found.focal_std is not None
    assert errors[0] < 2 * found.focal_std


def test_computed_points_have_a_perfect_board_if_they_can() -> None:
    np.testing.assert_allclose(fewcal.calibrate(bent_views((0.0, 0.0)), SIZE).departures, 0, atol=1e-9)
    bent = fewcal.calibrate(bent_views((4e-3, 0.0)), SIZE)
    np.testing.assert_allclose(bent.departures[:2], [4e-3, 0], atol=2e-4)


OFF_CENTRE = fewcal.Camera(1100.0, 1103.0, 700.0, 440.0, [-0.12, 0.03, 0.0006, -0.0004, 0.0])


@pytest.mark.parametrize("lens", [CAMERA, OFF_CENTRE], ids=["CAMERA", "OFF_CENTRE"])
@pytest.mark.parametrize("coefficient", [-0.03, 0.03])
def test_the_remainder_of_a_lens_is_told_from_its_distortion(coefficient: float, lens: fewcal.Camera) -> None:
    shifted = []
    for T in POSES:
        pixels = lens.project(BOARD.points, T)
        radial = radial_terms(lens, SIZE)
        shift = coefficient * lens_remainder(pixels.T[None], SIZE, lens.intrinsics[2:], radial)[0].T
        shifted.append(fewcal.View(BOARD.points, pixels + shift))
    found = fewcal.calibrate(shifted, SIZE)
    wrong = fewcal.calibrate(shifted, SIZE, priors=FLAT)
    corner = np.array([[5.0, 5.0]])
    ray = lens.unproject(corner)
    error, without = (np.linalg.norm(answer.camera.project(ray) - corner) for answer in (found, wrong))
    assert found.departures[2] == pytest.approx(coefficient, rel=0.3)
    assert error < 0.5 * without


@pytest.mark.parametrize("radial", [(-0.25, 0.08), (0.2, -0.03), (-0.1, -0.02)])
def test_a_radius_without_the_distortion_is_that_of_the_model(radial: tuple[float, float]) -> None:
    straight = np.linspace(0, 0.9, 50)
    a1, a2 = radial
    seen = straight * (1 + a1 * straight**2 + a2 * straight**4)
    np.testing.assert_allclose(_undistorted(seen, np.array(radial)), straight, atol=1e-8)
    # Beyond the fold there is none.
    assert _undistorted(np.array([0.9]), np.array([-0.9, 0.0])) == 0.9
    # Nor where the model rises again, behind it.
    assert _undistorted(np.array([1.21]), np.array([-0.518, 0.074])) == 1.21


@pytest.mark.parametrize("k3", [-0.01, 0.02])
def test_the_remainder_is_the_third_radial_term_of_the_model(k3: float) -> None:
    """Also of a wide lens, whose barrel brings the corners of the image nearer by a third."""
    lens = fewcal.Camera(800.0, 800.0, 645.0, 475.0, [-0.2, 0.06, 0.0, 0.0, k3])
    views = [
        fewcal.View(BOARD.points, lens.project(BOARD.points, pose(tilt, about, camera=lens, shift_px=shift)))
        for tilt, about, shift in WIDE
    ]
    found = fewcal.calibrate(noisy(views, 0.02, 1), SIZE)
    assert found.departures[2] == pytest.approx(k3, rel=0.2)
    corners = np.array([[0.0, 0.0], [1279.0, 0.0], [0.0, 959.0], [1279.0, 959.0]])
    missed = np.linalg.norm(found.camera.project(lens.unproject(corners)) - corners, axis=1)
    assert np.all(missed < 2 * found.projection_std(corners))


@pytest.mark.parametrize("method", ["zhu2020", "zhang"])
def test_the_other_methods_know_no_departures(method: str) -> None:
    np.testing.assert_array_equal(fewcal.calibrate(bent_views((0.0, 0.0)), SIZE, method).departures, 0)


@pytest.mark.parametrize("offset", [[0, 0], [60.0, -25.0], [-700.0, 0.0]])
def test_the_remainder_changes_the_focal_length_on_the_axis(offset: list[float]) -> None:
    centre, step = (np.array(SIZE) - 1) / 2 + offset, np.array([1e-3, 0.0])
    at = np.clip(centre, 0, np.array(SIZE)) + step
    for radial in (STRAIGHT, np.array([-0.2, 0.05])):
        shift = lens_remainder(at[None, :, None], SIZE, centre, radial)[0, :, 0]
        assert shift[0] / step[0] == pytest.approx(axial_remainder(SIZE, centre, radial), rel=1e-5)


def test_the_remainder_of_the_lens_does_not_move_its_centre() -> None:
    shift = lens_remainder(np.full((1, 2, 1), 320.0), (640, 480), np.array([320.0, 320.0]))
    np.testing.assert_array_equal(shift, 0)
