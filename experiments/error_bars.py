"""One calibration of a drawn scene, and how many reported standard deviations it missed the truth by."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from real_cameras import turned_errors
from synthetic import ERRORS, SPANS, Scene, draw_scene

import fewcal
from fewcal.camera import project_jacobians
from fewcal.constraints import Priors
from fewcal.parametrisation import ScaleFree

Array = NDArray[np.float64]

TILTS_DEG = (0, 5, 10, 20, 30, 45, 65)
VIEWS = (1, 2, 3, 5)
SCENARIOS: dict[str, tuple[str, float]] = {
    "assumed": ("assumed", 1.0),
    "iid": ("iid", 1.0),
    "real": ("real", 1.0),
    "bent": ("bent", 1.0),
    "wrong sigma": ("wrong sigma", 1.0),
    "assumed x2": ("assumed", 2.0),
    "assumed x3": ("assumed", 3.0),
}
"""Model of the errors, and how many times as wide as the prior principal point and aspect are drawn."""
QUANTITIES = ("fx", "cx", "cy", "k1", "p1", "p2", "pixel", "turned")


@dataclass(frozen=True)
class Draw:
    """One calibration beside its truth.

    Attributes
    ----------
    scenario, tilt_deg, views, distance
        What was drawn.
    fx, cx, cy, k1, p1, p2, pixel, turned : float
        Error over reported standard deviation; infinite without an answer.
    focal_error, focal_std : float
        Of ln fx, and relative.
    prior_std : float
        What the prior alone would leave of ln fx once the distortion is known.
    usable : bool
    """

    scenario: str
    tilt_deg: int
    views: int
    distance: str
    fx: float = np.inf
    cx: float = np.inf
    cy: float = np.inf
    k1: float = np.inf
    p1: float = np.inf
    p2: float = np.inf
    pixel: float = np.inf
    turned: float = np.inf
    focal_error: float = np.inf
    focal_std: float = np.nan
    prior_std: float = np.nan
    usable: bool = False


Job = tuple[str, int, int]
"""Scenario, tilt in degrees, number of the draw."""


def scene_of(job: Job) -> tuple[Scene, list[fewcal.View], str, np.random.Generator]:
    """Draw a scene and its views, one of :data:`SPANS`; the generator is for what else is to be drawn."""
    scenario, tilt, number = job
    rng = np.random.default_rng([list(SCENARIOS).index(scenario), tilt, number])
    errors, width = SCENARIOS[scenario]
    distance = tuple(SPANS)[number // len(VIEWS) % len(SPANS)]
    scene = draw_scene(rng, tilt, VIEWS[number % len(VIEWS)], distance, width)
    return scene, ERRORS[errors](scene, rng), distance, rng


def run(job: Job) -> Draw:
    """Draw a scene, calibrate from it and compare."""
    scene, views, distance, rng = scene_of(job)
    drawn = (job[0], job[1], len(views), distance)
    try:
        found = fewcal.calibrate(views, scene.size)
    except fewcal.FewcalError:
        return Draw(*drawn)
    return Draw(*drawn, *compare(found, scene, rng))


def compare(found: fewcal.Calibration, scene: Scene, rng: np.random.Generator) -> tuple[float, ...]:
    """Everything that :class:`Draw` holds of the answer."""
    std, covariance, focal_std = found.std, found.covariance, found.focal_std
    assert std is not None
    assert covariance is not None
    assert focal_std is not None
    truth = scene.camera
    errors = {name: getattr(found.camera, name) - getattr(truth, name) for name in ("fx", "cx", "cy")}
    distortion = found.camera.distortion - truth.distortion
    errors |= {name: float(distortion[i]) for name, i in (("k1", 0), ("p1", 2), ("p2", 3))}
    scores = [error / std[name] for name, error in errors.items()]
    pixel = rng.uniform(0, 1, 2) * (np.array(scene.size) - 1)
    scores += [fixed_score(found.camera, covariance, truth, pixel)]
    scores += [turned_score(found.camera, covariance, scene, rng)]
    log_error = float(np.log(found.camera.fx / truth.fx))
    return (*scores, log_error, focal_std, prior_focal_std(found.camera, scene.size), found.verdict.usable)


def fixed_score(camera: fewcal.Camera, covariance: Array, truth: fewcal.Camera, pixel: Array) -> float:
    """Error of where the direction of a true pixel projects, along the worst direction in the image."""
    ray = truth.unproject(pixel[None])
    J = camera_jacobian(camera, ray)[0]
    return _worst_score((camera.project(ray) - pixel)[0], J @ covariance @ J.T)


def turned_score(camera: fewcal.Camera, covariance: Array, scene: Scene, rng: np.random.Generator) -> float:
    """The same for a pixel of the grid after the rotation that fits all of the image best."""
    rays, errors = turned_errors(camera, scene.camera, scene.size)
    seen = np.isfinite(errors).all(axis=1)
    if not seen.any():
        return np.inf
    rays, errors = rays[seen], errors[seen]
    J = camera_jacobian(camera, rays)
    d_points = project_jacobians(rays, camera.intrinsics, camera.distortion).d_points
    by_turn = np.cross(rays[:, None], d_points).reshape(-1, 3)
    flat = J.reshape(-1, 8)
    left = (flat - by_turn @ np.linalg.lstsq(by_turn, flat, rcond=None)[0]).reshape(J.shape)
    index = rng.integers(len(rays))
    return _worst_score(errors[index], left[index] @ covariance @ left[index].T)


def camera_jacobian(camera: fewcal.Camera, rays: Array) -> Array:
    """Derivative (N, 2, 8) of the projection by fx, fy, cx, cy, k1, k2, p1, p2."""
    found = project_jacobians(rays, camera.intrinsics, camera.distortion)
    return np.concatenate([found.d_intrinsics, found.d_distortion[..., :4]], axis=-1)


def _worst_score(error: Array, covariance: Array) -> float:
    """Error along the widest axis of its covariance (2, 2), over the standard deviation there."""
    if not (np.isfinite(error).all() and np.isfinite(covariance).all()):
        return np.inf
    variance, axes = np.linalg.eigh(covariance)
    return float(error @ axes[:, 1] / np.sqrt(variance[1]))


def prior_focal_std(camera: fewcal.Camera, size: tuple[int, int]) -> float:
    """Standard deviation of ln fx by the prior alone, for a camera whose distortion is known."""
    theta = ScaleFree(size).theta(np.concatenate([camera.intrinsics, camera.distortion[:4]]))
    by_focal = Priors().rows(size)(theta[None])[1][0, :, 0]
    return float(1 / np.linalg.norm(by_focal))
