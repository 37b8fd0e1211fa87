from __future__ import annotations

from dataclasses import replace

import numpy as np
from board_pictures import BOARD, picture, pose

from fewcal.corner_links import find_links, turn
from fewcal.saddle_points import find_saddle_points


def test_neighbours_are_those_of_the_board() -> None:
    image, true = picture(pose(BOARD, 30, 30, 40, 15))
    saddles = find_saddle_points(image)
    start, end, _ = find_links(image, saddles)
    gaps = np.linalg.norm(saddles.points[:, None] - true, axis=2)
    place = gaps.argmin(axis=1)
    row, column = np.divmod(place, BOARD.columns)
    assert gaps.min(axis=1)[start].max() < 0.5
    steps = np.abs(row[end] - row[start]) + np.abs(column[end] - column[start])
    assert (steps == 1).all()
    assert len(start) == 2 * (9 * 5 + 8 * 6)


def test_each_link_goes_both_ways_along_the_other_edge() -> None:
    image, _ = picture(pose(BOARD, 30, 30, 40, 15))
    start, end, along_first = find_links(image, find_saddle_points(image))
    there = dict(zip(zip(start.tolist(), end.tolist(), strict=True), along_first.tolist(), strict=True))
    assert all(there[b, a] is not first for (a, b), first in there.items())


def test_a_chain_without_squares_is_no_board() -> None:
    image, true = picture(pose(BOARD, 30))
    saddles = find_saddle_points(image)
    gaps = np.linalg.norm(saddles.points[:, None] - true[:9], axis=2)
    row = gaps.min(axis=1) < 2
    chain = replace(
        saddles, points=saddles.points[row], edges=saddles.edges[row], contrast=saddles.contrast[row]
    )
    assert len(chain.points) == 9
    start, end, along_first = find_links(image, chain)
    assert len(start) == len(end) == len(along_first) == 0


def test_corners_that_no_edge_joins_have_no_links() -> None:
    image, _ = picture(pose(BOARD, 30))
    saddles = find_saddle_points(image)
    blank = np.full_like(image, 90)
    assert all(len(part) == 0 for part in find_links(blank, saddles))


def test_directions_differ_by_a_right_angle_at_most() -> None:
    np.testing.assert_allclose(
        turn(np.radians([0, 10, 90, 170, 180, -100])), np.radians([0, 10, 90, 10, 0, 80])
    )
