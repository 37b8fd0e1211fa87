from __future__ import annotations

import numpy as np
import pytest

from fewcal.checks import LARGEST, is_covariance, is_number, require_numbers, require_pair
from fewcal.errors import InvalidInput


@pytest.mark.parametrize("value", [0, -3, 2.5, np.float64(1), np.int32(7), LARGEST])
def test_numbers(value: object) -> None:
    assert is_number(value)


@pytest.mark.parametrize("value", [None, "1", np.nan, np.inf, 1j, [1.0], np.array(1.0), 2 * LARGEST])
def test_what_is_no_number(value: object) -> None:
    assert not is_number(value)
    with pytest.raises(InvalidInput, match="A prior needs finite numbers"):
        require_numbers("A prior", [value])
    with pytest.raises(InvalidInput, match="finite numbers"):
        require_pair("A prior", (1.0, value))


@pytest.mark.parametrize("value", [0, -1.0, 0.1 / LARGEST])
def test_what_is_not_above_zero(value: float) -> None:
    require_numbers("A mean", [value])
    with pytest.raises(InvalidInput, match="A width needs numbers above zero, not"):
        require_numbers("A width", [], positive=[value])


@pytest.mark.parametrize("pair", [None, 1200, (1, 2, 3), [1]])
def test_what_is_no_pair(pair: object) -> None:
    with pytest.raises(InvalidInput, match="focal_px must be two numbers, not"):
        require_pair("focal_px", pair)


def test_pairs() -> None:
    require_pair("focal_px", np.array([1200.0, 12]), positive=True)
    require_pair("slope", (0.1, -0.1))
    with pytest.raises(InvalidInput, match="above zero"):
        require_pair("focal_px", (1200, 0), positive=True)


def test_covariances() -> None:
    assert is_covariance(((2, -1), (-1, 1)))
    for matrix in ("x", None, 1.0, np.eye(3), [[1, 2], [2, 1]], [[1, 0.5], [0, 1]], [[np.nan, 0], [0, 1]]):
        assert not is_covariance(matrix)
