from __future__ import annotations

import numpy as np
import pytest

from fewcal.reduction import COARSEST_PX, densest_window, reduce, reductions


@pytest.mark.parametrize(
    ("shape", "factors"),
    [
        ((1080, 1920), [4, 2, 1]),
        ((480, 640), [2, 1]),
        ((1, 1), [1]),
        ((20, 20000), [8, 4, 2, 1]),
    ],
)
def test_copies_go_from_coarse_to_fine(shape: tuple[int, int], factors: list[int]) -> None:
    assert reductions(np.zeros(shape, np.uint8)) == factors
    assert max(shape) / factors[0] >= COARSEST_PX or factors == [1]
    assert reductions(np.zeros((1080, 1920), np.uint8), 75) == [16, 8, 4, 2, 1]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_copy_is_the_mean_over_blocks(dtype: type) -> None:
    grey = np.random.default_rng(0).integers(0, 250, (9, 14)).astype(dtype)
    copy = reduce(grey, 4)
    assert copy.dtype == dtype
    np.testing.assert_allclose(
        copy, grey[:8, :12].reshape(2, 4, 3, 4).mean(axis=(1, 3)), atol=1.0
    )  # rounded twice
    assert reduce(grey, 1) is grey


@pytest.mark.parametrize("place", [(700, 400), (20, 400), (1270, 940)])
def test_the_window_lies_about_the_densest_points(place: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    away = rng.uniform((0, 0), (1279, 959), (500, 2))
    board = np.clip(rng.uniform(-80, 80, (200, 2)) + place, 0, (1279, 959))
    points = np.concatenate([away, board])
    rows, columns = densest_window(points, np.ones(len(points)), (960, 1280), 400)
    assert (rows.stop - rows.start, columns.stop - columns.start) == (400, 400)
    first, last = np.array([columns.start, rows.start]), np.array([columns.stop, rows.stop])
    assert np.all((board >= first) & (board < last))
    assert first.min() >= 0
    assert columns.stop <= 1280
    assert rows.stop <= 960


def test_strong_points_count_more_and_none_at_all_give_a_window() -> None:
    points = np.array([[100.0, 100.0]] * 3 + [[900.0, 100.0]])
    _, columns = densest_window(points, np.array([1.0, 1, 1, 9]), (200, 1000), 300)
    assert columns == slice(700, 1000)
    rows, columns = densest_window(np.empty((0, 2)), np.empty(0), (20, 20000), 500)
    assert len(range(*rows.indices(20))) == 20
    assert columns == slice(0, 500)
