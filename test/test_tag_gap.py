from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fewcal.planarity import map_points
from fewcal.tag_gap import seen_gap

SLANT = np.array([[300.0, 40.0, 320.0], [-25.0, 280.0, 240.0], [0.12, -0.08, 1.0]])


def tags(gap: float, rows: int = 3, columns: int = 4) -> np.ndarray:
    """Corners (2 R, 2 C, 2) of tags of length 1."""
    x, y = ((np.arange(count)[:, None] * (1 + gap) + [0, 1]).ravel() for count in (columns, rows))
    return np.stack(np.meshgrid(x, y), axis=-1)


def seen(board: np.ndarray) -> np.ndarray:
    return map_points(SLANT, board.reshape(-1, 2)).reshape(board.shape)


@given(gap=st.floats(0.01, 0.99))
def test_the_gap_is_that_of_the_board_whatever_the_perspective(gap: float) -> None:
    found, sd = seen_gap(seen(tags(gap)))
    assert found == pytest.approx(gap, rel=1e-6)
    assert sd < 1e-6


def test_its_sd_is_the_size_of_its_error() -> None:
    rng = np.random.default_rng(2)
    found = np.array([seen_gap(seen(tags(0.3)) + rng.normal(0, 2, (6, 8, 2))) for _ in range(300)])
    error = found[:, 0] - 0.3
    assert 0.6 < np.std(error) / found[:, 1].mean() < 1.6
    assert abs(error.mean()) < 0.5 * np.std(error)


def test_a_wrong_corner_does_no_harm() -> None:
    corners = seen(tags(0.3))
    corners[2, 3] += 40
    assert seen_gap(corners)[0] == pytest.approx(0.3, abs=1e-6)


def test_tags_that_are_not_seen_are_left_out() -> None:
    corners = seen(tags(0.3))
    corners[:, :4] = np.nan
    assert seen_gap(corners)[0] == pytest.approx(0.3)
    corners[2:, 4:6] = corners[:2, 6:] = np.nan
    corners[2:4, 6:] = np.nan
    assert np.isnan(seen_gap(corners)).all(), "no two are beside each other"
