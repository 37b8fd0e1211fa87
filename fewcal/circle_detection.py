"""Find a circle grid in an image, and say why when there is none to use.

    image -> reduced copies, coarse to fine -> blobs -> lattice -> ellipses -> centres of the circles -> View

The order of the points is that of the board's ``points``, and it is always the same for the same view:

- x cross y points away from the camera: the board is never mirrored.
- Of the turns in which the pattern fits, the first circle is the one nearest to the top left corner of the
  image, measured as u + v. An asymmetric grid with an odd number of rows (4x11) fits in one turn only; all
  other grids look the same turned by half, square ones by a quarter.

In a mirror most grids look the same, and are found; asymmetric ones with an even number of rows do not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .blob_lattice import crop, find_lattices
from .blobs import Blobs, find_blobs
from .circle_bias import circle_centres
from .detection import EDGE_WIDTH_PER_BLUR, MAX_EDGE_SHARE, Detection, outside
from .disc_refinement import Ellipses, refine_discs
from .errors import BoardNotFound
from .grey import GreyImage
from .grid import fill_gaps, local_axes, predict
from .planarity import plane_residuals
from .reduction import SEARCHED_PX, reduce, reductions
from .views import View

if TYPE_CHECKING:
    from .circle_grid import Circles

Array = NDArray[np.float64]
Indices = NDArray[np.intp]
Pattern = NDArray[np.bool_]

SMALL_RADIUS_PX = 4.0
"""Circles smaller than this in one copy are shown better by the next; larger ones gain nothing."""
ROUGH_RADIUS_PX = 8.0
"""Larger circles are first located in a reduced copy, where they have half to all of that radius."""
BAND_BLURS, BAND_MARGIN_PX = 3.0, 1.5
"""Pixels to either side of the edge that then locate them, in sd of its blur and in addition."""
MIN_KNOWN_SHARE = 0.75
"""Share of the circles that must be seen as blobs; the others are then located where these predict them."""
MIN_RIM_SHARE = 0.3
"""Share of an outer row that must be there before it counts as part of the grid."""
MIN_CLAIMED = 12
"""Circles that a grid of another size must have before it is called a board: texture often lines up."""
_ATTEMPTS = 3
"""Rounds of looking again for circles that were wrong."""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Approximate circles of a whole board, in the order of its points: pixels (N, 2) and px^2 (N, 2, 2)."""

    points: Array
    covariances: Array

    @cached_property
    def reach(self) -> float:
        """Half the distance between neighbours, in radii: median over the board."""
        step = self.points - self.points[:, None]
        radii = np.sqrt(np.einsum("mni,mij,mnj->mn", step, np.linalg.inv(4 * self.covariances), step))
        np.fill_diagonal(radii, np.inf)
        return float(np.median(radii.min(axis=1))) / 2

    @cached_property
    def radii(self) -> Array:
        """Smaller and larger semi-axes (N, 2), pixels."""
        return np.asarray(2 * np.sqrt(np.linalg.eigvalsh(self.covariances)))


def detect_circles(
    grey: GreyImage, board: Circles, source: str = "", stamp_ns: int | None = None
) -> Detection:
    """Find a whole circle grid, see :meth:`fewcal.Board.detect`."""
    pattern = board.pattern
    plane = np.argwhere(pattern)[:, ::-1].astype(np.float64)
    ellipses = _find_ellipses(grey, pattern, plane)
    points, _ = circle_centres(plane, ellipses.points, ellipses.covariances, grey.shape)
    sigma = np.hypot(ellipses.sigma, ellipses.covered)
    view = View(board.points, points, sigma, source, stamp_ns)
    found = _Grid(ellipses.points, ellipses.covariances)
    spacing = 2 * found.reach * float(np.median(found.radii[:, 0]))
    return Detection(view, EDGE_WIDTH_PER_BLUR * float(np.median(ellipses.blur)), spacing)


