from __future__ import annotations

import copy
import pickle
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scenes import BOARD

from fewcal.adjustment import rotation_from_vector
from fewcal.boards import Chessboard
from fewcal.errors import InvalidInput
from fewcal.views import View, align_views, stack_views

OBJECT = Chessboard(4, 3, 0.03).points
IMAGE = OBJECT[:, :2] * 1000 + 50


def test_a_view_keeps_what_it_was_given() -> None:
    view = View(OBJECT, IMAGE, sigma=0.1, source="left.png", stamp_ns=12)
    assert len(view) == 12
    np.testing.assert_array_equal(view.object_points, OBJECT)
    np.testing.assert_array_equal(view.image_points, IMAGE)
    assert view.sigma is not None
    np.testing.assert_array_equal(view.sigma, np.full(12, 0.1))
    assert (view.source, view.stamp_ns) == ("left.png", 12)


def test_sigma_is_optional_and_may_differ_by_point() -> None:
    assert View(OBJECT, IMAGE).sigma is None
    sigma = View(OBJECT, IMAGE, np.linspace(0.1, 1, 12)).sigma
    assert sigma is not None
    np.testing.assert_array_equal(sigma, np.linspace(0.1, 1, 12))


def test_views_of_different_parts_are_aligned_by_the_points_of_the_board() -> None:
    whole, left, right = View(OBJECT, IMAGE), View(OBJECT[:5], IMAGE[:5] + 1), View(OBJECT[3:], IMAGE[3:] + 2)
    np.testing.assert_array_equal(align_views([whole, whole]), [IMAGE, IMAGE])
    aligned = align_views([right, whole, left])
    assert aligned.shape == (3, 12, 2)
    seen = np.isfinite(aligned).all(axis=2)
    assert seen.sum(axis=1).tolist() == [9, 12, 5]
    np.testing.assert_array_equal((aligned - aligned[1])[0][seen[0]], np.full((9, 2), 2.0))
    np.testing.assert_array_equal((aligned - aligned[1])[2][seen[2]], np.full((5, 2), 1.0))
    assert (seen[0] & seen[2]).sum() == 2


def test_points_without_z_lie_in_the_plane_z_0() -> None:
    np.testing.assert_array_equal(View(OBJECT[:, :2], IMAGE).object_points, OBJECT)


def test_lists_and_integers_are_taken() -> None:
    view = View([[0, 0], [1, 0], [1, 1], [0, 1]], [[0, 0], [9, 0], [9, 9], [0, 9]])
    assert view.object_points.dtype == view.image_points.dtype == np.float64


def test_a_view_cannot_be_changed_through_its_arrays() -> None:
    image = IMAGE.copy()
    view = View(OBJECT, image, 0.1)
    image[0] = -1
    np.testing.assert_array_equal(view.image_points, IMAGE)
    for array in (view.object_points, view.image_points, view.sigma):
        assert array is not None
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1


def test_a_point_that_is_given_several_times_counts_as_one() -> None:
    order = [*range(12), 3, 3, 7]
    weights = stack_views([View(OBJECT[order], IMAGE[order], np.linspace(0.2, 0.2, 15))]).weights[0]
    squares = np.bincount(order, weights**2)
    np.testing.assert_allclose(squares, squares[0])


def test_copies_are_as_read_only_as_what_they_are_copies_of() -> None:
    view = pickle.loads(pickle.dumps(View(OBJECT, IMAGE, 0.1, "left.png", 5)))
    assert (view.source, view.stamp_ns) == ("left.png", 5)
    np.testing.assert_array_equal(view.image_points, IMAGE)
    assert view.sigma is not None
    for array in (view.object_points, copy.deepcopy(view).image_points, view.sigma):
        assert not array.flags.writeable


def test_points_of_one_sigma_weigh_one_whichever_view_is_longer() -> None:
    stack = stack_views([View(OBJECT, IMAGE, 0.3), View(OBJECT[:5], IMAGE[:5], 0.3), View(OBJECT, IMAGE)])
    np.testing.assert_array_equal(stack.counts, [12, 5, 12])
    np.testing.assert_allclose(stack.weights[stack.weights > 0], 1)


def test_points_that_are_a_little_out_of_a_plane_lie_in_none() -> None:
    bent = OBJECT.copy()
    bent[5, 2] = 1e-5 * np.ptp(OBJECT)
    with pytest.raises(InvalidInput, match="do not lie in one plane"):
        View(bent, IMAGE)


def test_no_point_counts_for_more_than_board_and_lens_let_it() -> None:
    sigma = np.where(np.arange(12) < 6, 1e-6, 0.1)
    weights = stack_views([View(OBJECT, IMAGE, sigma)]).weights[0]
    assert weights[0] / weights[-1] == pytest.approx(np.sqrt(2))


def test_four_points_may_lie_off_a_plane_already() -> None:
    with pytest.raises(InvalidInput, match="one plane"):
        View([[0, 0, 0], [1, 0, 0], [1, 1, 0.001], [0, 1, 0]], IMAGE[:4])


def test_sigma_has_one_row() -> None:
    with pytest.raises(InvalidInput, match="sigma must be positive pixels"):
        View(OBJECT, IMAGE, np.ones((3, 4)))


