from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, SIZE, noisy, views_at

from fewcal.calibration import calibrate
from fewcal.camera import Camera
from fewcal.constraints import FOCAL, Priors
from fewcal.copies import copies
from fewcal.departures import axial_remainder, radial_terms
from fewcal.map_estimator import estimate_map
from fewcal.posterior import determined_share, posterior
from fewcal.solution import (
    focal_std,
    map_solution,
    pixel_solution,
    spread,
    squared_errors,
    with_stated_focal,
)
from fewcal.verdict import Thresholds
from fewcal.views import View, stack_views
from fewcal.zhu2020 import estimate_zhu2020

SQUARE = Camera(1100.0, 1100.0, 650.0, 470.0, [-0.12, 0.03, 0.0006, -0.0004, 0.0])
TILTS = ((40, 30), (35, 120))


def test_pixel_distortion_says_the_same_as_the_camera() -> None:
    views = noisy(views_at(*TILTS), 0.2, 1)
    for found in (
        calibrate(views, SIZE),
        calibrate(views_at(*TILTS, camera=SQUARE), SIZE, method="zhu2020"),
    ):
        k1, k2, k3, k4 = found.pixel_distortion
        f = np.sqrt(found.camera.fx * found.camera.fy)
        expected = [k1 * f**2, k2 * f**4, k4 * f, k3 * f, 0]
        np.testing.assert_allclose(found.camera.distortion, expected, rtol=1e-6, atol=1e-12)


def test_a_skewed_camera_is_not_given_away_as_one_without() -> None:
    # Pixels that are longer than wide, which the paper's constraint makes up for by skew.
    views = noisy(views_at((40, 30), (25, 100), camera=replace(CAMERA, fy=1122.0)), 0.02, 5)
    found = calibrate(views, SIZE, "zhu2020", thresholds=Thresholds(focal_std=1.0))
    assert abs(found.skew) > 5
    assert found.rms > 1
    assert not found.verdict.usable
    assert "no place in plumb_bob" in " ".join(found.verdict.reasons)
    held = calibrate(noisy(views_at(*TILTS), 0.2, 1), SIZE, "zhu2020")
    assert "no place in plumb_bob" not in " ".join(held.verdict.reasons)


def test_what_plumb_bob_does_not_hold_is_what_it_misses_beyond_the_method() -> None:
    views = noisy(views_at(*TILTS, camera=replace(CAMERA, fy=1122.0)), 0.2, 5)
    stack, alike = stack_views(views), copies(views, SIZE)
    found = estimate_zhu2020(stack, SIZE)
    solution = pixel_solution(found, SIZE, Priors(), alike)
    misses = squared_errors(found, solution.camera).sum()
    own = found.adjustment.linearise(found.geometry).squares[0]
    assert solution.unheld_px == pytest.approx(np.sqrt((misses - own) / (2 * 54)))
    assert map_solution(estimate_map(stack, SIZE, Priors()), alike).unheld_px == 0


def test_points_that_count_for_less_do_not_tell_what_plumb_bob_does_not_hold() -> None:
    rng, sigma = np.random.default_rng(3), np.where(np.arange(54) % 3, 0.05, 1.0)
    views = [
        View(view.object_points, view.image_points + rng.normal(0, 1, (54, 2)) * sigma[:, None], sigma)
        for view in views_at(*TILTS, camera=SQUARE)
    ]
    found = estimate_zhu2020(stack_views(views), SIZE)
    solution = pixel_solution(found, SIZE, Priors(), copies(views, SIZE))
    assert squared_errors(found, solution.camera).sum() > 20
    assert solution.unheld_px < 0.2


