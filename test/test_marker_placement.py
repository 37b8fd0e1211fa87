from __future__ import annotations

import numpy as np
import pytest
from marker_pictures import CHARUCO, needs_markers

from fewcal.aprilgrid import AprilGrid
from fewcal.aprilgrid_detection import aprilgrid_layout
from fewcal.charuco_detection import charuco_layout
from fewcal.marker_placement import Layout, Placement, place_by_likeness, place_by_numbers, turned
from fewcal.markers import marker_bits

CHARUCO_LAYOUT = charuco_layout(CHARUCO)
GRID_LAYOUT = aprilgrid_layout(AprilGrid(4, 3, 0.088, 0.3, "tag36h11"))
RNG = np.random.default_rng(5)


def seen(layout: Layout, turn: int, part: tuple[slice, slice]) -> tuple[np.ndarray, np.ndarray, Placement]:
    """Squares of a part of a board, turned and counted from elsewhere, their markers, and where they lie."""
    row, column = np.nonzero(layout.numbers[part] >= 0)
    on_board = np.stack([column + part[1].start, row + part[0].start], axis=1)
    cells = turned(on_board, -turn) + np.array([3, -2])
    offset = on_board[0] - turned(cells, turn)[0]
    return (
        cells,
        layout.numbers[on_board[:, 1], on_board[:, 0]],
        Placement(turn, tuple(offset), len(cells), int(np.ptp(on_board[:, 1]))),
    )


@pytest.mark.parametrize("turn", range(4))
def test_four_turns_are_none(turn: int) -> None:
    cells = RNG.integers(-5, 6, (9, 2))
    np.testing.assert_array_equal(turned(turned(cells, turn), 4 - turn), cells)
    np.testing.assert_array_equal(turned(np.array([[0, 0], [2, 1]]), 1), [[-1, 0], [-2, 2]])


@pytest.mark.parametrize("layout", [CHARUCO_LAYOUT, GRID_LAYOUT], ids=["ChArUco", "AprilGrid"])
@pytest.mark.parametrize("turn", range(4))
def test_markers_tell_where_they_are(layout: Layout, turn: int) -> None:
    cells, ids, true = seen(layout, turn, (slice(1, 5), slice(1, 6)))
    turns = np.full(len(ids), turn)
    assert place_by_numbers(cells, ids, turns, layout) == true
    wrong = ids.copy()
    wrong[[0, 2]] = wrong[[2, 0]]
    assert place_by_numbers(cells, wrong, turns, layout) == true._replace(votes=len(ids) - 2)
    np.testing.assert_array_equal(layout.numbers[tuple(true.on_board(cells).T[::-1])], ids)


def test_markers_of_no_board_place_nothing() -> None:
    cells, none = np.array([[0, 0], [1, 1]]), np.empty((0, 2), np.intp)
    found = place_by_numbers(cells, np.array([80, 91]), np.array([3, 3]), CHARUCO_LAYOUT)
    assert (found.turn, found.votes) == (3, 0)
    assert place_by_numbers(none, none[:, 0], none[:, 0], CHARUCO_LAYOUT).votes == 0


@needs_markers
@pytest.mark.parametrize("turn", range(4))
def test_bits_that_run_into_each_other_still_tell_where_they_are(turn: int) -> None:
    cells, ids, true = seen(CHARUCO_LAYOUT, turn, (slice(0, 5), slice(0, 7)))
    sharp = np.pad(
        np.rot90(marker_bits(CHARUCO.dictionary, ids), turn, axes=(1, 2)), ((0, 0), (1, 1), (1, 1))
    )
    weights = np.array([0.25, 0.45, 0.3])
    blurred = sum(
        weights[i] * weights[j] * np.roll(sharp, (i - 1, j - 1), axis=(1, 2))
        for i in range(3)
        for j in range(3)
    )
    levels = 60 + RNG.uniform(30, 80, (len(ids), 1, 1)) * blurred + RNG.normal(0, 2, sharp.shape)
    assert place_by_likeness(cells, levels[:, 1:-1, 1:-1], 1, CHARUCO_LAYOUT) == true._replace(rows=0)
    few = place_by_likeness(cells[:5], levels[:5, 1:-1, 1:-1], 1, CHARUCO_LAYOUT)
    assert few.votes == 0


@needs_markers
def test_what_looks_otherwise_is_not_placed() -> None:
    cells, ids, _ = seen(CHARUCO_LAYOUT, 0, (slice(0, 5), slice(0, 7)))
    for _ in range(10):
        assert place_by_likeness(cells, RNG.normal(100, 20, (len(ids), 5, 5)), 1, CHARUCO_LAYOUT).votes == 0
    assert place_by_likeness(cells, np.full((len(ids), 5, 5), 100.0), 1, CHARUCO_LAYOUT).votes == 0
    assert place_by_likeness(cells * 2, np.full((len(ids), 5, 5), 100.0), 1, CHARUCO_LAYOUT).votes == 0
