from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fewcal.boards import Board, Chessboard, parse_board
from fewcal.errors import FewcalError, InvalidInput


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
        "chessboard:9999x9999:0.025",
        "hexagons:9x6:0.025",
    ],
)
def test_text_that_is_no_board_is_answered_with_the_form(text: str) -> None:
    with pytest.raises(InvalidInput, match=r"chessboard:9x6:0\.025"):
        parse_board(text)


@given(st.text() | st.from_regex(r"chessboard:\d*x\d*:[\d.e+-]*"))
def test_any_text_is_a_board_or_a_named_error(text: str) -> None:
    try:
        board = parse_board(text)
    except FewcalError:
        return
    assert parse_board(str(board)) == board
