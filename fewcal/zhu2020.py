"""The paper's two-step method, and Zhang's, which it is compared with.

Zhu et al.: weighted homographies (eq 15), the simplified closed form (eqs 19-27), poses (eq 28), then
refinement of every parameter with the exponential constraint on fx - fy (eq 29).
Zhang (2000): unweighted homographies, his closed form, refinement of fx, fy, s, u0, v0, k1, k2 and poses.
"""

from __future__ import annotations

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
from .least_squares import Stop, minimise
from .parametrisation import PixelModel
from .views import ViewStack

Array = NDArray[np.float64]


def estimate_zhu2020(views: ViewStack, image_size: tuple[int, int], centred: bool = False) -> Estimate:
    """Run the paper's method (section 4).

    Parameters
    ----------
    views : ViewStack
    image_size : (width, height), pixels
    centred : bool
        Hold the principal point at the image's centre in the closed form of several views, as the paper does
        for one; not the paper's method, but it tells where that one fails.

    Raises
    ------
    ImaginaryFocalLength
        When the closed form gives f^2 <= 0.
    DegenerateViews
        When the closed form puts a board behind the camera.
    """
    centre = np.array(image_size) / 2
    H = homographies(views.points, views.pixels, views.weights)
    H = refine_homographies(H, views.points, views.pixels, views.weights, centre)
    squared, u0, v0 = simplified_intrinsics(H, centre, centred)
    f = checked_focal_length(squared)
    count = len(views.points)

    def penalty(theta: Array) -> tuple[Array, Array]:
        r, J = exponential_penalty(theta[:, 0], theta[:, 1], count)
        rows = np.zeros((len(theta), 1, theta.shape[1]))
        rows[:, 0, :2] = J
        return r[:, None], rows

    start = np.array([f, f, u0, v0, 0.0])
    problem = Adjustment(views, PixelModel(tangential=True), penalty)
    return _refine(problem, H, start)


def estimate_zhang(views: ViewStack) -> Estimate:
    """Run Zhang's method as the paper does.

    Raises
    ------
    ImaginaryFocalLength
        When the closed form asks for the root of a negative number.
    DegenerateViews
        When the closed form puts a board behind the camera.
    """
    H = homographies(views.points, views.pixels, views.weights)
    start = zhang_intrinsics(H)
    problem = Adjustment(views, PixelModel(tangential=False), _unconstrained)
    return _refine(problem, H, start)


def _unconstrained(theta: Array) -> tuple[Array, Array]:
    return np.zeros((len(theta), 0)), np.zeros((len(theta), 0, theta.shape[1]))


def _refine(problem: Adjustment, H: Array, intrinsics: Array) -> Estimate:
    """Poses by eq 28, distortion zero, then Levenberg-Marquardt over everything."""
    fx, fy, u0, v0, skew = intrinsics
    A = np.array([[fx, skew, u0], [0, fy, v0], [0, 0, 1]])
    R, t = poses_from_homographies(H, A)
    theta = np.zeros((1, problem.model.size))
    theta[0, :5] = intrinsics
    found = minimise(problem, Geometry(theta, R[None], t[None]))
    if not np.isfinite(found.objective[0]):
        raise DegenerateViews(
            'The closed form puts a board behind the camera; tilt the board more, or use method "map".'
        )
    if not np.all(found.state.theta[0, :2] > 0):
        raise DegenerateViews(
            'The refinement leads to a focal length that is not positive; add a view, or use method "map".'
        )
    return Estimate(problem, found.state, 1.0, Stop(int(found.stop[0])))
