"""Bundle adjustment: a camera and the pose of every view, from many starts at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .departures import Departures
from .least_squares import NormalEquations, Stop, take
from .noise import Noise
from .parametrisation import SHIFT, Parametrisation, ScaleFree
from .prior_rows import PriorRows
from .views import ViewStack

Array = NDArray[np.float64]

Constraint = Callable[[Array], tuple[Array, Array]]
"""Camera unknowns (B, S) to rows (B, K) and their Jacobian (B, K, S)."""

POSE = 6
"""Unknowns of a pose: a turn about the board's axes (rad) and a shift of its centroid (m)."""

LARGEST_FOCAL_STEP = 1.0
"""Of ln f; what is linear does not reach farther, and wrong poses would run away to infinity."""


class Geometry(NamedTuple):
    """One camera and the poses of its V views, for each start.

    Attributes
    ----------
    theta : (B, S) camera unknowns, and those of the departures where the adjustment has any
    rotation : (B, V, 3, 3) from the axes of the board's plane (`ViewStack.plane`) to the camera's
    position : (B, V, 3) of the centroid of the board's points in the camera frame, metres
    """

    theta: Array
    rotation: Array
    position: Array


class Rows(NamedTuple):
    """Rows of the reprojection and their Jacobians, in units of one standard deviation.

    Attributes
    ----------
    r : (V, 2 N)
    by_camera : (V, 2 N, S), along the steps that :meth:`Adjustment.retract` takes
    by_pose : (V, 2 N, 6), turn and shift
    """

    r: Array
    by_camera: Array
    by_pose: Array


@dataclass(frozen=True)
class Adjustment:
    """The least-squares problem of one set of views.

    Parameters
    ----------
    views : ViewStack
        The same for every start, or with a first axis (B, ...) of its own a set for each.
    model : Parametrisation
    constraint : callable
        The rows on the camera alone.
    noise : Noise, optional
        For each start; without it rows are pixels, of variance 1.
    departures : Departures, optional
        Of board and lens, whose coefficients are further unknowns of a scale-free camera.
    """

    views: ViewStack
    model: Parametrisation
    constraint: Constraint
    noise: Noise | None = None
    departures: Departures | None = None

    def jacobian(self, state: Geometry) -> Array:
        """Linearise the reprojection of every point.

        Returns
        -------
        (B, V, 6 + S + 1, 2, N)
            For each view the columns of pose and camera and the residual, in this order, over both image
            coordinates of all points; pixels times the weight of the point. The points come last, so that
            every operation runs over long rows, and one product holds all of J'J and J'r.
        """
        theta, rotation, position = state
        board = self.views.points
        size = self.model.size
        columns = np.empty((*rotation.shape[:2], POSE + theta.shape[1] + 1, *board.shape[-2:]))
        if self.departures is not None:
            board = board + theta[:, -1, None, None, None] * self.departures.stretch
        points = rotation[..., :2] @ board
        points += position[..., None]
        if self.departures is not None:
            lift = theta[:, None, None, size : size + 2] @ self.departures.lift  # (B, V, 1, N)
            points += rotation[..., 2:] * lift
        depth = points[:, :, 2:]
        depth = np.where(depth > 0, depth, np.nan)
        camera = columns[:, :, POSE - SHIFT : POSE + size + 1]
        self.model.project(points[:, :, :2] / depth, theta[:, :size], camera)
        turn, shift = columns[:, :, : POSE - SHIFT], columns[:, :, POSE - SHIFT : POSE]
        shift /= depth[:, :, None]
        # A turn w of the board moves its point p by R (w x p), and d . R (w x p) = w . (p x R'd).
        d = np.swapaxes(rotation, -1, -2) @ shift.reshape(*shift.shape[:3], -1)
        d = d.reshape(shift.shape)
        x, y = board[..., 0, None, :], board[..., 1, None, :]
        np.multiply(d[:, :, 2], y, out=turn[:, :, 0])
        np.multiply(d[:, :, 2], -x, out=turn[:, :, 1])
        np.subtract(d[:, :, 1] * x, d[:, :, 0] * y, out=turn[:, :, 2])
        if isinstance(self.model, ScaleFree):
            # The boards keep their size in the image, see retract.
            columns[:, :, POSE] += shift[:, :, 2] * position[..., 2, None, None]
        if self.departures is not None:
            turn[:, :, 0] -= d[:, :, 1] * lift
            turn[:, :, 1] += d[:, :, 0] * lift
            columns[:, :, -1] = camera[:, :, -1] + theta[:, -2, None, None, None] * self.departures.shift
            np.multiply(d[:, :, 2, None], self.departures.lift[:, :, None], out=columns[:, :, -5:-3])
            columns[:, :, -3] = self.departures.shift
            columns[:, :, -2] = (d[:, :, :2] * self.departures.stretch[:, :, None]).sum(axis=2)
        columns[:, :, -1] -= self.views.pixels
        columns *= self.views.weights[..., None, None, :]
        return columns

    def linearise(self, state: Geometry) -> NormalEquations:
        """Normal equations; a state with a point behind the camera, or beyond all numbers, is NaN."""
        columns = self.jacobian(state)
        columns = columns.reshape(*columns.shape[:3], -1)
        if isinstance(self.constraint, PriorRows):
            shared = self.constraint.quadratic(state.theta)
        else:
            r, J = self.constraint(state.theta)
            constraint = np.concatenate([J, r[..., None]], axis=-1)
            shared = np.swapaxes(constraint, -1, -2) @ constraint
        return NormalEquations(columns @ np.swapaxes(columns, -1, -2), shared)

    def rows(self, state: Geometry, sigma: float) -> Rows:
        """Rows of a batch of one, with the standard deviation of an image point of weight 1 in pixels."""
        columns = self.jacobian(state)[0] / sigma
        columns = np.swapaxes(columns.reshape(*columns.shape[:2], -1), -1, -2)
        return Rows(columns[..., -1], columns[..., POSE:-1], columns[..., :POSE])

    def retract(self, state: Geometry, shared: Array, local: Array) -> Geometry:
        """Step away from a state: camera unknowns, then a turn and a shift of each board.

        A step of ln f moves the boards away in proportion, so that their size in the image stays: the valley
        along which focal length and distance compensate each other is straight then, and quickly walked.
        """
        if not isinstance(self.model, ScaleFree):
            return _moved(state, shared, local)
        far = np.abs(shared[:, 0]) / LARGEST_FOCAL_STEP
        if far.max() > 1:
            shrink = 1 / np.maximum(far, 1)
            shared, local = shared * shrink[:, None], local * shrink[:, None, None]
        moved = _moved(state, shared, local)
        moved.position[..., 2] += state.position[..., 2] * np.expm1(shared[:, None, 0])
        return moved

    def variance(self, squares: Array) -> Array:
        """Variance (B,) of an image point of weight 1, px^2, for sums of squared residuals (B,)."""
        return np.ones_like(squares) if self.noise is None else self.noise.variance(squares)

    def objective(self, squares: Array, shared_squares: Array) -> Array:
        """Negative log posterior (B,), up to a constant, for sums of squares of residuals and constraints."""
        if self.noise is None:
            return 0.5 * (squares + shared_squares)
        return self.noise.objective(squares, shared_squares)

    def believing(self, noise: Noise) -> Adjustment:
        """Judge the same residuals by another noise."""
        return replace(self, noise=noise)

    def take(self, items: NDArray[np.intp]) -> Adjustment:
        """Keep some starts only."""
        kept = self if self.noise is None else replace(self, noise=self.noise.take(items))
        return kept if self.views.points.ndim == 3 else replace(kept, views=take(self.views, items))


