"""Whether numbers that a user states can be computed with."""

from __future__ import annotations

import operator
import reprlib
from collections.abc import Sequence
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InvalidInput

LARGEST = 1e50
"""What is beyond, or closer to zero than its inverse, has products that a double cannot hold."""


LARGEST_IMAGE = 2**31 - 1
"""Width and height, pixels, that file formats and OpenCV can hold."""


def real_array(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Copy what a caller gives as an array into one of doubles.

    Raises
    ------
    InvalidInput
        When it holds what is no real number, or rows of different length; masked points are no numbers.
    """
    try:
        if np.ma.is_masked(values) or np.asarray(values).dtype.kind not in "biufO":
            raise TypeError
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InvalidInput(f"{name} must be an array of numbers, none of them complex or masked.") from None


def is_number(value: object) -> bool:
    """Whether a value is one real number that is finite and not absurdly large; arrays are not."""
    return isinstance(value, Real) and bool(value <= LARGEST and not value < -LARGEST)


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
    several = isinstance(pair, Sequence) or (isinstance(pair, np.ndarray) and pair.ndim > 0)
    if not several or len(pair) != 2:  # type: ignore[arg-type]
        raise InvalidInput(f"{name} must be two numbers, not {pair!r}.")
    numbers = list(pair)  # type: ignore[call-overload]
    require_numbers(name, () if positive else numbers, numbers if positive else ())


def checked_stamp(stamp_ns: object) -> int | None:
    """Time of a frame, nanoseconds, as a plain number; None where it is not known.

    Raises
    ------
    InvalidInput
        When it is no whole number.
    """
    try:
        return None if stamp_ns is None else operator.index(stamp_ns)  # type: ignore[arg-type]
    except TypeError:
        raise InvalidInput(
            f"stamp_ns must be a whole number of nanoseconds, or None, not {reprlib.repr(stamp_ns)}."
        ) from None


def require_kind(name: str, value: object, kind: type) -> None:
    """Refuse what is not of a class of this package.

    Raises
    ------
    InvalidInput
    """
    if not isinstance(value, kind):
        raise InvalidInput(f"{name} must be fewcal.{kind.__name__}, not {reprlib.repr(value)}.")


def checked_size(image_size: tuple[int, int]) -> tuple[int, int]:
    """Width and height of images, pixels, as plain numbers.

    Raises
    ------
    InvalidInput
        When they are not positive and whole.
    """
    try:
        width, height = (operator.index(length) for length in image_size)
    except (TypeError, ValueError):
        given = reprlib.repr(image_size)
        raise InvalidInput(
            f"image_size must be (width, height) in pixels, not {given}; give whole numbers."
        ) from None
    if width < 1 or height < 1:
        raise InvalidInput(f"image_size must be positive, not {width}x{height}.")
    if max(width, height) > LARGEST_IMAGE:
        raise InvalidInput(f"image_size must be at most {LARGEST_IMAGE} pixels, not {width}x{height}.")
    return width, height


def _listed(values: Sequence[object]) -> str:
    return ", ".join(map(repr, values))