def _find_ellipses(grey: GreyImage, pattern: Pattern, plane: Array) -> Ellipses:
    """Locate the first lattice of the board's pattern that stands all tests, coarse to fine."""
    largest = np.empty((0, 0, 2))
    small = False
    failure: BoardNotFound | None = None
    for factor in reductions(grey):
        if max(grey.shape) / factor > SEARCHED_PX and not small:
            break
        blobs = _scaled(find_blobs(reduce(grey, factor)), factor)
        for lattice in find_lattices(blobs):
            known = lattice >= 0
            areas = np.linalg.det(blobs.covariances[lattice[known]])
            small |= bool(np.median(areas) < (SMALL_RADIUS_PX * factor / 2) ** 4)
            grid = _place(lattice, blobs, pattern)
            if grid is not None:
                try:
                    return _locate(grey, grid, plane)
                except BoardNotFound as error:
                    failure = failure or error
            elif known.sum() > np.isfinite(largest[..., 0]).sum():
                largest = np.where(known[..., None], blobs.points[lattice], np.nan)
    raise failure or _not_found(grey, largest, pattern)


def _scaled(blobs: Blobs, factor: float) -> Blobs:
    """Blobs of a reduced copy, at full resolution."""
    return Blobs((blobs.points + 0.5) * factor - 0.5, blobs.covariances * factor**2)


def _place(lattice: Indices, blobs: Blobs, pattern: Pattern) -> _Grid | None:
    """Give the circles of a board whose pattern the lattice shows, or None when it shows another."""
    if not pattern.all():
        lattice = _turned_by_an_eighth(lattice)
    lattice = _trim(lattice, MIN_RIM_SHARE * float(pattern.mean()))
    turns = [np.rot90(lattice, k) for k in range(4)]
    fitting = [turn for turn in turns if turn.shape == pattern.shape and not ((turn >= 0) & ~pattern).any()]
    if not fitting or (lattice >= 0).sum() < MIN_KNOWN_SHARE * pattern.sum():
        return None
    grids = [fill_gaps(np.where((turn >= 0)[..., None], blobs.points[turn], np.nan)) for turn in fitting]
    first = min(range(len(grids)), key=lambda k: float(grids[k][0, 0].sum()))
    grid, index = grids[first], fitting[first][pattern]
    if not np.isfinite(grid[pattern]).all():
        return None
    # Each circle is seen as the cell about it is, and all of them fill the same share of their cells.
    cells = np.stack(local_axes(grid), axis=-1)[pattern]
    shapes = cells @ np.swapaxes(cells, 1, 2)
    known, found = index >= 0, blobs.covariances[index]
    share = np.median(np.sqrt(np.linalg.det(found[known]) / np.linalg.det(shapes[known])))
    return _Grid(grid[pattern], np.where(known[:, None, None], found, share * shapes))


def _turned_by_an_eighth(lattice: Indices) -> Indices:
    """Lay a lattice along the diagonals of its own: every second cell is then used."""
    rows, columns = np.nonzero(lattice >= 0)
    x, y = columns - rows, columns + rows
    turned = np.full((np.ptp(y) + 1, np.ptp(x) + 1), -1, dtype=np.intp)
    turned[y - y.min(), x - x.min()] = lattice[rows, columns]
    return turned


def _trim(lattice: Indices, least: float) -> Indices:
    """Drop rows and columns at the rim of which less than a share is known: marks beside the board."""
    while True:
        known = lattice >= 0
        rows, columns = known.mean(axis=1) > least, known.mean(axis=0) > least
        if not rows.any() or not columns.any() or (rows[[0, -1]].all() and columns[[0, -1]].all()):
            return lattice
        kept = crop(lattice, rows[:, None] & columns)
        if kept.shape == lattice.shape:
            return lattice
        lattice = kept


def _locate(grey: GreyImage, grid: _Grid, plane: Array) -> Ellipses:
    """Ellipses at the scale that suits them; those that fail are looked for where the others put them."""
    if outside(grey.shape, grid.points, 0):
        raise _beyond_border()
    for _ in range(_ATTEMPTS):
        ellipses = _refine(grey, grid)
        spacing = 2 * grid.reach * grid.radii[:, 0]
        residuals, allowed, outlying = plane_residuals(
            plane, ellipses.points, spacing, ellipses.sigma, grey.shape
        )
        misplaced = np.linalg.norm(residuals, axis=1) > allowed
        bad = misplaced | ~ellipses.good
        if not bad.any():
            break
        grid = _Grid(np.where(bad[:, None], ellipses.points - residuals, ellipses.points), grid.covariances)
    _check(grey, grid, ellipses, misplaced)
    return replace(ellipses, covered=np.hypot(ellipses.covered, outlying))


