from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from board_pictures import SIZE
from marker_pictures import CHARUCO, errors, indices, marker_picture, needs_markers

from fewcal.corner_refinement import Squares
from fewcal.detection import Detection
from fewcal.errors import BoardNotFound
from fewcal.marker_boards import CornerGrid, locate_board
from fewcal.rendering import Conditions

pytestmark = needs_markers
GRID = CornerGrid(CHARUCO.points[:, :2].reshape(4, 6, 2), 0.04, Squares(0.125, 0.125 + 0.75 / 7), 0.084)
PLANE = CHARUCO.marker_corners


def located(image: Any, true: Any, markers: Any = np.s_[:]) -> Detection:
    """The board, given some markers with corners to about a pixel."""
    corners = np.array([homography(true, marker) for marker in PLANE])
    rough = np.rint(corners + np.random.default_rng(0).uniform(-0.5, 0.5, corners.shape))
    known = rough[markers]
    return locate_board(image, GRID, PLANE[markers], known)


def homography(true: Any, marker: Any) -> Any:
    """Where a marker is, from four corners of the board far apart."""
    corners = [0, 5, 18, 23]
    x, y = CHARUCO.points[corners, :2].T
    u, v = true[corners].T
    one, no = np.ones(4), np.zeros(4)
    rows = np.concatenate(
        [
            np.stack([x, y, one, no, no, no, -u * x, -u * y], axis=1),
            np.stack([no, no, no, x, y, one, -v * x, -v * y], axis=1),
        ]
    )
    H = np.append(np.linalg.solve(rows, np.concatenate([u, v])), 1.0).reshape(3, 3)
    mapped = np.column_stack([marker, np.ones(4)]) @ H.T
    return mapped[:, :2] / mapped[:, 2:]


@pytest.mark.parametrize("markers", [np.s_[:], np.s_[::2], np.s_[7:10]], ids=str)
def test_a_few_markers_tell_where_all_corners_are(markers: Any) -> None:
    image, true = marker_picture(CHARUCO, 48, 30, 40, 20)
    found = located(image, true, markers)
    assert len(found.view) == 24
    assert np.abs(errors(CHARUCO, found, true)).max() < 0.05


def test_no_square_is_no_board() -> None:
    image, true = marker_picture(CHARUCO, 48, 30, 40, 20)
    with pytest.raises(BoardNotFound, match="no two of them lie as on the board") as caught:
        located(image, true, np.s_[:0])
    assert caught.value.reason == "no board"


def test_what_the_blur_leaves_out_of_a_window_does_not_bias_it() -> None:
    z = []
    for about in range(0, 360, 120):
        image, true = marker_picture(CHARUCO, 24, 20, about, 10, conditions=Conditions(blur_px=1.8))
        found = located(image, true)
        assert found.view.sigma is not None
        z.append(errors(CHARUCO, found, true) / found.view.sigma[:, None])
    assert 0.7 < np.sqrt(np.mean(np.concatenate(z) ** 2)) < 1.4


def test_corners_that_are_covered_are_left_out() -> None:
    image, true = marker_picture(CHARUCO, 48, 10, 40)
    covered = image.copy()
    left = int(true[:, 0].min()) + 80
    covered[:, left:] = 120
    found = located(covered, true)
    assert (true[indices(CHARUCO, found), 0] < left).all()
    assert len(found.view) == 8
    covered[:, left - 50 :] = 120
    with pytest.raises(BoardNotFound, match="Only 4 of the 24 corners are to be seen, 6 are needed"):
        located(covered, true)
    one_row = image.copy()
    one_row[int(true[:6, 1].max()) + 24 :] = 120
    with pytest.raises(BoardNotFound, match="The 6 corners that are seen lie in one line") as caught:
        located(one_row, true)
    assert caught.value.reason == "cut off"


def test_blurred_squares_are_refused() -> None:
    image, true = marker_picture(CHARUCO, 24, 10, 40, conditions=Conditions(blur_px=3.0))
    with pytest.raises(BoardNotFound, match=r"edges of the squares are .* px wide"):
        located(image, true)


def test_a_corner_that_looks_otherwise_is_left_out() -> None:
    image, true = marker_picture(CHARUCO, 48, 10, 40, 10)
    x, y = np.rint(true[8]).astype(int)
    wrong = image.copy()
    wrong[y - 14 : y + 15, x - 14 : x + 15] = image[y - 20 : y + 9, x - 20 : x + 9]
    found = located(wrong, true)
    assert np.setdiff1d(np.arange(24), indices(CHARUCO, found)).tolist() == [8]


def test_a_board_that_is_bent_like_no_paper_is_not_planar() -> None:
    image, true = marker_picture(CHARUCO, 48, 10, 40, 10)
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(np.float32)
    waves = (x + 7 * np.sin(x / 18) * np.sin(y / 18)).astype(np.float32)
    with pytest.raises(BoardNotFound, match="not where a flat board would show them") as caught:
        located(cv2.remap(image, waves, y, cv2.INTER_CUBIC), true)
    assert caught.value.reason == "not planar"


def test_an_image_too_small_for_the_board_does_no_harm() -> None:
    image, true = marker_picture(CHARUCO, 48, 10, 40, 10)
    with pytest.raises(BoardNotFound):
        located(image[:9, :9], true)
    assert image.shape == SIZE[::-1]
