from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import CAMERA, SIZE, geometry, noisy, pose, view, views_at

from fewcal.adjustment import Geometry
from fewcal.calibration import calibrate
from fewcal.camera import Camera
from fewcal.constraints import Priors
from fewcal.elimination import eliminate
from fewcal.least_squares import Stop, minimise
from fewcal.map_estimator import _doubtful, estimate_map
from fewcal.noise import Noise
from fewcal.parametrisation import ScaleFree
from fewcal.prior_rows import PriorRows
from fewcal.variational import middle
from fewcal.views import View, stack_views

Array = NDArray[np.float64]

FREE = ScaleFree(SIZE)
TILTS = ((40, 30), (35, 120), (30, -60), (20, 80), (45, 200))
UNSQUARE = replace(CAMERA, fy=1000.0)
THETA = FREE.theta(np.concatenate([CAMERA.intrinsics, CAMERA.distortion[:4]]))


@pytest.mark.parametrize("span", [0.08, 0.15, 0.3])
def test_the_right_one_of_both_poses_is_found_for_boards_far_away(span: float) -> None:
    tilts = ((50, 10), (50, 100))
    poses = [pose(*tilt, span=span) for tilt in tilts]
    found = estimate_map(stack_views(noisy([view(T) for T in poses], 0.02, 5)), SIZE, Priors())
    for R, T in zip(found.geometry.rotation[0], poses, strict=True):
        assert np.degrees(np.arccos(min(1.0, (np.trace(R.T @ T[:3, :3]) - 1) / 2))) < 3
    fx = np.exp(found.geometry.theta[0, 0])
    assert fx == pytest.approx(1100, rel=0.1)


@pytest.mark.parametrize("f", [600.0, 5000.0])
def test_lenses_far_from_the_ordinary_are_found(f: float) -> None:
    lens = Camera(f, f, 639.5, 479.5)
    found = estimate_map(
        stack_views(noisy(views_at((45, 30), (40, 120), camera=lens), 0.1, 6)), SIZE, Priors()
    )
    assert np.exp(found.geometry.theta[0, 0]) == pytest.approx(f, rel=0.03)


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("sigma", [0.02, 0.2, 1.0])
def test_the_estimate_is_the_middle_of_the_posterior_at_its_own_noise(count: int, sigma: float) -> None:
    found = estimate_map(stack_views(noisy(views_at(*TILTS[:count]), sigma, 7)), SIZE, Priors())
    assert found.stop != Stop.ITERATIONS
    problem, at = found.adjustment, found.geometry
    squares = problem.linearise(at).squares
    assert found.sigma**2 == pytest.approx(problem.variance(squares)[0], rel=1e-3)
    eliminated = eliminate(problem.rows(at, found.sigma))
    reduced = eliminated.camera.reshape(-1, 13)
    assert isinstance(problem.constraint, PriorRows)
    centre = middle(reduced[:, :-1], reduced[:, -1], problem.constraint.tails(at.theta[0]))
    assert centre is not None
    assert centre.length < 0.02
    # And no pose of a board suits the camera better.
    still = np.zeros((1, 12))
    moved = problem.retract(at, still, eliminated.pose_steps(still[0])[None])
    gain = (squares - problem.linearise(moved).squares)[0] / found.sigma**2
    assert abs(gain) < 1e-3


@pytest.mark.parametrize(("f", "tilt"), [(3000.0, (10, 30)), (600.0, (15, 150)), (3000.0, (15, 150))])
def test_the_way_to_the_middle_takes_as_many_steps_as_it_needs(f: float, tilt: tuple[float, float]) -> None:
    (seen,) = noisy(views_at(tilt, camera=Camera(f, f, 700.0, 450.0)), 0.05, 1)
    found = estimate_map(stack_views([seen]), SIZE, Priors())
    problem, at = found.adjustment, found.geometry
    assert isinstance(problem.constraint, PriorRows)
    reduced = eliminate(problem.rows(at, found.sigma)).camera.reshape(-1, 13)
    centre = middle(reduced[:, :-1], reduced[:, -1], problem.constraint.tails(at.theta[0]))
    assert centre is not None
    assert centre.length < 0.02


