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


def homographies(board_points: Array, image_points: Array, weights: Array) -> Array:
    """Normalised direct linear transform.

    Parameters
    ----------
    board_points : (..., N, 2)
        In the board's plane, metres.
    image_points : (..., N, 2)
        Pixels.
    weights : (..., N)
        Weight of each point; 0 leaves it out, so that views of different length share one array.

    Returns
    -------
    (..., 3, 3) scaled so that the board's centroid has a positive third coordinate of 1.

    Raises
    ------
    DegenerateViews
        When a view has fewer than four points, or its points are collinear.
    """
    check_points(board_points, image_points, weights)
    source, from_source = _normalise(board_points, weights)
    target, from_target = _normalise(image_points, weights)
    x, y = source[..., 0], source[..., 1]
    u, v = target[..., 0], target[..., 1]
    zero, one = np.zeros_like(x), np.ones_like(x)
    rows = np.stack(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=-1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=-1),
        ],
        axis=-2,
    )
    rows = (rows * weights[..., None, None]).reshape(*rows.shape[:-3], -1, 9)
    _, _, vt = np.linalg.svd(np.linalg.qr(rows, mode="r"))
    H = vt[..., 8, :].reshape(*vt.shape[:-2], 3, 3)
    # In normalised coordinates the centroid is the origin and is finite, so that h33 is not zero.
    H = H / H[..., 2:, 2:]
    return _denormalise(H, from_source, from_target)


def refine_homographies(
    H: Array, board_points: Array, image_points: Array, weights: Array, principal_point: Array
) -> Array:
    """Minimise sum |m - m'|^2 / (c + r), r the distance of m from the principal point (paper eq 15).

    Parameters
    ----------
    H : (B, 3, 3)
        Where to start.
    board_points, image_points : (B, N, 2)
        Metres and pixels.
    weights : (B, N)
        0 leaves a point out.
    principal_point : (2,) or (B, 2)
        Pixels; the image centre at this stage of the paper.

    Returns
    -------
    (B, 3, 3)
    """
    offset = image_points - np.broadcast_to(principal_point, (len(H), 2))[:, None, :]
    radius = np.hypot(offset[..., 0], offset[..., 1])
    source, from_source = _normalise(board_points, weights)
    target, from_target = _normalise(image_points, weights)
    size = from_target[:, None, 0, 0]  # pixels per unit of the normalised image
    problem = _HomographyProblem(source, target, weights * size / np.sqrt(DISTANCE_OFFSET_PX + radius))
    start = np.linalg.inv(from_target) @ H @ from_source
    start = (start / start[..., 2:, 2:]).reshape(-1, 9)[:, :8]
    found = minimise(problem, _Entries(start)).state.entries
    H = np.concatenate([found, np.ones((len(found), 1))], axis=1).reshape(-1, 3, 3)
    return _denormalise(H, from_source, from_target)


def check_points(board_points: Array, image_points: Array, weights: Array) -> None:
    """Refuse views that no plane-to-image map can be drawn from."""
    counts = (weights > 0).sum(axis=-1)
    if np.any(counts < 4):
        raise DegenerateViews(
            f"A view has {counts.min()} points; four or more that are not on one line are needed."
        )
    for points in (board_points, image_points):
        centred = (points - _centroid(points, weights)[..., None, :]) * (weights > 0)[..., None]
        extent = np.linalg.svd(centred, compute_uv=False)
        if np.any(extent[..., 1] <= COLLINEAR * extent[..., 0]):
            raise DegenerateViews(
                "The points of a view are collinear; show a board with points in two directions, not edge-on."
            )


class _Entries(NamedTuple):
    entries: Array


@dataclass(frozen=True)
class _HomographyProblem:
    """The eight free entries of each homography as shared unknowns; there are no groups."""

    source: Array
    target: Array
    scale: Array

    def linearise(self, state: _Entries) -> NormalEquations:
        h = state.entries
        x, y = self.source[..., 0], self.source[..., 1]
        depth = h[:, None, 6] * x + h[:, None, 7] * y + 1
        u = (h[:, None, 0] * x + h[:, None, 1] * y + h[:, None, 2]) / depth
        v = (h[:, None, 3] * x + h[:, None, 4] * y + h[:, None, 5]) / depth
        weight = self.scale / depth
        J = np.zeros((*x.shape, 2, 8))
        J[..., 0, 0] = J[..., 1, 3] = weight * x
        J[..., 0, 1] = J[..., 1, 4] = weight * y
        J[..., 0, 2] = J[..., 1, 5] = weight
        J[..., 0, 6], J[..., 0, 7] = -weight * x * u, -weight * y * u
        J[..., 1, 6], J[..., 1, 7] = -weight * x * v, -weight * y * v
        r = (np.stack([u, v], axis=-1) - self.target) * self.scale[..., None]
        J, r = J.reshape(len(h), -1, 8), r.reshape(len(h), -1)
        cost = 0.5 * (r * r).sum(axis=1)
        cost[np.any((depth <= 0) & (self.scale > 0), axis=1)] = np.inf
        empty = np.zeros((len(h), 0, 8, 0))
        Jt = np.swapaxes(J, 1, 2)
        return NormalEquations(
            cost,
            Jt @ J,
            (Jt @ r[..., None])[..., 0],
            empty,
            np.zeros((len(h), 0, 0, 0)),
            np.zeros((len(h), 0, 0)),
        )

    def retract(self, state: _Entries, shared: Array, local: Array) -> _Entries:
        return _Entries(state.entries + shared)

    def take(self, items: NDArray[np.intp]) -> _HomographyProblem:
        return _HomographyProblem(self.source[items], self.target[items], self.scale[items])


def _centroid(points: Array, weights: Array) -> Array:
    used = (weights > 0).astype(float)
    centroid: Array = (points * used[..., None]).sum(axis=-2) / used.sum(axis=-1)[..., None]
    return centroid


def _normalise(points: Array, weights: Array) -> tuple[Array, Array]:
    """Centre the points and scale them to a mean distance of sqrt(2); also the matrix that undoes it."""
    used = (weights > 0).astype(float)
    centroid = _centroid(points, weights)
    centred = points - centroid[..., None, :]
    distance = (np.hypot(centred[..., 0], centred[..., 1]) * used).sum(axis=-1) / used.sum(axis=-1)
    scale = distance / np.sqrt(2)
    back = np.zeros((*scale.shape, 3, 3))
    back[..., 0, 0] = back[..., 1, 1] = scale
    back[..., :2, 2] = centroid
    back[..., 2, 2] = 1
    return centred / scale[..., None, None], back


def _denormalise(H: Array, from_source: Array, from_target: Array) -> Array:
    H = from_target @ H @ np.linalg.inv(from_source)
    return H
