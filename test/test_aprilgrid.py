from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marker_pictures import needs_markers

from fewcal.aprilgrid import FAMILIES, AprilGrid
from fewcal.boards import Board, parse_board
from fewcal.errors import InvalidInput

KALIBR_TAG_0 = 0xD5D628584
"""Code of tag 0 of the family 36h11 in the AprilTag library; Kalibr prints a one as white."""


@given(
    st.integers(1, 5),
    st.integers(2, 6),
    st.floats(1e-3, 1.0),
    st.floats(0.05, 0.95),
    st.sampled_from(sorted(FAMILIES)),
    st.booleans(),
)
def test_the_text_form_is_read_back(
    columns: int, rows: int, tag: float, gap: float, family: str, from_top: bool
) -> None:
    board = AprilGrid(columns, rows, tag, gap, family, from_top)
    assert parse_board(str(board)) == board


def test_the_text_form_of_the_design() -> None:
    board = parse_board("aprilgrid:6x6:0.088:0.3:tag36h11")
    assert board == AprilGrid(6, 6, 0.088, 0.3, "tag36h11")
    assert str(board) == "aprilgrid:6x6:0.088:0.3:tag36h11"
    assert isinstance(board, Board)
    assert parse_board("aprilgrid:6X6:0.088:0.3:TAG36H11") == board
    assert parse_board("aprilgrid:6x6:0.088:0.3:tag36h11:top") == replace(board, from_top=True)


def test_tags_may_be_counted_from_the_top() -> None:
    upwards = AprilGrid(2, 3, 0.1, 0.3, "tag36h11")
    downwards = replace(upwards, from_top=True)
    np.testing.assert_array_equal(downwards.points, upwards.points)
    np.testing.assert_array_equal(downwards.tag_corners, upwards.tag_corners[[4, 5, 2, 3, 0, 1]])


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("aprilgrid:6x6:0.088", "is not a board; write aprilgrid:COLUMNSxROWS:TAG:GAP:FAMILY"),
        ("aprilgrid:6x6:wide:0.3:tag36h11", "'wide' .* is not a length in metres"),
        ("aprilgrid:6x6:0.088:wide:tag36h11", "'wide' .* is not a share of the tag"),
        ("aprilgrid:1x1:0.088:0.3:tag36h11", "needs two tags or more, not 1x1"),
        ("aprilgrid:6x6:0:0.3:tag36h11", "The tag size must be a positive length"),
        ("aprilgrid:6x6:0.088:1.0:tag36h11", "must be a share of the tag between 0 and 1, not 1.0"),
        ("aprilgrid:6x6:0.088:nan:tag36h11", "must be a share of the tag between 0 and 1, not nan"),
        ("aprilgrid:6x6:0.088:0.3:tag36h12", "no family 'tag36h12'; there are tag16h5, .*tag36h11"),
        ("aprilgrid:6x6:0.088:0.3:tag16h5", "tag16h5 has 30 tags, the board needs 36"),
    ],
)
def test_what_is_no_board_is_said_in_a_sentence(text: str, sentence: str) -> None:
    with pytest.raises(InvalidInput, match=sentence):
        parse_board(text)


def test_a_family_that_is_no_text_is_refused() -> None:
    with pytest.raises(InvalidInput, match="There is no family"):
        AprilGrid(6, 6, 0.088, 0.3, ["tag36h11"])  # type: ignore[arg-type]


def test_points_are_in_the_order_of_kalibr() -> None:
    """As in the drawing of Kalibr's GridCalibrationTargetAprilgrid, with y down instead of up."""
    points = AprilGrid(2, 2, 1.0, 0.5, "tag36h11").points
    assert points.shape == (16, 3)
    np.testing.assert_array_equal(points[:4], [[0, 0, 0], [1, 0, 0], [1.5, 0, 0], [2.5, 0, 0]])
    np.testing.assert_array_equal(points[4:8, 1], [-1.0] * 4)
    np.testing.assert_array_equal(points[8:12, 1], [-1.5] * 4)
    np.testing.assert_array_equal(points[15], [2.5, -2.5, 0])


def test_corners_of_the_tags_are_points_of_the_board() -> None:
    board = AprilGrid(3, 2, 0.1, 0.3, "tag25h9")
    grid = board.points[:, :2].reshape(4, 6, 2)
    for tag, corners in enumerate(board.tag_corners):
        row, column = divmod(tag, 3)
        lower, upper = grid[2 * row, 2 * column :][:2], grid[2 * row + 1, 2 * column :][:2]
        np.testing.assert_allclose(corners, [upper[0], upper[1], lower[1], lower[0]], atol=1e-15)


@needs_markers
def test_the_board_is_drawn_as_kalibr_does() -> None:
    board = AprilGrid(2, 2, 0.1, 0.3, "tag36h11")
    drawing = board.draw()
    # Ten samples a tag: two bits of border, six of code, two of border; three across a space.
    x, y = 0.005 + 0.01 * np.arange(-3, 26), -0.005 - 0.01 * np.arange(-3, 26)[::-1]
    black = drawing.is_black(np.stack(np.meshgrid(x, y), axis=-1))
    assert black.shape == (29, 29)
    tag = black[-13:-3, 3:13]  # the lower left one
    code = int("".join("01"[white] for white in (~tag[2:-2, 2:-2]).ravel().astype(int)), 2)
    assert code == KALIBR_TAG_0
    border = tag.copy()
    border[2:-2, 2:-2] = True
    assert border.all()
    for row in (slice(0, 3), slice(13, 16), slice(26, 29)):
        for column in (slice(0, 3), slice(13, 16), slice(26, 29)):
            assert black[row, column].all()
    assert not black[13:16, 3:13].any()
    assert not black[3:13, 13:16].any()
    left, top, right, bottom = drawing.extent
    assert left < -0.03
    assert top < -0.26
    assert right > 0.26
    assert bottom > 0.03
