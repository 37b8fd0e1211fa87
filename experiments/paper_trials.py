"""One trial of the paper's synthetic study: what a method finds, how far off, how fast, and what is possible.

A trial succeeds when more than 70 % of the parameters (fx s u0 fy v0 k1 k2, and three Euler angles and three
translations a view) lie within 30 % of the truth, or within 0.1 where the truth is 0 (section 5).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

import fewcal
from fewcal.adjustment import Adjustment, Geometry
from fewcal.constraints import Normal, Priors
from fewcal.parametrisation import ScaleFree
from fewcal.posterior import gaussian_covariance
from fewcal.views import View, stack_views
from fewcal.virtual_camera import (
    FIGURE_12_CAMERA,
    FIGURE_12_REACH,
    PAPER_CAMERA,
    PAPER_COLUMNS,
    PAPER_REACH,
    PAPER_TILTS_DEG,
    Trial,
    VirtualCamera,
    paper_row,
)
from fewcal.zhu2020 import estimate_zhu2020

Array = NDArray[np.float64]
Views: TypeAlias = tuple[View, ...]

ROUNDING_PX = 1 / math.sqrt(12)
"""Standard deviation of the error that rounding to whole pixels makes."""
INTRINSICS = ("fx", "s", "u0", "fy", "v0", "k1", "k2")
POSE = ("alpha", "beta", "gamma", "tx", "ty", "tz")
VAGUE = 10.0
"""Standard deviation of ln(f / W) where nothing is known of the focal length."""
ANGLES = 3
"""The first so many of a pose."""


class Case(NamedTuple):
    """Which of the paper's studies.

    Attributes
    ----------
    title : str
    views : int
    quantised : bool
        Pixels rounded to whole numbers.
    camera : VirtualCamera
    reach : float
        See :func:`fewcal.virtual_camera.paper_trial`.
    methods : tuple of str
        Of :data:`SOLVERS`, those that tell something here.
    """

    title: str
    views: int
    methods: tuple[str, ...] = ("map", "zhu2020", "zhang")
    quantised: bool = False
    camera: VirtualCamera = PAPER_CAMERA
    reach: float = PAPER_REACH

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of all parameters that count."""
        numbers = range(1, self.views + 1)
        return INTRINSICS + tuple(f"{name}{i}" if self.views > 1 else name for i in numbers for name in POSE)


CASES = {
    "one": Case("One exact view", 1),
    "two": Case("Two exact views", 2, ("map", "zhu2020", "zhu2020, centred", "zhang")),
    "quantised": Case(
        "Two views, pixels rounded",
        2,
        ("map", "map, f unknown", "zhu2020", "zhu2020, centred", "zhang"),
        quantised=True,
    ),
    "figure12": Case("Two exact views, figure 12", 2, camera=FIGURE_12_CAMERA, reach=FIGURE_12_REACH),
}


class Outcome(NamedTuple):
    """What one method made of one trial.

    Attributes
    ----------
    method : str
    columns : int
    tilt_deg : float
    success : bool
        By the paper's criterion.
    bias : (P,)
        Estimate less truth of `Case.parameters`: pixels, px^-2, px^-4, rad, metres; NaN without an answer.
    focal_error : float
        Relative, of fx; infinite without an answer.
    seconds : float
    bounds : (3,)
        Cramer-Rao bound of ln fx from the points alone, with the priors of map but that of the focal length,
        and with all its priors. NaN for exact points.
    """

    method: str
    columns: int
    tilt_deg: float
    success: bool
    bias: Array
    focal_error: float
    seconds: float
    bounds: Array


class Job(NamedTuple):
    """Trials with boards of one size: every n-th of the case's 1350, counted row by row."""

    case: str
    columns: int
    methods: tuple[str, ...]
    every: int = 1


def run(job: Job) -> list[Outcome]:
    """Run all methods on the trials of a job."""
    case = CASES[job.case]
    first = PAPER_COLUMNS.index(job.columns) * len(PAPER_TILTS_DEG)
    tilts = [tilt for i, tilt in enumerate(PAPER_TILTS_DEG, first) if i % job.every == 0]
    if not tilts:
        return []
    found = []
    for trial in paper_row(job.columns, tilts, case.views, case.camera, case.reach):
        bounds = focal_bounds(case.camera, trial) if case.quantised else np.full(3, np.nan)
        found += [attempt(case, trial, method, bounds) for method in job.methods]
    return found


