"""From views to a camera: the steps in order, and the result."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .adjustment import Estimate
from .camera import Camera
from .checks import checked_size, real_array, require_kind
from .constraints import PRIOR_ROWS, Priors
from .copies import Copies, copies
from .departures import COUNT, lens_remainder, radial_terms
from .errors import DegenerateViews, InvalidInput
from .least_squares import Stop
from .map_estimator import estimate_map
from .posterior import NAMES, projection_std
from .solution import (
    Solution,
    focal_std,
    map_solution,
    pixel_solution,
    spread,
    squared_errors,
    with_stated_focal,
)
from .verdict import Evidence, Thresholds, Verdict, extent, judge, outside, tilt_deg
from .views import View, stack_views
from .zhu2020 import estimate_zhang, estimate_zhu2020

Array = NDArray[np.float64]

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
        sd = spread(self.covariance, self.camera, self.departures, self.image_size)
        return dict(zip(NAMES, sd.tolist(), strict=True))

    @property
    def focal_std(self) -> float | None:
        """Relative one sigma of the focal length fx; None for zhang."""
        std = self.std
        return None if std is None else std["fx"] / self.camera.fx

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
        centre, radial = self.camera.intrinsics[2:], radial_terms(self.camera, self.image_size)
        beyond = self.departures[2] * np.hypot(
            *lens_remainder(uv.T[None], self.image_size, centre, radial)[0]
        )
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
    size = checked_size(image_size)
    views = _checked_views(views)
    check_options(method, priors, thresholds)
    stack, alike = stack_views(views), copies(views, size)
    try:
        if method == "map":
            found = estimate_map(stack, size, priors, alike)
            solution = map_solution(found, alike)
            if max(solution.prior_conflicts.values()) > thresholds.conflict:
                tilted = bool(tilt_deg(found.geometry.rotation[0]).max() > thresholds.tilt_deg)
                solution = with_stated_focal(solution, stack, size, priors, alike, tilted)
        else:
            found = estimate_zhu2020(stack, size) if method == "zhu2020" else estimate_zhang(stack)
            solution = pixel_solution(found, size, priors, alike)
    except np.linalg.LinAlgError:
        raise DegenerateViews(
            "The points of a view lie so close together that rounding hides how; check their unit, pixels."
        ) from None
    return _result(found, solution, views, alike, size, method, priors, thresholds)


def _result(
    found: Estimate,
    solution: Solution,
    views: tuple[View, ...],
    alike: Copies,
    size: tuple[int, int],
    method: str,
    priors: Priors,
    thresholds: Thresholds,
) -> Calibration:
    stack = found.adjustment.views
    poses = found.board_poses()
    counts = stack.counts
    squares = squared_errors(found, solution.camera)
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
        copies=alike.times,
        outside_px=max(outside(view.image_points, size) for view in views),
        camera=solution.camera,
        image_size=size,
        sigma_px=solution.sigma_px,
        focal_std=None if covariance is None else focal_std(solution, size),
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
