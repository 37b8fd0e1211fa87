"""From loose corners to the grid of a chessboard, of whatever size it has.

Chains of neighbours give integer coordinates; corners that were missed are looked for where their neighbours
predict them.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from .corner_links import CHESSBOARD, EDGE_CONTRAST, Indices, Linking, find_links, turn
from .saddle_points import Image, SaddlePoints, sample

Array = NDArray[np.float64]

MIN_CORNERS = 8
"""Fewest linked corners that are worth growing: the smallest board, 3x3, less one."""
QUADRANT_SHARE = 0.25
"""Where the four squares about a corner are looked at: half way to their centres."""
MIN_RIM_SHARE = 0.6
"""Share of the known corners of an outer row at which four squares must meet."""
MIN_KNOWN_SHARE = 0.4
"""Share of an outer row that must have been found at all; the rest is then located by its prediction."""
MIN_SQUARES = 3
"""Fewest closed squares among them: of the four of a 3x3 board a missing corner leaves three."""
MAX_GRIDS = 3
"""Chains of corners that are grown, largest first."""
SNAP_SHARE = 0.3
"""A missing corner is sought this far from its prediction, as a share of the distance to its neighbours."""
MAX_RINGS = 200
"""Rounds of growing; each adds at least one corner, so this only bounds a board of unusual size."""
_RIMS = ((0,), (-1,), (slice(None), 0), (slice(None), -1))
_WITHOUT_RIM = (
    (slice(1, None),),
    (slice(None, -1),),
    (slice(None), slice(1, None)),
    (slice(None), slice(None, -1)),
)


def find_grids(image: Image, saddles: SaddlePoints) -> list[Array]:
    """Arrange corners in grids.

    Parameters
    ----------
    image : (H, W) array
        The image that the corners were found in.
    saddles : SaddlePoints
        Its corner candidates.

    Returns
    -------
    list of (R, C, 2) arrays, largest in the image first: pixels, NaN where a corner was not found,
    which :func:`fill_gaps` can complete.
    """
    grids = []
    for grid, swapped in islice(find_chains(image, saddles), MAX_GRIDS):
        if _closed_squares(grid) < MIN_SQUARES:
            continue
        grid = _grow(grid, swapped, saddles)
        points = _trim(image, np.where((grid >= 0)[..., None], saddles.points[grid], np.nan))
        if min(points.shape[:2]) > 1 and np.isfinite(fill_gaps(points)).all():
            grids.append(points)
    return sorted(grids, key=_area, reverse=True)


def find_chains(
    image: Image, saddles: SaddlePoints, linking: Linking = CHESSBOARD, least: int = MIN_CORNERS
) -> Iterator[tuple[Indices, bool]]:
    """Arrange corners in grids as far as edges link them.

    Parameters
    ----------
    image, saddles
        See :func:`find_grids`.
    linking : Linking
    least : int
        Fewest linked corners that are of interest.

    Yields
    ------
    Those of most corners first:

    grid : (R, C)
        Index of the corner in each cell, -1 for none.
    swapped : bool
        Whether the corner of cell (0, 0) has its first edge along the column rather than the row.
    """
    # Imported here, since it takes longer than all of fewcal, and who has points already needs none of it.
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(saddles.points) < least:
        return
    start, end, along_first = find_links(image, saddles, linking)
    if len(start) == 0:
        return
    count = len(saddles.points)
    graph = coo_matrix((np.ones(len(start)), (start, end)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    sizes = np.bincount(label)
    for component in np.argsort(-sizes, kind="stable"):
        if sizes[component] < least:
            return
        own = label[start] == component
        yield _coordinates(saddles, start[own], end[own], along_first[own])


def _closed_squares(grid: Indices) -> int:
    """Squares of a grid of which all four corners are known; texture gives chains but hardly any squares."""
    known = grid >= 0
    return int((known[:-1, :-1] & known[1:, :-1] & known[:-1, 1:] & known[1:, 1:]).sum())


def _area(grid: Array) -> float:
    """Area of a grid in the image, px^2: that of the square at each of its corners."""
    across, down = local_axes(grid)
    squares = np.abs(across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0])
    return float(np.nansum(squares))


def _coordinates(
    saddles: SaddlePoints, start: Indices, end: Indices, first: NDArray[np.bool_]
) -> tuple[Indices, bool]:
    """Grid of one chain of neighbours: walk the links outwards from the best connected corner.

    Returns
    -------
    grid : (R, C)
        Index of the corner in each cell, -1 for none.
    swapped : bool
        Whether the corner of cell (0, 0) has its first edge along the column rather than the row.
    """
    points = saddles.points
    lines = np.stack([np.cos(saddles.edges), np.sin(saddles.edges)], axis=-1)
    step = points[end] - points[start]
    cell = np.zeros((len(points), 2), dtype=np.int64)
    axes = np.zeros((len(points), 2, 2))
    swapped = np.zeros(len(points), dtype=bool)
    known = np.zeros(len(points), dtype=bool)
    seed = np.bincount(start).argmax()
    known[seed], axes[seed] = True, lines[seed]
    while True:
        new = np.flatnonzero(known[start] & ~known[end])
        if len(new) == 0:
            break
        _, once = np.unique(end[new], return_index=True)
        new = new[once]
        i, j = start[new], end[new]
        # Axis 0 of the grid follows the first edge of every second corner and the second of the others.
        axis = (first[new] == swapped[i]).astype(np.intp)
        direction = np.sign(np.sum(axes[i, axis] * step[new], axis=1)).astype(np.int64)
        cell[j] = cell[i]
        cell[j, axis] += direction
        swapped[j] = ~swapped[i]
        own = np.where(swapped[j, None, None], lines[j][:, ::-1], lines[j])
        axes[j] = own * np.sign(np.sum(own * axes[i], axis=2, keepdims=True))
        known[j] = True
    members = np.flatnonzero(known)
    place = cell[members] - cell[members].min(axis=0)
    columns, rows = place.max(axis=0) + 1
    flat = place[:, 1] * columns + place[:, 0]
    grid = np.full(rows * columns, -1, dtype=np.intp)
    grid[flat] = members
    grid[np.bincount(flat, minlength=rows * columns) > 1] = -1  # two corners claim one cell: neither is sure
    return grid.reshape(rows, columns), bool(swapped[members[0]] ^ (place[0].sum() % 2 == 1))


def predict(grid: Array) -> tuple[Array, Array]:
    """Where each corner of a grid should be, judged by the others alone.

    Parameters
    ----------
    grid : (R, C, 2)
        Pixels, NaN where unknown.

    Returns
    -------
    prediction : (R, C, 2)
        Mean of what rows and columns say: the middle of two neighbours where there are two, else the
        straight continuation of two on one side. NaN where neither is known.
    spacing : (R, C)
        Distance to the nearest of the neighbours used, pixels; NaN where there is no prediction.
    """
    rows, columns = grid.shape[:2]
    wide = np.full((rows + 4, columns + 4, 2), np.nan)
    wide[2:-2, 2:-2] = grid

    def at(dy: int, dx: int) -> Array:
        return wide[2 + dy : 2 + dy + rows, 2 + dx : 2 + dx + columns]

    guesses, spacings = [], []
    for dy, dx in ((0, 1), (1, 0)):
        before, after = at(-dy, -dx), at(dy, dx)
        middle = (before + after) / 2
        on, back = 2 * after - at(2 * dy, 2 * dx), 2 * before - at(-2 * dy, -2 * dx)
        guess = np.where(np.isfinite(middle), middle, np.where(np.isfinite(on), on, back))
        guesses.append(guess)
        spacings += [np.hypot(*np.moveaxis(near - guess, -1, 0)) for near in (before, after)]
    # An outer corner of an L: three corners of a square give the fourth.
    corner = np.stack([at(dy, 0) + at(0, dx) - at(dy, dx) for dy in (-1, 1) for dx in (-1, 1)])
    either = _mean(np.stack(guesses))
    prediction = np.where(np.isfinite(either), either, _mean(corner))
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        spacings.append(np.hypot(*np.moveaxis(at(dy, dx) - prediction, -1, 0)))
    spacing = np.fmin.reduce(np.stack(spacings))
    return prediction, spacing


def fill_gaps(grid: Array) -> Array:
    """Put predictions where corners are unknown, from the rim of each gap inwards; (R, C, 2) pixels."""
    while np.isnan(grid).any():
        prediction, _ = predict(grid)
        filled = np.where(np.isfinite(grid), grid, prediction)
        if np.isnan(filled).sum() == np.isnan(grid).sum():
            break
        grid = filled
    return grid


def _mean(values: Array) -> Array:
    """Mean over the first axis of the values that are known."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    total = np.where(known, values, 0).sum(axis=0)
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1), np.nan))


