"""The study of the detector's speed and memory: a small run of each."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from detection_speed import BOARDS, frames, is_found

from fewcal.boards import parse_board

STUDY = Path(__file__).resolve().parent.parent / "experiments" / "detection_speed.py"


@pytest.mark.parametrize("text", BOARDS)
def test_each_kind_is_found_where_it_is_and_nowhere_else(text: str) -> None:
    board = parse_board(text)
    with_board, without = frames((960, 720), board)
    assert is_found(with_board, board)
    assert not is_found(without, board)


@pytest.mark.parametrize(("more", "columns"), [((), 8), (("--memory", "1"), 4)])
def test_a_small_run(more: tuple[str, ...], columns: int) -> None:
    run = [sys.executable, str(STUDY), "--boards", BOARDS[0], "--sizes", "320x240", "--runs", "1", *more]
    done = subprocess.run(run, capture_output=True, text=True, check=True, timeout=300)
    header, rule, row = done.stdout.splitlines()
    assert header.count("|") == rule.count("|") == row.count("|") == columns + 1
    assert BOARDS[0] in row
