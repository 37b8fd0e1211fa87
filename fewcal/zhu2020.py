"""The paper's two-step method, and Zhang's, which it is compared with.

Zhu et al.: weighted homographies (eq 15), the simplified closed form (eqs 19-27), poses (eq 28), then
refinement of every parameter with the exponential constraint on fx - fy (eq 29).
Zhang (2000): unweighted homographies, his closed form, refinement of fx, fy, s, u0, v0, k1, k2 and poses.

Both take many sets of views at once, for studies.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .adjustment import Adjustment, Estimate, Geometry
from .closed_form import (
    checked_focal_length,
    poses_from_homographies,
    simplified_intrinsics,
    zhang_intrinsics,
)
from .constraints import exponential_penalty
from .errors import DegenerateViews
from .homography import homographies, refine_homographies
from .least_squares import Minimum, Stop, minimise
from .parametrisation import PixelModel
from .views import ViewStack

Array = NDArray[np.float64]


class Solutions(NamedTuple):
    """What a method makes of B sets of views.

    Attributes
    ----------
    problem : Adjustment
        With the views of all sets.
    squared_focal : (B, K)
        What the closed form finds for f^2, or for fx^2 and fy^2, px^2.
    minimum : Minimum
    """

    problem: Adjustment
    squared_focal: Array
    minimum: Minimum[Geometry]

    def estimate(self, item: int) -> Estimate:
        """Look at one of them.

        Raises
        ------
        ImaginaryFocalLength
            When the closed form asks for the root of a number that is not positive.
        DegenerateViews
            When it puts a board behind the camera, or the refinement leads to none.
        """
        for squared in self.squared_focal[item]:
            checked_focal_length(squared)
        found = self.minimum.take(np.array([item]))
        if not np.isfinite(found.objective[0]):
            raise DegenerateViews(
                'The closed form puts a board behind the camera; tilt the board more, or use method "map".'
            )
        if not np.all(found.state.theta[0, :2] > 0):
            raise DegenerateViews(
                "The refinement leads to a focal length that is not positive; add a view, or use method "
                '"map".'
            )
        views = ViewStack(*(part[item] for part in self.problem.views))
        return Estimate(replace(self.problem, views=views), found.state, 1.0, Stop(int(found.stop[0])))


def estimate_zhu2020(views: ViewStack, image_size: tuple[int, int]) -> Estimate:
    """Run the paper's method (section 4).

    Parameters
    ----------
    views : ViewStack
    image_size : (width, height), pixels

    Raises
    ------
    ImaginaryFocalLength
        When the closed form gives f^2 <= 0.
    DegenerateViews
        When the closed form puts a board behind the camera, or the refinement leads to no camera.
    """
    return solve_zhu2020(ViewStack.several([views]), image_size).estimate(0)


def estimate_zhang(views: ViewStack) -> Estimate:
    """Run Zhang's method as the paper does.

    Raises
    ------
    ImaginaryFocalLength
        When the closed form asks for the root of a negative number.
    DegenerateViews
        When the closed form puts a board behind the camera, or the refinement leads to no camera.
    """
    return solve_zhang(ViewStack.several([views])).estimate(0)


def solve_zhu2020(views: ViewStack, image_size: tuple[int, int], centred: bool = False) -> Solutions:
    """Run the paper's method on many sets of views.

    Parameters
    ----------
    views : ViewStack
        With a first axis, see :meth:`ViewStack.several`.
    image_size : (width, height), pixels
    centred : bool
        Hold the principal point at the image's centre in the closed form of several views, as the paper does
        for one; not the paper's method, but it tells where that one fails.
    """
    centre = np.array(image_size) / 2
    H = homographies(views.points, views.pixels, views.weights)
    parts = (H, views.points, views.pixels, views.weights)
    apart, points, pixels, weights = (part.reshape(-1, *part.shape[2:]) for part in parts)
    H = refine_homographies(apart, points, pixels, weights, centre).reshape(H.shape)
    found = simplified_intrinsics(H, centre, centred)
    count = views.points.shape[1]

    def penalty(theta: Array) -> tuple[Array, Array]:
        r, J = exponential_penalty(theta[:, 0], theta[:, 1], count)
        rows = np.zeros((len(theta), 1, theta.shape[1]))
        rows[:, 0, :2] = J
        return r[:, None], rows

    problem = Adjustment(views, PixelModel(tangential=True), penalty)
    return _refine(problem, H, found[:, :1], found[:, 1:])


def solve_zhang(views: ViewStack) -> Solutions:
    """Run Zhang's method on many sets of views, which have a first axis as for :func:`solve_zhu2020`."""
    H = homographies(views.points, views.pixels, views.weights)
    found = zhang_intrinsics(H)
    problem = Adjustment(views, PixelModel(tangential=False), _unconstrained)
    return _refine(problem, H, found[:, :2], found[:, 2:])


def _unconstrained(theta: Array) -> tuple[Array, Array]:
    return np.zeros((len(theta), 0)), np.zeros((len(theta), 0, theta.shape[1]))


def _refine(problem: Adjustment, H: Array, squared_focal: Array, rest: Array) -> Solutions:
    """Poses by eq 28, distortion zero, then Levenberg-Marquardt over everything.

    `rest` (B, 2 or 3) is u0, v0 and skew, where the closed form has one. Where it has no focal length the
    start is NaN, at which nothing is minimised.
    """
    real = np.isfinite(squared_focal).all(axis=1) & (squared_focal > 0).all(axis=1)
    A = np.tile(np.eye(3), (len(H), 1, 1))
    theta = np.full((len(H), problem.model.size), np.nan)
    theta[real] = 0
    theta[real, :2] = np.sqrt(squared_focal[real])
    theta[real, 2 : 2 + rest.shape[1]] = rest[real]
    A[real, 0, 0], A[real, 1, 1] = theta[real, :2].T
    A[real, :2, 2], A[real, 0, 1] = theta[real, 2:4], theta[real, 4]
    R, t = poses_from_homographies(H, A[:, None])
    return Solutions(problem, squared_focal, minimise(problem, Geometry(theta, R, t)))
