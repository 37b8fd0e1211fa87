"""Which markers belong to one board, and where its other points must be then."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .homography import homographies

Array = NDArray[np.float64]

MAX_DISAGREEMENT = 0.35
"""How far a marker may be from where its neighbour expects it, as a share of their distance: a board that
bulges through a fisheye stays at half of it, and a marker one square off is at 0.5 and more."""
NEIGHBOURS = 16
"""Known points about a point that say where it is: the corners of four markers, or of two and the corners of
the squares about them."""
FLAT = 1e-9
"""Sine of an angle below which three corners are on one line."""


def largest_board(plane: Array, pixels: Array, reach: float) -> NDArray[np.bool_]:
    """Find the largest set of markers that lie to each other as on the board.

    Parameters
    ----------
    plane : (M, 4, 2)
        Corners of each marker on the board, any unit.
    pixels : (M, 4, 2)
        The same corners in the image.
    reach : float
        Markers whose middles are closer than this on the board are held against each other. A marker says
        little of what lies farther away, its corners being known to a pixel only.

    Returns
    -------
    (M,) whether a marker belongs to the set.
    """
    # Imported here, since it takes longer than all of fewcal, and who has points already needs none of it.
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count = len(plane)
    if count == 0:
        return np.zeros(0, dtype=bool)
    H = _square_to(pixels) @ np.linalg.inv(_square_to(plane))
    centre, shown = plane.mean(axis=1), pixels.mean(axis=1)
    first, second = np.nonzero(np.linalg.norm(centre[:, None] - centre, axis=2) < reach)
    expected = _map(H[first], centre[second])
    distance = np.linalg.norm(shown[first] - shown[second], axis=1)
    agree = np.linalg.norm(expected - shown[second], axis=1) <= MAX_DISAGREEMENT * distance
    first, second = first[agree], second[agree]
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label == np.bincount(label).argmax())


def local_frames(
    plane: Array, pixels: Array, weights: Array, wanted: Array, within: float = math.inf
) -> Array:
    """Say how the surroundings of points of a plane show in an image, each from the nearest points known.

    Parameters
    ----------
    plane, pixels : (N, 2)
        Points known on the plane and in the image.
    weights : (N,)
        What they are worth: inverse to their sd.
    wanted : (W, 2)
        Points on the plane.
    within : float
        Those farther from the nearest known point are left out: what is known may lie in one line for them.

    Returns
    -------
    (W, 3, 3) homographies to pixels, from coordinates on the plane that have their origin at the point; NaN
    for points left out.
    """
    from scipy.spatial import cKDTree

    nearest = cKDTree(plane).query(wanted, k=min(NEIGHBOURS, len(plane)))
    reached = np.asarray(nearest[0])[:, 0] < within
    near = np.asarray(nearest[1])[reached]
    H = homographies(np.swapaxes(plane[near], 1, 2), np.swapaxes(pixels[near], 1, 2), weights[near])
    H[..., 2] += (H[..., :2] @ wanted[reached][..., None])[..., 0]
    frames = np.full((len(wanted), 3, 3), np.nan)
    frames[reached] = H / H[:, 2:, 2:]
    return frames


def map_grid(quads: Array, shares: Array) -> Array:
    """Points of a square grid in quadrangles that show a square.

    Parameters
    ----------
    quads : (K, 4, 2)
        Corners of each, pixels, one after the other.
    shares : (S,)
        Where the lines of the grid are, as shares of the edge.

    Returns
    -------
    (K, S, S, 2) pixels: along the last but one axis from the first corner to the second.
    """
    H = _square_to(quads)
    v, u = np.meshgrid(shares, shares, indexing="ij")
    mapped = H @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    points = np.swapaxes(mapped[:, :2] / mapped[:, 2:], 1, 2)
    return np.asarray(points.reshape(len(quads), *u.shape, 2))


def _square_to(quads: Array) -> Array:
    """Homographies (K, 3, 3) from the unit square to quadrangles (K, 4, 2).

    Heckbert (1989), "Fundamentals of texture mapping and image warping", section 2.2.3.
    """
    first, second, third, fourth = np.moveaxis(quads, 1, 0)
    sides = np.stack([second - third, fourth - third], axis=-1)
    flat = np.abs(np.linalg.det(sides)) <= FLAT * np.linalg.norm(sides, axis=1).prod(axis=1)
    sides[flat] = np.eye(2)  # nobody can see anything there
    vanishing = np.linalg.solve(sides, (first - second + third - fourth)[..., None])
    x, y = vanishing[:, 0], vanishing[:, 1]
    return np.stack(
        [
            np.column_stack([second - first + x * second, x]),
            np.column_stack([fourth - first + y * fourth, y]),
            np.column_stack([first, np.ones(len(quads))]),
        ],
        axis=-1,
    )


def _map(H: Array, points: Array) -> Array:
    """Points (B, 2) through homographies (B, 3, 3), each its own."""
    mapped = (H[..., :2] @ points[..., None])[..., 0] + H[..., 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