def _grow(grid: Indices, swapped: bool, saddles: SaddlePoints) -> Indices:
    """Fill gaps and add rings of corners where the grid predicts them and a candidate fits."""
    from scipy.spatial import cKDTree

    tree = cKDTree(saddles.points)
    for _ in range(MAX_RINGS):
        wide = np.pad(grid, 1, constant_values=-1)
        # The rim moves cell (0, 0) by a diagonal step, to a corner of the same kind.
        points = np.where((wide >= 0)[..., None], saddles.points[wide], np.nan)
        prediction, spacing = predict(points)
        rows, columns = np.nonzero((wide < 0) & np.isfinite(prediction[..., 0]))
        distance, nearest = (np.asarray(part) for part in tree.query(prediction[rows, columns]))
        found = (distance < SNAP_SHARE * spacing[rows, columns]) & ~np.isin(nearest, grid)
        found &= _right_way_round(points, rows, columns, saddles.edges[nearest], swapped)
        rows, columns, nearest = rows[found], columns[found], nearest[found]
        _, once = np.unique(nearest, return_index=True)
        if len(once) == 0:
            break
        wide[rows[once], columns[once]] = nearest[once]
        grid, swapped = _crop(wide, swapped)
    return grid


def _right_way_round(
    points: Array, rows: Indices, columns: Indices, edges: Array, swapped: bool
) -> NDArray[np.bool_]:
    """Whether the first edge of each candidate runs along the row or the column as its place demands."""
    angles = []
    for axes in local_axes(points):
        mean = _mean(axes.reshape(-1, 2))
        own = _mean(
            np.stack(
                [
                    axes[np.clip(rows + dy, 0, len(axes) - 1), np.clip(columns + dx, 0, axes.shape[1] - 1)]
                    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0))
                ]
            )
        )
        own = np.where(np.isfinite(own), own, mean)
        angles.append(np.arctan2(own[:, 1], own[:, 0]))
    along_row, along_column = angles
    upright = turn(edges[:, 0] - along_row) + turn(edges[:, 1] - along_column)
    turned = turn(edges[:, 0] - along_column) + turn(edges[:, 1] - along_row)
    return np.asarray((turned < upright) == (((rows + columns) % 2 == 1) ^ swapped))


