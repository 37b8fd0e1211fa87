from __future__ import annotations

from dataclasses import replace

import numpy as np
from board_pictures import BOARD, CAMERA, SIZE, picture, pose

from fewcal.boards import Chessboard
from fewcal.corner_links import Linking
from fewcal.grid import fill_gaps, find_chains, find_grids, local_axes, predict, squares_meet_in_shadow
from fewcal.rendering import render
from fewcal.saddle_points import find_saddle_points

LATTICE = np.stack(np.meshgrid(np.arange(5.0) * 20, np.arange(4.0) * 30), axis=-1)


def test_a_board_is_one_grid_of_its_size() -> None:
    image, true = picture(pose(BOARD, 30, 30, 40, 15))
    grid = find_grids(image, find_saddle_points(image))[0]
    assert sorted(grid.shape[:2]) == [6, 9]
    gaps = np.linalg.norm(grid.reshape(-1, 1, 2) - true, axis=2)
    assert gaps.min(axis=1).max() < 0.5
    assert len(set(gaps.argmin(axis=1))) == len(true)


def test_chains_hold_what_edges_link() -> None:
    image, true = picture(pose(BOARD, 30, 30, 40, 15))
    saddles = find_saddle_points(image)
    grids = [grid for grid, _ in find_chains(image, saddles)]
    assert sorted(grids[0].shape) == [6, 9]
    assert np.linalg.norm(saddles.points[grids[0]].reshape(-1, 1, 2) - true, axis=2).min(axis=1).max() < 0.5
    assert list(find_chains(image, saddles, least=55)) == []
    apart = Linking(nearest=1)
    assert all(grid.size < 54 for grid, _ in find_chains(image, saddles, apart, least=2))


def test_an_edge_is_seen_beside_it_where_there_is_something_farther_off() -> None:
    image, true = picture(pose(BOARD, 40))
    covered = image.copy()
    middles = (true.reshape(6, 9, 2)[:-1, :-1] + true.reshape(6, 9, 2)[1:, 1:]) / 2
    for x, y in np.rint(middles.reshape(-1, 2)).astype(int):
        covered[y - 15 : y + 16, x - 15 : x + 16] = 100
    saddles = find_saddle_points(covered)
    assert all((grid >= 0).sum() < 54 for grid, _ in find_chains(covered, saddles))
    beside = Linking(side=0.02, least_side_px=2.0)
    assert any((grid >= 0).sum() == 54 for grid, _ in find_chains(covered, saddles, beside))


def test_missing_corners_are_found_again_or_left_open() -> None:
    image, _ = picture(pose(BOARD, 30, 30, 40, 15))
    saddles = find_saddle_points(image)
    kept = np.ones(len(saddles.points), dtype=bool)
    kept[[10, 30]] = False
    fewer = replace(
        saddles, points=saddles.points[kept], edges=saddles.edges[kept], contrast=saddles.contrast[kept]
    )
    grid = find_grids(image, fewer)[0]
    assert sorted(grid.shape[:2]) == [6, 9]
    assert np.isnan(grid[..., 0]).sum() == 2


def test_a_narrow_margin_before_a_dark_wall_adds_no_row() -> None:
    board = Chessboard(6, 4, 0.025)
    image, true = picture(pose(board, 40), board)
    low, high = np.rint(true[0] - 47).astype(int), np.rint(true[-1] + 47).astype(int)  # margins of 7 px
    framed = np.full_like(image, 70)
    framed[low[1] : high[1], low[0] : high[0]] = image[low[1] : high[1], low[0] : high[0]]
    assert sorted(find_grids(framed, find_saddle_points(framed))[0].shape[:2]) == [4, 6]


def test_predictions_are_exact_on_a_regular_lattice() -> None:
    for row, column in ((0, 0), (0, 2), (1, 0), (2, 2), (3, 4)):
        grid = LATTICE.copy()
        grid[row, column] = np.nan
        prediction, spacing = predict(grid)
        np.testing.assert_allclose(prediction[row, column], LATTICE[row, column], atol=1e-12)
        assert spacing[row, column] == 20


def test_gaps_are_filled_from_their_rim() -> None:
    grid = LATTICE.copy()
    grid[1:4, 1:4] = np.nan
    np.testing.assert_allclose(fill_gaps(grid), LATTICE, atol=1e-9)
    assert np.isnan(fill_gaps(np.full((3, 3, 2), np.nan))).all()


def test_local_axes_are_the_steps_of_the_lattice() -> None:
    across, down = local_axes(LATTICE)
    np.testing.assert_allclose(across, np.broadcast_to([20.0, 0.0], across.shape))
    np.testing.assert_allclose(down, np.broadcast_to([0.0, 30.0], down.shape))


def test_a_board_on_tiles_is_a_grid_of_its_own() -> None:
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    tiles = 0.35 + 0.3 * ((x // 42 + y // 42) % 2)
    image = render(CAMERA, SIZE, BOARD, pose(BOARD, 27, 20, 40, 20), background=tiles)
    shapes = [sorted(grid.shape[:2]) for grid in find_grids(image, find_saddle_points(image))]
    assert [6, 9] in shapes
    assert any(shape > [9, 9] for shape in shapes)


def test_squares_meet_in_half_a_shadow_and_not_at_the_rim() -> None:
    image, true = picture(pose(BOARD, 30))
    grid = true.reshape(6, 9, 2)
    image[: round(grid[3, 0, 1])] //= 4
    assert squares_meet_in_shadow(image, grid).all()
    beyond = np.concatenate([grid, 2 * grid[-1:] - grid[-2:-1]])
    assert not squares_meet_in_shadow(image, beyond)[-1].any()
