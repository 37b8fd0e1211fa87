from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import SIZE, pose, view, views_at

from fewcal.boards import Chessboard
from fewcal.camera import Camera, project_pixel_model
from fewcal.closed_form import simplified_intrinsics
from fewcal.errors import DegenerateViews, ImaginaryFocalLength
from fewcal.homography import homographies, refine_homographies
from fewcal.least_squares import Stop
from fewcal.parametrisation import PixelModel
from fewcal.views import View, ViewStack, stack_views
from fewcal.zhu2020 import estimate_zhang, estimate_zhu2020, solve_zhang, solve_zhu2020

Array = NDArray[np.float64]

SQUARE = Camera(1100.0, 1100.0, 650.0, 470.0, [-0.12, 0.03, 0.0006, -0.0004, 0.0])
RADIAL = Camera(1100.0, 1100.0, 650.0, 470.0, [-0.12, 0.03, 0.0, 0.0, 0.0])
TWO, THREE = ((40, 30), (35, 120)), ((40, 30), (35, 120), (30, -60))


def paper_views(
    intrinsics: list[float], coefficients: list[float], *tilts: tuple[float, float]
) -> list[View]:
    """Exact views of the paper's camera: fx, fy, u0, v0, s and distortion in pixels."""
    board = Chessboard(9, 6, 0.025)
    views = []
    for tilt, about in tilts:
        T = pose(tilt, about)
        points = board.points @ T[:3, :3].T + T[:3, 3]
        pixels = project_pixel_model(points, np.array(intrinsics), np.array(coefficients))
        views.append(View(board.points, pixels))
    return views


@pytest.mark.parametrize("tilts", [TWO, THREE, ((1.2, 0), (40, 20))])
def test_the_papers_method_is_exact_for_square_pixels(tilts: tuple[tuple[float, float], ...]) -> None:
    found = estimate_zhu2020(stack_views(views_at(*tilts, camera=SQUARE)), SIZE)
    intrinsics, coefficients = found.geometry.theta[0, :5], found.geometry.theta[0, 5:]
    np.testing.assert_allclose(intrinsics, [1100, 1100, 650, 470, 0], rtol=1e-6, atol=1e-6)
    expected = [-0.12 / 1100**2, 0.03 / 1100**4, -0.0004 / 1100, 0.0006 / 1100]
    np.testing.assert_allclose(coefficients, expected, rtol=1e-6)
    for i, tilt in enumerate(tilts):
        np.testing.assert_allclose(found.geometry.rotation[0, i], pose(*tilt)[:3, :3], atol=1e-8)
    assert found.stop != Stop.ITERATIONS


def test_the_papers_method_needs_the_principal_point_in_one_view() -> None:
    centred = Camera(1100.0, 1100.0, SIZE[0] / 2, SIZE[1] / 2, [-0.12, 0.03, 0.0, 0.0, 0.0])
    found = estimate_zhu2020(stack_views(views_at((40, 30), camera=centred)), SIZE)
    np.testing.assert_allclose(found.geometry.theta[0, :4], centred.intrinsics, rtol=1e-6)


def test_refinement_removes_what_distortion_does_to_the_closed_form() -> None:
    views = stack_views(views_at(*TWO, camera=SQUARE))
    H = homographies(views.points, views.pixels, views.weights)
    H = refine_homographies(H, views.points, views.pixels, views.weights, np.array(SIZE) / 2)
    f = np.sqrt(simplified_intrinsics(H, np.array(SIZE) / 2)[0])
    assert abs(f - 1100) > 1
    assert estimate_zhu2020(views, SIZE).geometry.theta[0, 0] == pytest.approx(1100, rel=1e-9)


def test_weighted_homographies_find_a_focal_length_where_unweighted_ones_do_not() -> None:
    centred = Camera(1100.0, 1100.0, SIZE[0] / 2, SIZE[1] / 2, [-0.12, 0.03, 0.0, 0.0, 0.0])
    views = stack_views(views_at((10, 90), camera=centred, span=0.8))
    unweighted = homographies(views.points, views.pixels, views.weights)
    assert simplified_intrinsics(unweighted, np.array(SIZE) / 2)[0] < 0
    estimate_zhu2020(views, SIZE)


