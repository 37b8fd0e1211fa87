"""The study on the paper's protocol: its criterion, its bounds, and a small run."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from paper_trials import CASES, SOLVERS, Job, euler, focal_bounds, run, succeeds
from zhu2020 import efficiency, successes

import fewcal
from fewcal.adjustment import rotation_from_vector
from fewcal.virtual_camera import PAPER_CAMERA, PAPER_COLUMNS, paper_row, paper_trial

STUDY = Path(__file__).resolve().parent.parent / "experiments" / "zhu2020.py"


def test_more_than_70_percent_of_the_parameters_have_to_be_right() -> None:
    truth = np.array([4000.0, 0, 600, 4010, 600, 2.3e-7, 2.8e-15, 0.1, 0.2, 0.3, 0.1, 0.1, 2.0])
    bias = np.zeros(13)
    assert succeeds(bias, truth)
    bias[:3] = 0.31 * truth[0], 0.11, 0.31 * truth[2]
    assert succeeds(bias, truth)
    bias[3] = -0.31 * truth[3]
    assert not succeeds(bias, truth)
    bias[:4] = 0.29 * truth[0], 0.09, 0.29 * truth[2], np.nan
    assert succeeds(bias, truth)


def test_euler_angles_make_the_rotation() -> None:
    a, b, c = 0.4, -0.3, 1.1
    R = rotation_from_vector(np.array([[0, 0, c], [0, b, 0], [a, 0, 0]]))
    np.testing.assert_allclose(euler(R[0] @ R[1] @ R[2]), (a, b, c), atol=1e-12)


def test_a_bound_is_the_spread_of_an_estimator_that_reaches_it() -> None:
    trial = paper_trial(8, 48.0, views=2)
    free, vague, prior = focal_bounds(PAPER_CAMERA, trial)
    assert free > vague > prior
    rng = np.random.default_rng(0)
    known = fewcal.Priors(
        log_focal_over_width=fewcal.constraints.Normal(0.0, 10.0), corner_sigma_px=(1 / np.sqrt(12), 0.01)
    )
    errors = []
    for _ in range(60):
        views = [
            fewcal.View(v.object_points, v.image_points + rng.uniform(-0.5, 0.5, v.image_points.shape))
            for v in trial.views
        ]
        found = fewcal.calibrate(views, PAPER_CAMERA.image_size, priors=known)
        errors.append(np.log(found.camera.fx / PAPER_CAMERA.fx))
    # The noise model of map takes corners to be correlated, so that it leans more on its priors.
    assert 0.5 * vague < np.std(errors) < 1.3 * vague


def test_the_solvers_find_the_camera() -> None:
    job = Job("two", 20, tuple(SOLVERS), every=7)
    trials = [outcome for outcome in run(job) if outcome.tilt_deg > 30]
    for method in ("map", "map, f unknown", "zhu2020, centred"):
        of = [outcome for outcome in trials if outcome.method == method]
        assert of
        assert all(outcome.success for outcome in of), method
        assert all(outcome.focal_error < 0.05 for outcome in of), method
    exact = [outcome for outcome in trials if outcome.method == "map"]
    assert max(outcome.focal_error for outcome in exact) < 1e-8


def test_rows_hold_the_trials_that_are_asked_for() -> None:
    (trial,) = paper_row(7, (24.0,), 2)
    for one, other in zip(trial.poses, paper_trial(7, 24.0, 2).poses, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)
    counts = [len(run(Job("one", columns, ("zhang",), every=135))) for columns in PAPER_COLUMNS]
    assert sum(counts) == 10


def test_tables_tell_what_was_found(capsys: pytest.CaptureFixture[str]) -> None:
    outcomes = run(Job("quantised", 12, ("map",), every=10))
    successes("quantised", outcomes)
    efficiency(CASES["quantised"], outcomes)
    told = capsys.readouterr().out
    good = sum(outcome.success for outcome in outcomes)
    assert f"| map | {good} of 5 | - | 0 |" in told
    row = re.search(r"\| map \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|", told)
    assert row is not None
    ratios = np.median([outcome.focal_error / outcome.bounds for outcome in outcomes], axis=0)
    assert [float(cell) for cell in row.groups()] == pytest.approx(ratios, abs=0.006)


def test_every_135th_trial(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    done = subprocess.run(
        [sys.executable, str(STUDY), "--every", "135", "--processes", "1", "--plots", str(tmp_path)],
        capture_output=True, encoding="utf-8", timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = [int(count) for count in re.findall(r"^\| map \| (\d+) of 10 \|", done.stdout, re.MULTILINE)]
    assert len(found) == len(CASES)
    # The first trial, four columns at 1.2 deg, is one of the few that one view does not settle.
    assert found[:2] == [9, 10]
    figures = sorted(path.name for path in tmp_path.glob("*.png"))
    assert figures == sorted(f"zhu2020_figure_{number}.png" for number in (5, 6, 7, 8, 9, 10, 12))
