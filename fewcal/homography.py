"""The homography from the board's plane to the image (paper section 4.1.1).

First the normalised direct linear transform (Hartley and Zisserman, algorithm 4.2), then, where asked, the
paper's weighted refinement (eq 15), which lets the points that distortion moves most count less. Every
function takes all views at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import DegenerateViews
from .least_squares import NormalEquations, minimise

Array = NDArray[np.float64]

DISTANCE_OFFSET_PX = 1.0
"""The constant c of eq 15, pixels, as in the paper's experiments (section 5)."""
COLLINEAR = 1e-4
"""Ratio of the board's two extents below which its points lie on a line for every practical purpose."""

UNDETERMINED = 1e-10
"""Ratio of the second smallest singular value to the largest at which more than one homography fits."""


def homographies(board_points: Array, image_points: Array, weights: Array) -> Array:
    """Normalised direct linear transform.

    Parameters
    ----------
    board_points : (..., 2, N)
        In the board's plane, metres.
    image_points : (..., 2, N)
        Pixels.
    weights : (..., N)
        Weight of each point; 0 leaves it out, so that views of different length share one array.

    Returns
    -------
    (..., 3, 3) scaled so that the board's centroid has a positive third coordinate of 1.

    Raises
    ------
    DegenerateViews
        When a view has fewer than four points, or no four of which no three are collinear.
    """
    (source, target), back = _normalise(np.stack([board_points, image_points]), weights)
    rows = np.zeros((*weights.shape[:-1], 9, 2, weights.shape[-1]))
    rows[..., 0:2, 0, :] = rows[..., 3:5, 1, :] = source
    rows[..., 2, 0, :] = rows[..., 5, 1, :] = 1
    rows[..., 6:8, :, :] = -source[..., :, None, :] * target[..., None, :, :]
    rows[..., 8, :, :] = -target
    rows *= weights[..., None, None, :]
    rows = np.swapaxes(rows.reshape(*rows.shape[:-2], -1), -1, -2)
    _, size, vt = np.linalg.svd(np.linalg.qr(rows, mode="r"))
    if (size[..., 7] <= UNDETERMINED * size[..., 0]).any():
        raise DegenerateViews(
            "The points of a view leave open how the board lies: all but one are on one line; give four of "
            "which no three are."
        )
    H = vt[..., 8, :].reshape(*vt.shape[:-2], 3, 3)
    # In normalised coordinates the centroid is the origin and is finite, so that h33 is not zero.
    H = H / H[..., 2:, 2:]
    return _denormalise(H, *back)


def refine_homographies(
    H: Array, board_points: Array, image_points: Array, weights: Array, principal_point: Array
) -> Array:
    """Minimise sum |m - m'|^2 / (c + r), r the distance of m from the principal point (paper eq 15).

    Parameters
    ----------
    H : (B, 3, 3)
        Where to start.
    board_points, image_points : (B, 2, N)
        Metres and pixels.
    weights : (B, N)
        0 leaves a point out.
    principal_point : (2,) or (B, 2)
        Pixels; the image centre at this stage of the paper.

    Returns
    -------
    (B, 3, 3)
    """
    offset = image_points - np.broadcast_to(principal_point, (len(H), 2))[..., None]
    radius = np.hypot(offset[:, 0], offset[:, 1])
    (source, target), (from_source, from_target) = _normalise(np.stack([board_points, image_points]), weights)
    size = from_target[:, None, 0, 0]  # pixels per unit of the normalised image
    problem = _HomographyProblem(source, target, weights * size / np.sqrt(DISTANCE_OFFSET_PX + radius))
    start = np.linalg.inv(from_target) @ H @ from_source
    start = (start / start[..., 2:, 2:]).reshape(-1, 9)[:, :8]
    found = minimise(problem, _Entries(start)).state.entries
    H = np.concatenate([found, np.ones((len(found), 1))], axis=1).reshape(-1, 3, 3)
    return _denormalise(H, from_source, from_target)


class _Entries(NamedTuple):
    entries: Array


@dataclass(frozen=True)
class _HomographyProblem:
    """The eight free entries of each homography as shared unknowns; there are no groups."""

    source: Array
    target: Array
    scale: Array

    def linearise(self, state: _Entries) -> NormalEquations:
        H = np.concatenate([state.entries, np.ones((len(state.entries), 1))], axis=1).reshape(-1, 3, 3)
        mapped = H[:, :, :2] @ self.source + H[:, :, 2:]
        depth = np.where((mapped[:, 2] > 0) | (self.scale == 0), mapped[:, 2], np.nan)
        uv = mapped[:, :2] / depth[:, None]
        columns = np.zeros((len(H), 9, *uv.shape[1:]))
        weight = self.scale / depth
        weighted = weight[:, None] * self.source
        columns[:, 0:2, 0] = columns[:, 3:5, 1] = weighted
        columns[:, 2, 0] = columns[:, 5, 1] = weight
        columns[:, 6:8] = -weighted[:, :, None] * uv[:, None]
        columns[:, 8] = (uv - self.target) * self.scale[:, None]
        columns = columns.reshape(len(H), 1, 9, -1)
        return NormalEquations(columns @ np.swapaxes(columns, -1, -2), np.zeros((len(H), 9, 9)))

    def retract(self, state: _Entries, shared: Array, local: Array) -> _Entries:
        return _Entries(state.entries + shared)

    def variance(self, squares: Array) -> Array:
        return np.ones_like(squares)

    def objective(self, squares: Array, shared_squares: Array) -> Array:
        return squares

    def take(self, items: NDArray[np.intp]) -> _HomographyProblem:
        return _HomographyProblem(self.source[items], self.target[items], self.scale[items])


def _normalise(points: Array, weights: Array) -> tuple[Array, Array]:
    """Centre points (..., 2, N), scale them to a mean distance of sqrt(2); also the matrix that undoes it.

    Raises
    ------
    DegenerateViews
        When fewer than four points are in use, or they are collinear.
    """
    used = (weights > 0).astype(float)
    count = used.sum(axis=-1)
    if (count < 4).any():
        raise DegenerateViews(
            f"A view has {int(count.min())} points; four or more that are not on one line are needed."
        )
    centroid = (points * used[..., None, :]).sum(axis=-1) / count[..., None]
    centred = points - centroid[..., None]
    squares = centred * centred * used[..., None, :]
    sums = squares.sum(axis=-1)
    xx, yy = sums[..., 0], sums[..., 1]
    xy = (centred[..., 0, :] * centred[..., 1, :] * used).sum(axis=-1)
    largest = (xx + yy + np.hypot(xx - yy, 2 * xy)) / 2
    if (xx * yy - xy * xy <= (COLLINEAR * largest) ** 2).any():
        raise DegenerateViews(
            "The points of a view are collinear; show a board with points in two directions, not edge-on."
        )
    distance = np.sqrt(squares[..., 0, :] + squares[..., 1, :]).sum(axis=-1) / count
    scale = distance / np.sqrt(2)
    back = np.zeros((*scale.shape, 3, 3))
    back[..., 0, 0] = back[..., 1, 1] = scale
    back[..., :2, 2] = centroid
    back[..., 2, 2] = 1
    return centred / scale[..., None, None], back


def _denormalise(H: Array, from_source: Array, from_target: Array) -> Array:
    return np.asarray(from_target @ H @ np.linalg.inv(from_source), dtype=np.float64)
