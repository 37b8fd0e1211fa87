"""The study of recall under difficulties: its images, its measure, and a small run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recall import CASES, Case, hands, is_right, shadow, table

from fewcal.boards import Chessboard

STUDY = Path(__file__).resolve().parent.parent / "experiments" / "recall.py"


def test_cases_have_names_of_their_own() -> None:
    assert len({case.name for case in CASES}) == len(CASES)


@pytest.mark.parametrize("effect", [table(0.0, 0.04), hands, shadow])
def test_what_happens_to_a_board_leaves_its_corners_to_be_seen(effect: object) -> None:
    plain, true = Case("plain", noise=0.0).take(np.random.default_rng(1))
    image, moved = Case("other", noise=0.0, effects=(effect,)).take(np.random.default_rng(1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(true, moved)
    assert (image != plain).any()
    for u, v in np.rint(true).astype(int):
        assert np.ptp(image[v - 5 : v + 6, u - 5 : u + 6]) > 25


def test_any_turn_in_which_the_corners_look_the_same_is_right_and_a_mirrored_board_is_not() -> None:
    board = Chessboard(9, 6, 0.025)
    _, true = Case("plain").take(np.random.default_rng(1))
    assert is_right(true + 0.5, true, board)
    assert is_right(true[::-1], true, board)
    assert not is_right(true.reshape(6, 9, 2)[:, ::-1].reshape(-1, 2), true, board)
    assert not is_right(true + 5.0, true, board)
    assert not is_right(None, true, board)


def test_a_small_run() -> None:
    run = [sys.executable, str(STUDY), "--only", "barrel 30 %", "--trials", "1"]
    done = subprocess.run(run, capture_output=True, text=True, check=True, timeout=300)
    _, _, *rows = done.stdout.splitlines()
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [row[0] for row in cells] == ["barrel 30 %", "20x14, barrel 30 %"]
    assert all(row[1] == "1" and row[-2:] == ["0", "0"] for row in cells)
