from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import gamma, multivariate_t
from scipy.stats import t as student

from fewcal.tails import Tails, expected_precisions


@pytest.mark.parametrize("nu", [0.9, 3.0, 40.0])
@pytest.mark.parametrize("z", [(0.0,), (4.0,), (0.3, -2.0)])
def test_precision_of_a_prior_is_the_one_expected_for_what_it_says_of(
    nu: float, z: tuple[float, ...]
) -> None:
    rows = len(z)
    tails = Tails(np.array(z), np.eye(rows), np.zeros(rows, dtype=np.intp), np.array([nu]))
    each = np.exp(np.linspace(-30, 6, 20_001))
    density = gamma.pdf(each, nu / 2, scale=2 / nu) * each ** (1 + rows / 2)
    density *= np.exp(-0.5 * each * (tails.z @ tails.z))
    expected = (each * density).sum() / density.sum()
    np.testing.assert_allclose(expected_precisions(tails)(tails.z**2), expected, rtol=1e-3)


def test_a_normal_prior_keeps_its_precision() -> None:
    tails = Tails(np.array([9.0, 9.0]), np.eye(2), np.arange(2), np.array([np.inf, 2.0]))
    found = expected_precisions(tails)(tails.z**2)
    assert found[0] == 1
    assert found[1] < 0.1


def test_an_alternative_counts_as_it_is_likely() -> None:
    # Two bivariate t of the same two unknowns, at 0 and at (1, 1), the second twice as wide.
    share, nu, scale = np.array([0.7, 0.3]), np.array([1.5, 3.0]), np.array([1.0, 2.0])
    x, middle = np.array([0.8, -0.4]), np.array([[0.0, 0.0], [1.0, 1.0]])
    z = ((x - middle) / scale[:, None]).ravel()
    rows = np.repeat(np.eye(2)[None], 2, axis=0).reshape(4, 2) / np.repeat(scale, 2)[:, None]
    tails = Tails(z, rows, np.array([0, 0, 1, 1]), nu, np.log(share / scale**2))
    found = expected_precisions(tails)(z**2)
    density = [
        part * multivariate_t.pdf(x, mean, size**2 * np.eye(2), df=degrees)
        for part, mean, size, degrees in zip(share, middle, scale, nu, strict=True)
    ]
    likely = np.array(density) / sum(density)
    alone = (nu + 2) / (nu + (z**2).reshape(2, 2).sum(axis=1))
    np.testing.assert_allclose(found, np.repeat(likely * alone, 2), rtol=1e-9)


def test_two_alternatives_of_one_unknown() -> None:
    tails = Tails(
        np.array([0.5, -1.0]), np.ones((2, 1)), np.arange(2), np.array([4.0, 4.0]), np.log([0.5, 0.5])
    )
    found = expected_precisions(tails)(tails.z**2)
    likely = student.pdf(tails.z, 4)
    np.testing.assert_allclose(found, likely / likely.sum() * 5 / (4 + tails.z**2), rtol=1e-12)