def _check(grey: GreyImage, grid: _Grid, ellipses: Ellipses, misplaced: NDArray[np.bool_]) -> None:
    """Refuse a board of which not every circle is known to be right."""
    width = EDGE_WIDTH_PER_BLUR * float(np.median(ellipses.blur))
    across = 2 * float(np.median(grid.radii[:, 0]))
    if width > MAX_EDGE_SHARE * across:
        raise BoardNotFound(
            "blurred",
            f"The edges of the circles are {width:.1f} px wide and the circles {across:.1f} px; hold the "
            "board still, or focus.",
        )
    seen = ellipses.good & ~misplaced
    points = np.where(seen[:, None], ellipses.points, grid.points)
    extent = 2 * np.sqrt(
        np.where(seen[:, None, None], ellipses.covariances, grid.covariances)[:, [0, 1], [0, 1]]
    )
    if outside(grey.shape, np.concatenate([points - extent, points + extent]), 0):
        raise _beyond_border()
    if not ellipses.good.all():
        raise BoardNotFound(
            "cut off",
            f"{int((~ellipses.good).sum())} of the {len(misplaced)} circles cannot be seen, or are unlike "
            "the others; uncover the whole board, keep reflections off it, and print all circles alike.",
        )
    if misplaced.any():
        raise BoardNotFound(
            "not planar",
            f"{int(misplaced.sum())} of the {len(misplaced)} circles are not where a flat board would show "
            "them; hold the board flat and free of reflections.",
        )


def _beyond_border() -> BoardNotFound:
    return BoardNotFound(
        "cut off", "Part of the board is beyond the border of the image; bring the whole board into it."
    )


def _refine(grey: GreyImage, grid: _Grid) -> Ellipses:
    """Fit the ellipses: large ones roughly in a reduced copy first, and then to the pixels at their edges."""
    factor = 1
    while float(np.median(grid.radii[:, 1])) > ROUGH_RADIUS_PX * factor:
        factor *= 2
    rough = _refine_reduced(grey, grid, factor)
    if factor == 1:
        return rough
    points = np.where(rough.good[:, None], rough.points, grid.points)
    covariances = np.where(rough.good[:, None, None], rough.covariances, grid.covariances)
    band_px = BAND_BLURS * float(np.median(rough.blur)) + BAND_MARGIN_PX
    fine = refine_discs(grey, points, covariances, grid.reach, band_px)
    return replace(fine, good=rough.good & fine.good)


def _refine_reduced(grey: GreyImage, grid: _Grid, factor: int) -> Ellipses:
    """Fit the ellipses in a reduced copy of the image; the answer is at full resolution."""
    found = refine_discs(
        reduce(grey, factor),
        (grid.points + 0.5) / factor - 0.5,
        grid.covariances / factor**2,
        grid.reach,
        rough=factor > 1,
    )
    return Ellipses(
        (found.points + 0.5) * factor - 0.5,
        found.covariances * factor**2,
        found.sigma * factor,
        found.covered * factor,
        found.blur * factor,
        found.good,
    )


def _not_found(grey: GreyImage, lattice: Array, pattern: Pattern) -> BoardNotFound:
    """Say why the largest lattice (A, B, 2) of the image is not the board."""
    count, asked = int(np.isfinite(lattice[..., 0]).sum()), int(pattern.sum())
    if count < MIN_CLAIMED:
        return BoardNotFound(
            "no board", "No circle grid is to be seen; show it whole, well lit, black circles on white."
        )
    wide = np.pad(lattice, ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
    beyond, _ = predict(wide)
    if count < asked and outside(grey.shape, beyond, 0):
        return BoardNotFound(
            "cut off", f"Only {count} of the {asked} circles are in the image; bring the whole board into it."
        )
    return BoardNotFound(
        "wrong size",
        f"Found a grid of {count} circles that is not the one of {asked} asked for; give kind (circles or "
        "acircles), columns and rows of the board that is shown, and show it uncovered and sharp.",
    )
