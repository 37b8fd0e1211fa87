"""Exact views of a known camera, shared by the tests of the mathematics."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fewcal.adjustment import rotation_from_vector
from fewcal.boards import Chessboard
from fewcal.camera import Camera
from fewcal.views import View

Array = NDArray[np.float64]

SIZE = (1280, 960)
BOARD = Chessboard(9, 6, 0.025)
CAMERA = Camera(1100.0, 1103.0, 650.0, 470.0, [-0.12, 0.03, 0.0006, -0.0004, 0.0])
"""An everyday camera: nothing about it contradicts the priors."""


def pose(
    tilt_deg: float,
    about_deg: float = 0.0,
    roll_deg: float = 0.0,
    span: float = 0.5,
    shift_px: tuple[float, float] = (0.0, 0.0),
    points: Array = BOARD.points,
    camera: Camera = CAMERA,
    size: tuple[int, int] = SIZE,
) -> Array:
    """Pose of a board tilted about an axis in the image plane.

    Parameters
    ----------
    tilt_deg, about_deg : float
        Angle of the tilt, and the direction of its axis from the x axis of the image.
    roll_deg : float
        Turn of the board in its own plane, before the tilt.
    span : float
        Diagonal of the board, seen face on, over the diagonal of the image.
    shift_px : (float, float)
        Where the middle of the board is seen, from the middle of the image.
    points : (N, 3)
        Of the board, metres.

    Returns
    -------
    (4, 4) T_camera_board.
    """
    about = np.radians(about_deg)
    tilt = rotation_from_vector(np.radians(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))
    roll = rotation_from_vector(np.array([0.0, 0.0, np.radians(roll_deg)]))
    depth = camera.fx * np.linalg.norm(np.ptp(points, axis=0)) / (span * np.hypot(*size))
    middle = (np.array(size) - 1) / 2 + shift_px
    T = np.eye(4)
    T[:3, :3] = tilt @ roll
    T[:3, 3] = np.append((middle - camera.intrinsics[2:]) / camera.intrinsics[:2], 1.0) * depth
    T[:3, 3] -= T[:3, :3] @ points.mean(axis=0)
    return T


def view(T: Array, points: Array = BOARD.points, camera: Camera = CAMERA) -> View:
    """What the camera sees, exactly."""
    return View(points, camera.project(points, T))


def views_at(*arrangements: tuple[float, float], camera: Camera = CAMERA, **more: float) -> list[View]:
    """Exact views of the board tilted by so many degrees about such axes."""
    return [view(pose(tilt, about, camera=camera, **more), camera=camera) for tilt, about in arrangements]


def geometry(poses: Sequence[Array], points: Array = BOARD.points) -> tuple[Array, Array]:
    """Poses as an adjustment holds them: rotations (1, V, 3, 3) and positions of the centroid (1, V, 3)."""
    T = np.stack(poses)[None]
    return T[..., :3, :3], T[..., :3, :3] @ points.mean(axis=0) + T[..., :3, 3]


def noisy(views: Sequence[View], sigma_px: float, seed: int) -> list[View]:
    """The same views with normal noise on every image coordinate."""
    rng = np.random.default_rng(seed)
    return [
        View(v.object_points, v.image_points + rng.normal(0, sigma_px, v.image_points.shape)) for v in views
    ]


def differences(function: Callable[[Array], Array], at: Array, step: float | Array) -> Array:
    """Central differences of `function` by the last axis of `at`; the new axis comes last."""
    steps = np.broadcast_to(step, at.shape[-1:])
    columns = []
    for i, h in enumerate(steps):
        ahead, back = at.copy(), at.copy()
        ahead[..., i] += h
        back[..., i] -= h
        columns.append((function(ahead) - function(back)) / (2 * h))
    return np.stack(columns, axis=-1)


def assert_derivative(analytic: Array, numeric: Array, tolerance: float = 1e-7) -> None:
    """Agreement, column by column, as far as central differences can show in double precision."""
    assert analytic.shape == numeric.shape
    largest = np.abs(numeric).max(axis=tuple(range(numeric.ndim - 1)))
    assert np.isfinite(analytic).all()
    assert (np.abs(analytic - numeric) <= tolerance * largest).all()
