"""A view: one picture of a board, reduced to correspondences."""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .checks import checked_stamp, real_array
from .errors import InvalidInput

PLANARITY_TOLERANCE = 1e-6
"""Largest distance of a point from the board's plane, as a share of the board's extent: numbers that
were meant to be planar miss by rounding alone."""

LARGEST = 1e15
"""Largest coordinate of a point, metres or pixels; what is beyond has products that a double cannot hold."""

UNEXPLAINED_PX = 0.1
"""What board and lens model leave unexplained at a perfectly located corner, pixels: the best residuals of
real boards scatter by about as much. It bounds how much more one corner can count than another."""

MIN_COMMON = 4
"""Points that two views must both show to tell whether the board has moved: as many as fix its pose."""


_FACING = np.sqrt([1.0, 2.0, 5.0])
"""The side to which normals point: no plane that anybody writes down has it in it."""
_UPRIGHT = 0.9
"""Share of x in the normal from which on x lies too steeply to the plane to be an axis of it."""


@dataclass(frozen=True, eq=False)
class View:
    """Points of one board and where one image shows them.

    Parameters
    ----------
    object_points : array_like, (N, 3) or (N, 2)
        Points in the board frame, metres. They must lie in one plane; z = 0 is assumed when it is left out.
        A board may be bent along x and along y and its print stretched, so that these run best along its
        sides. In a plane other than z = const they are x, or y where x is the normal, as it lies in the
        plane, and the direction at right angles to it.
    image_points : array_like, (N, 2)
        The same points in the image, pixels, the centre of the first pixel at (0, 0).
    sigma : array_like, scalar or (N,), optional
        One standard deviation of an image point in either direction, pixels. Used as relative weights; the
        common scale is estimated with the camera. Equal for all points when left out, and then that of an
        average point of those views that have it. A point that is given several times counts as one.
    source : str
        Where the view comes from, such as a file name or topic.
    stamp_ns : int, optional
        Time of the image, nanoseconds.

    Raises
    ------
    InvalidInput
        When shapes disagree, a number is not finite, a sigma is not positive or the points lie in no plane.
    """

    object_points: NDArray[np.float64]
    image_points: NDArray[np.float64]
    sigma: NDArray[np.float64] | None = field(default=None)
    source: str = ""
    stamp_ns: int | None = None

    def __init__(
        self,
        object_points: ArrayLike,
        image_points: ArrayLike,
        sigma: ArrayLike | None = None,
        source: str = "",
        stamp_ns: int | None = None,
    ) -> None:
        obj = _finite(object_points, "object_points")
        img = _finite(image_points, "image_points")
        if obj.ndim != 2 or obj.shape[1] not in (2, 3):
            raise InvalidInput(f"object_points must have shape (N, 3), metres, not {obj.shape}.")
        if img.ndim != 2 or img.shape[1] != 2:
            raise InvalidInput(f"image_points must have shape (N, 2), pixels, not {img.shape}.")
        if len(obj) != len(img):
            raise InvalidInput(f"{len(obj)} object points but {len(img)} image points; give one for each.")
        if obj.shape[1] == 2:
            obj = np.hstack([obj, np.zeros((len(obj), 1))])
        if not isinstance(source, str):
            raise InvalidInput(f"source must be a text, not {reprlib.repr(source)}.")
        _check_planar(obj)
        weights = None if sigma is None else _sigmas(sigma, len(obj))
        obj.setflags(write=False)
        img.setflags(write=False)
        for name, value in (
            ("object_points", obj),
            ("image_points", img),
            ("sigma", weights),
            ("source", source),
            ("stamp_ns", checked_stamp(stamp_ns)),
        ):
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[type[View], tuple[object, ...]]:
        # Through the constructor: numpy forgets that an array was read-only.
        return View, (self.object_points, self.image_points, self.sigma, self.source, self.stamp_ns)

    def __len__(self) -> int:
        return len(self.object_points)


def align_views(views: Sequence[View]) -> NDArray[np.float64]:
    """Image points of several views of one board, each point of the board in one column.

    Parameters
    ----------
    views : sequence of V View
        They may show different parts of the board.

    Returns
    -------
    (V, P, 2) pixels, NaN for points that a view does not show.
    """
    if all(np.array_equal(view.object_points, views[0].object_points) for view in views):
        return np.stack([view.image_points for view in views])
    points, column = np.unique(
        np.concatenate([view.object_points for view in views]), axis=0, return_inverse=True
    )
    row = np.repeat(np.arange(len(views)), [len(view) for view in views])
    aligned = np.full((len(views), len(points), 2), np.nan)
    aligned[row, column.ravel()] = np.concatenate([view.image_points for view in views])
    return aligned


def distances(points: NDArray[np.float64], view: int) -> NDArray[np.float64]:
    """Root mean square distance (V,) of the points that a view has in common with each, pixels.

    Infinite where there are fewer than :data:`MIN_COMMON`: all boards have the corner in common that they are
    counted from. `points` (V, P, 2) are those of :func:`align_views`.
    """
    squares = np.sum((points - points[view]) ** 2, axis=2)
    common = np.isfinite(squares)
    count, total = common.sum(axis=1), np.where(common, squares, 0).sum(axis=1)
    return np.asarray(np.sqrt(np.where(count >= MIN_COMMON, total / np.maximum(count, 1), np.inf)))


