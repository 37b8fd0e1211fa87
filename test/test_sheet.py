from __future__ import annotations

import numpy as np
import pytest

from fewcal.boards import parse_board
from fewcal.errors import InvalidInput
from fewcal.sheet import FOOTER_MM, PAPERS_MM, UNPRINTABLE_MM, lay_out

BOARD = parse_board("chessboard:9x6:0.025")
TALL = parse_board("chessboard:6x9:0.025")


def ink_mm(sheet):
    return 1e3 * np.array(sheet.drawing.ink)


@pytest.mark.parametrize("board", [BOARD, TALL])
@pytest.mark.parametrize("paper", ["A4", "a3", "Letter", "A0", "300x250", "202x277"])
def test_all_that_is_black_can_be_printed(board, paper):
    sheet = lay_out(board, paper)
    left, top, right, bottom = ink_mm(sheet)
    half_a_line = 0.101
    assert min(left, top) >= UNPRINTABLE_MM - half_a_line
    assert right <= sheet.width - UNPRINTABLE_MM + half_a_line
    assert bottom <= sheet.height - UNPRINTABLE_MM
    assert all(text.y < sheet.height - UNPRINTABLE_MM for text in sheet.texts)
    assert sheet.drawing.extent == pytest.approx((0, 0, 1e-3 * sheet.width, 1e-3 * sheet.height))


def test_paper_is_turned_only_where_the_board_does_not_fit_upright():
    sheet = lay_out(BOARD, "A4")
    assert (sheet.width, sheet.height) == (297, 210)
    sheet = lay_out(TALL, "A4")
    assert (sheet.width, sheet.height) == (210, 297)
    sheet = lay_out(BOARD, "A2")
    assert (sheet.width, sheet.height) == PAPERS_MM["A2"]


def test_margin_and_footer_do_not_meet():
    for paper in ("A4", "202x277", "A1"):
        sheet = lay_out(BOARD, paper)
        board = np.concatenate(BOARD.draw().polygons)
        squares = np.concatenate(sheet.drawing.polygons[: len(BOARD.draw().polygons)])
        offset = 1e3 * (squares - board)
        np.testing.assert_allclose(offset, np.broadcast_to(offset[0], offset.shape), atol=1e-9)
        left, top, right, bottom = 1e3 * np.array(BOARD.draw().extent) + np.tile(offset[0], 2)
        assert left >= 0
        assert top >= 0
        assert right <= sheet.width
        assert bottom <= sheet.height - FOOTER_MM + 1e-9
        ruler = 1e3 * np.concatenate(sheet.drawing.polygons[len(BOARD.draw().polygons) :])
        assert ruler[:, 1].min() >= bottom


@pytest.mark.parametrize(("paper", "length"), [("A4", 100), ("A5", 100), ("75x75", 50), ("60x67", 20)])
def test_the_ruler_is_as_long_as_it_says(paper, length):
    sheet = lay_out(parse_board("chessboard:3x3:0.01"), paper)
    count = len(parse_board("chessboard:3x3:0.01").draw().polygons)
    ruler = sheet.drawing.polygons[count:]
    ticks = np.array([tick[:, 0].mean() for tick in ruler[:-1]])
    np.testing.assert_allclose(1e3 * np.diff(ticks), 10, atol=1e-9)
    assert 1e3 * (ticks[-1] - ticks[0]) == pytest.approx(length)
    assert any(text.content.startswith(f"{length} mm") for text in sheet.texts)


def test_form_and_lengths_are_printed():
    texts = [text.content for text in lay_out(BOARD, "A4").texts]
    assert texts[0].startswith("chessboard:9x6:0.025   square 25 mm   print at 100 %")


@pytest.mark.parametrize(
    ("form", "paper", "says"),
    [
        ("chessboard:9x6:0.025", "A5", "; it fits on A4."),
        ("chessboard:9x6:0.025", "200x270", "more than a sheet (200 x 270 mm) has; it fits on A4."),
        ("chessboard:9x6:0.03", "A4", "; it fits on A3."),
        ("chessboard:20x20:0.1", "A3", "not even A0 is enough, give a size such as 2150x2164"),
        ("chessboard:9x6:0.00025", "A4", "is 2.5 mm large, which no printer draws well"),
        ("chessboard:9x6:0.025", "A6", "There is no paper 'A6'; choose from A5, A4, letter"),
        ("chessboard:9x6:0.025", "0x100", "There is no paper of 0 x 100 mm"),
        ("chessboard:9x6:0.025", "9000x100", "up to 5000 mm"),
        ("chessboard:9x6:0.025", "-3x100", "There is no paper"),
    ],
)
def test_paper_that_does_not_do(form, paper, says):
    with pytest.raises(InvalidInput) as caught:
        lay_out(parse_board(form), paper)
    assert says in str(caught.value)
    assert str(caught.value).endswith(".")


def test_the_size_that_is_advised_is_enough():
    board = parse_board("chessboard:20x20:0.1")
    sheet = lay_out(board, "2150x2164")
    assert sheet.width == 2150
    with pytest.raises(InvalidInput):
        lay_out(board, "2150x2163")