def test_the_constraint_of_eq_29_pulls_the_focal_lengths_together() -> None:
    views = stack_views(paper_views([1100, 1150, 650, 470, 0], [-1e-7, 2e-14, 0, 0], *TWO))
    fx, fy = estimate_zhu2020(views, SIZE).geometry.theta[0, :2]
    assert 0 < fy - fx < 49


def test_zhang_is_exact_from_three_views_with_skew() -> None:
    intrinsics, radial = [1100.0, 1130.0, 650.0, 470.0, 4.0], [-1e-7, 2e-14, 0.0, 0.0]
    found = estimate_zhang(stack_views(paper_views(intrinsics, radial, *THREE)))
    assert found.adjustment.model == PixelModel(tangential=False)
    np.testing.assert_allclose(found.geometry.theta[0], [*intrinsics, *radial[:2]], rtol=1e-6)


def test_boards_in_other_planes_have_poses_in_their_own_axes() -> None:
    turn = pose(50, 70)[:3, :3]
    views = views_at(*THREE, camera=RADIAL)
    lifted = [View(v.object_points @ turn.T + [1, 2, 3], v.image_points) for v in views]
    for estimate in (lambda v: estimate_zhu2020(v, SIZE), estimate_zhang):
        stack = stack_views(lifted)
        rotation = estimate(stack).geometry.rotation[0] @ np.swapaxes(stack.plane, -1, -2)
        for i, tilt in enumerate(THREE):
            np.testing.assert_allclose(rotation[i] @ turn, pose(*tilt)[:3, :3], atol=1e-7)


SQUARE_TARGET = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
"""Four points that no camera shows in the wild arrangements below."""


@pytest.mark.parametrize(
    ("pixels", "error", "message"),
    [
        (
            [[573, 243], [37, 15], [732, 821], [546, 657]],
            ImaginaryFocalLength,
            "gives f\\^2 = -.*with the board tilted by 30 deg",
        ),
        ([[122, 649], [473, 279], [437, 801], [841, 322]], DegenerateViews, "puts a board behind the camera"),
        (
            [[777, 499], [781, 557], [643, 403], [613, 572]],
            DegenerateViews,
            "focal length that is not positive",
        ),
    ],
)
def test_what_the_papers_method_cannot_do_has_a_name(
    pixels: list[list[float]], error: type[DegenerateViews], message: str
) -> None:
    with pytest.raises(DegenerateViews, match=message) as caught:
        estimate_zhu2020(stack_views([View(SQUARE_TARGET, pixels)]), SIZE)
    assert caught.type is error


def test_what_zhang_cannot_do_has_a_name() -> None:
    with pytest.raises(ImaginaryFocalLength, match="board tilted by 30 deg"):
        estimate_zhang(stack_views([view(pose(40, 30))]))
    wild = [
        [[856, 11], [310, 395], [361, 26], [220, 851]],
        [[818, 117], [45, 641], [159, 268], [899, 795]],
        [[140, 334], [367, 53], [440, 172], [735, 799]],
    ]
    with pytest.raises(DegenerateViews, match="puts a board behind the camera"):
        estimate_zhang(stack_views([View(SQUARE_TARGET, pixels) for pixels in wild]))


def test_many_sets_of_views_at_once_are_each_as_alone() -> None:
    good = [views_at(*tilts, camera=RADIAL) for tilts in (TWO, ((30, 10), (50, 200)))]
    # Two parallel boards have no focal length.
    sets = [stack_views(views) for views in (good[0], views_at((0, 0), (0, 0), camera=RADIAL), good[1])]
    for solutions, alone in (
        (solve_zhu2020(ViewStack.several(sets), SIZE), lambda views: estimate_zhu2020(views, SIZE)),
        (solve_zhang(ViewStack.several(sets)), estimate_zhang),
    ):
        for item, views in enumerate(sets):
            try:
                expected = alone(views)
            except DegenerateViews as error:
                with pytest.raises(type(error), match=re.escape(str(error)[:30])):
                    solutions.estimate(item)
                continue
            found = solutions.estimate(item)
            np.testing.assert_allclose(found.geometry.theta, expected.geometry.theta, rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(found.board_poses(), expected.board_poses(), atol=1e-7)
    assert solve_zhu2020(ViewStack.several(sets), SIZE).estimate(2).stop == Stop.CONVERGED
