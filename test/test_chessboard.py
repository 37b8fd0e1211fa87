from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fewcal.boards import parse_board
from fewcal.chessboard import Chessboard
from fewcal.errors import InvalidInput

SIZES = st.floats(1e-6, 10.0)
COUNTS = st.integers(3, 999)


def test_points_are_metres_row_by_row() -> None:
    points = Chessboard(columns=4, rows=3, square_size=0.5).points
    assert points.shape == (12, 3)
    np.testing.assert_array_equal(points[:5], [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1.5, 0, 0], [0, 0.5, 0]])
    np.testing.assert_array_equal(points[-1], [1.5, 1.0, 0])


@given(COUNTS, COUNTS, SIZES)
def test_the_text_form_is_read_back(columns: int, rows: int, square_size: float) -> None:
    board = Chessboard(columns, rows, square_size)
    assert parse_board(str(board)) == board


@pytest.mark.parametrize("size", ["0", "-0.025", "nan", "inf", "1e999"])
def test_sizes_that_are_no_length(size: str) -> None:
    with pytest.raises(InvalidInput, match="positive length in metres"):
        parse_board(f"chessboard:9x6:{size}")


@pytest.mark.parametrize("columns", [2, 0, -3, 4.0, "9", True, None])
def test_counts_that_are_no_chessboard(columns: object) -> None:
    with pytest.raises(InvalidInput, match=r"at least 3 .* but columns is"):
        Chessboard(columns, 6, 0.025)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match=r"at least 3 .* but rows is"):
        Chessboard(9, columns, 0.025)  # type: ignore[arg-type]


def test_the_drawing_has_four_squares_about_every_corner() -> None:
    board = Chessboard(4, 3, 0.03)
    drawing = board.draw()
    quarter = 0.25 * board.square_size * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    around = drawing.is_black(board.points[:, None, :2] + quarter)
    first_black = np.indices((3, 4)).sum(axis=0).ravel() % 2 == 0
    np.testing.assert_array_equal(around[first_black], [[True, False, True, False]] * 6)
    np.testing.assert_array_equal(around[~first_black], [[False, True, False, True]] * 6)
    np.testing.assert_allclose(drawing.ink, [-0.03, -0.03, 0.12, 0.09])
    np.testing.assert_allclose(drawing.size, [5.5 * 0.03, 4.5 * 0.03])
    assert drawing.caption == "square 30 mm"
