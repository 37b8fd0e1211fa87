from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import SIZE, noisy, views_at
from scipy.stats import gamma, qmc

from fewcal import precision_draws
from fewcal.calibration import calibrate
from fewcal.precision_draws import DRAWS, Draws, _even_points, draw
from fewcal.tails import Tails, expected_precisions

Array = NDArray[np.float64]


@pytest.mark.parametrize("dimension", [1, 4, 9])
def test_points_are_evenly_spread(dimension: int) -> None:
    points = _even_points(DRAWS, dimension).copy()  # the oldest scipy takes none that are read-only
    slices = np.floor(points * DRAWS).astype(int)
    np.testing.assert_array_equal(np.sort(slices, axis=0).T, np.tile(np.arange(DRAWS), (dimension, 1)))
    random = np.random.default_rng(0).uniform(size=points.shape)
    assert qmc.discrepancy(points) < 0.7 * qmc.discrepancy(random)


def likelihood(precision: Array, z: Array, covariance: Array, reference: Array) -> Array:
    """Logarithm of that of precisions (M, K) of the rows of priors, over that of the reference (K,)."""
    more = precision - reference
    A = np.eye(len(z)) + covariance * more[:, None]
    left = np.linalg.solve(A, np.broadcast_to(z[:, None], (len(A), len(z), 1)))[..., 0]
    found: Array = -0.5 * (np.linalg.slogdet(A)[1] + (more * z * left).sum(axis=1))
    return found


def weights(found: Draws, tails: Tails, z: Array, covariance: Array, reference: Array) -> Array:
    """Of the draws, (M,), which sum to 1."""
    logarithm = found.log_weight + likelihood(found.precision[:, tails.group], z, covariance, reference)
    weight = np.exp(logarithm - logarithm.max())
    return weight / weight.sum()


@pytest.mark.parametrize("nu", [0.9, 2.0, 30.0, 1000.0])
@pytest.mark.parametrize(
    ("z", "sd"),
    [
        ((0.0,), (0.3,)),
        ((0.0,), (20.0,)),
        ((6.0,), (0.1,)),
        ((0.5, -1.0), (0.2, 3.0)),
        ((-9.0, 2.0), (1.0, 0.1)),
        ((1.0, 1.0), (0.8, 1.0)),
        ((30.0,), (0.1,)),
    ],
)
def test_of_one_prior_the_draws_are_as_good_as_of_the_posterior(
    nu: float, z: tuple[float, ...], sd: tuple[float, ...]
) -> None:
    rows = len(z)
    tails = Tails(np.array(z), np.eye(rows), np.zeros(rows, dtype=np.intp), np.array([nu]))
    reference = expected_precisions(tails)(tails.z**2)
    # What the data say, with the rows turned against each other, and the reference with it.
    turn = np.array([[0.8, -0.6], [0.6, 0.8]])[:rows, :rows] if rows == 2 else np.eye(1)
    information = turn @ np.diag(np.array(sd) ** -2.0) @ turn.T
    covariance = np.linalg.inv(information + reference[0] * np.eye(rows))
    mean = covariance @ information @ tails.z
    found = draw(tails, mean, covariance, reference)
    precision = found.precision[:, 0]
    weight = weights(found, tails, mean, covariance, reference)
    assert 1 / (weight @ weight) > 0.88 * DRAWS
    # By quadrature over the logarithm of the precision.
    each = np.exp(np.linspace(-40, 8, 100_001))
    density = gamma.pdf(each, nu / 2, scale=2 / nu) * each ** (1 + rows / 2)
    density *= np.exp(likelihood(each[:, None].repeat(rows, axis=1), mean, covariance, reference))
    for power in (1.0, 0.5, -0.2):
        expected = (density * each**power).sum() / density.sum()
        assert weight @ precision**power == pytest.approx(expected, rel=0.02)


def test_alternatives_are_drawn_as_often_as_the_data_make_them_likely() -> None:
    # The first says 0 and the second 3; so, all but surely, do the data.
    tails = Tails(
        np.array([30.0, 0.0]), np.array([[10.0], [10.0]]), np.arange(2), np.array([5.0, 5.0]), np.zeros(2)
    )
    reference = expected_precisions(tails)(tails.z**2)
    variance = 1 / (1.0 + (100 * reference).sum())
    found = draw(
        tails, tails.z - 100 * variance * reference * tails.z, np.full((2, 2), 100 * variance), reference
    )
    often = (found.precision > 0).mean(axis=0)
    assert often.sum() == 1, "one of them holds"
    assert often[0] > 0.04, "the other one is not left out"
    assert often[1] > 0.5


@pytest.mark.parametrize("seed", range(6))
def test_of_alternatives_the_draws_are_nearly_as_good_as_of_the_posterior(seed: int) -> None:
    # Two bivariate t of the same two unknowns, about which the data say about as much as they do.
    rng = np.random.default_rng(seed)
    scale = np.array([0.4, 1.5])
    by_unknowns = np.repeat(1 / scale, 2)[:, None] * np.tile(np.eye(2), (2, 1))
    z = by_unknowns @ rng.normal(size=2) + np.array([0.0, 0.0, 1.5, -1.5])
    tails = Tails(z, by_unknowns, np.array([0, 0, 1, 1]), np.array([1.5, 3.0]), -2 * np.log(scale))
    reference = expected_precisions(tails)(z**2)
    half = rng.normal(size=(2, 2))
    information = half @ half.T + 0.3 * np.eye(2)
    covariance = np.linalg.inv(information + by_unknowns.T @ (reference[:, None] * by_unknowns))
    mean = z - by_unknowns @ covariance @ by_unknowns.T @ (reference * z)
    of_rows = by_unknowns @ covariance @ by_unknowns.T
    weight = weights(draw(tails, mean, of_rows, reference), tails, mean, of_rows, reference)
    assert 1 / (weight @ weight) > 0.8 * DRAWS


def test_a_prior_that_gave_way_at_the_estimate_holds_where_the_data_do_not() -> None:
    tails = Tails(np.array([50.0]), np.eye(1), np.zeros(1, dtype=np.intp), np.array([1.2]))
    reference = expected_precisions(tails)(tails.z**2)
    # The data leave it open to a hundred times the scale of the prior.
    variance = 1 / (1e-4 + reference[0])
    found = draw(tails, np.array([50.0]) * 1e-4 * variance, np.array([[variance]]), reference)
    assert np.median(found.precision) == pytest.approx(gamma.median(0.6, scale=1 / 0.6), rel=0.5)


@pytest.mark.parametrize("tilts", [[(12.0, 70.0)], [(35.0, 200.0)], [(25.0, 20.0), (30.0, 110.0)]])
def test_the_bars_are_those_of_many_draws(
    tilts: list[tuple[float, float]], monkeypatch: pytest.MonkeyPatch
) -> None:
    views = noisy(views_at(*tilts), 0.2, seed=4)
    few = calibrate(views, SIZE).std
    monkeypatch.setattr(precision_draws, "DRAWS", 8192)
    many = calibrate(views, SIZE).std
    assert few is not None
    assert many is not None
    assert few == pytest.approx(many, rel=0.12)
    assert few["fx"] == pytest.approx(many["fx"], rel=0.06)