@dataclass(frozen=True)
class MapProblem(Adjustment):
    """What :mod:`fewcal.map_estimator` finds; without departures as long as these are too small to matter."""

    model: ScaleFree
    constraint: PriorRows
    noise: Noise
    departures: Departures | None


@dataclass(frozen=True)
class Estimate:
    """The best minimum an estimator found.

    Attributes
    ----------
    adjustment : Adjustment
    geometry : Geometry
        Its solution, with a batch of one.
    sigma : float
        Standard deviation of an image point of weight 1, pixels.
    stop : Stop
        Why the last iteration stopped.
    """

    adjustment: Adjustment
    geometry: Geometry
    sigma: float
    stop: Stop

    def board_poses(self) -> Array:
        """T_camera_board (V, 4, 4) of each view, in the frame that the board's points were given in."""
        views, (_, rotation, position) = self.adjustment.views, self.geometry
        poses = np.zeros((len(views.centroid), 4, 4))
        poses[:, :3, :3] = rotation[0] @ np.swapaxes(views.plane, -1, -2)
        poses[:, :3, 3] = position[0] - (poses[:, :3, :3] @ views.centroid[..., None])[..., 0]
        poses[:, 3, 3] = 1
        return poses


_CROSS = np.zeros((3, 9))
"""Vector to the entries of its cross product matrix."""
_CROSS[[0, 0, 1, 1, 2, 2], [7, 5, 2, 6, 3, 1]] = 1, -1, 1, -1, 1, -1


def rotation_from_vector(vector: Array) -> Array:
    """Rodrigues' formula: (..., 3) rotation vectors, rad, to (..., 3, 3) matrices."""
    angle2 = (vector * vector).sum(axis=-1)
    angle = np.sqrt(angle2)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    # Below 1e-4 rad the next terms of the series lie under the rounding of a double.
    sine = np.where(small, 1 - angle2 / 6, np.sin(safe) / safe)
    cosine = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
    cross = (vector @ _CROSS).reshape(*vector.shape, 3)
    rotations: Array = np.eye(3) + sine[..., None, None] * cross + cosine[..., None, None] * (cross @ cross)
    return rotations


def _moved(state: Geometry, shared: Array, local: Array) -> Geometry:
    return Geometry(
        state.theta + shared, state.rotation @ _turn(local[..., :3]), state.position + local[..., 3:]
    )


def _turn(vector: Array) -> Array:
    """Rotation whose vector is `vector` (..., 3) for small angles, and less for large ones (Cayley)."""
    half = vector / 2
    cross = (half @ _CROSS).reshape(*vector.shape, 3)
    share = 2 / (1 + (half * half).sum(axis=-1))
    rotation: Array = (cross + cross @ cross) * share[..., None, None]
    rotation[..., [0, 1, 2], [0, 1, 2]] += 1
    return rotation
