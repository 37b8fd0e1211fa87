"""The paper's virtual camera and the views it takes (Zhu et al. 2020, section 5.1.1).

The paper gives the camera, the boards and the shooting angles, but neither the direction of the tilt nor the
place of the board. Here they follow a rule, so that every trial is the same on every machine:

- Place. "The displacement which arises from the radial distortion is up to 35.67 pixels": with the paper's
  coefficients that is 572 px from the middle of the image, 95.5 % of half its side. So the board comes as
  near as it can with every point inside that circle. (Filling the square image instead would displace the
  corners of a square board by more than twice as much.)
- Direction. The tilt axis turns by the golden angle from trial to trial, counted row by row over the 27 x 50
  trials. No direction is preferred, and none is special: a board tilted exactly about one of its own axes
  says nothing of the focal length through the first of the two equations that a view gives.
- The first of two views, always at 1.2 degrees, is tilted about an axis at right angles to that of the view
  with which it is paired, so that the pair never is one view twice.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .adjustment import rotation_from_vector
from .boards import Chessboard
from .distortion import distort, fold_radius, undistort
from .errors import InvalidInput
from .rendering import Projector
from .views import View

Array = NDArray[np.float64]

PAPER_ROWS = 6
PAPER_COLUMNS = range(4, 31)
PAPER_TILTS_DEG = tuple(round(1.2 * k, 1) for k in range(1, 51))
"""Control points down and across the board, and shooting angles: 27 x 50 = 1350 trials."""
PAPER_REFERENCE_TILT_DEG = 1.2
"""Shooting angle of the first of two views (section 5.1.3)."""
PAPER_SQUARE_SIZE = 0.03
"""Metres. The paper names none; only the translations scale with it."""
PAPER_REACH = 0.9546
"""Radius of the outermost point over half the image's side, at which the displacement is 35.67 px."""
FIGURE_12_REACH = 0.8
"""The same for figure 12, whose distortion folds over at 0.87."""
GOLDEN_ANGLE_DEG = 180 * (3 - math.sqrt(5))
"""Multiples of it fall evenly on the circle, whatever their number."""

_CENTRING_STEPS = 6
"""Each leaves a few per cent, at most a third, of the offset of the middle: together less than 0.1 px."""
_NEAREST, _FARTHEST = 0.05, 500.0
"""Distances looked at, in extents of the board: from a fish-eye to 20 times a telephoto lens."""
_SECTIONS, _ROUNDS = 24, 8
"""The distance is bracketed in 23 parts, 8 times over, to 1e-10 of itself."""


@dataclass(frozen=True, eq=False)
class VirtualCamera:
    """A camera with the paper's distortion in pixels (eqs 2-13).

    Parameters
    ----------
    fx, fy, u0, v0 : float
        Focal lengths and principal point, pixels.
    pixel_distortion : array_like, (4,)
        k1, k2, k3, k4 in px^-2, px^-4, px^-1, px^-1.
    image_size : (int, int)
        Width and height, pixels.
    s : float
        Skew, pixels.
    """

    fx: float
    fy: float
    u0: float
    v0: float
    pixel_distortion: Array = field(default_factory=lambda: np.zeros(4))
    image_size: tuple[int, int] = (1200, 1200)
    s: float = 0.0

    def __post_init__(self) -> None:
        distortion = np.array(self.pixel_distortion, dtype=np.float64)
        if distortion.shape != (4,) or not np.isfinite([*distortion, *self.intrinsics]).all():
            raise InvalidInput("A virtual camera has five finite intrinsics and four of k1, k2, k3, k4.")
        distortion.setflags(write=False)
        object.__setattr__(self, "pixel_distortion", distortion)

    @property
    def intrinsics(self) -> Array:
        """(5,) fx, fy, u0, v0, s, pixels."""
        return np.array([self.fx, self.fy, self.u0, self.v0, self.s])

    def project(self, points: ArrayLike, T_camera_board: ArrayLike | None = None) -> Array:
        """Project points (..., 3), metres, to pixels (..., 2); see :meth:`fewcal.Camera.project`."""
        X = np.asarray(points, dtype=np.float64)
        if T_camera_board is not None:
            T = np.asarray(T_camera_board, dtype=np.float64)
            X = X @ T[:3, :3].T + T[:3, 3]
        depth = np.where(X[..., 2] > 0, X[..., 2], np.nan)
        x, y = X[..., 0] / depth, X[..., 1] / depth
        undistorted = np.stack([self.fx * x + self.s * y, self.fy * y], axis=-1)
        return distort(undistorted, self._coefficients) + self.intrinsics[2:4]

    def unproject(self, pixels: ArrayLike, *, folded: str = "nan") -> Array:
        """Directions (..., 3) of pixels (..., 2), unit vectors; NaN beyond the fold of the distortion."""
        uv = np.asarray(pixels, dtype=np.float64)
        flat = undistort(uv.reshape(-1, 2) - [self.u0, self.v0], self._coefficients)
        if folded == "raise" and np.isnan(flat).any():
            raise InvalidInput("A pixel lies where the distortion model has folded over and gives no ray.")
        y = flat[:, 1] / self.fy
        rays = np.stack([(flat[:, 0] - self.s * y) / self.fx, y, np.ones_like(y)], axis=-1)
        unit: Array = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        return unit.reshape(*uv.shape[:-1], 3)

    @property
    def fold_radius_px(self) -> float:
        """Distance from the principal point, pixels in the image, at which the distortion folds over."""
        k1, k2 = self.pixel_distortion[:2]
        r = float(fold_radius(self._coefficients))
        return r * (1 + k1 * r**2 + k2 * r**4) if math.isfinite(r) else math.inf

    @property
    def _coefficients(self) -> Array:
        k1, k2, k3, k4 = self.pixel_distortion
        return np.array([k1, k2, k4, k3, 0.0])


