from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fewcal.camera import Camera
from fewcal.checks import (
    LARGEST,
    is_covariance,
    is_number,
    real_array,
    require_kind,
    require_numbers,
    require_pair,
)
from fewcal.errors import InvalidInput


@pytest.mark.parametrize("value", [0, -3, 2.5, np.float64(1), np.int32(7), LARGEST])
def test_numbers(value: object) -> None:
    assert is_number(value)


@pytest.mark.parametrize(
    "value", [None, "1", np.nan, np.inf, 1j, [1.0], np.array(1.0), 2 * LARGEST, 10**400, -(10**400)]
)
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


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "values",
    [
        "corners",
        [[1, 2], [3]],
        [1 + 2j],
        np.array([1 + 0j]),
        np.array(["2026-11-23"], "datetime64[s]"),
        ["1", "2"],
        [10**400],
        np.ma.masked_array([1.0, 5000.0], mask=[False, True]),
    ],
)
def test_what_is_no_array_of_numbers(values: Any) -> None:
    with pytest.raises(
        InvalidInput, match="pixels must be an array of numbers, none of them complex or masked"
    ):
        real_array(values, "pixels")


def test_arrays_of_numbers() -> None:
    given = np.array([1.0, 2.0])
    for values in (given, [1, 2], (np.float32(1), 2), np.ma.masked_array([1, 2], mask=False)):
        taken = real_array(values, "pixels")
        np.testing.assert_array_equal(taken, given)
        assert type(taken) is np.ndarray
        assert taken.dtype == np.float64
    assert not np.shares_memory(real_array(given, "pixels"), given)


def test_what_is_of_another_kind() -> None:
    require_kind("camera", Camera(1, 1, 0, 0), Camera)
    with pytest.raises(InvalidInput, match=r"camera must be fewcal\.Camera, not 3\."):
        require_kind("camera", 3, Camera)


@pytest.mark.parametrize("pair", [None, 1200, (1, 2, 3), [1], {1200, 12}, (x for x in (1200, 12))])
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
