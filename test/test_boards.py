from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fewcal.boards import Board, Chessboard, parse_board
from fewcal.errors import FewcalError, InvalidInput

SIZES = st.floats(1e-6, 1e3, exclude_min=True)
COUNTS = st.integers(3, 9999)


def test_points_are_metres_row_by_row() -> None:
    points = Chessboard(columns=4, rows=3, square_size=0.5).points
    assert points.shape == (12, 3)
    np.testing.assert_array_equal(points[:5], [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1.5, 0, 0], [0, 0.5, 0]])
    np.testing.assert_array_equal(points[-1], [1.5, 1.0, 0])


@given(COUNTS, COUNTS, SIZES)
def test_the_text_form_is_read_back(columns: int, rows: int, square_size: float) -> None:
    board = Chessboard(columns, rows, square_size)
    assert parse_board(str(board)) == board


def test_the_text_form_of_the_design() -> None:
    assert parse_board("chessboard:9x6:0.025") == Chessboard(columns=9, rows=6, square_size=0.025)
    assert str(Chessboard(9, 6, 0.025)) == "chessboard:9x6:0.025"
    assert parse_board("  chessboard:9X6:2.5e-2\n") == Chessboard(9, 6, 0.025)


def test_a_chessboard_is_a_board() -> None:
    assert isinstance(Chessboard(9, 6, 0.025), Board)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "chessboard",
        "9x6:0.025",
        "chessboard:9x6",
        "chessboard:9x6:",
        "chessboard:9by6:0.025",
        "chessboard:9x6:25mm",
        "chessboard:9x6:0.025:0.03",
        "chessboard:9.5x6:0.025",
        "chessboard:-9x6:0.025",
        "circles:9x6:0.025",
    ],
)
def test_text_that_is_no_board_is_answered_with_the_form(text: str) -> None:
    with pytest.raises(InvalidInput, match=r"chessboard:9x6:0\.025"):
        parse_board(text)


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


@given(st.text() | st.from_regex(r"chessboard:\d*x\d*:[\d.e+-]*"))
def test_any_text_is_a_board_or_a_named_error(text: str) -> None:
    try:
        board = parse_board(text)
    except FewcalError:
        return
    assert parse_board(str(board)) == board
