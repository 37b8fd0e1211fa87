from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import SIZE, views_at
from scenes import noisy as with_noise

import fewcal
from fewcal.copies import SAME_PLACE, SHARED, copies, repetition, share_weight
from fewcal.views import View, stack_views
from fewcal.virtual_camera import PAPER_CAMERA, paper_trial

TILTS = ((40, 30), (35, 120), (30, -60))
DIAGONAL = float(np.hypot(*SIZE))


def noisy(sigma: float | None = None) -> list[View]:
    """Three different views."""
    rng = np.random.default_rng(1)
    return [
        View(view.object_points, view.image_points + rng.normal(0, 0.2, view.image_points.shape), sigma)
        for view in views_at(*TILTS)
    ]


def total(views: list[View]) -> NDArray[np.float64]:
    """Weight of each view, 1 for one by itself, but for what all views have in common."""
    count = copies(views, SIZE).times
    weights = share_weight(stack_views(views), count).weights
    return np.asarray((weights**2).mean(axis=1)) * repetition((1 / count).sum())


def test_many_views_count_for_so_many_at_most() -> None:
    stack = stack_views(noisy())
    for views in (1, 2, 30, 1000):
        many = stack._replace(weights=np.ones((views, 54)))
        weight = (share_weight(many, np.ones(views)).weights ** 2).sum() / 54
        assert weight == pytest.approx(views / (1 + SHARED * (views - 1)))
        assert weight < 1 / SHARED


@given(st.lists(st.integers(0, 2), min_size=1, max_size=8), st.sampled_from([None, 0.1]))
def test_copies_have_the_weight_of_one_view(which: list[int], sigma: float | None) -> None:
    views = noisy(sigma)
    weights = total([views[i] for i in which])
    for i in set(which):
        assert weights[np.array(which) == i].sum() == pytest.approx(1, abs=0.02)


def test_the_nearer_two_views_are_the_less_the_second_counts() -> None:
    first, *_ = noisy()
    together = []
    for shift in (0, 0.5, 1, 2, 5):
        step = np.array([shift * SAME_PLACE * DIAGONAL, 0])
        moved = View(first.object_points, first.image_points + step)
        together.append(total([first, moved]).sum())
    assert together[0] == pytest.approx(1)
    assert np.all(np.diff(together) > 0)
    assert together[2] == pytest.approx(2 / (1 + np.exp(-0.5)))
    assert together[-1] == pytest.approx(2, abs=1e-5)


def test_views_of_different_parts_are_no_copies() -> None:
    first, *_ = noisy()
    halves = [
        View(first.object_points[part], first.image_points[part]) for part in np.split(np.arange(54), 2)
    ]
    np.testing.assert_allclose(total(halves), 1)


def test_a_corner_in_common_makes_no_copy() -> None:
    first, second, _ = noisy()
    # Other boards are counted from (0, 0, 0), too, which may be seen at the same place.
    shift = first.image_points[0] - second.image_points[0]
    other = View(0.7 * second.object_points, second.image_points + shift)
    np.testing.assert_array_equal(copies([first, other], SIZE).times, 1)


@pytest.mark.parametrize(("common", "times"), [(3, 1), (4, 2), (5, 2)])
def test_views_are_compared_by_four_points_or_more(common: int, times: int) -> None:
    first, *_ = noisy()
    parts = np.arange(20), np.arange(20 - common, 40)
    views = [View(first.object_points[part], first.image_points[part]) for part in parts]
    np.testing.assert_allclose(copies(views, SIZE).times, times)


def test_views_are_compared_by_the_points_that_they_share() -> None:
    first, second, _ = noisy()
    part = View(first.object_points[20:], first.image_points[20:])
    other = View(first.object_points + np.array([9, 0, 0]), first.image_points)
    # The second view joins the other two, which have no point in common.
    start = View(first.object_points[:20], first.image_points[:20])
    np.testing.assert_allclose(copies([start, part, second], SIZE).times, 1)
    np.testing.assert_allclose(copies([part, other, first, first], SIZE).times, [3, 1, 3, 3])
    np.testing.assert_allclose(
        copies([other, first, View(other.object_points, second.image_points)], SIZE).times, 1
    )


