from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import t as student

from fewcal.tails import Tails
from fewcal.variational import Middle, contradictions, middle

Array = NDArray[np.float64]


def one(nu: float, z: float, scale: float = 1.0) -> Tails:
    """A prior of one unknown, whose estimate lies z scales from its centre."""
    return Tails(np.array([z]), np.array([[1 / scale]]), np.array([0]), np.array([nu]))


def random(seed: int) -> tuple[Array, Array, Tails]:
    """Data and priors of four unknowns in units of their own."""
    rng = np.random.default_rng(seed)
    J, r, K, z = rng.normal(size=(9, 4)), rng.normal(size=9), rng.normal(size=(4, 4)), rng.normal(size=4)
    units = 10.0 ** rng.uniform(-4, 4, 4)
    return J * units, r, Tails(z, K * units, np.array([0, 1, 1, 2]), np.array([2.0, 3.0, np.inf]))


def found(J: Array, r: Array, tails: Tails) -> Middle:
    """The middle, which there is."""
    result = middle(J, r, tails)
    assert result is not None
    return result


def moved(tails: Tails, step: Array) -> Tails:
    """The same priors seen from another estimate."""
    return tails._replace(z=tails.z + tails.by_unknowns @ step)


# --- where it is -------------------------------------------------------------------------------------------


def test_with_normal_priors_it_is_the_least_squares_solution() -> None:
    J, r, tails = random(1)
    tails = tails._replace(nu=np.full(3, np.inf))
    rows, target = np.concatenate([J, tails.by_unknowns]), np.concatenate([r, tails.z])
    at = found(J, r, tails)
    expected = -np.linalg.lstsq(rows / np.linalg.norm(rows, axis=0), target, rcond=None)[0]
    np.testing.assert_allclose(at.step, expected / np.linalg.norm(rows, axis=0), rtol=1e-9)
    information = rows.T @ rows
    scale = np.sqrt(np.diagonal(information))
    np.testing.assert_allclose(at.covariance @ information * scale[:, None] / scale, np.eye(4), atol=1e-9)
    assert at.length == pytest.approx(np.sqrt(at.step @ information @ at.step))


@pytest.mark.parametrize("nu", [1.0, 2.0, 5.0])
@pytest.mark.parametrize("off", [0.0, 0.5, 2.0, 6.0])
@pytest.mark.parametrize("sd", [0.2, 0.5, 1.0])
def test_it_is_nearer_to_the_mean_of_the_posterior_than_its_highest_point(
    nu: float, off: float, sd: float
) -> None:
    x = np.linspace(-100, 100, 400_001)
    density = student.pdf(x, nu) * np.exp(-0.5 * ((x - off) / sd) ** 2)
    mean = (x * density).sum() / density.sum()
    spread = np.sqrt(((x - mean) ** 2 * density).sum() / density.sum())
    at = found(np.array([[1 / sd]]), np.array([-off / sd]), one(nu, 0.0)).step[0]
    highest = x[np.argmax(density)]
    assert abs(at - mean) <= abs(highest - mean) + 0.05 * spread
    assert abs(at - mean) < 0.2 * spread


@pytest.mark.parametrize(("off", "sd"), [(1.0, 0.5), (3.2, 0.5), (2.0, 0.3)])
def test_of_two_alternatives_each_counts_as_it_is_likely(off: float, sd: float) -> None:
    share, centre, scale = np.array([0.6, 0.4]), np.array([0.0, 4.0]), np.array([0.5, 1.0])
    kinds = Tails(-centre / scale, 1 / scale[:, None], np.arange(2), np.full(2, 3.0), np.log(share / scale))
    x = np.linspace(-60, 60, 240_001)
    prior = (share * student.pdf((x[:, None] - centre) / scale, 3.0) / scale).sum(axis=1)
    density = prior * np.exp(-0.5 * ((x - off) / sd) ** 2)
    mean = (x * density).sum() / density.sum()
    spread = np.sqrt(((x - mean) ** 2 * density).sum() / density.sum())
    at = found(np.array([[1 / sd]]), np.array([-off / sd]), kinds).step[0]
    assert abs(at - mean) < 0.25 * spread


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_the_likelier_of_two_alternatives_draws_the_more(share: float) -> None:
    kinds = Tails(np.array([1.0, -1.0]), np.ones((2, 1)), np.arange(2), np.full(2, 3.0))
    kinds = kinds._replace(height=np.log([share, 1 - share]))
    x = np.linspace(-60, 60, 240_001)
    prior = share * student.pdf(x + 1, 3.0) + (1 - share) * student.pdf(x - 1, 3.0)
    density = prior * np.exp(-0.5 * x**2)
    mean = (x * density).sum() / density.sum()
    spread = np.sqrt(((x - mean) ** 2 * density).sum() / density.sum())
    assert abs(found(np.ones((1, 1)), np.zeros(1), kinds).step[0] - mean) < 0.25 * spread


