"""Which corners are neighbours on a chessboard.

Two corners are neighbours when an edge runs from one to the other, dark on one side and bright on the other
all the way, and when each is the other's nearest in that direction. Along an edge dark and bright change
sides at each corner, so the edge that enters a dark sector at one corner leaves one at the next: chance
hardly ever imitates that. What it does imitate, where a board lies on tiles or beside another board, is told
by the squares that it does not close.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .saddle_points import Image, SaddlePoints, sample

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

EDGE_TOLERANCE_RAD = 0.35
"""How far a neighbour may lie off the direction of an edge: 20 deg, for a short and distorted edge."""
SECTOR_SHARE = 0.4
"""The same as a share of the narrower sector, so that one direction is never taken for the other."""
EDGE_CONTRAST = 0.3
"""Step across an edge between two corners, as a share of the stronger corner's contrast."""


@dataclass(frozen=True)
class Linking:
    """What tells neighbours on a kind of board.

    Attributes
    ----------
    nearest : int
        Corners looked at around each one: its 8 on the board, and as many of clutter between them.
    side : float
        How far to either side of an edge the step is measured, as a share of its length.
    least_side_px : float
        The least distance, pixels.
    max_step_ratio : float
        Step to a neighbour over the step back along the same edge. On a chessboard perspective and lens
        change it by a third from one square to the next; a longer one leads off the board.
    """

    nearest: int = 14
    side: float = 0.25
    least_side_px: float = 0.0
    max_step_ratio: float = 2.0


CHESSBOARD = Linking()


def find_links(
    image: Image, saddles: SaddlePoints, linking: Linking = CHESSBOARD
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Pairs of neighbouring corners that are a side of a square.

    Parameters
    ----------
    image : (H, W) array
        The image that the corners were found in.
    saddles : SaddlePoints
        At least two corner candidates.
    linking : Linking

    Returns
    -------
    start, end : (L,)
        Indices of the corners; each pair both ways.
    along_first : (L,)
        Whether the pair is on the start's first edge.
    """
    start, end, along_first = _neighbours(image, saddles, linking)
    if len(start) == 0:
        return start, end, along_first
    sides = _sides_of_squares(start, end, len(saddles.points))
    return start[sides], end[sides], along_first[sides]


def turn(angle: Array) -> Array:
    """Difference of two undirected directions, radians, between 0 and pi / 2."""
    return np.abs((angle + np.pi / 2) % np.pi - np.pi / 2)


def _neighbours(
    image: Image, saddles: SaddlePoints, linking: Linking
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Pairs of neighbouring corners, each pair both ways, and whether it is on the start's first edge."""
    from scipy.spatial import cKDTree

    points, edges = saddles.points, saddles.edges
    near = min(linking.nearest + 1, len(points))
    _, neighbours = cKDTree(points).query(points, k=near)
    start = np.repeat(np.arange(len(points)), near - 1)
    end = np.asarray(neighbours, dtype=np.intp)[:, 1:].ravel()
    step = points[end] - points[start]
    # Sine of the angle between the step and each edge, from the cross product, against the tolerance.
    normals = np.stack([-np.sin(edges), np.cos(edges)], axis=-1)
    sector = turn(edges[:, 1] - edges[:, 0])
    tolerance = np.sin(np.minimum(EDGE_TOLERANCE_RAD, SECTOR_SHARE * sector))
    length = np.hypot(step[:, 0], step[:, 1])
    on_start = np.abs(np.einsum("pi,pei->pe", step, normals[start])) < (tolerance[start] * length)[:, None]
    on_end = np.abs(np.einsum("pi,pei->pe", step, normals[end])) < (tolerance[end] * length)[:, None]
    first = on_start[:, 0] & on_end[:, 1]
    kept = np.flatnonzero(first | (on_start[:, 1] & on_end[:, 0]))
    kept = kept[_is_edge(image, saddles, start[kept], end[kept], first[kept], linking)]
    start, end, first, step, length = start[kept], end[kept], first[kept], step[kept], length[kept]
    angle = np.where(first, edges[start, 0], edges[start, 1])
    forward = step[:, 0] * np.cos(angle) + step[:, 1] * np.sin(angle) > 0
    kept = _nearest_each_way(4 * start + 2 * first + forward, length, linking.max_step_ratio)
    start, end, first = start[kept], end[kept], first[kept]
    mutual = np.isin(start * len(points) + end, end * len(points) + start)
    return start[mutual], end[mutual], first[mutual]


def _nearest_each_way(way: Indices, length: Array, max_ratio: float) -> Indices:
    """Choose the shortest of the steps that go the same way from the same corner.

    Ways 2 k and 2 k + 1 are the two ways along one edge of one corner; a step much longer than the one back
    is left out.
    """
    order = np.lexsort([length, way])
    taken, first = np.unique(way[order], return_index=True)
    nearest = order[first]
    shortest = np.full(way.max(initial=0) + 2, np.inf)
    shortest[taken] = length[nearest]
    return np.asarray(nearest[length[nearest] < max_ratio * shortest[taken ^ 1]])


def _is_edge(
    image: Image,
    saddles: SaddlePoints,
    start: Indices,
    end: Indices,
    first: NDArray[np.bool_],
    linking: Linking,
) -> NDArray[np.bool_]:
    """Whether the brightness steps the right way across the line from start to end, all along it."""
    a, b = saddles.points[start], saddles.points[end]
    step = b - a
    # Seen along an edge that opens a dark sector, the side towards increasing angle is dark.
    side = np.maximum(linking.side, linking.least_side_px / np.linalg.norm(step, axis=1))
    across = np.stack([-step[:, 1], step[:, 0]], axis=1) * np.where(first, side, -side)[:, None]
    along = a[:, None] + step[:, None] * np.array([0.3, 0.5, 0.7])[:, None]
    drop = sample(image, along - across[:, None]) - sample(image, along + across[:, None])
    needed = EDGE_CONTRAST * np.maximum(saddles.contrast[start], saddles.contrast[end])
    return np.asarray((drop > needed[:, None]).all(axis=1))


def _sides_of_squares(start: Indices, end: Indices, count: int) -> NDArray[np.bool_]:
    """Which links are a side of a closed square; what ties a board to things beyond it hardly ever is."""
    from scipy.sparse import csr_matrix

    graph = csr_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    # Walks of three links from end to end, less those that go back on themselves.
    degree = np.asarray(graph.sum(axis=1)).ravel()
    walks = np.asarray((graph @ graph @ graph)[start, end]).ravel()
    return np.asarray(walks - degree[start] - degree[end] + 1 > 0)
