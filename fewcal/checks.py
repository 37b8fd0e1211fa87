"""Whether numbers that a user states can be computed with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from numbers import Real

import numpy as np

from .errors import InvalidInput

LARGEST = 1e50
"""What is beyond, or closer to zero than its inverse, has products that a double cannot hold."""


def is_number(value: object) -> bool:
    """Whether a value is one real number that is finite and not absurdly large; arrays are not."""
    return isinstance(value, Real) and abs(float(value)) <= LARGEST


def is_covariance(matrix: object) -> bool:
    """Whether a value is a symmetric positive definite 2x2 matrix."""
    try:
        values = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    if values.shape != (2, 2) or not np.all(np.abs(values) <= LARGEST):
        return False
    return bool(np.allclose(values, values.T) and np.linalg.eigvalsh(values).min() > 0)


def require_numbers(name: str, values: Sequence[object], positive: Sequence[object] = ()) -> None:
    """Refuse what is not a number, and what is not above zero among `positive`.

    Raises
    ------
    InvalidInput
    """
    if not all(is_number(value) for value in (*values, *positive)):
        raise InvalidInput(f"{name} needs finite numbers, not {_listed((*values, *positive))}.")
    if not all(float(value) >= 1 / LARGEST for value in positive):  # type: ignore[arg-type]
        raise InvalidInput(f"{name} needs numbers above zero, not {_listed(positive)}.")


def require_pair(name: str, pair: object, positive: bool = False) -> None:
    """Refuse what is not a sequence of two numbers, above zero where `positive`.

    Raises
    ------
    InvalidInput
    """
    if not isinstance(pair, Iterable) or len(numbers := tuple(pair)) != 2:
        raise InvalidInput(f"{name} must be two numbers, not {pair!r}.")
    require_numbers(name, () if positive else numbers, numbers if positive else ())


def _listed(values: Sequence[object]) -> str:
    return ", ".join(map(repr, values))