@pytest.mark.parametrize("times", [2, 5])
def test_copies_leave_camera_and_error_bars_as_they_are(times: int) -> None:
    once = fewcal.calibrate(noisy(), SIZE)
    often = fewcal.calibrate(noisy() * times, SIZE)
    np.testing.assert_allclose(often.camera.intrinsics, once.camera.intrinsics, rtol=1e-6)
    assert often.std == pytest.approx(once.std, rel=1e-4)
    assert often.sigma_px == pytest.approx(once.sigma_px, rel=1e-5)
    np.testing.assert_allclose(often.view_rms[:3], once.view_rms, rtol=1e-4)


@pytest.mark.parametrize("seed", [0, 19, 20])
def test_copies_do_not_hide_how_the_boards_are_tilted(seed: int) -> None:
    """Small boards far away, which noise lets appear tilted to either side, each by its own pose of two."""
    rng = np.random.default_rng(seed)
    tilts = [(rng.uniform(5, 50), rng.uniform(0, 360)) for _ in range(2)]
    views = with_noise(views_at(*tilts, span=0.2), 1.0, seed)
    once = fewcal.calibrate(views, SIZE)
    uneven = [views[:1] * 2 + views[1:], views[:1] * 3 + views[1:]] if seed == 0 else []
    for repeated in (views * 2, *uneven):
        often = fewcal.calibrate(repeated, SIZE)
        np.testing.assert_allclose(often.camera.intrinsics, once.camera.intrinsics, rtol=1e-6)
        assert often.focal_std == pytest.approx(once.focal_std, rel=1e-4)


def test_an_original_is_a_view_of_the_same_points() -> None:
    first, second, _ = noisy()
    near = View(first.object_points, first.image_points + SAME_PLACE * DIAGONAL / 4)
    nearer = View(first.object_points, first.image_points + SAME_PLACE * DIAGONAL / 2)
    part = View(first.object_points[6:], first.image_points[6:])
    found = copies([second, first, near, part, nearer, part, second], SIZE)
    np.testing.assert_array_equal(found.original, [0, 1, 1, 3, 1, 3, 0])


def test_an_original_is_the_first_that_is_near_and_repeats_none_itself() -> None:
    first, *_ = noisy()

    def moved(*shifts: float) -> list[View]:
        step = SAME_PLACE * DIAGONAL * np.array([1, 0])
        return [View(first.object_points, first.image_points + shift * step) for shift in shifts]

    np.testing.assert_array_equal(copies(moved(0, 0.9, 1.8, 3.2), SIZE).original, [0, 0, 0, 3])
    np.testing.assert_array_equal(copies(moved(0, 1.6, 0.8), SIZE).original, [0, 1, 0])


def test_views_are_compared_though_only_others_show_that_they_are_of_one_board() -> None:
    first, *_ = noisy()
    left, middle, right = np.split(np.arange(54), 3)
    parts = left, right, np.append(middle, right), np.append(left, middle)
    views = [View(first.object_points[part], first.image_points[part]) for part in parts]
    np.testing.assert_allclose(copies(views, SIZE).times, [2, 2, 3, 3])


def test_computed_views_are_no_copies_however_alike_they_are() -> None:
    trial = paper_trial(20, 1.2, views=2)
    shift = np.linalg.norm(trial.views[0].image_points - trial.views[1].image_points, axis=1).max()
    assert shift < SAME_PLACE * np.hypot(*PAPER_CAMERA.image_size)
    found = fewcal.calibrate(trial.views, PAPER_CAMERA.image_size)
    assert found.camera.fx == pytest.approx(PAPER_CAMERA.fx, rel=1e-6)
