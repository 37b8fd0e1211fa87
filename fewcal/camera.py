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

from .checks import real_array
from .distortion import distort, distort_jacobians, fold_radius, undistort
from .errors import InvalidInput, ModelFoldsOver

Array = NDArray[np.float64]


class Projection(NamedTuple):
    """Pixels and their derivatives.

    Attributes
    ----------
    pixels : (..., N, 2) px
    d_points : (..., N, 2, 3) px per metre in the camera frame
    d_intrinsics : (..., N, 2, 4) by (fx, fy, cx, cy)
    d_distortion : (..., N, 2, K) by the distortion coefficients
    """

    pixels: Array
    d_points: Array
    d_intrinsics: Array
    d_distortion: Array


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


def project_pixel_model(points: Array, intrinsics: Array, distortion: Array) -> Array:
    """Project with the paper's distortion in pixels (eqs 2-13).

    Parameters
    ----------
    points : (..., N, 3)
        Camera frame, metres. Points with z <= 0 have no image and give NaN.
    intrinsics : (..., 5)
        fx, fy, u0, v0, s, pixels.
    distortion : (..., 4)
        k1, k2 (eq 10-11), k3, k4 (eq 12-13), in px^-2, px^-4, px^-1, px^-1.

    Returns
    -------
    (..., N, 2) pixels.
    """
    xy = _perspective(points)
    undistorted = xy * intrinsics[..., None, :2]
    undistorted[..., 0] += intrinsics[..., None, 4] * xy[..., 1]
    # The paper's k3 acts as p2 of plumb_bob and its k4 as p1.
    coefficients = np.zeros((*distortion.shape[:-1], 5))
    coefficients[..., :4] = distortion[..., [0, 1, 3, 2]]
    return distort(undistorted, coefficients) + intrinsics[..., None, 2:4]


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
        distortion = real_array(self.distortion, "distortion")
        numbers = real_array([self.fx, self.fy, self.cx, self.cy], "fx, fy, cx and cy")
        if numbers.shape != (4,):
            raise InvalidInput("fx, fy, cx and cy must be one number each.")
        if distortion.shape != (5,):
            raise InvalidInput("plumb_bob distortion has five coefficients: k1, k2, p1, p2, k3.")
        if not (np.isfinite(numbers).all() and np.isfinite(distortion).all() and (numbers[:2] > 0).all()):
            raise InvalidInput("A camera needs finite numbers and focal lengths above zero.")
        distortion.setflags(write=False)
        object.__setattr__(self, "distortion", distortion)
        for name, value in zip(("fx", "fy", "cx", "cy"), numbers.tolist(), strict=True):
            object.__setattr__(self, name, value)

    def __reduce__(self) -> tuple[type[Camera], tuple[object, ...]]:
        # Through the constructor: numpy forgets that an array was read-only.
        return Camera, (self.fx, self.fy, self.cx, self.cy, self.distortion)

    @property
    def intrinsics(self) -> Array:
        """(4,) fx, fy, cx, cy, pixels."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def parameters(self) -> dict[str, float]:
        """Every number by its name: fx, fy, cx, cy in pixels, then k1, k2, p1, p2, k3."""
        names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
        return dict(zip(names, [*self.intrinsics.tolist(), *self.distortion.tolist()], strict=True))

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
        X = _floats(points, 3, "points")
        if T_camera_board is not None:
            T = real_array(T_camera_board, "T_camera_board")
            if T.shape != (4, 4):
                raise InvalidInput(f"T_camera_board must have shape (4, 4), not {T.shape}.")
            X = X @ T[:3, :3].T + T[:3, 3]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            uv = project(X.reshape(-1, 3), self.intrinsics, self.distortion)
        return uv.reshape(*X.shape[:-1], 2)

    def unproject(self, pixels: ArrayLike, *, folded: str = "raise") -> Array:
        """Directions that pixels see: the inverse of :meth:`project`.

        Parameters
        ----------
        pixels : array_like, (..., 2)
            Pixels.
        folded : {"raise", "nan"}
            What to do about pixels beyond the radius where the distortion model folds over. Where p1 and p2
            are larger than those of any lens (0.02) others may be taken for such.

        Returns
        -------
        (..., 3) unit vectors in the camera frame.

        Raises
        ------
        ModelFoldsOver
            When a pixel has no ray and `folded` is "raise".
        """
        if folded not in ("raise", "nan"):
            raise InvalidInput(f'folded must be "raise" or "nan", not {folded!r}.')
        uv = _floats(pixels, 2, "pixels")
        if folded == "raise" and not np.isfinite(uv).all():
            raise InvalidInput("pixels holds a value that is not finite; leave such pixels out.")
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


def _floats(values: ArrayLike, width: int, name: str) -> Array:
    array = real_array(values, name)
    if array.ndim == 0 or array.shape[-1] != width:
        raise InvalidInput(f"{name} must have shape (..., {width}), not {array.shape}.")
    return array
