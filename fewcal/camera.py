"""The camera: pinhole with plumb_bob distortion, and the paper's distortion in pixels.

A point of the camera frame (x right, y down, z forward, REP 103 optical frame) is divided by its depth,
distorted, and placed on the sensor:

    (x, y) = (X / Z, Y / Z),   r2 = x^2 + y^2
    x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2)
    y' = y (1 + k1 r2 + k2 r2^2 + k3 r2^3) + p1 (r2 + 2 y^2) + 2 p2 x y
    u = fx x' + cx,  v = fy y' + cy

which is ``plumb_bob`` of sensor_msgs/CameraInfo and the default of OpenCV ("Camera Calibration and 3D
Reconstruction"). Zhu et al. (2020, eqs 2-13) apply the very same polynomial to the undistorted *pixel* about
the principal point, (X, Y) = (fx x + s y, fy y), with p1 = k4 and p2 = k3 of their notation.

The functions take any leading axes that broadcast (views, a batch of starts) and loop over nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InvalidInput, ModelFoldsOver

Array = NDArray[np.float64]

_NEWTON_STEPS = 50
"""Both inversions stop by themselves, in about 6 steps; this only bounds a sequence that does not."""
_NEWTON_TOLERANCE = 1e-14
"""Relative step at which an inversion is as exact as a double can hold."""
_FOLD_START = 0.9
"""Where the search starts, as a share of the fold radius, for a point that only p1 and p2 may have pushed
beyond the fold. Any start from 0.8 to 0.98 finds the same rays in simulated lenses."""
_FOLD_REACH = 1.2
"""How far p1 and p2 can move the fold, as a share of its radius, for coefficients up to 0.02; a solution
farther out lies on another sheet of the polynomial."""


class Projection(NamedTuple):
    """Pixels and their derivatives.

    Attributes
    ----------
    pixels : (..., N, 2) px
    d_points : (..., N, 2, 3) px per metre in the camera frame
    d_intrinsics : (..., N, 2, 4) by (fx, fy, cx, cy), or (..., N, 2, 5) with the skew last
    d_distortion : (..., N, 2, K) by the distortion coefficients
    """

    pixels: Array
    d_points: Array
    d_intrinsics: Array
    d_distortion: Array


def distort(points: Array, coefficients: Array) -> Array:
    """Apply the distortion polynomial.

    Parameters
    ----------
    points : (..., N, 2)
        Undistorted coordinates: normalised for plumb_bob, pixels about the principal point for the paper's.
    coefficients : (..., 5)
        k1, k2, p1, p2, k3 in the unit that belongs to the points.

    Returns
    -------
    (..., N, 2) distorted coordinates.
    """
    x, y = points[..., 0], points[..., 1]
    k1, k2, p1, p2, k3 = _columns(coefficients)
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def distort_jacobians(points: Array, coefficients: Array) -> tuple[Array, Array]:
    """Differentiate :func:`distort`.

    Returns
    -------
    d_points : (..., N, 2, 2)
    d_coefficients : (..., N, 2, 5) by k1, k2, p1, p2, k3
    """
    x, y = points[..., 0], points[..., 1]
    k1, k2, p1, p2, k3 = _columns(coefficients)
    xx, xy, yy = x * x, x * y, y * y
    r2 = xx + yy
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)  # d radial / d r2
    shape = np.broadcast_shapes(x.shape, radial.shape)
    d_points = np.empty((*shape, 2, 2))
    d_points[..., 0, 0] = radial + 2 * xx * slope + 2 * p1 * y + 6 * p2 * x
    d_points[..., 0, 1] = 2 * xy * slope + 2 * p1 * x + 2 * p2 * y
    d_points[..., 1, 0] = d_points[..., 0, 1]
    d_points[..., 1, 1] = radial + 2 * yy * slope + 6 * p1 * y + 2 * p2 * x
    d_coefficients = np.empty((*shape, 2, 5))
    for row, coordinate in enumerate((x, y)):
        d_coefficients[..., row, 0] = coordinate * r2
        d_coefficients[..., row, 1] = coordinate * r2 * r2
        d_coefficients[..., row, 4] = coordinate * r2 * r2 * r2
    d_coefficients[..., 0, 2] = d_coefficients[..., 1, 3] = 2 * xy
    d_coefficients[..., 0, 3] = r2 + 2 * xx
    d_coefficients[..., 1, 2] = r2 + 2 * yy
    return d_points, d_coefficients


def project(points: Array, intrinsics: Array, distortion: Array) -> Array:
    """Project points of the camera frame with plumb_bob distortion.

    Parameters
    ----------
    points : (..., N, 3)
        Camera frame, metres. Points with z <= 0 have no image and give NaN.
    intrinsics : (..., 4)
        fx, fy, cx, cy, pixels.
    distortion : (..., 5)
        k1, k2, p1, p2, k3.

    Returns
    -------
    (..., N, 2) pixels.
    """
    distorted = distort(_perspective(points), distortion)
    return distorted * intrinsics[..., None, :2] + intrinsics[..., None, 2:4]


def project_jacobians(points: Array, intrinsics: Array, distortion: Array) -> Projection:
    """Project as :func:`project` does, with the derivatives by point, intrinsics and distortion."""
    xy = _perspective(points)
    distorted = distort(xy, distortion)
    d_xy, d_coefficients = distort_jacobians(xy, distortion)
    focal = intrinsics[..., None, :2]
    d_xy *= focal[..., None]
    d_intrinsics = np.zeros((*distorted.shape, 4))
    d_intrinsics[..., 0, 0] = distorted[..., 0]
    d_intrinsics[..., 1, 1] = distorted[..., 1]
    d_intrinsics[..., 0, 2] = d_intrinsics[..., 1, 3] = 1
    return Projection(
        distorted * focal + intrinsics[..., None, 2:4],
        _through_perspective(d_xy, xy, points[..., 2]),
        d_intrinsics,
        d_coefficients * focal[..., None],
    )


def project_pixel_model_jacobians(points: Array, intrinsics: Array, distortion: Array) -> Projection:
    """Project with the paper's distortion in pixels (eqs 2-13), with derivatives.

    Parameters
    ----------
    points : (..., N, 3)
        Camera frame, metres.
    intrinsics : (..., 5)
        fx, fy, u0, v0, s, pixels.
    distortion : (..., 4)
        k1, k2 (eq 10-11), k3, k4 (eq 12-13), in px^-2, px^-4, px^-1, px^-1.
    """
    xy = _perspective(points)
    fx, fy, _, _, skew = _columns(intrinsics)
    undistorted = np.stack([fx * xy[..., 0] + skew * xy[..., 1], fy * xy[..., 1]], axis=-1)
    coefficients = _as_plumb_bob_order(distortion)
    d_undistorted, d_coefficients = distort_jacobians(undistorted, coefficients)
    scale = np.zeros((*np.broadcast_shapes(fx.shape, skew.shape), 2, 2))
    scale[..., 0, 0], scale[..., 0, 1], scale[..., 1, 1] = fx, skew, fy
    d_intrinsics = np.zeros((*undistorted.shape, 5))
    d_intrinsics[..., 0] = d_undistorted[..., 0] * xy[..., None, 0]
    d_intrinsics[..., 1] = d_undistorted[..., 1] * xy[..., None, 1]
    d_intrinsics[..., 0, 2] = d_intrinsics[..., 1, 3] = 1
    d_intrinsics[..., 4] = d_undistorted[..., 0] * xy[..., None, 1]
    return Projection(
        distort(undistorted, coefficients) + intrinsics[..., None, 2:4],
        _through_perspective(d_undistorted @ scale, xy, points[..., 2]),
        d_intrinsics,
        d_coefficients[..., [0, 1, 3, 2]],
    )


def fold_radius(distortion: Array) -> Array:
    """Undistorted radius at which the radial distortion turns back on itself.

    Beyond it two directions share one image point, so that no ray belongs to the image there. It is the
    smallest positive root in r of d/dr [r (1 + k1 r^2 + k2 r^4 + k3 r^6)] = 0.

    Parameters
    ----------
    distortion : (..., 5)
        k1, k2, p1, p2, k3.

    Returns
    -------
    (...) radius in the unit of the undistorted coordinates; infinite where the model never folds.
    """
    # With q = 1 / r^2 the condition q^3 + 3 k1 q^2 + 5 k2 q + 7 k3 = 0 is monic whatever vanishes.
    companion = np.zeros((*distortion.shape[:-1], 3, 3))
    companion[..., 1, 0] = companion[..., 2, 1] = 1
    for row, (coefficient, factor) in enumerate(((4, 7), (1, 5), (0, 3))):
        companion[..., row, 2] = -factor * distortion[..., coefficient]
    roots = np.linalg.eigvals(companion)
    size = np.abs(roots).max(axis=-1, keepdims=True)
    real = (np.abs(roots.imag) <= 1e-7 * size) & (roots.real > 1e-12 * (1 + size))
    largest = np.max(np.where(real, roots.real, 0), axis=-1)
    return np.where(largest > 0, 1 / np.sqrt(np.where(largest > 0, largest, 1)), np.inf)


def undistort(points: Array, coefficients: Array) -> Array:
    """Invert :func:`distort`; NaN where the model has folded over.

    The radius is found first, between zero and the fold where it is monotone, by a safeguarded Newton
    iteration that cannot leave that interval; Newton steps in the plane then account for p1 and p2, which
    also move the fold itself, outwards on one side of the image.

    Parameters
    ----------
    points : (..., N, 2)
        Distorted coordinates.
    coefficients : (..., 5)
        k1, k2, p1, p2, k3.

    Returns
    -------
    (..., N, 2) undistorted coordinates.
    """
    radius = np.hypot(points[..., 0], points[..., 1])
    undistorted_radius = _undistort_radius(radius, coefficients)
    xy = points * (undistorted_radius / np.where(radius > 0, radius, 1))[..., None]
    scale = np.maximum(undistorted_radius, np.finfo(float).tiny)
    upright = np.ones(xy.shape[:-1], dtype=bool)
    with np.errstate(invalid="ignore", over="ignore"):
        for _ in range(_NEWTON_STEPS):
            error = distort(xy, coefficients) - points
            J, _ = distort_jacobians(xy, coefficients)
            determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] ** 2
            upright = (determinant > 0) & (J[..., 0, 0] > 0)
            step = (
                np.stack(
                    [
                        J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1],
                        J[..., 0, 0] * error[..., 1] - J[..., 0, 1] * error[..., 0],
                    ],
                    axis=-1,
                )
                / np.where(determinant > 0, determinant, np.nan)[..., None]
            )
            xy = xy - step
            if not np.any(np.abs(step).max(axis=-1) > _NEWTON_TOLERANCE * scale):
                break
        # The fold itself is where the determinant reaches zero, so a ray beyond it is not the one wanted.
        far = np.hypot(xy[..., 0], xy[..., 1]) > _FOLD_REACH * fold_radius(coefficients)[..., None]
        missed = ~(np.abs(distort(xy, coefficients) - points).max(axis=-1) <= 1e-9 * (radius + scale))
    xy[missed | far | ~upright] = np.nan
    return xy


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with plumb_bob distortion.

    Parameters
    ----------
    fx, fy, cx, cy : float
        Focal lengths and principal point, pixels; the centre of the first pixel is (0, 0).
    distortion : array_like, (5,)
        k1, k2, p1, p2, k3. Zero when left out.

    Raises
    ------
    InvalidInput
        When a number is not finite or a focal length is not positive.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Array = field(default_factory=lambda: np.zeros(5))

    model = "plumb_bob"

    def __post_init__(self) -> None:
        distortion = np.array(self.distortion, dtype=np.float64)
        numbers = np.array([self.fx, self.fy, self.cx, self.cy], dtype=np.float64)
        if distortion.shape != (5,):
            raise InvalidInput("plumb_bob distortion has five coefficients: k1, k2, p1, p2, k3.")
        if not (np.isfinite(numbers).all() and np.isfinite(distortion).all() and (numbers[:2] > 0).all()):
            raise InvalidInput("A camera needs finite numbers and focal lengths above zero.")
        distortion.setflags(write=False)
        object.__setattr__(self, "distortion", distortion)
        for name, value in zip(("fx", "fy", "cx", "cy"), numbers.tolist(), strict=True):
            object.__setattr__(self, name, value)

    @property
    def intrinsics(self) -> Array:
        """(4,) fx, fy, cx, cy, pixels."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def matrix(self) -> Array:
        """(3, 3) camera matrix, pixels (K of sensor_msgs/CameraInfo)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def project(self, points: ArrayLike, T_camera_board: ArrayLike | None = None) -> Array:
        """Project points to pixels.

        Parameters
        ----------
        points : array_like, (..., 3)
            Metres, in the camera frame, or in the board frame when a pose is given.
        T_camera_board : array_like, (4, 4), optional
            Pose that maps board coordinates into the camera frame.

        Returns
        -------
        (..., 2) pixels; NaN for points that are not in front of the camera.
        """
        X = _floats(points, 3)
        if T_camera_board is not None:
            T = np.asarray(T_camera_board, dtype=np.float64)
            if T.shape != (4, 4):
                raise InvalidInput(f"T_camera_board must have shape (4, 4), not {T.shape}.")
            X = X @ T[:3, :3].T + T[:3, 3]
        flat = X.reshape(-1, 3)
        return project(flat, self.intrinsics, self.distortion).reshape(*X.shape[:-1], 2)

    def unproject(self, pixels: ArrayLike, *, folded: str = "raise") -> Array:
        """Directions that pixels see: the inverse of :meth:`project`.

        Parameters
        ----------
        pixels : array_like, (..., 2)
            Pixels.
        folded : {"raise", "nan"}
            What to do about pixels beyond the radius where the distortion model folds over.

        Returns
        -------
        (..., 3) unit vectors in the camera frame.

        Raises
        ------
        ModelFoldsOver
            When a pixel has no ray and `folded` is "raise".
        """
        uv = _floats(pixels, 2)
        flat = (uv.reshape(-1, 2) - self.intrinsics[2:]) / self.intrinsics[:2]
        xy = undistort(flat, self.distortion)
        if folded == "raise" and np.isnan(xy).any():
            lost = np.isnan(xy[:, 0])
            # Tangential distortion alone folds without a radius.
            radius = self.fold_radius_px
            where = f" {radius:.0f} px from the principal point" if np.isfinite(radius) else ""
            raise ModelFoldsOver(
                f"The distortion model folds over{where}; {lost.sum()} of {len(flat)} pixels "
                "lie beyond it, where it gives no ray."
            )
        rays: Array = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return rays.reshape(*uv.shape[:-1], 3)

    @property
    def fold_radius_px(self) -> float:
        """Distance from the principal point, pixels, at which the radial model folds over, or infinity."""
        radius = fold_radius(self.distortion)
        if not np.isfinite(radius):
            return float("inf")
        radial = np.concatenate([self.distortion[:2], [0.0, 0.0], self.distortion[4:]])
        return float(distort(np.array([[radius, 0.0]]), radial)[0, 0]) * min(self.fx, self.fy)


def _perspective(points: Array) -> Array:
    depth = points[..., 2:3]
    return points[..., :2] / np.where(depth > 0, depth, np.nan)


def _through_perspective(d_xy: Array, xy: Array, depth: Array) -> Array:
    d_points = np.empty((*d_xy.shape[:-1], 3))
    d_points[..., :2] = d_xy / depth[..., None, None]
    d_points[..., 2] = -(d_points[..., 0] * xy[..., None, 0] + d_points[..., 1] * xy[..., None, 1])
    return d_points


def _undistort_radius(distorted: Array, coefficients: Array) -> Array:
    k1, k2, _, _, k3 = _columns(coefficients)
    fold = np.broadcast_to(fold_radius(coefficients)[..., None], distorted.shape)

    def value(r: Array) -> Array:
        r2 = r * r
        return r * (1 + r2 * (k1 + r2 * (k2 + r2 * k3)))

    low = np.zeros_like(distorted)
    high = np.where(np.isfinite(fold), fold, np.maximum(distorted, 1e-300))
    with np.errstate(over="ignore", invalid="ignore"):
        while np.any(short := np.isinf(fold) & (value(high) < distorted)):
            high = np.where(short, 2 * high, high)
        reachable = value(high) >= distorted
        r = np.minimum(distorted, high)
        for _ in range(_NEWTON_STEPS):
            r2 = r * r
            error = value(r) - distorted
            low, high = np.where(error < 0, r, low), np.where(error >= 0, r, high)
            slope = 1 + r2 * (3 * k1 + r2 * (5 * k2 + r2 * 7 * k3))
            newton = r - error / np.where(slope > 0, slope, np.nan)
            # At the ends of the bracket Newton has arrived, so the comparison admits them.
            inside = (newton >= low) & (newton <= high)
            following = np.where(inside, newton, (low + high) / 2)
            moved = np.abs(following - r) > _NEWTON_TOLERANCE * following
            r = following
            if not moved.any():
                break
    return np.where(reachable, r, _FOLD_START * fold)


def _as_plumb_bob_order(distortion: Array) -> Array:
    """Order the paper's k1, k2, k3, k4 as k1, k2, p1, p2, k3: their k3 acts as p2 and k4 as p1."""
    return np.concatenate([distortion[..., [0, 1, 3, 2]], np.zeros_like(distortion[..., :1])], axis=-1)


def _columns(values: Array) -> list[Array]:
    """Split the last axis, each part with an axis for the points."""
    return [values[..., None, i] for i in range(values.shape[-1])]


def _floats(values: ArrayLike, width: int) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != width:
        raise InvalidInput(f"Expected an array of shape (..., {width}), not {array.shape}.")
    return array
