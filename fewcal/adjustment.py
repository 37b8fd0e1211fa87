"""Bundle adjustment: a camera and the pose of every view, from many starts at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .constraints import reprojection
from .least_squares import NormalEquations, Stop
from .parametrisation import Parametrisation, ScaleFree
from .views import ViewStack

Array = NDArray[np.float64]

Constraint = Callable[[Array], tuple[Array, Array]]
"""Camera unknowns (B, S) to rows (B, K) and their Jacobian (B, K, S)."""


class Geometry(NamedTuple):
    """One camera and the poses of its V views, for each start.

    Attributes
    ----------
    theta : (B, S) camera unknowns
    rotation : (B, V, 3, 3) from the board's axes to the camera's
    position : (B, V, 3) of the centroid of the board's points in the camera frame, metres
    """

    theta: Array
    rotation: Array
    position: Array


class Rows(NamedTuple):
    """Residual rows and their Jacobians, in units of one standard deviation.

    Attributes
    ----------
    r : (B, V, 2 N) reprojection
    by_camera : (B, V, 2 N, S), along the steps that :meth:`Adjustment.retract` takes
    by_pose : (B, V, 2 N, 6), turn about the camera's axes (rad) and shift of the centroid (m)
    prior : (B, K)
    prior_by_camera : (B, K, S)
    """

    r: Array
    by_camera: Array
    by_pose: Array
    prior: Array
    prior_by_camera: Array


@dataclass(frozen=True)
class Adjustment:
    """The least-squares problem of one set of views.

    Parameters
    ----------
    views : ViewStack
    model : Parametrisation
    constraint : callable
        The rows on the camera alone.
    sigma : (B,)
        Standard deviation of an image point of weight 1, pixels, for each start.
    """

    views: ViewStack
    model: Parametrisation
    constraint: Constraint
    sigma: Array

    def rows(self, state: Geometry) -> Rows:
        """Linearise every row; points behind the camera give NaN."""
        theta, rotation, position = state
        turned = self.views.points @ np.swapaxes(rotation, -1, -2)
        pixels, d_points, d_theta = self.model.project(turned + position[..., None, :], theta)
        by_pose = np.concatenate([_by_turn(d_points, turned), d_points], axis=-1)
        if isinstance(self.model, ScaleFree):
            d_theta[..., 0] += d_points[..., 2] * position[..., None, None, 2]
        weights = self.views.weights / self.sigma[:, None, None]
        r, (by_camera, by_pose) = reprojection(pixels, self.views.pixels, weights, d_theta, by_pose)
        return Rows(r, by_camera, by_pose, *self.constraint(theta))

    def linearise(self, state: Geometry) -> NormalEquations:
        """Normal equations; a state with a point behind the camera, or beyond all numbers, is not allowed."""
        with np.errstate(over="ignore", invalid="ignore"):
            rows = self.rows(state)
            cost = 0.5 * ((rows.r**2).sum(axis=(1, 2)) + (rows.prior**2).sum(axis=1))
            camera_t = np.swapaxes(rows.by_camera, -1, -2)
            pose_t = np.swapaxes(rows.by_pose, -1, -2)
            prior_t = np.swapaxes(rows.prior_by_camera, -1, -2)
            return NormalEquations(
                np.where(np.isfinite(cost), cost, np.inf),
                (camera_t @ rows.by_camera).sum(axis=1) + prior_t @ rows.prior_by_camera,
                (camera_t @ rows.r[..., None])[..., 0].sum(axis=1)
                + (prior_t @ rows.prior[..., None])[..., 0],
                camera_t @ rows.by_pose,
                pose_t @ rows.by_pose,
                (pose_t @ rows.r[..., None])[..., 0],
            )

    def retract(self, state: Geometry, shared: Array, local: Array) -> Geometry:
        """Step away from a state: camera unknowns, then a turn and a shift of each board.

        A step of ln f moves the boards away in proportion, so that their size in the image stays: the valley
        along which focal length and distance compensate each other is straight then, and quickly walked.
        """
        position = state.position + local[..., 3:]
        if isinstance(self.model, ScaleFree):
            with np.errstate(over="ignore"):
                position[..., 2] += state.position[..., 2] * np.expm1(shared[:, None, 0])
        return Geometry(state.theta + shared, rotation_from_vector(local[..., :3]) @ state.rotation, position)

    def take(self, items: NDArray[np.intp]) -> Adjustment:
        """Keep some starts only."""
        return replace(self, sigma=self.sigma[items])

    def squares(self, state: Geometry) -> Array:
        """Weighted sum of squared reprojection errors, (B, V), px^2."""
        squares: Array = (self.rows(state).r ** 2).sum(axis=2) * self.sigma[:, None] ** 2
        return squares


@dataclass(frozen=True)
class Estimate:
    """The best minimum an estimator found.

    Attributes
    ----------
    adjustment : Adjustment
        The problem, for one start, in units of its noise.
    geometry : Geometry
        Its solution, with a batch of one.
    stop : Stop
        Why the last iteration stopped.
    """

    adjustment: Adjustment
    geometry: Geometry
    stop: Stop


def rotation_from_vector(vector: Array) -> Array:
    """Rodrigues' formula: (..., 3) rotation vectors, rad, to (..., 3, 3) matrices."""
    angle2 = (vector * vector).sum(axis=-1)
    angle = np.sqrt(angle2)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    # Below 1e-4 rad the next terms of the series lie under the rounding of a double.
    sine = np.where(small, 1 - angle2 / 6, np.sin(safe) / safe)
    cosine = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(safe)) / safe**2)
    cross = np.zeros((*vector.shape, 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross[..., 1, 0], cross[..., 2, 0], cross[..., 2, 1] = z, -y, x
    rotations: Array = np.eye(3) + sine[..., None, None] * cross + cosine[..., None, None] * (cross @ cross)
    return rotations


def _by_turn(d_points: Array, turned: Array) -> Array:
    """Derivative by a small turn w, for which the point moves by w x X: d . (w x X) = w . (X x d)."""
    x, y, z = (turned[..., None, i] for i in range(3))
    a, b, c = d_points[..., 0], d_points[..., 1], d_points[..., 2]
    return np.stack([y * c - z * b, z * a - x * c, x * b - y * a], axis=-1)
