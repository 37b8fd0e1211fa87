"""What a board looks like on paper: black on white, in metres of the board frame.

Everything that shows a board comes from its drawing: the sheet that is printed and the images that are
rendered. x runs to the right and y down when the printed side is looked at, as in an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Drawing:
    """Black shapes on white paper.

    Parameters
    ----------
    polygons : sequence of (K, 2) arrays
        Outlines, metres, their edges in turn along x and along y: squares, bits of markers. They may touch
        but not overlap.
    discs : (M, 3) array
        Centre x, y and radius of each, metres. They may not overlap.
    extent : (float, float, float, float)
        Least x, least y, largest x, largest y of the board with the white margin that it needs, metres.
    caption : str
        The lengths that a ruler can check on the print, such as ``square 25 mm``.
    """

    polygons: Sequence[Array]
    discs: Array
    extent: tuple[float, float, float, float]
    caption: str = ""

    @property
    def size(self) -> tuple[float, float]:
        """Width and height with the margin, metres."""
        left, top, right, bottom = self.extent
        return right - left, bottom - top

    @cached_property
    def ink(self) -> tuple[float, float, float, float]:
        """Bounds of what is black, as `extent` gives those of the board."""
        centre, radius = self.discs[:, :2], self.discs[:, 2:]
        corners = np.concatenate([*self.polygons, centre - radius, centre + radius])
        (left, top), (right, bottom) = corners.min(axis=0), corners.max(axis=0)
        return float(left), float(top), float(right), float(bottom)

    def moved(self, x: float, y: float) -> Drawing:
        """Give the same drawing with the origin of the board at (x, y), metres."""
        left, top, right, bottom = self.extent
        extent = (left + x, top + y, right + x, bottom + y)
        polygons = [polygon + np.array([x, y]) for polygon in self.polygons]
        return Drawing(polygons, self.discs + np.array([x, y, 0.0]), extent, self.caption)

    def is_black(self, samples: ArrayLike) -> NDArray[np.bool_]:
        """Whether points are black.

        Parameters
        ----------
        samples : array_like, (..., S, 2)
            Metres. The S points of a set must be closer together than two discs are.

        Returns
        -------
        (..., S) bool.
        """
        samples = np.asarray(samples, dtype=np.float64)
        x, y, table = self._cells
        column, row = np.searchsorted(x, samples[..., 0]), np.searchsorted(y, samples[..., 1])
        black = table[row, column]
        if len(self.discs):
            nearest = self.discs[self._tree.query(samples.mean(axis=-2))[1]][..., None, :]
            black |= ((samples - nearest[..., :2]) ** 2).sum(axis=-1) < nearest[..., 2] ** 2
        return black

    def may_change(self, centres: ArrayLike, reach: ArrayLike) -> NDArray[np.bool_]:
        """Whether black may turn to white within reach of points; where not, a point tells the whole.

        Parameters
        ----------
        centres : array_like, (..., 2)
            Metres.
        reach : array_like, (..., 2)
            Half the width and half the height of a box about each, metres.
        """
        centres, reach = np.asarray(centres), np.asarray(reach)
        x, y, _ = self._cells
        change = np.zeros(centres.shape[:-1], dtype=bool)
        for axis, edges in enumerate((x, y)):
            low, high = (centres[..., axis] + sign * reach[..., axis] for sign in (-1, 1))
            change |= np.searchsorted(edges, low) != np.searchsorted(edges, high)
        if len(self.discs):
            distance, index = self._tree.query(centres)
            change |= np.abs(distance - self.discs[index, 2]) <= np.linalg.norm(reach, axis=-1)
        return change

    def coverage(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Share of black in the pixels of a raster.

        Parameters
        ----------
        x, y : array_like, (W + 1,) and (H + 1,)
            Borders of the columns and rows, ascending, metres.

        Returns
        -------
        (H, W) from 0 to 1. Exact for polygons; a disc's edge is taken for straight within a pixel.
        """
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        x_edges, y_edges, table = self._cells
        inner = table[1:-1, 1:-1].astype(np.float64)  # what lies outside of all polygons is white
        share = _overlap(y, y_edges) @ inner @ _overlap(x, x_edges).T
        pixel = (x[-1] - x[0]) / (len(x) - 1)
        mid_x, mid_y = (edges[:-1] + np.diff(edges) / 2 for edges in (x, y))
        for centre_x, centre_y, radius in self.discs:
            columns, rows = (
                slice(*np.searchsorted(edges, (centre - radius - pixel, centre + radius + pixel)))
                for edges, centre in ((x, centre_x), (y, centre_y))
            )
            distance = np.hypot(mid_x[columns] - centre_x, mid_y[rows, None] - centre_y)
            share[rows, columns] += np.clip(0.5 + (radius - distance) / pixel, 0, 1)
        return share

    @cached_property
    def _cells(self) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Lines x (X,) and y (Y,) on which all edges lie, and which cells between them are black.

        The table has shape (Y + 1, X + 1): cell (i, j) lies before line i in y and before line j in x.
        """
        corners = np.concatenate([*self.polygons, np.empty((0, 2))])
        x, y = _lines(corners[:, 0]), _lines(corners[:, 1])
        if len(corners) == 0:
            return x, y, np.zeros((1, 1), dtype=bool)
        # Of the function that is 1 inside, the derivative by x and y is a peak at each corner, its sign in
        # turn + and - along the outline; summed up over x and y the peaks give the function back.
        peaks = np.zeros((len(y) + 1, len(x) + 1), dtype=np.int8)
        signs = np.concatenate([_turns(polygon) for polygon in self.polygons])
        np.add.at(peaks, (_index(y, corners[:, 1]) + 1, _index(x, corners[:, 0]) + 1), signs)
        return x, y, peaks.cumsum(axis=0).cumsum(axis=1) != 0

    @cached_property
    def _tree(self) -> cKDTree:
        # Imported here, since it takes longer than all of fewcal, and few programs draw discs.
        from scipy.spatial import cKDTree

        return cKDTree(self.discs[:, :2])


def rectangles(lower: ArrayLike, upper: ArrayLike) -> list[Array]:
    """Outlines (4, 2) of rectangles, given their least and their largest x and y.

    Parameters
    ----------
    lower, upper : array_like, (N, 2) and (N, 2) or (2,)
        Metres.
    """
    low, high = np.broadcast_arrays(np.asarray(lower, dtype=np.float64), np.asarray(upper, dtype=np.float64))
    x, y = np.stack([low[:, 0], high[:, 0]]), np.stack([low[:, 1], high[:, 1]])
    return list(np.stack([x[[0, 1, 1, 0]], y[[0, 0, 1, 1]]], axis=-1).transpose(1, 0, 2))


def cells(black: ArrayLike, left: float, top: float, edge: float) -> list[Array]:
    """Outlines of the black cells of a square grid.

    Parameters
    ----------
    black : array_like, (R, C) of bool
        Which cells are black, row by row downwards.
    left, top : float
        Where the first cell begins, metres.
    edge : float
        Of a cell, metres.
    """
    row, column = np.nonzero(np.asarray(black))
    # From the grid's lines and not each from its own corner, so that neighbours meet exactly.
    at = np.stack([column, row], axis=1)
    return rectangles(at * edge + (left, top), (at + 1) * edge + (left, top))


_MERGED_M = 1e-9
"""Lines closer than this are one: no print is as fine, and sums of lengths are rounded."""


def _lines(values: Array) -> Array:
    ordered = np.unique(values)
    apart = np.append(True, np.diff(ordered) > _MERGED_M)
    return np.asarray(ordered[apart[: len(ordered)]])


def _index(lines: Array, values: Array) -> NDArray[np.intp]:
    """Index of the line on which each value lies."""
    return np.searchsorted(lines, values + _MERGED_M, side="right") - 1


def _turns(polygon: Array) -> NDArray[np.int8]:
    """Sign of each corner: in turn, and the same for outlines drawn either way round."""
    x, y = polygon.T
    area = x @ np.roll(y, -1) - y @ np.roll(x, -1)
    first_along_x = abs(x[1] - x[0]) > abs(y[1] - y[0])
    sign = 1 if (area > 0) == first_along_x else -1
    return np.tile(np.array([sign, -sign], dtype=np.int8), len(polygon) // 2)


def _overlap(borders: Array, lines: Array) -> Array:
    """Share of each pixel (P,) that lies between each two neighbouring lines, (P, L - 1)."""
    below = np.clip((lines - borders[:-1, None]) / np.diff(borders)[:, None], 0, 1)
    return np.asarray(np.diff(below, axis=1))
