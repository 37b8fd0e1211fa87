from __future__ import annotations

from functools import cache
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import SIZE, noisy, pose, view, views_at

from fewcal.calibration import Calibration, calibrate
from fewcal.camera import Camera
from fewcal.constraints import Priors
from fewcal.copies import repetition
from fewcal.parametrisation import ScaleFree
from fewcal.posterior import projection_std
from fewcal.selection import EXHAUSTIVE, Information, best_subset, information, thin
from fewcal.views import View

Array = NDArray[np.float64]

TILTS = ((40, 30), (40, 30), (41, 29), (39, 31), (35, 150), (2, 0))
"""Four nearly parallel copies, one view tilted about another axis, one face on."""


@cache
def calibrated(tilts: tuple[tuple[float, float], ...] = TILTS) -> Calibration:
    return calibrate(noisy(views_at(*tilts), 0.2, 1), SIZE)


def random_information(seed: int, views: int) -> Information:
    """Views that each speak of four combinations of eight unknowns."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(views, 4, 8)) * rng.uniform(0.1, 3, (views, 1, 1))
    spread = rng.normal(size=(20, 8))
    return Information(np.swapaxes(J, 1, 2) @ J, np.eye(8), spread.T @ spread)


def error(known: Information, subset: tuple[int, ...]) -> float:
    views = sum(known.views[i] for i in subset) / repetition(len(subset))
    covariance = np.linalg.inv(known.prior + views)
    return float(np.sqrt(np.trace(known.spread @ covariance)))


# --- information -------------------------------------------------------------------------------------------


def test_projection_std_of_all_views_is_that_of_the_calibration() -> None:
    # Copies share their weight in a calibration; the information of a view is that of the view by itself.
    found = calibrated(TILTS[3:])
    known = information(found)
    everything = known.projection_std(np.arange(3)[None])[0]
    total = known.prior + known.views.sum(axis=0) / repetition(3)
    scale = 1 / np.sqrt(np.diagonal(total))
    covariance = np.linalg.inv(total * scale[:, None] * scale) * scale[:, None] * scale
    # The first unknown is the logarithm of the focal length; the tails of the priors are averaged over here.
    assert np.sqrt(covariance[0, 0]) == pytest.approx(found.focal_std, rel=0.1)
    # Of the same covariance the worst direction in the image; the mean is over both.
    w, h = SIZE
    grid = np.stack(np.meshgrid(np.linspace(0, w - 1, 9), np.linspace(0, h - 1, 9)), axis=-1).reshape(-1, 2)
    model, camera = ScaleFree(SIZE), found.camera
    J = model.natural_jacobian(model.theta(np.concatenate([camera.intrinsics, camera.distortion[:4]])))
    worst = np.sqrt((projection_std(camera, J @ covariance[:8, :8] @ J.T, grid) ** 2).mean())
    assert 0.9 * worst < everything < 1.5 * worst
    # The calibration averages over the widths of the priors, of which the remainder of the lens has no end.
    assert worst < np.sqrt((found.projection_std(grid) ** 2).mean()) < 1.5 * worst


@given(seed=st.integers(0, 1000))
def test_projection_std_of_subsets(seed: int) -> None:
    known = random_information(seed, 5)
    subsets = np.array(list(combinations(range(5), 3)))
    expected = [error(known, tuple(subset)) for subset in subsets]
    np.testing.assert_allclose(known.projection_std(subsets), expected, rtol=1e-9)
    repeated = known.projection_std(np.array([[0, 0]]))[0]
    assert repeated < known.projection_std(np.array([[0]]))[0], "a view taken twice says more"


def test_spread_is_the_mean_squared_error_over_the_image() -> None:
    found, model = calibrated(TILTS[3:]), ScaleFree(SIZE)
    theta = model.theta(np.concatenate([found.camera.intrinsics, found.camera.distortion[:4]]))
    pixels = np.stack(np.meshgrid(*(np.linspace(0, n - 1, 9) for n in SIZE)), axis=-1).reshape(-1, 2)
    focal, centre = np.split(found.camera.intrinsics, 2)
    rays = np.column_stack([(pixels - centre) / focal, np.ones(81)])

    def project(unknowns: Array) -> Array:
        natural = model.natural(unknowns)
        return Camera(*natural[:4].tolist(), np.append(natural[4:], 0.0)).project(rays)

    steps = 1e-5 * np.eye(8)
    J = np.stack([(project(theta + step) - project(theta - step)) / 2e-5 for step in steps], axis=-1)
    spread = information(found).spread
    np.testing.assert_allclose(spread[:8, :8], np.einsum("nki,nkj->ij", J, J) / 81, rtol=1e-6, atol=1e-3)
    assert not spread[8:].any(), "departures do not move the camera"
    assert not spread[:, 8:].any()


def test_every_view_adds_to_what_is_known() -> None:
    known = information(calibrated())
    errors = [known.projection_std(np.arange(count)[None])[0] for count in range(1, len(TILTS) + 1)]
    assert (np.diff(errors) < 0).all()


# --- the best subset ---------------------------------------------------------------------------------------


@given(seed=st.integers(0, 1000), views=st.integers(2, 7), count=st.integers(1, 5))
def test_best_subset_is_the_best_of_all(seed: int, views: int, count: int) -> None:
    known = random_information(seed, views)
    found = best_subset(known, count)
    count = min(count, views)
    assert found == tuple(sorted(set(found)))
    assert len(found) == count
    best = min(error(known, subset) for subset in combinations(range(views), count))
    assert error(known, found) == pytest.approx(best, rel=1e-9)


def test_many_views_are_added_one_by_one_each_time_the_best() -> None:
    known = random_information(3, 60)
    assert len(list(combinations(range(60), 2))) < EXHAUSTIVE
    found = best_subset(known, 6)
    assert found == tuple(sorted(set(found)))
    assert len(found) == 6
    chosen = list(best_subset(known, 2))
    while len(chosen) < 6:
        rest = [i for i in range(60) if i not in chosen]
        chosen.append(min(rest, key=lambda i: error(known, (*chosen, i))))
    assert found == tuple(sorted(chosen))
    rng = np.random.default_rng(4)
    at_random = [error(known, tuple(rng.permutation(60)[:6])) for _ in range(200)]
    assert error(known, found) < min(at_random)


def test_differently_tilted_views_are_preferred_to_parallel_copies() -> None:
    known = information(calibrated())
    pair = best_subset(known, 2)
    assert 4 in pair
    assert set(pair) & {0, 1, 2, 3}
    assert best_subset(known, 9) == tuple(range(6))


# --- thinning ----------------------------------------------------------------------------------------------


def sequence(count: int) -> list[View]:
    """A board that moves steadily across the image, and rests for most of the time at its start."""
    where = np.concatenate([np.zeros(count), np.linspace(0, 300, count)])
    return [view(pose(30, 20, span=0.3, shift_px=(x, 0))) for x in where]


def test_few_views_are_all_kept() -> None:
    assert thin(sequence(3), 6) == list(range(6))


@pytest.mark.parametrize("count", [2, 5, 9])
def test_thinned_views_spread_over_what_was_seen(count: int) -> None:
    views = sequence(20)
    chosen = thin(views, count)
    assert len(chosen) == count
    assert chosen == sorted(set(chosen))
    x = np.sort([views[i].image_points[:, 0].mean() for i in chosen])
    assert (x[0], x[-1]) == pytest.approx(
        (views[0].image_points[:, 0].mean(), views[-1].image_points[:, 0].mean())
    )
    # Farthest-point sampling: no gap is more than about twice another.
    assert np.diff(x).max() < 2.5 * np.diff(x).min() + 16


def test_copies_of_one_view_are_one() -> None:
    assert thin([view(pose(30, 20))] * 9, 4) == [0]


def test_views_of_different_parts_are_thinned_by_what_both_show() -> None:
    def part(of: View, points: slice) -> View:
        return View(of.object_points[points], of.image_points[points])

    near, far = view(pose(30, 20)), view(pose(30, 20, shift_px=(100, 0)))
    views = [part(near, slice(0, 30)), part(near, slice(20, 54)), part(far, slice(10, 40)), near]
    assert thin(views, 2) == [0, 2]
    apart = [part(near, slice(0, 20)), part(far, slice(10, 40)), part(near, slice(40, 54))]
    assert thin(apart, 2) == [0, 2]


def test_information_knows_what_was_stated() -> None:
    free, known = (
        information(calibrated(), priors).projection_std(np.array([[4, 5]]))[0]
        for priors in (Priors(), Priors(focal_px=(1100.0, 0.1)))
    )
    assert known < 0.9 * free