class ViewStack(NamedTuple):
    """Several views in one set of arrays; shorter views are padded with points of weight 0.

    Attributes
    ----------
    points : (V, 2, N)
        Board points in the board's plane, about their centroid, metres. The points come last, here and below.
    centroid : (V, 3)
        Metres, in the board frame.
    plane : (V, 3, 3)
        Rotation whose first two columns span the board's plane: ``plane[:, :2] @ points`` is the board.
    pixels : (V, 2, N)
    weights : (V, N)
        Relative: 1 over sigma and UNEXPLAINED_PX together, with a mean square of 1 over all points; of points
        that a view has several times each has its share of one.
    """

    points: NDArray[np.float64]
    centroid: NDArray[np.float64]
    plane: NDArray[np.float64]
    pixels: NDArray[np.float64]
    weights: NDArray[np.float64]

    @property
    def counts(self) -> NDArray[np.intp]:
        """Points of each view, (V,)."""
        counts: NDArray[np.intp] = np.count_nonzero(self.weights > 0, axis=-1)
        return counts

    @classmethod
    def several(cls, stacks: Sequence[ViewStack]) -> ViewStack:
        """Put stacks of the same shape side by side, along a new first axis of every attribute."""
        return cls(*(np.stack(parts) for parts in zip(*stacks, strict=True)))


def stack_views(views: Sequence[View]) -> ViewStack:
    """Put views into one set of arrays.

    Raises
    ------
    InvalidInput
        When there is no view.
    """
    if not views:
        raise InvalidInput("There is no view to calibrate from; give at least one.")
    longest = max(len(view) for view in views)
    points, pixels = np.zeros((2, len(views), 2, longest))
    weights, centroid = np.zeros((len(views), longest)), np.zeros((len(views), 3))
    plane = np.tile(np.eye(3), (len(views), 1, 1))
    for i, view in enumerate(views):
        count = len(view)
        if count == 0:
            continue
        centroid[i] = view.object_points.mean(axis=0)
        centred = view.object_points - centroid[i]
        if np.ptp(view.object_points[:, 2]) > 0:
            plane[i] = _plane_axes(centred)
        points[i, :, :count] = (centred @ plane[i, :, :2]).T
        pixels[i, :, :count] = view.image_points.T
        # Padding lies at the centroid, in front of every camera.
        weights[i, :count] = 1 if view.sigma is None else 1 / np.hypot(view.sigma, UNEXPLAINED_PX)
    # Views without sigmas weigh as much as those with sigmas do on average.
    given = [i for i, view in enumerate(views) if view.sigma is not None and len(view)]
    if given:
        squares = weights[given] ** 2
        weights[given] /= np.sqrt(squares.sum() / (squares > 0).sum())
    for i, view in enumerate(views):
        weights[i, : len(view)] /= np.sqrt(_times(view.object_points))
    return ViewStack(points, centroid, plane, pixels, weights)


def _plane_axes(centred: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) axes of the plane of points (N, 3) about their centroid, and its normal, as columns.

    They are the same whichever part of a board the points are, as what is bent along them has to be.
    """
    normal = np.linalg.svd(np.linalg.qr(centred, mode="r"))[2][2]
    normal = normal * np.where(normal @ _FACING < 0, -1, 1)
    along = np.eye(3)[int(abs(normal[0]) > _UPRIGHT)]
    first = along - (along @ normal) * normal
    first = first / np.linalg.norm(first)
    return np.column_stack([first, np.cross(normal, first), normal])


def _finite(values: ArrayLike, name: str) -> NDArray[np.float64]:
    array = real_array(values, name)
    if not np.all(np.isfinite(array)):
        raise InvalidInput(f"{name} holds a value that is not finite; leave such points out.")
    if array.size and np.abs(array).max() > LARGEST:
        raise InvalidInput(f"{name} holds a value beyond {LARGEST:g}; leave such points out.")
    return array


def _sigmas(sigma: ArrayLike, count: int) -> NDArray[np.float64]:
    values = np.atleast_1d(_finite(sigma, "sigma"))
    if values.shape not in ((1,), (count,)) or np.any(values <= 0):
        raise InvalidInput("sigma must be positive pixels, one for all points or one for each.")
    values = np.broadcast_to(values, (count,)).copy()
    values.setflags(write=False)
    return values


def _times(points: NDArray[np.float64]) -> NDArray[np.intp]:
    """How often each of some points (N, 3) is among them, (N,)."""
    order = np.lexsort(points.T)
    other = np.any(points[order[1:]] != points[order[:-1]], axis=1)
    if other.all():
        return np.ones(len(points), dtype=np.intp)
    which = np.empty(len(points), dtype=np.intp)
    which[order] = np.concatenate([[0], np.cumsum(other)])
    return np.bincount(which)[which]


def _check_planar(points: NDArray[np.float64]) -> None:
    if len(points) < 4 or not np.any(points[:, 2] - points[0, 2]):
        return
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[2] > PLANARITY_TOLERANCE * max(spread[0], 1e-300):
        raise InvalidInput("The object points do not lie in one plane; fewcal calibrates from planar boards.")