@given(
    hnp.arrays(np.float64, 3, elements=st.floats(-3, 3)), hnp.arrays(np.float64, 3, elements=st.floats(-9, 9))
)
def test_a_plane_may_lie_anywhere_in_space(rvec: Any, tvec: Any) -> None:
    turned = OBJECT @ cv2.Rodrigues(rvec)[0].T + tvec
    assert len(View(turned, IMAGE)) == 12


@given(st.integers(0, 11), st.floats(1e-3, 1))
def test_a_point_off_the_plane_is_refused(index: int, height: float) -> None:
    bent = OBJECT.copy()
    bent[index, 2] = height
    with pytest.raises(InvalidInput, match="one plane"):
        View(bent, IMAGE)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ((OBJECT.T, IMAGE), r"object_points must have shape \(N, 3\)"),
        ((OBJECT[:, :1], IMAGE), r"object_points must have shape"),
        ((OBJECT[0], IMAGE), r"object_points must have shape"),
        ((OBJECT, OBJECT), r"image_points must have shape \(N, 2\)"),
        ((OBJECT, IMAGE[:-1]), "12 object points but 11 image points"),
        ((OBJECT * np.nan, IMAGE), "object_points holds a value that is not finite"),
        ((OBJECT, IMAGE * np.inf), "image_points holds a value that is not finite"),
        (("corners", IMAGE), "object_points must be an array of numbers"),
        ((OBJECT, None), "image_points"),
        ((OBJECT, [[1, 2], [3]]), "image_points must be an array of numbers"),
        ((OBJECT, IMAGE, 0.0), "sigma must be positive"),
        ((OBJECT, IMAGE, -0.1), "sigma must be positive"),
        ((OBJECT, IMAGE, [0.1, 0.2]), "one for all points or one for each"),
        ((OBJECT, IMAGE, np.nan), "sigma holds a value that is not finite"),
        ((OBJECT, IMAGE * 1e90), "image_points holds a value beyond 1e\\+15"),
        ((OBJECT, IMAGE, 1e300), "sigma holds a value beyond"),
    ],
)
def test_correspondences_that_cannot_be_used(arguments: tuple[Any, ...], sentence: str) -> None:
    with pytest.raises(InvalidInput, match=sentence):
        View(*arguments)


def test_views_without_sigmas_weigh_as_much_as_those_with_sigmas() -> None:
    sigma = np.linspace(0.1, 0.5, 12)
    stack = stack_views([View(OBJECT, IMAGE), View(OBJECT, IMAGE, sigma), View(OBJECT, IMAGE, 2 * sigma)])
    squares = stack.weights**2
    np.testing.assert_array_equal(squares[0], 1)
    assert squares[1:].mean() == pytest.approx(1)
    assert (squares[1] > squares[2]).all()


@pytest.mark.parametrize("part", [slice(None), slice(0, 30), np.arange(54) % 9 < 3, [0, 4, 9, 40]])
@pytest.mark.parametrize(
    ("order", "shift", "axes"),
    [
        ([0, 1, 2], 0.1, [[1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ([0, 2, 1], 0.0, [[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
        ([2, 0, 1], 0.0, [[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    ],
)
def test_the_axes_of_a_plane_are_those_of_the_board_whatever_part_is_seen(
    order: list[int], shift: float, axes: list[list[int]], part: Any
) -> None:
    """The mean of many times 0.1 is not 0.1; and a board that is higher than wide is not lying."""
    for points in (BOARD.points, BOARD.points[:, [1, 0, 2]]):
        seen = (points + np.array([0, 0, shift]))[part][:, order]
        plane = stack_views([View(seen, np.zeros((len(seen), 2)))]).plane[0]
        np.testing.assert_allclose(plane.T, axes, atol=1e-12)


def test_a_view_says_where_and_when_it_was_taken() -> None:
    pixels = BOARD.points[:, :2]
    assert View(BOARD.points, pixels, stamp_ns=np.int64(5)).stamp_ns == 5  # type: ignore[arg-type]
    for wrong in ({"stamp_ns": "now"}, {"stamp_ns": 1.5}, {"source": None}, {"source": 3}):
        with pytest.raises(InvalidInput, match=f"{next(iter(wrong))} must be a"):
            View(BOARD.points, pixels, **wrong)  # type: ignore[arg-type]


def test_as_many_points_as_a_dense_pattern_has_are_no_burden() -> None:
    pixels = np.random.default_rng(1).uniform(0, 1, (50_000, 2))
    upright = np.column_stack([pixels[:, 0], np.zeros(len(pixels)), pixels[:, 1]])
    plane = stack_views([View(upright, pixels)]).plane[0]
    np.testing.assert_allclose(np.abs(plane[1]), [0, 0, 1], atol=1e-12)


def test_a_plane_at_any_angle_has_axes_in_it() -> None:
    points = BOARD.points @ rotation_from_vector(np.array([0.4, -0.3, 0.9])).T
    planes = [stack_views([View(seen, np.zeros((len(seen), 2)))]).plane[0] for seen in (points, points[:20])]
    np.testing.assert_allclose(planes[0], planes[1], atol=1e-12)
    np.testing.assert_allclose((points - points[0]) @ planes[0][:, 2], 0, atol=1e-15)
    np.testing.assert_allclose(planes[0].T @ planes[0], np.eye(3), atol=1e-12)
    assert np.linalg.det(planes[0]) == pytest.approx(1)
    assert planes[0][0, 0] > 0
