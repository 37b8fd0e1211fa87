from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fewcal.boards import Board, parse_board
from fewcal.charuco import Charuco
from fewcal.errors import InvalidInput

DICTIONARY = "DICT_5X5_100"


@given(
    st.integers(4, 12),
    st.integers(3, 12),
    st.floats(1e-3, 1.0),
    st.floats(0.3, 0.9),
    st.sampled_from(["DICT_5X5_100", "DICT_4X4_250", "DICT_APRILTAG_36h11"]),
    st.booleans(),
)
def test_the_text_form_is_read_back(
    columns: int, rows: int, square: float, share: float, dictionary: str, legacy: bool
) -> None:
    board = Charuco(columns, rows, square, share * square, dictionary, legacy)
    assert parse_board(str(board)) == board


def test_the_text_form_of_the_design() -> None:
    board = parse_board("charuco:7x5:0.04:0.03:DICT_5X5_100")
    assert board == Charuco(7, 5, 0.04, 0.03, "DICT_5X5_100")
    assert str(board) == "charuco:7x5:0.04:0.03:DICT_5X5_100"
    assert isinstance(board, Board)
    assert parse_board("charuco:7x6:0.04:0.03:dict_apriltag_36H11:legacy") == Charuco(
        7, 6, 0.04, 0.03, "DICT_APRILTAG_36h11", legacy=True
    )


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("charuco:7x5:0.04", "is not a board; write charuco:COLUMNSxROWS:SQUARE:MARKER:DICTIONARY"),
        ("charuco:7x5:0.04:wide:DICT_5X5_100", "'wide' .* is not a length in metres; write charuco"),
        ("charuco:7x5:0.04:0.03:DICT_5X5_100:old", "is not a board"),
        ("charuco:7x5:0.04:0.03:DICT_8X8_100", r"no dictionary 'DICT_8X8_100'; there are DICT_4X4_50, .*\."),
        ("charuco:30x30:0.04:0.03:DICT_5X5_100", "DICT_5X5_100 has 100 markers, the board needs 450"),
        ("charuco:3x3:0.04:0.03:DICT_5X5_100", "at least 4x3 squares, not 3x3"),
        ("charuco:7x2:0.04:0.03:DICT_5X5_100", "at least 4x3 squares, not 7x2"),
        ("charuco:7x5:0.03:0.04:DICT_5X5_100", "A marker of 0.04 m does not fit into a square of 0.03 m"),
        ("charuco:7x5:0:0.03:DICT_5X5_100", "The square size must be a positive length"),
        ("charuco:7x5:0.04:nan:DICT_5X5_100", "The marker size must be a positive length"),
    ],
)
def test_what_is_no_board_is_said_in_a_sentence(text: str, sentence: str) -> None:
    with pytest.raises(InvalidInput, match=sentence):
        parse_board(text)


@pytest.mark.skipif(not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"), reason="OpenCV before 4.7")
@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("size", [(7, 5), (8, 6), (5, 6), (4, 3)])
def test_the_board_is_that_of_opencv(size: tuple[int, int], legacy: bool) -> None:
    board = Charuco(*size, 0.04, 0.03, DICTIONARY, legacy)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, DICTIONARY))
    theirs = cv2.aruco.CharucoBoard(size, 0.04, 0.03, dictionary)
    theirs.setLegacyPattern(legacy)
    np.testing.assert_allclose(board.points, theirs.getChessboardCorners(), atol=1e-7)
    markers = np.array(theirs.getObjPoints())
    np.testing.assert_allclose(board.marker_corners, markers[..., :2], atol=1e-7)
    assert board.marker_count == len(markers)
    # 112 pixels to a square make 12 to a bit of a marker.
    picture = theirs.generateImage((112 * size[0], 112 * size[1]))
    x, y = (np.arange(112 * count + 1) / 112 * 0.04 for count in size)
    np.testing.assert_allclose(board.draw().coverage(x, y), picture == 0, atol=1e-6)
