from __future__ import annotations

import numpy as np
import pytest

from fewcal.board_fields import COUNTS, check_length, is_count, lattice, match_form, read_number
from fewcal.errors import InvalidInput


def test_a_form_is_matched_or_shown() -> None:
    match = match_form(f"{COUNTS}:(?P<size>.+)", " 4X3:2e-2 ", "COLUMNSxROWS:SIZE")
    assert (match["columns"], match["rows"]) == ("4", "3")
    assert read_number(match, "size", "COLUMNSxROWS:SIZE") == 0.02
    with pytest.raises(InvalidInput, match=r"'4:3' is not a board; write COLUMNSxROWS\."):
        match_form(COUNTS, "4:3", "COLUMNSxROWS")
    word = match_form(f"{COUNTS}:(?P<size>.+)", "4x3:wide", "COLUMNSxROWS:SIZE")
    with pytest.raises(InvalidInput, match=r"'wide' in '4x3:wide' is not a length in metres; write COL"):
        read_number(word, "size", "COLUMNSxROWS:SIZE")
    grouped = match_form(f"{COUNTS}:(?P<size>.+)", "4x3:0.02_5", "COLUMNSxROWS:SIZE")
    with pytest.raises(InvalidInput, match=r"'0\.02_5' in '4x3:0.02_5' is not a length"):
        read_number(grouped, "size", "COLUMNSxROWS:SIZE")


def test_counts_are_whole_numbers() -> None:
    assert is_count(3, 3)
    assert is_count(np.int64(4), 3)
    assert not any(is_count(value, 3) for value in (2, 4.0, "9", True, None))


@pytest.mark.parametrize("value", [0, -1.0, np.nan, np.inf, "0.02", None, True])
def test_lengths_are_positive(value: object) -> None:
    check_length("gap", 0.02)
    with pytest.raises(InvalidInput, match=r"The gap must be a positive length in metres, not .*\."):
        check_length("gap", value)


@pytest.mark.parametrize("value", [25, 1e300, 1e-300])
def test_lengths_are_those_of_boards(value: float) -> None:
    with pytest.raises(
        InvalidInput, match=r"A gap of .* m is not that of a board; lengths are in metres, .*\."
    ):
        check_length("gap", value)


def test_a_lattice_goes_row_by_row() -> None:
    np.testing.assert_array_equal(
        lattice(3, 2, 0.5), [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [0, 0.5, 0], [0.5, 0.5, 0], [1, 0.5, 0]]
    )