PAPER_CAMERA = VirtualCamera(4000.0, 4010.0, 600.0, 600.0, np.array([2.3e-7, 2.8e-15, 0, 0]), (1200, 1200))
"""The camera of sections 5.1.1 to 5.1.4."""
FIGURE_12_CAMERA = VirtualCamera(
    1000.0, 1050.0, 1000.0, 1000.0, np.array([-2e-7, 2.5e-15, 0, 0]), (2000, 2000)
)
"""The camera of section 6, figure 12."""


class Trial(NamedTuple):
    """One trial of the paper: what is calibrated from, and the truth.

    Attributes
    ----------
    columns : int
    tilt_deg : float
        Shooting angle of the view that varies.
    views : tuple of View
    poses : tuple of (4, 4) T_camera_board, one for each view
    """

    columns: int
    tilt_deg: float
    views: tuple[View, ...]
    poses: tuple[Array, ...]


def board_pose(
    tilt_deg: float,
    tilt_axis_deg: float,
    roll_deg: float = 0.0,
    distance: float = 1.0,
    centre: ArrayLike = (0.0, 0.0),
) -> Array:
    """Pose of a tilted board, its given point on the principal axis.

    Parameters
    ----------
    tilt_deg : float
        Angle between the principal axis and the board's normal.
    tilt_axis_deg : float
        Direction in the image of the axis about which it is tilted, from u towards v.
    roll_deg : float
        Turn in the board's own plane, before the tilt.
    distance : float
        Depth of the given point, metres.
    centre : array_like, (2,)
        That point in the board frame, metres.

    Returns
    -------
    (4, 4) T_camera_board.
    """
    about = math.radians(tilt_axis_deg)
    axis = np.array([math.cos(about), math.sin(about), 0.0])
    T = np.eye(4)
    T[:3, :3] = rotation_from_vector(math.radians(tilt_deg) * axis) @ rotation_from_vector(
        np.array([0.0, 0.0, math.radians(roll_deg)])
    )
    T[:3, 3] = [0.0, 0.0, distance] - T[:3, :2] @ np.asarray(centre, dtype=np.float64)
    return T


def fill_image(
    camera: Projector,
    image_size: tuple[int, int],
    points: Array,
    rotation: Array,
    reach: float = 0.95,
    outline: str = "frame",
) -> Array:
    """Bring a board as near as it can come with all its points inside a region of the image.

    Parameters
    ----------
    camera : Projector
        Any camera that projects.
    image_size : (int, int)
        Width and height, pixels.
    points : (N, 3)
        Board frame, metres, z = 0.
    rotation : (3, 3)
        From board to camera; it is kept.
    reach : float
        Size of the region as a share of the image.
    outline : {"frame", "circle"}
        Whether the region is the image's own rectangle or its inscribed circle, about the image's middle.

    Returns
    -------
    (4, 4) T_camera_board. The middle of the image of the board is at the middle of the image.

    Raises
    ------
    InvalidInput
        When the distortion folds over inside the region.
    """
    if outline not in ("frame", "circle"):
        raise InvalidInput(f'outline is "frame" or "circle", not {outline!r}.')
    half = (np.array(image_size, dtype=np.float64) - 1) / 2
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    turned = (points - middle) @ rotation.T
    slope = _slope(camera, half)
    for _ in range(_CENTRING_STEPS):
        distance = _nearest(camera, half, turned, slope, extent, reach, outline == "circle")
        pixels = camera.project(turned + distance * slope)
        slope = slope + _slope(camera, half) - _slope(camera, (pixels.min(axis=0) + pixels.max(axis=0)) / 2)
    distance = _nearest(camera, half, turned, slope, extent, reach, outline == "circle")
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = distance * slope - rotation @ middle
    seen = turned + distance * slope
    back = camera.unproject(camera.project(seen), folded="nan")
    if not np.allclose(np.cross(back, seen), 0, atol=1e-6 * distance):
        raise InvalidInput("The distortion folds over inside the region; choose a smaller reach.")
    return T


