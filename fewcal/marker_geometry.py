"""Which markers belong to one board, and where its other points must be then."""

from __future__ import annotations

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
    H = _homographies(plane, pixels)
    centre, shown = plane.mean(axis=1), pixels.mean(axis=1)
    first, second = np.nonzero(np.linalg.norm(centre[:, None] - centre, axis=2) < reach)
    expected = _map(H[first], centre[second])
    distance = np.linalg.norm(shown[first] - shown[second], axis=1)
    agree = np.linalg.norm(expected - shown[second], axis=1) <= MAX_DISAGREEMENT * distance
    first, second = first[agree], second[agree]
    graph = coo_matrix((np.ones(len(first)), (first, second)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    return np.asarray(label == np.bincount(label).argmax())


def local_frames(plane: Array, pixels: Array, weights: Array, wanted: Array) -> tuple[Array, Array]:
    """Say how the surroundings of points of a plane show in an image, each from the nearest points known.

    Parameters
    ----------
    plane, pixels : (N, 2)
        Points known on the plane and in the image.
    weights : (N,)
        What they are worth: inverse to their sd.
    wanted : (W, 2)
        Points on the plane.

    Returns
    -------
    frames : (W, 3, 3)
        Homographies to pixels, from coordinates on the plane that have their origin at the point.
    distance : (W,)
        From each point to the nearest known one, on the plane.
    """
    from scipy.spatial import cKDTree

    nearest = cKDTree(plane).query(wanted, k=min(NEIGHBOURS, len(plane)))
    distance, near = np.asarray(nearest[0]), np.asarray(nearest[1])
    frames = _homographies(plane[near], pixels[near], weights[near])
    frames[..., 2] += (frames[..., :2] @ wanted[..., None])[..., 0]
    return frames / frames[:, 2:, 2:], distance[:, 0]


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
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    H = _homographies(np.broadcast_to(unit, quads.shape), quads)
    y, x = np.meshgrid(shares, shares, indexing="ij")
    mapped = H @ np.stack([x.ravel(), y.ravel(), np.ones(x.size)])
    points = np.swapaxes(mapped[:, :2] / mapped[:, 2:], 1, 2)
    return np.asarray(points.reshape(len(quads), *x.shape, 2))


def _homographies(plane: Array, pixels: Array, weights: Array | None = None) -> Array:
    """Homographies (B, 3, 3) of sets of points (B, K, 2) with weights (B, K)."""
    if weights is None:
        weights = np.ones(plane.shape[:2])
    return homographies(np.swapaxes(plane, 1, 2), np.swapaxes(pixels, 1, 2), weights)


def _map(H: Array, points: Array) -> Array:
    """Points (B, 2) through homographies (B, 3, 3), each its own."""
    mapped = (H[..., :2] @ points[..., None])[..., 0] + H[..., 2]
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
