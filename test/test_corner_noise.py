"""The measurement of the corner noise, on views whose noise is known."""

from __future__ import annotations

import numpy as np
import pytest
from corner_noise import rms, samples
from scenes import SIZE, noisy, views_at

import fewcal
from fewcal.constraints import Priors
from fewcal.map_estimator import estimate_map
from fewcal.views import stack_views

TILTS = [(15.0 + 5 * (i % 7), 40.0 * i) for i in range(24)]


def measured(views: list[fewcal.View]) -> tuple[float, float, float]:
    """Scatter, sigma along the camera and likeness of neighbours over all views."""
    found = samples(views, estimate_map(stack_views(views), SIZE, Priors()))
    assert len(found) == len(views)
    scatter, sigma, alike, tilt = np.array(found).T
    np.testing.assert_allclose(tilt, [tilt for tilt, _ in TILTS], atol=1)
    return rms(scatter), rms(sigma), float(alike.mean())


def test_independent_errors_count_as_much_as_they_scatter() -> None:
    scatter, sigma, alike = measured(noisy(views_at(*TILTS), 0.2, 1))
    assert scatter == pytest.approx(0.2, rel=0.05)
    assert sigma == pytest.approx(0.2, rel=0.15)
    assert abs(alike) < 0.15


def test_errors_that_neighbours_share_count_for_more() -> None:
    rng = np.random.default_rng(2)
    exact = views_at(*TILTS)
    points = exact[0].object_points / 0.025
    apart = ((points[:, None] - points) ** 2).sum(axis=-1)
    root = np.linalg.cholesky(np.exp(-apart / 2) + 1e-6 * np.eye(len(points)))
    views = [
        fewcal.View(v.object_points, v.image_points + 0.2 * root @ rng.normal(size=(len(points), 2)))
        for v in exact
    ]
    scatter, sigma, alike = measured(views)
    assert sigma > 1.8 * scatter
    assert alike > 0.2


def test_views_of_few_points_are_left_out() -> None:
    views = views_at(*TILTS[:4])
    few = fewcal.View(views[-1].object_points[::7], views[-1].image_points[::7])
    views = noisy([*views[:3], few], 0.1, 3)
    assert len(samples(views, estimate_map(stack_views(views), SIZE, Priors()))) == 3
