"""From views to a camera: the steps in order, and the result."""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .adjustment import Estimate
from .agreement import Disagreement, disagreement
from .camera import Camera, project
from .checks import real_array, require_kind
from .constraints import FOCAL, PRIOR_ROWS, Priors
from .copies import copies, share_weight
from .departures import COUNT, axial_remainder, lens_remainder
from .elimination import eliminate
from .errors import DegenerateViews, InvalidInput
from .least_squares import Stop
from .map_estimator import estimate_map
from .noise import Noise
from .parametrisation import PixelModel, ScaleFree
from .pixel_camera import from_plumb_bob, nearest_plumb_bob, plumb_bob_jacobian
from .posterior import NAMES, determined_share, gaussian_covariance, posterior, projection_std
from .prior_rows import PriorRows
from .verdict import Evidence, Thresholds, Verdict, extent, judge, outside, tilt_deg
from .views import View, ViewStack, stack_views
from .zhu2020 import estimate_zhang, estimate_zhu2020

Array = NDArray[np.float64]

LARGEST_IMAGE = 2**31 - 1
"""Width and height, pixels, that file formats and OpenCV can hold."""
METHODS = ("map", "zhu2020", "zhang")
"""The default estimator, the paper's, and the one the paper compares itself with."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera, and how far to trust it.

    Attributes
    ----------
    camera : Camera
        With distortion (5,) k1, k2, p1, p2, k3 of plumb_bob.
    image_size : (width, height), pixels
    method : str
    views : tuple of View
    board_poses : tuple of (4, 4)
        T_camera_board of each view, metres.
    view_rms : (V,)
        Root mean square distance of observed points and those that `camera` projects, of each view, pixels.
    rms : float
        The same over all points, pixels.
    pixel_distortion : (4,)
        k1, k2, k3, k4 of the paper's eqs 10-13. The methods zhu2020 and zhang estimate these, and
        `camera.distortion` is the nearest plumb_bob; for map it is the other way round.
    skew : float
        Pixels; zero unless the method estimates it.
    covariance : (8, 8) or None
        Of fx, fy, cx, cy, k1, k2, p1, p2, in their units; None for zhang.
    determined : dict or None
        For each of the unknowns (focal length, aspect ratio, ...) the share of its prior variance that the
        data removed, 0 to 1. Only for map.
    prior_conflicts : dict
        Residual, in standard deviations, of each prior that the estimate contradicts, those of board and lens
        among them.
    sigma_px : float
        Standard deviation of a point that the error bars rest on, pixels.
    departures : (4,)
        Bend of the board along x and along y, remainder of the lens, and stretch of the print, as
        :class:`Priors` counts them. The camera is the best one beside them. Zero but for map.
    verdict : Verdict
    """

    camera: Camera
    image_size: tuple[int, int]
    method: str
    views: tuple[View, ...]
    board_poses: tuple[Array, ...]
    view_rms: Array
    rms: float
    pixel_distortion: Array
    skew: float
    covariance: Array | None
    determined: dict[str, float] | None
    prior_conflicts: dict[str, float]
    sigma_px: float
    departures: Array
    verdict: Verdict

    def __post_init__(self) -> None:
        for array in (*self.board_poses, self.view_rms, self.pixel_distortion, self.departures):
            array.setflags(write=False)
        if self.covariance is not None:
            self.covariance.setflags(write=False)

    @property
    def std(self) -> dict[str, float] | None:
        """One sigma of fx, fy, cx, cy (pixels), k1, k2, p1, p2; None for zhang.

        Those of fx and fy count what the lens was found to do beyond the model, which `covariance` does not:
        `camera` suits the whole image best, and the focal length on the axis of the lens is another one.
        """
        if self.covariance is None:
            return None
        sd = _spread(self.covariance, self.camera, self.departures, self.image_size)
        return dict(zip(NAMES, sd.tolist(), strict=True))

    @property
    def focal_std(self) -> float | None:
        """Relative one sigma of the focal length fx; None for zhang."""
        return None if self.std is None else self.std["fx"] / self.camera.fx

    @cached_property
    def tilts_deg(self) -> Array:
        """(V,) angle between each board and the image plane, degrees."""
        tilts = tilt_deg(np.stack(self.board_poses)[:, :3, :3] @ stack_views(self.views).plane)
        tilts.setflags(write=False)
        return tilts

    def projection_std(self, pixels: ArrayLike) -> Array:
        """One sigma of where a known direction projects.

        Parameters
        ----------
        pixels : array_like, (N, 2)
            Where the direction projects by this camera.

        Returns
        -------
        (N,) pixels, in the worst direction in the image, with what the lens was found to do beyond the model
        of `camera` (`departures`); NaN beyond the fold of the distortion model.

        Raises
        ------
        InvalidInput
            For the method zhang, which reports no uncertainty.
        """
        if self.covariance is None:
            raise InvalidInput('The method "zhang" reports no uncertainty; use "map".')
        uv = real_array(pixels, "pixels")
        if uv.ndim != 2 or uv.shape[1] != 2:
            raise InvalidInput(f"pixels must have shape (N, 2), not {uv.shape}.")
        centre = self.camera.intrinsics[2:]
        beyond = self.departures[2] * np.hypot(*lens_remainder(uv.T[None], self.image_size, centre)[0])
        of_camera = projection_std(self.camera, self.covariance, uv)
        return np.asarray(np.hypot(of_camera, beyond), dtype=np.float64)


