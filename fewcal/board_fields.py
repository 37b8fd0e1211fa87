"""The fields that describe a board: read from its text form, checked, and laid out as points."""

from __future__ import annotations

import math
import re

import numpy as np
from numpy.typing import NDArray

from .errors import InvalidInput

COUNTS = r"(?P<columns>[0-9]{1,3})[xX](?P<rows>[0-9]{1,3})"
"""How columns and rows are written in every text form; no camera resolves a thousand."""
MIN_LENGTH_M, MAX_LENGTH_M = 1e-6, 10.0
"""From squares under a microscope to those on a wall; 25 was meant to be 25 mm."""


def match_form(pattern: str, text: str, form: str) -> re.Match[str]:
    """Match the text form of a board; when it does not, the error shows the form."""
    match = re.fullmatch(pattern, text.strip())
    if match is None:
        raise InvalidInput(f"{text!r} is not a board; write {form}.")
    return match


def read_number(match: re.Match[str], name: str, form: str, what: str = "a length in metres") -> float:
    """Read the number in the group `name` of a match."""
    try:
        if "_" in match[name]:  # Python's own way of grouping digits
            raise ValueError
        return float(match[name])
    except ValueError:
        raise InvalidInput(f"{match[name]!r} in {match.string!r} is not {what}; write {form}.") from None


def is_count(value: object, least: int) -> bool:
    """Whether a value is a whole number of at least so much."""
    return not isinstance(value, bool) and isinstance(value, int | np.integer) and bool(value >= least)


def check_length(name: str, value: object) -> None:
    """Refuse what is no positive length, and what is none of a board."""
    if isinstance(value, bool) or not (isinstance(value, float | int | np.number) and 0 < value < math.inf):
        raise InvalidInput(f"The {name} must be a positive length in metres, not {value!r}.")
    if not MIN_LENGTH_M <= value <= MAX_LENGTH_M:
        raise InvalidInput(
            f"A {name} of {float(value):g} m is not that of a board; lengths are in metres, 0.025 for 25 mm."
        )


def lattice(columns: int, rows: int, step: float) -> NDArray[np.float64]:
    """(columns * rows, 3) points of a square lattice, metres, row by row: x varies fastest, z = 0."""
    y, x = np.mgrid[:rows, :columns].reshape(2, -1)
    return np.stack([x, y, np.zeros_like(x)], axis=1) * float(step)
