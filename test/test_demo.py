"""The demo that `make demo` runs, on every bundled recording."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DEMO = ROOT / "experiments" / "demo.py"
RECORDINGS = tuple(json.loads((ROOT / "bags" / "truth.json").read_text()))

installed = pytest.mark.skipif(
    not Path(sys.executable).with_name("fewcal").exists(), reason="fewcal is not installed beside this python"
)


def run(recording: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, DEMO, recording],
        capture_output=True,
        encoding="utf-8",
        env=os.environ | {"PYTHONIOENCODING": "utf-8"},
        timeout=120,
        check=False,
    )


@installed
@pytest.mark.parametrize("recording", RECORDINGS)
def test_the_demo_shows_result_and_truth(recording: str) -> None:
    done = run(recording)
    assert done.returncode == 0, done.stdout + done.stderr
    truth = json.loads((ROOT / "bags" / "truth.json").read_text())[recording]["camera"]
    row = next(line for line in done.stdout.splitlines() if line.startswith("│ fx"))
    _, _, found, sigma, known, apart, _ = (cell.strip() for cell in row.split("│"))
    assert float(known) == truth["fx"]
    assert abs(float(found) - truth["fx"]) < 3 * float(sigma)
    assert abs(float(apart)) < 3
    assert "Usable." in done.stdout


@installed
def test_the_demo_of_no_recording_fails_with_a_sentence() -> None:
    done = run("none")
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert "arm.mcap" in done.stderr
