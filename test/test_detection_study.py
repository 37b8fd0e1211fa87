"""The study of the corners' accuracy: its images, its measures, and a small run."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from detection import CASES, USUAL, Found, barrel_camera, errors, take

STUDY = Path(__file__).resolve().parent.parent / "experiments" / "detection.py"


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
def test_the_lens_draws_the_corner_inwards_by_its_share(share: float) -> None:
    camera = barrel_camera((640, 480), share)
    x, y, z = camera.unproject([-0.5, -0.5])
    straight = np.array([x, y]) / z * camera.fx
    drawn = np.array([-0.5, -0.5]) - camera.intrinsics[2:]
    assert np.linalg.norm(drawn) / np.linalg.norm(straight) == pytest.approx(1 - share, abs=1e-3)


def test_the_whole_board_is_in_every_image() -> None:
    shot = take(USUAL, np.random.default_rng(0))
    assert shot.image.shape == (480, 640)
    assert shot.truth.shape == (54, 2)
    assert (shot.truth > 0).all()
    assert (shot.truth < (640, 480)).all()
    np.testing.assert_allclose(np.linalg.norm(shot.to_light, axis=1), 1)


def test_the_order_counts_where_it_is_part_of_the_answer() -> None:
    shot = take(USUAL, np.random.default_rng(0))
    turned = Found(shot.truth[::-1] + 0.1)
    assert errors(turned, shot, any_order=False) is None
    np.testing.assert_allclose(errors(turned, shot, any_order=True), 0.1)
    assert errors(None, shot, any_order=True) is None


def test_cases_have_names_of_their_own() -> None:
    assert len({case.name for case in CASES}) == len(CASES)


def test_a_small_run_meets_the_goals() -> None:
    run = [sys.executable, str(STUDY), "--small", "--trials", "2"]
    done = subprocess.run(run, capture_output=True, text=True, check=True, timeout=300)
    _, _, *rows = done.stdout.splitlines()
    assert len(rows) == 3
    for row in rows:
        cells = [cell.strip() for cell in row.strip("|").split("|")]
        ratio, z, _, _, found, _ = cells[-6:]
        assert float(ratio) < 0.7
        assert 0.7 < float(z) < 1.35  # of two images
        assert found.startswith("2/")
