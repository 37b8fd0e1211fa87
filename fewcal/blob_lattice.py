"""From loose blobs to the lattice of a circle grid, of whatever size it has.

The ellipse that a disc is seen as tells the perspective about it: measured in radii of the ellipse, the
nearest neighbours of a disc are equally far in four directions at right angles, however the board is tilted.
A disc with four such neighbours is where a lattice begins; it grows as long as its discs predict further ones
and a blob is there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .blobs import Blobs
from .grid import predict

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

NEAREST = 14
"""Blobs looked at around each one: foreshortened by half, the fourth neighbour of a disc is the tenth."""
NEIGHBOUR_RADII = (2.0, 9.0)
"""Distance of the nearest neighbour in radii: discs touch at 2; a diagonal neighbour on a grid whose
spacing is 6 radii is at 8.5."""
NEIGHBOUR_RATIO = 1.25
"""Largest ratio of the distances to two of the four neighbours; to a diagonal one it is 1.41."""
MAX_AREA_RATIO = 2.5
"""Largest ratio of the areas of two neighbours: perspective at its worst gives half of it."""
MAX_OFF_LINE = 0.3
"""How far a disc may be from the middle of two opposite neighbours, as a share of the distance to them."""
SNAP_SHARE = 0.3
"""A further disc is sought this far from its prediction, as a share of the distance to its neighbours."""
MAX_LATTICES = 3
"""Lattices that are grown."""
MAX_RINGS = 200
"""Rounds of growing; each adds at least one disc, so this only bounds a board of unusual size."""


def find_lattices(blobs: Blobs) -> list[Indices]:
    """Arrange blobs in lattices.

    Returns
    -------
    list of (A, B) arrays, the one of most blobs first: index of the blob in each cell, -1 for none. The step
    to the next row and that to the next column are those to the nearest neighbours, the step to the next
    column turned towards that to the next row as x is towards y.
    """
    from scipy.spatial import cKDTree

    if len(blobs.points) < 5:
        return []
    tree = cKDTree(blobs.points)
    seeds = _crosses(blobs, tree)
    lattices: list[Indices] = []
    taken = np.zeros(len(blobs.points), dtype=bool)
    for seed in seeds:
        if len(lattices) == MAX_LATTICES:
            break
        if not taken[seed[seed >= 0]].any():
            lattices.append(_grow(seed, blobs, tree))
            taken[lattices[-1][lattices[-1] >= 0]] = True
    return sorted(lattices, key=lambda lattice: -int((lattice >= 0).sum()))


def _crosses(blobs: Blobs, tree: cKDTree) -> Indices:
    """Blobs with four neighbours: (K, 3, 3) indices, -1 in the corners, the most regular first."""
    points, count = blobs.points, min(NEAREST + 1, len(blobs.points))
    near = np.asarray(tree.query(points, k=count)[1], dtype=np.intp)[:, 1:]
    step = points[near] - points[:, None]
    shape = (blobs.covariances[:, None] + blobs.covariances[near]) / 2
    radii = np.sqrt(np.einsum("nki,nkij,nkj->nk", step, np.linalg.inv(4 * shape), step))
    area = np.sqrt(np.linalg.det(blobs.covariances))
    alike = np.abs(np.log(area[near] / area[:, None])) < np.log(MAX_AREA_RATIO)
    radii = np.where(alike & (radii > NEIGHBOUR_RADII[0] * 0.9), radii, np.inf)
    order = np.argsort(radii, axis=1)[:, :5]
    distance = np.take_along_axis(radii, order, 1)
    four = np.take_along_axis(near, order[:, :4], 1)
    found = (distance[:, 3] < NEIGHBOUR_RATIO * distance[:, 0]) & (distance[:, 0] < NEIGHBOUR_RADII[1])
    if distance.shape[1] > 4:
        found &= distance[:, 4] > distance[:, 3] * 1.1
    own, four = np.flatnonzero(found), four[found]
    step = np.take_along_axis(step[found], order[found, :4, None], 1)
    # Turning from x to y, the first and the third are opposite, and so are the second and the fourth.
    turn = np.argsort(np.arctan2(step[..., 1], step[..., 0]), axis=1)
    four, step = np.take_along_axis(four, turn, 1), np.take_along_axis(step, turn[..., None], 1)
    across, off = step[:, :2] - step[:, 2:], step[:, :2] + step[:, 2:]
    worst = 2 * (np.linalg.norm(off, axis=2) / np.linalg.norm(across, axis=2)).max(axis=1)
    kept = np.flatnonzero(worst < MAX_OFF_LINE)
    kept = kept[np.argsort(worst[kept], kind="stable")]
    crosses = np.full((len(kept), 3, 3), -1, dtype=np.intp)
    crosses[:, 1, 1] = own[kept]
    crosses[:, [1, 2, 1, 0], [2, 1, 0, 1]] = four[kept]
    return crosses


def _grow(lattice: Indices, blobs: Blobs, tree: cKDTree) -> Indices:
    """Add rings of blobs where the lattice predicts them."""
    area = np.sqrt(np.linalg.det(blobs.covariances))
    free = np.ones(len(area), dtype=bool)
    free[lattice[lattice >= 0]] = False
    for _ in range(MAX_RINGS):
        wide = np.pad(lattice, 1, constant_values=-1)
        prediction, spacing = predict(np.where((wide >= 0)[..., None], blobs.points[wide], np.nan))
        rows, columns = np.nonzero((wide < 0) & np.isfinite(prediction[..., 0]))
        distance, nearest = (np.asarray(part) for part in tree.query(prediction[rows, columns]))
        least, most = area[~free].min() / MAX_AREA_RATIO, area[~free].max() * MAX_AREA_RATIO
        found = (distance < SNAP_SHARE * spacing[rows, columns]) & free[nearest]
        found &= (area[nearest] > least) & (area[nearest] < most)
        rows, columns, nearest = rows[found], columns[found], nearest[found]
        _, once = np.unique(nearest, return_index=True)
        if len(once) == 0:
            break
        wide[rows[once], columns[once]] = nearest[once]
        free[nearest] = False
        lattice = crop(wide, wide >= 0)
    return lattice


def crop(lattice: Indices, known: NDArray[np.bool_]) -> Indices:
    """Drop rows and columns at the rim where nothing is known."""
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    return lattice[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
