from __future__ import annotations

import numpy as np
import pytest
from circle_pictures import ASYMMETRIC, BARREL, SYMMETRIC, pose
from numpy.typing import NDArray

from fewcal.blob_lattice import find_lattices
from fewcal.blobs import Blobs
from fewcal.boards import AsymmetricCircleGrid, CircleGrid
from fewcal.circle_bias import _CIRCLE, _ellipses


def blobs(board: CircleGrid | AsymmetricCircleGrid, tilt: float, about: float) -> Blobs:
    outlines = board.points[:, None] + 0.006 * np.c_[_CIRCLE, np.zeros(len(_CIRCLE))]
    return Blobs(*_ellipses(BARREL.project(outlines, pose(board, tilt, about, span=0.4, camera=BARREL))))


def without(all_blobs: Blobs, chosen: list[int]) -> Blobs:
    return Blobs(
        np.delete(all_blobs.points, chosen, axis=0), np.delete(all_blobs.covariances, chosen, axis=0)
    )


def turned_right(lattice: NDArray[np.intp], points: NDArray[np.float64]) -> bool:
    known = (lattice[:-1, :-1] >= 0) & (lattice[1:, :-1] >= 0) & (lattice[:-1, 1:] >= 0)
    first = points[lattice[:-1, :-1][known]]
    across, down = points[lattice[:-1, 1:][known]] - first, points[lattice[1:, :-1][known]] - first
    return bool((across[:, 0] * down[:, 1] > across[:, 1] * down[:, 0]).all())


@pytest.mark.parametrize("about", [0, 75, 200])
@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_a_symmetric_grid_is_one_lattice(tilt: float, about: float) -> None:
    found = blobs(SYMMETRIC, tilt, about)
    (lattice,) = find_lattices(found)
    assert sorted(lattice.shape) == [7, 10]
    assert sorted(lattice.ravel()) == list(range(70))
    grid = lattice if lattice.shape == (7, 10) else lattice.T
    order = grid[:, :: 1 if grid[0, 0] < grid[0, 1] else -1][:: 1 if grid[0, 0] < grid[1, 0] else -1]
    np.testing.assert_array_equal(order.ravel(), np.arange(70))
    assert turned_right(lattice, found.points)


@pytest.mark.parametrize("tilt", [0, 30, 60])
def test_an_asymmetric_grid_lies_across_its_lattice(tilt: float) -> None:
    found = blobs(ASYMMETRIC, tilt, 20)
    (lattice,) = find_lattices(found)
    assert lattice.shape == (9, 9)
    assert sorted(lattice[lattice >= 0]) == list(range(44))
    assert turned_right(lattice, found.points)


def test_a_missing_blob_leaves_a_gap_and_clutter_is_left_out() -> None:
    rng = np.random.default_rng(0)
    board = without(blobs(SYMMETRIC, 30, 20), [23, 24])
    noise = rng.uniform(0, 480, (40, 2))
    noise = noise[np.linalg.norm(noise[:, None] - board.points, axis=2).min(axis=1) > 15]
    shapes = np.einsum("n,ij->nij", rng.uniform(1, 60, len(noise)), np.eye(2))
    found = Blobs(np.concatenate([noise, board.points]), np.concatenate([shapes, board.covariances]))
    lattice = find_lattices(found)[0]
    members = lattice[lattice >= 0]
    assert np.isin(np.arange(68) + len(noise), members).all()
    assert len(members) <= 70


def test_two_boards_are_two_lattices() -> None:
    one, other = blobs(ASYMMETRIC, 20, 10), blobs(SYMMETRIC, 0, 0)
    points = np.concatenate([one.points + np.array([2000, 0]), other.points])
    both = Blobs(points, np.concatenate([one.covariances, other.covariances]))
    assert [int((lattice >= 0).sum()) for lattice in find_lattices(both)] == [70, 44]


@pytest.mark.parametrize("count", [0, 1, 4, 200])
def test_scattered_blobs_are_no_lattice(count: int) -> None:
    rng = np.random.default_rng(1)
    scattered = Blobs(rng.uniform(0, 1000, (count, 2)), np.tile(9 * np.eye(2), (count, 1, 1)))
    assert all((lattice >= 0).sum() < 12 for lattice in find_lattices(scattered))