def calibrate(
    views: Sequence[View],
    image_size: tuple[int, int],
    method: str = "map",
    priors: Priors = Priors(),
    thresholds: Thresholds = Thresholds(),
) -> Calibration:
    """Calibrate a camera from one, two or more views of a planar board.

    Parameters
    ----------
    views : sequence of View
    image_size : (width, height)
        Pixels.
    method : {"map", "zhu2020", "zhang"}
        The default estimator, the paper's (Zhu et al. 2020), or Zhang's as that paper runs it.
    priors : Priors
        What is known of the camera beforehand; used by map.
    thresholds : Thresholds
        Where the verdict draws its lines.

    Returns
    -------
    Calibration

    Raises
    ------
    InvalidInput
        When an argument is not what it should be.
    DegenerateViews
        When the points of a view are too few or collinear, or no camera fits.
    ImaginaryFocalLength
        When the closed form of zhu2020 or zhang finds no focal length.
    """
    size = _checked_size(image_size)
    views = _checked_views(views)
    check_options(method, priors, thresholds)
    stack, alike = stack_views(views), copies(views, size)
    try:
        if method == "map":
            found = estimate_map(stack, size, priors, alike)
            solution = _map_solution(found)
            if max(solution.prior_conflicts.values()) > thresholds.conflict:
                solution = _with_stated_focal(solution, stack, size, priors, alike)
        else:
            found = estimate_zhu2020(stack, size) if method == "zhu2020" else estimate_zhang(stack)
            solution = _pixel_solution(found, size, priors, alike)
    except np.linalg.LinAlgError:
        raise DegenerateViews(
            "The points of a view lie so close together that rounding hides how; check their unit, pixels."
        ) from None
    return _result(found, solution, views, alike, size, method, priors, thresholds)


@dataclass(frozen=True)
class _Solution:
    """What an estimator found, in the terms of every method; `settled` is what the data determined of all.

    `unheld_px` is how far `camera` misses the points beyond what was found does, root mean square.
    """

    camera: Camera
    pixel_distortion: Array
    skew: float
    unheld_px: float
    sigma_px: float
    departures: Array
    covariance: Array | None
    settled: dict[str, float] | None
    prior_conflicts: dict[str, float]
    disagreement: Disagreement | None


def _map_solution(found: Estimate) -> _Solution:
    model, known = found.adjustment.model, found.adjustment.constraint
    assert isinstance(model, ScaleFree)
    assert isinstance(known, PriorRows)
    theta = found.geometry.theta[0, : model.size]
    natural = model.natural(theta)
    if model.in_pixels:
        coefficients = model.pixel_coefficients(theta)
        camera = nearest_plumb_bob(np.append(natural[:4], 0.0), coefficients, model.image_size)
    else:
        fx, fy, cx, cy = natural[:4].tolist()
        camera = Camera(fx, fy, cx, cy, np.append(natural[4:], 0.0))
        coefficients = from_plumb_bob(camera)
    rows = found.adjustment.rows(found.geometry, found.sigma)
    result = posterior(rows, known.tails(found.geometry.theta[0]))
    conflicts = known.distance(found.geometry.theta[0])
    own = slice(model.size)
    conflicts[own] = np.maximum(conflicts[own], np.abs(result.against_prior[own]))
    return _Solution(
        camera,
        coefficients,
        0.0,
        0.0,
        found.sigma,
        found.geometry.theta[0, model.size :],
        model.natural_spread(theta, result.covariance[:8, :8]),
        {name: 1 - left for name, left in _worst_by_name(1 - determined_share(result)).items()},
        _worst_by_name(conflicts),
        disagreement(result.reduced, model.size, found.sigma, found.adjustment.views.counts),
    )


