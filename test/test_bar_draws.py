"""The study of the number of draws behind the error bars: a small run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from bar_draws import log_ratio

from fewcal import precision_draws
from fewcal.posterior import NAMES

BAR_DRAWS = Path(__file__).resolve().parent.parent / "experiments" / "bar_draws.py"
JOB = ("assumed", 30, 1)


def test_as_many_draws_give_the_same_and_fewer_do_not() -> None:
    same = log_ratio(JOB, precision_draws.DRAWS)
    assert same == pytest.approx(np.zeros(len(NAMES)), abs=1e-12)
    few = log_ratio(JOB, 8)
    assert few is not None
    assert 1e-4 < np.abs(few).max() < 1


def test_a_small_run_prints_a_row_for_each_parameter() -> None:
    command = [sys.executable, str(BAR_DRAWS), "--trials", "1", "--scenarios", "assumed", "--many", "512"]
    done = subprocess.run(command, capture_output=True, encoding="utf-8", timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    rows = re.findall(r"^\| (\w+) \| ([\d.]+) % \| ([\d.]+) % \|$", done.stdout, re.MULTILINE)
    assert [name for name, _, _ in rows] == list(NAMES)
    assert all(0 < float(median) <= float(largest) < 50 for _, median, largest in rows)