def exact_view(camera: Projector, points: Array, T_camera_board: Array) -> View:
    """View of points (N, 3), metres, without any noise."""
    return View(points, camera.project(points, T_camera_board))


def paper_pose(
    columns: int,
    tilt_deg: float,
    tilt_axis_deg: float,
    camera: VirtualCamera = PAPER_CAMERA,
    reach: float = PAPER_REACH,
    roll_deg: float = 0.0,
) -> Array:
    """Pose (4, 4) of the paper's board of 6 rows, as near as the circle of `reach` admits."""
    points = _paper_points(columns)
    rotation = board_pose(tilt_deg, tilt_axis_deg, roll_deg)[:3, :3]
    return fill_image(camera, camera.image_size, points, rotation, reach, "circle")


def paper_trial(
    columns: int,
    tilt_deg: float,
    views: int = 1,
    camera: VirtualCamera = PAPER_CAMERA,
    reach: float = PAPER_REACH,
    rng: np.random.Generator | None = None,
) -> Trial:
    """One trial of the paper, from one exact view or from two.

    Parameters
    ----------
    columns : int
        Control points in each of the 6 rows; the paper has 4 to 30.
    tilt_deg : float
        Shooting angle; the paper has 1.2 to 60 in steps of 1.2.
    views : {1, 2}
        With two, the first is always taken at 1.2 degrees (section 5.1.3).
    camera, reach
        Such as `FIGURE_12_CAMERA` and `FIGURE_12_REACH`.
    rng : numpy.random.Generator, optional
        Draws the tilt axes, and a roll, at random, to see what depends on the rule above.
    """
    if views not in (1, 2):
        raise InvalidInput(f"A trial of the paper has one view or two, not {views!r}.")
    row, column = columns - PAPER_COLUMNS[0], round(tilt_deg / PAPER_TILTS_DEG[0]) - 1
    axis = (row * len(PAPER_TILTS_DEG) + column) * GOLDEN_ANGLE_DEG % 360
    arrangements = [(PAPER_REFERENCE_TILT_DEG, axis + 90, 0.0), (tilt_deg, axis, 0.0)][-views:]
    if rng is not None:
        arrangements = [(tilt, *rng.uniform(0, 360, 2).tolist()) for tilt, _, _ in arrangements]
    poses = tuple(paper_pose(columns, tilt, about, camera, reach, roll) for tilt, about, roll in arrangements)
    points = _paper_points(columns)
    return Trial(columns, tilt_deg, tuple(exact_view(camera, points, T) for T in poses), poses)


def paper_trials(views: int = 1) -> Iterator[Trial]:
    """Make all 1350 trials of section 5.1.2 (one view) or 5.1.3 (two views), one after the other."""
    for columns in PAPER_COLUMNS:
        for tilt_deg in PAPER_TILTS_DEG:
            yield paper_trial(columns, tilt_deg, views)


def _paper_points(columns: int) -> Array:
    return Chessboard(columns, PAPER_ROWS, PAPER_SQUARE_SIZE).points


def _slope(camera: Projector, pixel: Array) -> Array:
    """(3,) direction of a pixel, x / z, y / z, 1."""
    ray = camera.unproject(pixel[None], folded="nan")[0]
    return np.asarray(ray / ray[2])


def _nearest(
    camera: Projector, half: Array, turned: Array, slope: Array, extent: float, reach: float, circle: bool
) -> float:
    """Smallest distance along a slope from which on outwards every point is inside the region."""
    near, far = _NEAREST * extent, _FARTHEST * extent
    for _ in range(_ROUNDS):
        distances = np.geomspace(far, near, _SECTIONS)
        pixels = camera.project(turned + distances[:, None, None] * slope)
        offset = np.abs(pixels - half) / (half.min() if circle else half)
        size = np.linalg.norm(offset, axis=-1) if circle else offset.max(axis=-1)
        inside = size.max(axis=-1) <= reach  # a point behind the camera is NaN, and so not inside
        if inside.all():
            return float(near)
        first = max(int(np.argmin(inside)), 1)
        far, near = distances[first - 1], distances[first]
    return float(far)