def _with_stated_focal(
    solution: _Solution, stack: ViewStack, size: tuple[int, int], priors: Priors, alike: Array
) -> _Solution:
    """Hold a focal length that was stated, if any, against what the views say without it, both with their sd.

    What is stated surely can make everything else give way, at a camera where the views seem to agree.
    """
    if priors.focal_px is None:
        return solution
    free = _map_solution(estimate_map(stack, size, replace(priors, focal_px=None), alike))
    mean, sd = priors.focal_px
    off = abs(math.log(free.camera.fx / mean)) / math.hypot(sd / mean, _focal_std(free, size))
    conflicts = solution.prior_conflicts
    return replace(solution, prior_conflicts={**conflicts, FOCAL: max(off, conflicts[FOCAL])})


def _pixel_solution(found: Estimate, size: tuple[int, int], priors: Priors, alike: Array) -> _Solution:
    model, theta = found.adjustment.model, found.geometry.theta[0]
    assert isinstance(model, PixelModel)
    # The paper weighs all views alike, also as n of eq 29; but copies tell nothing new.
    shared = replace(found.adjustment, views=share_weight(found.adjustment.views, alike))
    rows = shared.rows(found.geometry, found.sigma)
    coefficients = model.coefficients(theta)
    squares = (rows.r**2).sum(keepdims=True)[0] * found.sigma**2
    sigma = float(np.sqrt(Noise.of(shared.views, priors).variance(squares)[0]))
    covariance: Array | None = None
    if model.tangential:
        penalty = found.adjustment.constraint(found.geometry.theta)[1][0] * np.sqrt((1 / alike).mean())
        of_theta = gaussian_covariance(rows, penalty) * (sigma / found.sigma) ** 2
        covariance = _propagated(of_theta, plumb_bob_jacobian(theta))
    camera = nearest_plumb_bob(theta[:5], coefficients, size)
    views = found.adjustment.views
    even = replace(found.adjustment, views=views._replace(weights=np.sign(views.weights)))
    beyond = _squared_errors(found, camera).sum() - even.linearise(found.geometry).squares[0]
    unheld = math.sqrt(max(float(beyond), 0.0) / views.counts.sum())
    reduced = eliminate(found.adjustment.rows(found.geometry, found.sigma)).camera
    apart = disagreement(reduced, theta.size, found.sigma, views.counts)
    return _Solution(
        camera, coefficients, float(theta[4]), unheld, sigma, np.zeros(COUNT), covariance, None, {}, apart
    )


def _propagated(covariance: Array, J: Array) -> Array:
    """Covariance (8, 8) through a Jacobian (8, S); infinite where a part of it is."""
    if not np.isfinite(covariance).all():
        return np.full((len(J), len(J)), np.inf)
    propagated: Array = J @ covariance @ J.T
    return propagated


def _worst_by_name(values: Array) -> dict[str, float]:
    """Gather rows that speak of one quantity under its name, keeping the largest value."""
    worst: dict[str, float] = {}
    for name, value in zip(PRIOR_ROWS, values.tolist(), strict=True):
        worst[name] = max(value, worst.get(name, value))
    return worst