@pytest.mark.parametrize("count", [1, 2, 4])
def test_the_estimate_lies_near_the_highest_point_of_the_posterior(count: int) -> None:
    found = estimate_map(stack_views(noisy(views_at(*TILTS[:count]), 0.2, 7)), SIZE, Priors())
    problem, at = found.adjustment, found.geometry
    highest = minimise(problem, at)
    equations = problem.linearise(at)
    here = problem.objective(equations.squares, equations.shared_squares)
    assert -0.1 < here[0] - highest.objective[0] < 2


def test_the_true_camera_is_no_better_than_the_estimate() -> None:
    stack = stack_views(noisy(views_at(*TILTS[:2]), 0.3, 9))
    found = estimate_map(stack, SIZE, Priors())
    truth = Geometry(np.append(THETA, np.zeros(4))[None], *geometry([pose(*tilt) for tilt in TILTS[:2]]))
    objective = [
        found.adjustment.objective(e.squares, e.shared_squares)[0]
        for e in map(found.adjustment.linearise, (found.geometry, truth))
    ]
    assert objective[0] < objective[1]


@pytest.mark.parametrize(
    ("camera", "tilts", "span"),
    [
        (UNSQUARE, ((5, 30), (5, 150)), 0.6),
        (UNSQUARE, ((3, 0), (3, 90), (3, 200)), 0.3),
        (UNSQUARE, ((5, 0), (5, 60), (5, 120), (5, 200), (5, 300)), 0.3),
        (replace(CAMERA, fy=1067.0), ((0, 0), (0, 40), (0, 80)), 0.6),
        (replace(CAMERA, cx=960.0, cy=640.0), ((10, 30),), 0.6),
    ],
)
def test_no_minimum_near_the_truth_is_lower_far_out_in_the_tails_of_the_prior(
    camera: Camera, tilts: tuple[tuple[float, float], ...], span: float
) -> None:
    # Boards tilted the wrong way, or a lens three times as long, explain such views in ways of their own.
    poses = [pose(tilt, about, about if tilt == 0 else 0, span, camera=camera) for tilt, about in tilts]
    found = estimate_map(stack_views(noisy([view(T, camera=camera) for T in poses], 0.1, 0)), SIZE, Priors())
    theta = FREE.theta(np.concatenate([camera.intrinsics, camera.distortion[:4]]))
    truth = Geometry(np.append(theta, np.zeros(4))[None], *geometry(poses))
    here, there = (minimise(found.adjustment, start).objective[0] for start in (found.geometry, truth))
    assert here < there + 0.5


def test_exact_points_are_taken_at_their_word_against_the_prior() -> None:
    # An aspect ratio twenty scales from the middle of its prior: only trust in the data finds it.
    odd = Camera(1100.0, 1155.0, 650.0, 470.0, CAMERA.distortion)
    stack = stack_views(views_at((3, 0), (50, 120), camera=odd))
    found = estimate_map(stack, SIZE, Priors())
    assert np.exp(found.geometry.theta[0, 0]) == pytest.approx(1100, rel=1e-6)
    squares = found.adjustment.linearise(found.geometry).squares
    assert Noise.of(stack, Priors()).scatter(squares)[0] < 1e-6


def test_four_points_that_a_camera_saw_have_a_noise() -> None:
    (view,) = noisy(views_at((40, 30)), 0.3, 5)
    corners = [0, 8, 45, 53]
    found = calibrate([View(view.object_points[corners], view.image_points[corners])], SIZE)
    assert np.isfinite(found.sigma_px)
    assert found.focal_std is not None
    assert found.focal_std < 0.2


def test_a_minimum_is_doubtful_for_what_it_leaves_or_contradicts() -> None:
    found = estimate_map(stack_views(noisy(views_at((40, 30), (35, 120)), 0.2, 1)), SIZE, Priors())
    problem, lowest = found.adjustment, minimise(found.adjustment, found.geometry)
    assert problem.noise is not None
    scatter = float(problem.noise.scatter(lowest.equations.squares)[0])
    assert not _doubtful(problem, lowest, scatter)
    assert _doubtful(problem, lowest, scatter / 1.2)
    theta = lowest.state.theta + 0.02 * (np.arange(12) == 8)
    assert _doubtful(problem, replace(lowest, state=lowest.state._replace(theta=theta)), scatter)
    small = lowest.equations._replace(groups=1e-3 * lowest.equations.groups)
    assert not _doubtful(problem, replace(lowest, equations=small), 0.0)