def local_axes(grid: Array) -> tuple[Array, Array]:
    """Steps to the next column and to the next row at each corner.

    Parameters
    ----------
    grid : (R, C, 2)
        Pixels, NaN where unknown.

    Returns
    -------
    across, down : (R, C, 2)
        Pixels per square, from the neighbours on both sides or on one; NaN without neighbours.
    """
    steps = []
    for axis in (1, 0):
        gap = np.diff(grid, axis=axis)
        edge = np.full_like(np.take(grid, [0], axis=axis), np.nan)
        after = np.concatenate([gap, edge], axis=axis)
        before = np.concatenate([edge, gap], axis=axis)
        steps.append(_mean(np.stack([before, after])))
    return steps[0], steps[1]


def square_size(grid: Array) -> float:
    """Median length, pixels, of the shorter side of the squares of a grid (R, C, 2), NaN where unknown."""
    across, down = (np.linalg.norm(axes, axis=2) for axes in local_axes(grid))
    return float(np.nanmedian(np.fmin(across, down)))


def _crop(grid: Indices, swapped: bool) -> tuple[Indices, bool]:
    """Drop empty rows and columns at the rim."""
    rows, columns = np.flatnonzero((grid >= 0).any(axis=1)), np.flatnonzero((grid >= 0).any(axis=0))
    moved = bool((rows[0] + columns[0]) % 2)
    return grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1], swapped ^ moved


def _trim(image: Image, grid: Array) -> Array:
    """Drop rim rows and columns where no squares meet.

    Beyond the board a narrow margin with something dark behind it shows a saddle at the end of every edge,
    but on the far side of such a row dark and bright do not alternate.
    """
    known, meet = _squares_meet(image, grid)
    while min(known.shape) > 1:
        shares = [_rim_share(known[rim], meet[rim]) for rim in _RIMS]
        worst = int(np.argmin(shares))
        if shares[worst] > MIN_RIM_SHARE:
            break
        kept = _WITHOUT_RIM[worst]
        grid, known, meet = grid[kept], known[kept], meet[kept]
    return grid


def _rim_share(known: NDArray[np.bool_], meet: NDArray[np.bool_]) -> float:
    """Share of the known corners of a rim at which squares meet; 0 when too few are known to tell."""
    return float(meet.sum() / known.sum()) if known.mean() > MIN_KNOWN_SHARE else 0.0


def _squares_meet(image: Image, grid: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which corners are known, and at which of them two dark and two bright squares meet crosswise."""
    known, dark, bright, contrast = _quadrants(image, grid)
    return known, known & (bright - dark > EDGE_CONTRAST * contrast)


def squares_meet_in_shadow(image: Image, grid: Array) -> NDArray[np.bool_]:
    """Which corners (R, C) of a grid two dark and two bright squares meet at, if need be half in a shadow."""
    known, dark, bright, _ = _quadrants(image, grid)
    return known & (bright - dark > EDGE_CONTRAST * bright)


def _quadrants(image: Image, grid: Array) -> tuple[NDArray[np.bool_], Array, Array, Array]:
    """Squares about each corner (R, C).

    Returns
    -------
    known : (R, C)
        Whether the corner and enough of its neighbours are known.
    dark, bright : (R, C)
        Brighter one of the two opposite squares that are darker, and darker one of the two others; grey
        levels.
    contrast : (R, C)
        From the darkest to the brightest of the four.
    """
    across, down = (QUADRANT_SHARE * axes for axes in local_axes(grid))
    known = np.asarray(np.isfinite(grid + across + down).all(axis=2))
    quadrants = np.stack(
        [grid + across + down, grid - across - down, grid + across - down, grid - across + down]
    )
    values = sample(image, np.where(known[..., None], quadrants, 0))
    one, other = values[:2], values[2:]
    first_bright = one.sum(axis=0) > other.sum(axis=0)
    bright = np.where(first_bright, one.min(axis=0), other.min(axis=0))
    dark = np.where(first_bright, other.max(axis=0), one.max(axis=0))
    return known, dark, bright, np.ptp(values, axis=0)