def _result(
    found: Estimate,
    solution: _Solution,
    views: tuple[View, ...],
    alike: Array,
    size: tuple[int, int],
    method: str,
    priors: Priors,
    thresholds: Thresholds,
) -> Calibration:
    stack = found.adjustment.views
    poses = found.board_poses()
    counts = stack.counts
    squares = _squared_errors(found, solution.camera)
    if not np.isfinite(squares).all():
        raise DegenerateViews(
            "No camera suits these views: without the bend that they ask for the board lies behind it; check "
            "that all are of one camera, whose zoom was never changed, and of one rigid board."
        )
    view_rms = np.sqrt(squares / counts)
    covariance = solution.covariance
    evidence = Evidence(
        rotations=found.geometry.rotation[0],
        extents=np.array([extent(view.image_points, size) for view in views]),
        copies=alike,
        outside_px=max(outside(view.image_points, size) for view in views),
        camera=solution.camera,
        image_size=size,
        sigma_px=solution.sigma_px,
        focal_std=None if covariance is None else _focal_std(solution, size),
        conflicts={
            name: residual
            for name, residual in solution.prior_conflicts.items()
            if (solution.settled or {}).get(name, 0.0) < thresholds.settled_share
        },
        converged=found.stop != Stop.ITERATIONS,
        view_rms=view_rms,
        unheld_px=solution.unheld_px,
        disagreement=solution.disagreement,
        stated_focal_px=priors.focal_px,
    )
    return Calibration(
        camera=solution.camera,
        image_size=size,
        method=method,
        views=views,
        board_poses=tuple(poses),
        view_rms=view_rms,
        rms=float(np.sqrt(squares.sum() / counts.sum())),
        pixel_distortion=solution.pixel_distortion,
        skew=solution.skew,
        sigma_px=solution.sigma_px,
        departures=solution.departures,
        covariance=covariance,
        determined=solution.settled and {name: solution.settled[name] for name in PRIOR_ROWS[:-COUNT]},
        prior_conflicts={n: r for n, r in solution.prior_conflicts.items() if r > thresholds.conflict},
        verdict=judge(evidence, thresholds),
    )


def _focal_std(solution: _Solution, size: tuple[int, int]) -> float:
    assert solution.covariance is not None
    sd = _spread(solution.covariance, solution.camera, solution.departures, size)
    return float(sd[0]) / solution.camera.fx


def _spread(covariance: Array, camera: Camera, departures: Array, size: tuple[int, int]) -> Array:
    """One sigma (8,) of the parameters, see :attr:`Calibration.std`."""
    sd: Array = np.sqrt(np.diagonal(covariance))
    axial = departures[2] * axial_remainder(size, camera.intrinsics[2:])
    sd[:2] = np.hypot(sd[:2], axial * camera.intrinsics[:2])
    return sd


def _squared_errors(found: Estimate, camera: Camera) -> Array:
    """Sum of squared distances between what a camera projects and what was observed, (V,), px^2."""
    views, (_, rotation, position) = found.adjustment.views, found.geometry
    points = rotation[0, :, :, :2] @ views.points + position[0, :, :, None]
    projected = project(np.swapaxes(points, 1, 2), camera.intrinsics, camera.distortion)
    off = np.where(views.weights[..., None] > 0, projected - np.swapaxes(views.pixels, 1, 2), 0)
    squares: Array = (off * off).sum(axis=(1, 2))
    return squares


def check_options(method: str, priors: Priors, thresholds: Thresholds) -> None:
    """Refuse what :func:`calibrate` cannot work with.

    Raises
    ------
    InvalidInput
    """
    require_kind("priors", priors, Priors)
    require_kind("thresholds", thresholds, Thresholds)
    if not isinstance(method, str) or method not in METHODS:
        raise InvalidInput(f"There is no method {method!r}; choose one of {', '.join(METHODS)}.")


def _checked_views(views: Sequence[View]) -> tuple[View, ...]:
    listed = tuple(views) if isinstance(views, Iterable) else (None,)
    if not all(isinstance(view, View) for view in listed):
        raise InvalidInput("views must be a list of fewcal.View.")
    return listed


def _checked_size(image_size: tuple[int, int]) -> tuple[int, int]:
    try:
        width, height = (operator.index(length) for length in image_size)
    except (TypeError, ValueError):
        raise InvalidInput(f"image_size must be (width, height) in pixels, not {image_size!r}.") from None
    if width < 1 or height < 1:
        raise InvalidInput(f"image_size must be positive, not {width}x{height}.")
    if max(width, height) > LARGEST_IMAGE:
        raise InvalidInput(f"image_size must be at most {LARGEST_IMAGE} pixels, not {width}x{height}.")
    return width, height