@pytest.mark.parametrize("count", [2, 20])
def test_views_are_compared_by_their_own_scatter_however_many_share_the_weight(count: int) -> None:
    rng = np.random.default_rng(4)
    views = noisy(
        views_at(*np.column_stack([rng.uniform(10, 45, count), rng.uniform(0, 360, count)])), 0.3, 2
    )
    stack, alike = stack_views(views), copies(views, SIZE)
    mine = map_solution(estimate_map(stack, SIZE, Priors(), alike), alike).disagreement
    theirs = pixel_solution(estimate_zhu2020(stack, SIZE), SIZE, Priors(), alike).disagreement
    for found in (mine, theirs):
        assert found is not None
        assert found.alone_px == pytest.approx(0.3, rel=0.1)


def test_the_remainder_of_the_lens_widens_the_focal_length_alone() -> None:
    covariance, departures = np.diag(np.arange(1.0, 9.0)), np.array([0.5, 0.5, 0.02, 0.5])
    plain = np.sqrt(np.diagonal(covariance))
    np.testing.assert_array_equal(spread(covariance, CAMERA, np.zeros(4), SIZE), plain)
    wide = spread(covariance, CAMERA, departures, SIZE)
    beyond = (
        0.02
        * axial_remainder(SIZE, CAMERA.intrinsics[2:], radial_terms(CAMERA, SIZE))
        * CAMERA.intrinsics[:2]
    )
    np.testing.assert_allclose(wide[:2], np.hypot(plain[:2], beyond))
    np.testing.assert_array_equal(wide[2:], plain[2:])


def test_a_stated_focal_length_is_held_against_what_the_views_say_without_it() -> None:
    views = noisy(views_at(*TILTS), 0.2, 1)
    stack, alike = stack_views(views), copies(views, SIZE)
    free = map_solution(estimate_map(stack, SIZE, Priors(), alike), alike)
    stated = Priors(focal_px=(1200.0, 1.0))
    solution = map_solution(estimate_map(stack, SIZE, stated, alike), alike)
    assert with_stated_focal(solution, stack, SIZE, Priors(), alike) is solution
    held = with_stated_focal(solution, stack, SIZE, stated, alike)
    off = abs(np.log(free.camera.fx / 1200)) / np.hypot(1 / 1200, focal_std(free, SIZE))
    assert held.prior_conflicts[FOCAL] == pytest.approx(max(off, solution.prior_conflicts[FOCAL]))
    parallel = with_stated_focal(solution, stack, SIZE, stated, alike, tilted=False)
    assert parallel.prior_conflicts[FOCAL] == pytest.approx(off)
    near = replace(solution, prior_conflicts={FOCAL: 99.0})
    assert with_stated_focal(near, stack, SIZE, stated, alike).prior_conflicts[FOCAL] == 99
    assert held.prior_conflicts[FOCAL] > 2.5


def test_a_focal_length_that_is_stated_truly_is_not_contradicted_by_a_parallel_board() -> None:
    """Which without it would be tilted, behind a longer lens: far from linear, and no nearer to the truth."""
    camera = Camera(900.0, 900.0, 639.5, 479.5, [-0.2, 0.05, 0, 0, 0])
    for seed in range(10):
        views = noisy(views_at((1, 36.0 * seed), camera=camera, span=0.8), 0.2, seed)
        found = calibrate(views, SIZE, priors=Priors(focal_px=(900.0, 9.0)))
        assert FOCAL not in found.prior_conflicts
        assert found.camera.fx == pytest.approx(900, abs=27)


def test_a_quantity_of_two_unknowns_is_settled_as_its_worse_one_is() -> None:
    views = noisy(views_at(*TILTS), 0.2, 1)
    stack, alike = stack_views(views), copies(views, SIZE)
    found = estimate_map(stack, SIZE, Priors(), alike)
    rows = found.adjustment.rows(found.geometry, found.sigma)
    known, theta = Priors().rows(SIZE), found.geometry.theta[0]
    share = determined_share(posterior(rows, known.tails(theta), known.normal(theta)))
    settled = map_solution(found, alike).settled
    assert settled is not None
    for name, pair in (("radial distortion", share[4:6]), ("tangential distortion", share[6:8])):
        assert pair.min() < pair.max()
        assert settled[name] == pytest.approx(pair.min())
