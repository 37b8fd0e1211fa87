from __future__ import annotations

import numpy as np
import pytest
from board_pictures import BOARD, picture, pose
from scipy.spatial import cKDTree

from fewcal.saddle_points import find_saddle_points, sample


def test_every_corner_of_a_board_is_a_saddle_point_near_its_place() -> None:
    image, true = picture(pose(BOARD, 30, 20, 40, 15))
    saddles = find_saddle_points(image)
    distance, nearest = cKDTree(saddles.points).query(true)
    assert distance.max() < 0.3
    assert len(saddles.points) == len(true)
    assert (saddles.contrast[nearest] > 50).all()
    assert cKDTree(saddles.peaks).query(saddles.points)[0].max() == 0
    of_board = saddles.strength[cKDTree(saddles.peaks).query(saddles.points)[1]]
    assert of_board.min() > 5 * np.median(saddles.strength)


def test_the_sector_between_the_edges_is_dark() -> None:
    y, x = np.mgrid[:41, :41]
    image = np.where((x > 20) == (y > 20), 30, 200).astype(np.uint8)  # dark right below: from x towards y
    saddles = find_saddle_points(image)
    assert len(saddles.points) == 1
    np.testing.assert_allclose(saddles.points[0], [20.5, 20.5], atol=0.5)
    first, second = saddles.edges[0] % np.pi
    assert min(first, np.pi - first) < 0.1
    assert second == pytest.approx(np.pi / 2, abs=0.1)


@pytest.mark.parametrize("kind", ["edge", "blob", "stripe", "corner of a square", "T junction"])
def test_other_features_are_none(kind: str) -> None:
    y, x = np.mgrid[:41, :41].astype(float) - 20.3
    image = {
        "edge": np.where(x + 0.3 * y > 0, 200, 30),
        "blob": np.where(np.hypot(x, y) < 5, 200, 30),
        "stripe": np.where(np.abs(x - 0.5 * y) < 3, 200, 30),
        "corner of a square": np.where((x > 0) & (y > 0), 30, 200),
        "T junction": np.where(x > 0, 30, np.where(y > 0, 200, 110)),
    }[kind].astype(np.uint8)
    assert len(find_saddle_points(image).points) == 0


def test_sampling_is_bilinear_and_holds_the_border() -> None:
    image = np.array([[0, 10, 20], [30, 40, 50]], dtype=np.uint8)
    points = np.array([[0, 0], [0.5, 0], [1, 0.5], [1.25, 0.75], [-3, 0], [9, 9]], dtype=float)
    np.testing.assert_allclose(sample(image, points), [0, 5, 25, 35, 0, 50], atol=1e-4)
