from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fewcal.boards import AsymmetricCircleGrid, Board, CircleGrid, parse_board, pose_ambiguity
from fewcal.errors import InvalidInput


@pytest.mark.parametrize(
    ("text", "board"),
    [
        ("circles:10x7:0.02", CircleGrid(10, 7, 0.02)),
        ("acircles:4x11:0.035", AsymmetricCircleGrid(4, 11, 0.035)),
    ],
)
def test_the_text_form_is_read_and_given_back(text: str, board: Board) -> None:
    assert parse_board(text) == board
    assert str(board) == text
    assert isinstance(board, Board)


@pytest.mark.parametrize(
    "text", ["circles:10x7", "acircles:4x11:", "circles:10x7:wide", "circles:2x7:0.02", "acircles:4x11:-1"]
)
def test_what_is_no_grid_is_refused(text: str) -> None:
    with pytest.raises(InvalidInput):
        parse_board(text)


@pytest.mark.parametrize("kind", [CircleGrid, AsymmetricCircleGrid])
@pytest.mark.parametrize("fields", [(2, 7, 0.02), (4.0, 7, 0.02), (4, True, 0.02), (4, 7, 0), (4, 7, "wide")])
def test_fields_are_checked(kind: Any, fields: Any) -> None:
    with pytest.raises(InvalidInput):
        kind(*fields)


def test_points_of_a_symmetric_grid_go_row_by_row() -> None:
    points = CircleGrid(10, 7, 0.02).points
    np.testing.assert_allclose(points[[0, 1, 10]], [[0, 0, 0], [0.02, 0, 0], [0, 0.02, 0]])
    assert points.shape == (70, 3)


def test_points_of_an_asymmetric_grid_are_those_of_opencv() -> None:
    expected = [[(2 * j + i % 2) * 0.02, i * 0.02, 0] for i in range(11) for j in range(4)]
    np.testing.assert_allclose(AsymmetricCircleGrid(4, 11, 0.02).points, expected)


@pytest.mark.parametrize("board", [CircleGrid(10, 7, 0.02), AsymmetricCircleGrid(4, 11, 0.02)], ids=str)
def test_circles_are_drawn_where_the_points_are(board: CircleGrid | AsymmetricCircleGrid) -> None:
    drawing = board.draw()
    np.testing.assert_array_equal(drawing.discs[:, :2], board.points[:, :2])
    left, top, right, bottom = drawing.extent
    assert (left, top) == (-0.02, -0.02)
    np.testing.assert_allclose(
        [right, bottom], board.points[-1, :2].max() * 0 + board.points.max(axis=0)[:2] + 0.02
    )


@pytest.mark.parametrize(
    ("text", "turns"),
    [
        ("circles:10x7:0.02", 2),
        ("circles:7x7:0.02", 4),
        ("acircles:4x11:0.02", 1),
        ("acircles:4x10:0.02", 2),
        ("acircles:5x10:0.02", 2),
        ("chessboard:9x6:0.025", 1),
        ("chessboard:9x7:0.025", 2),
        ("chessboard:8x6:0.025", 2),
        ("chessboard:7x7:0.025", 2),
        ("chessboard:6x6:0.025", 4),
    ],
)
def test_a_board_knows_how_often_it_looks_the_same(text: str, turns: int) -> None:
    board = parse_board(text)
    assert board.turns == turns
    assert looks_alike(board, 2) == (turns % 2 == 0)
    assert looks_alike(board, 1) == (turns == 4)
    assert (pose_ambiguity(board) == "") == (turns == 1)


def looks_alike(board: Board, quarters: int) -> bool:
    """Whether the drawing looks the same after so many quarter turns about its middle."""
    drawing = board.draw()
    left, top, right, bottom = drawing.extent
    if quarters % 2 and not np.isclose(right - left, bottom - top):
        return False
    x, y = np.linspace(left, right, 301), np.linspace(top, bottom, 301)
    picture = drawing.coverage(x, y)
    return bool(np.abs(np.rot90(picture, quarters) - picture).max() < 0.5)
