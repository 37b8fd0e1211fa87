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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .adjustment import rotation_from_vector
from .boards import Chessboard
from .distortion import distort, fold_radius, undistort
from .errors import InvalidInput, ModelFoldsOver
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
_SECTIONS = 24
"""Distances of the first look, farthest first."""
_FALSE_POSITIONS = 60
"""More than any board needs, 8 as a rule, to find the distance between two of those."""
_ROUNDING = 1e-13
"""Of the size of a board's image, as a share of half the image's: 1e-10 pixels."""


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

    def unproject(self, pixels: ArrayLike, *, folded: str = "raise") -> Array:
        """Directions (..., 3) of pixels (..., 2), unit vectors; see :meth:`fewcal.Camera.unproject`."""
        uv = np.asarray(pixels, dtype=np.float64)
        flat = undistort(uv.reshape(-1, 2) - [self.u0, self.v0], self._coefficients)
        if folded == "raise" and np.isnan(flat).any():
            raise ModelFoldsOver("A pixel lies where the distortion model has folded over and gives no ray.")
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
    rotation : (..., 3, 3)
        From board to camera; it is kept. Many are placed at once.
    reach : float
        Size of the region as a share of the image.
    outline : {"frame", "circle"}
        Whether the region is the image's own rectangle or its inscribed circle, about the image's middle.

    Returns
    -------
    (..., 4, 4) T_camera_board. The middle of the image of the board is at the middle of the image.

    Raises
    ------
    InvalidInput
        When the distortion folds over inside the region.
    """
    if outline not in ("frame", "circle"):
        raise InvalidInput(f'outline is "frame" or "circle", not {outline!r}.')
    region = _Region((np.array(image_size, dtype=np.float64) - 1) / 2, reach, outline == "circle")
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    turned = (points - middle) @ np.swapaxes(rotation, -1, -2)
    centre = _slope(camera, region.half)
    slope = np.broadcast_to(centre, (*turned.shape[:-2], 3))
    for _ in range(_CENTRING_STEPS):
        distance = _nearest(camera, region, turned, slope, extent)
        pixels = camera.project(turned + distance[..., None, None] * slope[..., None, :])
        slope = slope + centre - _slope(camera, (pixels.min(axis=-2) + pixels.max(axis=-2)) / 2)
    distance = _nearest(camera, region, turned, slope, extent)
    seen = turned + distance[..., None, None] * slope[..., None, :]
    back = camera.unproject(camera.project(seen), folded="nan")
    if not np.all(np.abs(np.cross(back, seen)) <= 1e-6 * distance[..., None, None]):
        raise InvalidInput("The distortion folds over inside the region; choose a smaller reach.")
    T = np.zeros((*rotation.shape[:-2], 4, 4))
    T[..., :3, :3] = rotation
    T[..., :3, 3] = distance[..., None] * slope - rotation @ middle
    T[..., 3, 3] = 1
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
    pose: Array = _paper_poses(columns, [(tilt_deg, tilt_axis_deg, roll_deg)], camera, reach)[0]
    return pose


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
    return next(paper_row(columns, (tilt_deg,), views, camera, reach, rng))


def paper_trials(
    views: int = 1, camera: VirtualCamera = PAPER_CAMERA, reach: float = PAPER_REACH
) -> Iterator[Trial]:
    """Make all 1350 trials of section 5.1.2 (one view) or 5.1.3 (two views), one after the other."""
    for columns in PAPER_COLUMNS:
        yield from paper_row(columns, PAPER_TILTS_DEG, views, camera, reach)


def paper_row(
    columns: int,
    tilts_deg: Sequence[float] = PAPER_TILTS_DEG,
    views: int = 1,
    camera: VirtualCamera = PAPER_CAMERA,
    reach: float = PAPER_REACH,
    rng: np.random.Generator | None = None,
) -> Iterator[Trial]:
    """Make the trials with boards of one size, which are placed at once; see :func:`paper_trial`."""
    if views not in (1, 2):
        raise InvalidInput(f"A trial of the paper has one view or two, not {views!r}.")
    row = columns - PAPER_COLUMNS[0]
    arrangements: list[tuple[float, float, float]] = []
    for tilt_deg in tilts_deg:
        column = round(tilt_deg / PAPER_TILTS_DEG[0]) - 1
        axis = (row * len(PAPER_TILTS_DEG) + column) * GOLDEN_ANGLE_DEG % 360
        pair = [(PAPER_REFERENCE_TILT_DEG, axis + 90, 0.0), (tilt_deg, axis, 0.0)][-views:]
        if rng is not None:
            pair = [(tilt, rng.uniform(0, 360), rng.uniform(0, 360)) for tilt, _, _ in pair]
        arrangements += pair
    poses = iter(_paper_poses(columns, arrangements, camera, reach))
    points = _paper_points(columns)
    for tilt_deg in tilts_deg:
        of_trial = tuple(islice(poses, views))
        yield Trial(columns, tilt_deg, tuple(exact_view(camera, points, T) for T in of_trial), of_trial)


def _paper_poses(
    columns: int, arrangements: Sequence[tuple[float, float, float]], camera: VirtualCamera, reach: float
) -> Array:
    """Poses (P, 4, 4) for tilts, tilt axes and rolls, degrees."""
    rotations = np.stack([board_pose(*arrangement)[:3, :3] for arrangement in arrangements])
    return fill_image(camera, camera.image_size, _paper_points(columns), rotations, reach, "circle")


def _paper_points(columns: int) -> Array:
    return Chessboard(columns, PAPER_ROWS, PAPER_SQUARE_SIZE).points


class _Region(NamedTuple):
    """A part of the image about its middle: `half` (2,) of its size, pixels, and what share of it."""

    half: Array
    reach: float
    circle: bool

    def excess(self, pixels: Array) -> Array:
        """How far the outermost of some pixels (..., N, 2) is outside (...), as a share of `half`."""
        offset = np.abs(pixels - self.half) / (self.half.min() if self.circle else self.half)
        size = np.linalg.norm(offset, axis=-1) if self.circle else offset.max(axis=-1)
        excess: Array = size.max(axis=-1) - self.reach
        return excess


def _slope(camera: Projector, pixels: Array) -> Array:
    """Directions (..., 3) of pixels (..., 2), x / z, y / z, 1."""
    rays = camera.unproject(pixels.reshape(-1, 2), folded="nan").reshape(*pixels.shape[:-1], 3)
    slopes: Array = rays / rays[..., 2:]
    return slopes


def _nearest(camera: Projector, region: _Region, turned: Array, slope: Array, extent: float) -> Array:
    """Smallest distance (...) along a slope (..., 3) from which on all points (..., N, 3) are inside.

    The size of the image is almost linear in the inverse of the distance, so that false position (Illinois
    variant) finds it in a few steps; a point behind the camera is NaN, and the step a bisection.
    """

    def excess(inverse: Array) -> Array:
        return region.excess(camera.project(turned + slope[..., None, :] / inverse[..., None, None]))

    looked_at = np.geomspace(1 / (_FARTHEST * extent), 1 / (_NEAREST * extent), _SECTIONS)
    shape = turned.shape[:-2]
    seen = np.stack([excess(np.broadcast_to(inverse, shape)) for inverse in looked_at])
    inside = seen <= 0
    first = np.clip(np.argmin(inside, axis=0), 1, None)[None]  # of those that are not
    far, near = (looked_at[first - step][0] for step in (1, 0))
    at_far, at_near = (np.take_along_axis(seen, first - step, 0)[0] for step in (1, 0))
    went_near = np.zeros(shape, dtype=np.int8)
    for _ in range(_FALSE_POSITIONS):
        with np.errstate(invalid="ignore", divide="ignore"):
            step = at_far / (at_far - at_near)
        middle = far + np.where(np.isfinite(step), step, 0.5) * (near - far)
        at_middle = excess(middle)
        if np.all((np.abs(at_middle) < _ROUNDING) | (middle == far) | (middle == near)):
            break
        good = at_middle <= 0
        # An end that stays for the second time counts half, so that the next step reaches beyond.
        again = np.where(good, went_near > 0, went_near < 0)
        went_near = np.where(good, 1, -1)
        at_far = np.where(good, at_middle, np.where(again, at_far / 2, at_far))
        at_near = np.where(good, np.where(again, at_near / 2, at_near), at_middle)
        far, near = np.where(good, middle, far), np.where(good, near, middle)
    distance: Array = 1 / np.where(inside.all(axis=0), looked_at[-1], middle)
    return distance
