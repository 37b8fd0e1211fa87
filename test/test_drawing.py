from __future__ import annotations

import numpy as np
import pytest

from fewcal.drawing import Drawing, cells, rectangles

NO_DISCS = np.empty((0, 3))
CHECKER = np.indices((4, 5)).sum(axis=0) % 2 == 0


def brute_force(drawing: Drawing, x, y, across=40):
    fine = (np.arange(across) + 0.5) / across
    u = (x[:-1, None] + np.diff(x)[:, None] * fine).ravel()
    v = (y[:-1, None] + np.diff(y)[:, None] * fine).ravel()
    points = np.stack(np.meshgrid(u, v), axis=-1)
    black = drawing.is_black(points[:, :, None])[..., 0]
    return black.reshape(len(y) - 1, across, len(x) - 1, across).mean(axis=(1, 3))


@pytest.fixture
def board():
    discs = np.array([[0.2, 0.05, 0.02], [0.2, 0.1, 0.017]])
    return Drawing(cells(CHECKER, 0.01, 0.02, 0.03), discs, (-0.02, 0.0, 0.25, 0.2))


def test_cells_are_black_where_they_are_said_to_be(board):
    row, column = np.indices(CHECKER.shape)
    centres = np.stack([0.01 + 0.03 * (column + 0.5), 0.02 + 0.03 * (row + 0.5)], axis=-1)
    np.testing.assert_array_equal(board.is_black(centres[:, :, None])[..., 0], CHECKER)


def test_points_beyond_all_shapes_are_white(board):
    beyond = np.array([[-1.0, 0.05], [1.0, 0.05], [0.05, -1.0], [0.05, 1.0], [0.2, 0.075]])
    assert not board.is_black(beyond[:, None]).any()


def test_discs_are_black_inside_their_radius(board):
    angle = np.linspace(0, 6, 7)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    assert board.is_black((0.2, 0.05) + 0.0199 * ring).all()
    assert not board.is_black((0.2, 0.05) + 0.0201 * ring).any()


@pytest.mark.parametrize("pixel", [0.0007, 0.004, 0.05])
def test_coverage_is_the_share_of_black_in_each_pixel(board, pixel):
    x, y = np.arange(-0.013, 0.25, pixel), np.arange(-0.007, 0.16, pixel)
    drawing = Drawing(board.polygons, NO_DISCS, board.extent)
    share = drawing.coverage(x, y)
    np.testing.assert_allclose(share, brute_force(drawing, x, y), atol=0.06)  # of the samples
    inside = np.sum(CHECKER) * 0.03**2
    if y[-1] > 0.14:
        assert share.sum() * pixel**2 == pytest.approx(inside, rel=1e-12)


def test_coverage_of_a_disc_is_its_area(board):
    x = np.arange(0.17, 0.23, 0.0011)
    disc = Drawing([], board.discs[:1], board.extent)
    share = disc.coverage(x, np.arange(0.02, 0.08, 0.0011))
    assert share.sum() * 0.0011**2 == pytest.approx(np.pi * 0.02**2, rel=1e-3)
    assert share.max() == 1
    np.testing.assert_allclose(share, brute_force(disc, x, np.arange(0.02, 0.08, 0.0011)), atol=0.1)


def test_where_nothing_may_change_one_point_tells_the_whole(board):
    rng = np.random.default_rng(0)
    centres, reach = rng.uniform(-0.02, 0.25, (3000, 2)), np.array([0.003, 0.002])
    change = board.may_change(centres, np.broadcast_to(reach, centres.shape))
    assert 0.1 < change.mean() < 0.7
    around = centres[:, None] + rng.uniform(-1, 1, (3000, 50, 2)) * reach
    black = board.is_black(around)
    assert (black == board.is_black(centres[:, None]))[~change].all()


@pytest.mark.parametrize("step", [1, -1])
@pytest.mark.parametrize("first", range(6))
def test_an_outline_may_begin_anywhere_and_run_either_way(first, step):
    corner = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]) * 0.01
    bent = Drawing([np.roll(corner, first, axis=0)[::step]], NO_DISCS, (0, 0, 0.02, 0.02))
    next_to_it = Drawing(
        [bent.polygons[0], *rectangles([[0.01, 0.01]], [0.02, 0.02])], NO_DISCS, (0, 0, 0.02, 0.02)
    )
    borders = np.array([0, 0.01, 0.02])
    np.testing.assert_allclose(bent.coverage(borders, borders), [[1, 1], [1, 0]], atol=1e-12)
    np.testing.assert_allclose(next_to_it.coverage(borders, borders), 1, atol=1e-12)


def test_neighbours_leave_no_seam():
    thirds = Drawing(cells(np.ones((3, 7), dtype=bool), 0.1, 0.1, 0.1 / 3), NO_DISCS, (0, 0, 1, 1))
    share = thirds.coverage(np.linspace(0.11, 0.32, 100), np.linspace(0.11, 0.19, 100))
    np.testing.assert_allclose(share, 1, atol=1e-6)


def test_bounds(board):
    np.testing.assert_allclose(board.ink, (0.01, 0.02, 0.22, 0.14))
    assert board.size == pytest.approx((0.27, 0.2))
    moved = board.moved(1.0, 2.0)
    np.testing.assert_allclose(moved.ink, (1.01, 2.02, 1.22, 2.14))
    np.testing.assert_allclose(moved.extent, (0.98, 2.0, 1.25, 2.2))


def test_without_shapes_all_is_white():
    blank = Drawing([], NO_DISCS, (0, 0, 1, 1))
    assert not blank.is_black(np.zeros((3, 1, 2))).any()
    assert not blank.coverage(np.arange(5.0), np.arange(4.0)).any()
    assert not blank.may_change(np.zeros((3, 2)), np.ones((3, 2))).any()