@given(st.integers(0, 1000))
def test_it_does_not_depend_on_the_estimate_that_one_starts_from(seed: int) -> None:
    J, r, tails = random(seed)
    at = found(J, r, tails)
    again = found(J, r + J @ at.step, moved(tails, at.step))
    assert again.length < 1e-3
    np.testing.assert_allclose(again.covariance, at.covariance, rtol=2e-2, atol=1e-3 * at.covariance.max())


@given(st.integers(0, 1000))
def test_units_do_not_matter(seed: int) -> None:
    J, r, tails = random(seed)
    unit = np.array([1e-6, 1.0, 1e3, 1e5])
    plain = found(J, r, tails)
    scaled = found(J / unit, r, tails._replace(by_unknowns=tails.by_unknowns / unit))
    sd = np.sqrt(np.diagonal(plain.covariance))
    np.testing.assert_allclose(scaled.step / unit / sd, plain.step / sd, atol=1e-6)
    assert scaled.length == pytest.approx(plain.length, rel=1e-6)


def test_the_noise_is_that_of_what_is_left() -> None:
    J, r, tails = random(3)
    tails = tails._replace(nu=np.full(3, np.inf))
    at = middle(J, r, tails, variance=lambda left: left / 20)
    assert at is not None
    assert at.variance == pytest.approx(np.sum((r + J @ at.step) ** 2) / 20, rel=1e-3)
    weight = 1 / np.sqrt(at.variance)
    known = found(J * weight, r * weight, tails)
    sd = np.sqrt(np.diagonal(at.covariance))
    np.testing.assert_allclose(at.step / sd, known.step / sd, atol=1e-3)


def test_what_nothing_holds_has_no_middle() -> None:
    tails = Tails(np.zeros(1), np.array([[1.0, 0.0]]), np.array([0]), np.array([2.0]))
    assert middle(np.zeros((3, 2)), np.zeros(3), tails) is None


# --- priors against everything else ------------------------------------------------------------------------


@given(seed=st.integers(0, 1000))
def test_a_normal_prior_is_held_against_what_the_others_say(seed: int) -> None:
    J, r, tails = random(seed)
    surely = np.array([1.0, 1, 1, 10.0 ** np.random.default_rng(seed).uniform(0, 4)])
    K = tails.by_unknowns * surely[:, None]
    tails = Tails(tails.z * surely, K, np.arange(4), np.full(4, np.inf))
    held = contradictions(J, r, tails, found(J, r, tails).covariance)
    others = np.concatenate([J, K[:3]])
    scale = np.linalg.norm(others, axis=0)
    step = -np.linalg.lstsq(others / scale, np.concatenate([r, tails.z[:3]]), rcond=None)[0] / scale
    spread = np.sum(np.linalg.lstsq((others / scale).T, K[3] / scale, rcond=None)[0] ** 2)
    expected = (tails.z[3] + K[3] @ step) / np.sqrt(1 + spread)
    # Where a prior decides little, the rest is not asked without it.
    assert held[3] == pytest.approx(expected, rel=1e-2, abs=1e-2)


def test_what_the_others_say_is_as_uncertain_as_their_tails_make_it() -> None:
    # Of a t prior by itself the normal distribution that comes nearest has a variance of one.
    J, r, nu = np.zeros((1, 1)), np.zeros(1), np.array([np.inf, 1.5])
    tails = Tails(np.array([5.0, 0.0]), np.ones((2, 1)), np.arange(2), nu)
    assert 1 < contradictions(J, r, tails, np.eye(1))[0] < 0.9 * 5 / np.sqrt(2)


def test_a_prior_that_decides_little_is_as_far_off_as_at_the_estimate() -> None:
    J, r, tails = np.array([[100.0]]), np.zeros(1), one(np.inf, 3.0)
    assert contradictions(J, r, tails, found(J, r, tails).covariance) == [3.0]


def test_only_normal_priors_are_held_against_the_rest() -> None:
    J, r, tails = random(3)
    held = contradictions(J, r, tails, found(J, r, tails).covariance)
    assert held[3] != 0
    np.testing.assert_array_equal(held[:3], 0)


def test_a_prior_that_alone_speaks_of_an_unknown_contradicts_nothing() -> None:
    J, r = np.array([[1.0, 0.0]]), np.zeros(1)
    tails = Tails(np.array([5.0, 5.0]), np.eye(2), np.arange(2), np.full(2, np.inf))
    held = contradictions(J, r, tails, np.diag([0.5, 1.0]))
    np.testing.assert_allclose(held, [5 / np.sqrt(2), 0])


def test_a_t_prior_that_has_given_way_speaks_again_without_what_it_gave_way_to() -> None:
    # A sure statement has pulled the other unknown twenty scales out, where its prior says next to nothing.
    J, r = np.array([[10.0, -10.0]]), np.zeros(1)
    tails = Tails(np.array([0.0, 20.0]), np.diag([1e3, 1.0]), np.arange(2), np.array([np.inf, 1.5]))
    held = contradictions(J, r, tails, np.diag([1e-6, 1e-2]))
    assert abs(held[0]) > 5
