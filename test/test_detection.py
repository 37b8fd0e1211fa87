from __future__ import annotations

import numpy as np
import pytest
from board_pictures import BOARD, picture, pose

from fewcal.detection import blurred, detect, detect_board, edge_width, outside
from fewcal.errors import InvalidInput


def test_detection_asks_the_board() -> None:
    image, _ = picture(pose(BOARD, 30, 20, 40, 15))
    detection = detect_board(image, BOARD, "camera", 7)
    assert (detection.view.source, detection.view.stamp_ns) == ("camera", 7)
    np.testing.assert_array_equal(detection.view.image_points, BOARD.detect(image).view.image_points)
    np.testing.assert_array_equal(detection.view.image_points, detect(image, BOARD).image_points)
    assert detection.sharpness == 1 / detection.edge_width_px


def test_edges_are_as_wide_as_in_the_worse_direction() -> None:
    assert edge_width(np.array([[[1.0, 2.0], [1.2, 2.0]], [[1.1, 9.0], [1.1, 2.0]]])) == 2.563 * 2.0
    error = blurred(6.0, 10.0)
    assert error.reason == "blurred"
    assert "6.0 px wide and the squares 10.0 px" in str(error)


def test_points_too_close_to_the_border_are_outside() -> None:
    points = np.array([[2.0, 2.0], [7.0, 5.0]])
    assert not outside((8, 10), points, 2.0)
    assert outside((8, 10), points, 2.5)
    assert outside((8, 10), np.array([[-0.1, 3.0]]), 0.0)


def test_a_text_is_not_yet_a_board() -> None:
    with pytest.raises(
        InvalidInput, match=r"board must be a fewcal board, such as fewcal\.parse_board gives"
    ):
        detect(np.zeros((480, 640), np.uint8), "chessboard:9x6:0.025")  # type: ignore[arg-type]
