"""Trials of the paper's synthetic study: what a method finds, how far off, how fast, and what is possible.

A trial succeeds when more than 70 % of the parameters (fx s u0 fy v0 k1 k2, and three Euler angles and three
translations a view) lie within 30 % of the truth, or within 0.1 where the truth is 0 (section 5).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

import fewcal
from fewcal.adjustment import Adjustment, Geometry
from fewcal.constraints import Normal, Priors
from fewcal.parametrisation import PixelModel, ScaleFree
from fewcal.posterior import gaussian_covariance
from fewcal.views import View, ViewStack, stack_views
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
from fewcal.zhu2020 import Solutions, solve_zhang, solve_zhu2020

Array = NDArray[np.float64]
Views: TypeAlias = tuple[View, ...]
Solver: TypeAlias = Callable[[Sequence[Views], tuple[int, int]], "list[Array | None]"]
"""Trials and the size of the image to the parameters of each, None where there is no answer."""

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
        Share of the time that all trials of the row took.
    alone : float
        Seconds for this trial by itself; NaN where that was not tried, which is in all but one of a row.
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
    alone: float
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
    trials = list(paper_row(job.columns, tilts, case.views, case.camera, case.reach))
    bounds = [focal_bounds(case.camera, trial) if case.quantised else np.full(3, np.nan) for trial in trials]
    found = []
    for method in job.methods:
        found += attempt(case, trials, method, bounds)
    return found


def attempt(case: Case, trials: Sequence[Trial], method: str, bounds: Sequence[Array]) -> list[Outcome]:
    """Calibrate, and compare with the truth."""
    camera, solve = case.camera, SOLVERS[method]
    views = [trial.views for trial in trials]
    if case.quantised:
        views = [tuple(View(v.object_points, np.round(v.image_points)) for v in pair) for pair in views]
    answers, seconds = _timed(solve, views, camera.image_size)
    middle = len(trials) // 2
    alone = np.full(len(trials), np.nan)
    _, alone[middle] = _timed(solve, views[middle : middle + 1], camera.image_size)
    angles = np.array([name.rstrip("12") in POSE[:ANGLES] for name in case.parameters])
    outcomes = []
    for trial, answer, by_itself, bound in zip(trials, answers, alone.tolist(), bounds, strict=True):
        truth = _parameters(camera.intrinsics, camera.s, camera.pixel_distortion, trial.poses)
        bias = np.full(len(truth), np.nan) if answer is None else answer - truth
        bias[angles] = np.remainder(bias[angles] + np.pi, 2 * np.pi) - np.pi
        error = np.nan_to_num(abs(bias[0] / truth[0]), nan=np.inf)
        outcomes.append(
            Outcome(
                method,
                trial.columns,
                trial.tilt_deg,
                succeeds(bias, truth),
                bias,
                error,
                seconds / len(trials),
                by_itself,
                bound,
            )
        )
    return outcomes


def _timed(solve: Solver, trials: Sequence[Views], size: tuple[int, int]) -> tuple[list[Array | None], float]:
    start = time.perf_counter()
    answers = solve(trials, size)
    return answers, time.perf_counter() - start


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
        return math.sqrt(gaussian_covariance(rows, constraint(at.theta)[1][0])[0, 0])

    vague = Priors(log_focal_over_width=Normal(0.0, VAGUE))
    known = [priors.rows(camera.image_size) for priors in (vague, Priors())]
    return np.array([bound(constraint) for constraint in (_no_rows, *known)])


def _one_by_one(trials: Sequence[Views], size: tuple[int, int], priors: Priors) -> list[Array | None]:
    """Map, which knows no batch of problems: it has one of starts."""
    answers: list[Array | None] = []
    for views in trials:
        try:
            found = fewcal.calibrate(views, size, priors=priors)
        except fewcal.FewcalError:
            answers.append(None)
            continue
        answers.append(
            _parameters(found.camera.intrinsics, found.skew, found.pixel_distortion, found.board_poses)
        )
    return answers


def _at_once(
    trials: Sequence[Views], size: tuple[int, int], solve: Callable[[ViewStack, tuple[int, int]], Solutions]
) -> list[Array | None]:
    """All trials in one batch."""
    solutions = solve(ViewStack.several([stack_views(views) for views in trials]), size)
    answers: list[Array | None] = []
    for item in range(len(trials)):
        try:
            found = solutions.estimate(item)
        except fewcal.FewcalError:
            answers.append(None)
            continue
        model = found.adjustment.model
        assert isinstance(model, PixelModel)
        theta, poses = found.geometry.theta[0], found.board_poses()
        answers.append(_parameters(theta[:4], theta[4], model.coefficients(theta), tuple(poses)))
    return answers


SOLVERS: dict[str, Solver] = {
    "map": partial(_one_by_one, priors=Priors()),
    "map, f unknown": partial(_one_by_one, priors=Priors(log_focal_over_width=Normal(0.0, VAGUE))),
    "zhu2020": partial(_at_once, solve=solve_zhu2020),
    "zhu2020, centred": partial(_at_once, solve=partial(solve_zhu2020, centred=True)),
    "zhang": partial(_at_once, solve=lambda views, _: solve_zhang(views)),
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
