from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import differences

from fewcal.constraints import (
    ASPECT_TOLERANCE_PX,
    LARGEST_EXPONENT,
    Normal,
    Priors,
    StudentT,
    exponential_penalty,
)
from fewcal.errors import InvalidInput
from fewcal.radial_prior import RadialPrior

Array = NDArray[np.float64]


def distances(priors: Priors, theta: Array) -> Array:
    return np.stack([priors.rows((1280, 960)).distance(each) for each in theta])


def test_the_users_own_focal_length_replaces_the_prior() -> None:
    theta = np.zeros((3, 8))
    theta[:, 0] = np.log([1200.0, 1212.0, 1188.0])
    own, usual = distances(Priors(focal_px=(1200, 12)), theta), distances(Priors(), theta)
    np.testing.assert_allclose(own[:, 0], [0, 1, 1], atol=0.01)
    np.testing.assert_array_equal(own[:, 1:], usual[:, 1:])
    np.testing.assert_allclose(usual[:, 0], np.abs(theta[:, 0] - math.log(1280) + 0.21) / 0.4)


def test_priors_can_be_replaced_one_by_one() -> None:
    for field in fields(Priors):
        if field.name in ("focal_px", "corner_sigma_px", "radial"):
            continue
        own = replace(Priors(), **{field.name: Normal(0.1, 0.2)})
        differs = distances(own, np.zeros((1, 12))) != distances(Priors(), np.zeros((1, 12)))
        assert 1 <= differs.sum() <= 2, field.name


@pytest.mark.parametrize(
    "build",
    [
        lambda: Normal(0.0, 0.0),
        lambda: Normal(math.nan, 1.0),
        lambda: StudentT(0.0, 1.0),
        lambda: StudentT(3.0, -1.0),
        lambda: StudentT(3.0, math.inf),
        lambda: Priors(radial=()),
        lambda: Priors(radial=(Normal(0.0, 1.0),)),  # type: ignore[arg-type]
        lambda: Priors(focal_px=(1200.0, 0.0)),
        lambda: Priors(focal_px=(-1200.0, 10.0)),
        lambda: Priors(focal_px=(1200.0,)),  # type: ignore[arg-type]
        lambda: Priors(corner_sigma_px=(0.2, math.inf)),
        lambda: Priors(focal_px=1200.0),  # type: ignore[arg-type]
        lambda: Priors(focal_px=np.array(1200.0)),  # type: ignore[arg-type]
        lambda: Priors(focal_px=(10**400, 1)),
        lambda: Priors(focal_px=("1200", "12")),  # type: ignore[arg-type]
        lambda: Priors(log_aspect=0.01),  # type: ignore[arg-type]
        lambda: Priors(board_bend=None),  # type: ignore[arg-type]
        lambda: Priors(radial=Normal(0.0, 1.0)),  # type: ignore[arg-type]
        lambda: Normal(None, 1.0),  # type: ignore[arg-type]
        lambda: Normal(0.0, 1e-300),
    ],
)
def test_numbers_that_are_no_prior(build: object) -> None:
    with pytest.raises(InvalidInput):
        build()  # type: ignore[operator]


def test_arrays_make_the_priors_that_tuples_make() -> None:
    mean_sd = np.array([1200.0, 12.0])
    own = Priors(focal_px=mean_sd, radial=(RadialPrior(1.5, np.eye(2), np.zeros(2)),))  # type: ignore[arg-type]
    mean_sd[1] = -1
    assert own == Priors(focal_px=(1200.0, 12.0), radial=(RadialPrior(1.5, ((1.0, 0.0), (0.0, 1.0))),))
    assert len({own}) == 1


# --- the paper's constraint --------------------------------------------------------------------------------


def penalty(focal: Array, views: int) -> Array:
    return exponential_penalty(focal[:, 0], focal[:, 1], views)[0][:, None]


@pytest.mark.parametrize("views", [1, 2, 7])
def test_the_squared_row_is_the_constraint_of_eq_29_less_a_constant(views: int) -> None:
    d = np.linspace(-400, 400, 41)
    r, _ = exponential_penalty(1000 + d, np.full_like(d, 1000), views)
    expected = views * np.exp(d**2 / (2 * ASPECT_TOLERANCE_PX**2))
    np.testing.assert_allclose(r**2 + views, expected, rtol=1e-12)
    np.testing.assert_array_equal(np.sign(r), np.sign(d))


@pytest.mark.parametrize("d", [0.0, 1e-6, -0.01, 1.0, -30.0, 200.0, -450.0, 499.0])
def test_jacobian_of_the_constraint(d: float) -> None:
    focal = np.array([[1000 + d, 1000.0]])
    _, J = exponential_penalty(focal[:, 0], focal[:, 1], 3)
    numeric = differences(lambda at: penalty(at, 3), focal, 1e-3)[:, 0]
    np.testing.assert_allclose(J, numeric, rtol=1e-6)


def test_far_away_the_constraint_is_finite_and_points_back() -> None:
    limit = ASPECT_TOLERANCE_PX * math.sqrt(2 * LARGEST_EXPONENT)
    d = np.array([limit, 1e4, -1e4, 1e8])
    r, J = exponential_penalty(1000 + d, np.full_like(d, 1000), 2)
    np.testing.assert_allclose(np.abs(r), math.sqrt(2 * math.expm1(LARGEST_EXPONENT)))
    assert np.isfinite(J).all()
    assert (J[:, 0] > 0).all()
    np.testing.assert_array_equal(J[:, 1], -J[:, 0])