def attempt(case: Case, trial: Trial, method: str, bounds: Array) -> Outcome:
    """Calibrate, and compare with the truth."""
    views = trial.views
    if case.quantised:
        views = tuple(fewcal.View(view.object_points, np.round(view.image_points)) for view in views)
    camera = case.camera
    truth = _parameters(camera.intrinsics, camera.s, camera.pixel_distortion, trial.poses)
    start = time.perf_counter()
    try:
        bias = SOLVERS[method](views, camera.image_size) - truth
    except fewcal.FewcalError:
        bias = np.full(len(truth), np.nan)
    seconds = time.perf_counter() - start
    angles = np.array([name.rstrip("12") in POSE[:ANGLES] for name in case.parameters])
    bias[angles] = np.remainder(bias[angles] + np.pi, 2 * np.pi) - np.pi
    error = np.nan_to_num(abs(bias[0] / truth[0]), nan=np.inf)
    success = succeeds(bias, truth)
    return Outcome(method, trial.columns, trial.tilt_deg, success, bias, error, seconds, bounds)


def succeeds(bias: Array, truth: Array) -> bool:
    """Apply the paper's criterion."""
    error, scale = np.abs(bias), np.abs(truth)
    return bool(np.where(scale == 0, error <= 0.1, error <= 0.3 * scale).mean() > 0.7)


def focal_bounds(camera: VirtualCamera, trial: Trial) -> Array:
    """Cramer-Rao bounds (3,) of ln fx for points rounded to pixels; see :class:`Outcome`.

    The unknowns are fx, fy, u0, v0, k1 to k4 and the poses.
    """
    model = ScaleFree(camera.image_size, in_pixels=True)
    half = model.diagonal / 2
    fx, fy, u0, v0, _ = camera.intrinsics
    k1, k2, k3, k4 = camera.pixel_distortion
    offset = (np.array([u0, v0]) - model.centre) / model.diagonal
    theta = np.array(
        [math.log(fx), math.log(fy / fx), *offset, k1 * half**2, k2 * half**4, k4 * half, k3 * half]
    )
    stack, poses = stack_views(trial.views), np.stack(trial.poses)
    rotation = poses[:, :3, :3]
    position = poses[:, :3, 3] + (rotation @ stack.centroid[..., None])[..., 0]
    at = Geometry(theta[None], (rotation @ stack.plane)[None], position[None])

    def bound(constraint: Callable[[Array], tuple[Array, Array]]) -> float:
        rows = Adjustment(stack, model, constraint).rows(at, ROUNDING_PX)
        return math.sqrt(gaussian_covariance(rows)[0, 0])

    width = max(camera.image_size)
    vague = Priors(log_focal_over_width=Normal(0.0, VAGUE))
    return np.array([bound(_no_rows), bound(vague.rows(width)), bound(Priors().rows(width))])


def _calibrate(views: Views, size: tuple[int, int], method: str, priors: Priors = Priors()) -> Array:
    found = fewcal.calibrate(views, size, method=method, priors=priors)
    return _parameters(found.camera.intrinsics, found.skew, found.pixel_distortion, found.board_poses)


def _centred(views: Views, size: tuple[int, int]) -> Array:
    stack = stack_views(views)
    geometry = estimate_zhu2020(stack, size, centred=True).geometry
    theta = geometry.theta[0]
    poses = np.tile(np.eye(4), (len(views), 1, 1))
    poses[:, :3, :3] = geometry.rotation[0] @ np.swapaxes(stack.plane, -1, -2)
    poses[:, :3, 3] = geometry.position[0] - (poses[:, :3, :3] @ stack.centroid[..., None])[..., 0]
    return _parameters(theta[:4], theta[4], theta[5:], tuple(poses))


SOLVERS: dict[str, Callable[[Views, tuple[int, int]], Array]] = {
    "map": partial(_calibrate, method="map"),
    "map, f unknown": partial(
        _calibrate, method="map", priors=Priors(log_focal_over_width=Normal(0.0, VAGUE))
    ),
    "zhu2020": partial(_calibrate, method="zhu2020"),
    "zhu2020, centred": _centred,
    "zhang": partial(_calibrate, method="zhang"),
}
"""The methods, and two variants that tell what decides: map without a prior of the focal length, and zhu2020
with the principal point held at the centre in the closed form of two views."""


def _no_rows(theta: Array) -> tuple[Array, Array]:
    return np.zeros((len(theta), 0)), np.zeros((len(theta), 0, theta.shape[1]))


def _parameters(intrinsics: Array, skew: float, distortion: Array, poses: tuple[Array, ...]) -> Array:
    fx, fy, u0, v0 = intrinsics[:4]
    of_poses = [value for T in poses for value in (*euler(T[:3, :3]), *T[:3, 3])]
    return np.array([fx, skew, u0, fy, v0, *distortion[:2], *of_poses])


def euler(R: Array) -> tuple[float, float, float]:
    """Angles of R = Rz(gamma) Ry(beta) Rx(alpha), rad."""
    return (
        float(np.arctan2(R[2, 1], R[2, 2])),
        float(-np.arcsin(np.clip(R[2, 0], -1, 1))),
        float(np.arctan2(R[1, 0], R[0, 0])),
    )
