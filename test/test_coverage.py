"""The study of the error bars: its models of cameras and errors, its scores, and a small run."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arrangements import ARRANGEMENTS, named, reasons_for
from error_bars import QUANTITIES, TILTS_DEG, compare, fixed_score, prior_focal_std, run, turned_score
from real_cameras import turned_errors
from synthetic import (
    ERRORS,
    LARGE_BEND,
    absorbed_part,
    assumed,
    draw_camera,
    draw_scene,
    lens_remainder,
    real,
)

import fewcal
from fewcal.verdict import tilt_deg

COVERAGE = Path(__file__).resolve().parent.parent / "experiments" / "coverage.py"


@pytest.mark.parametrize("distance", ["far", "near"])
@pytest.mark.parametrize("tilt", TILTS_DEG)
def test_boards_are_seen_whole_and_tilted_as_asked(tilt: int, distance: str) -> None:
    for seed in range(5):
        scene = draw_scene(np.random.default_rng(seed), tilt, 3, distance)
        pixels = scene.pixels(scene.board.points)
        assert pixels.min() > 0
        assert (pixels < np.array(scene.size) - 1).all()
        assert tilt_deg(scene.poses[:, :3, :3]) == pytest.approx([tilt] * 3, abs=1e-5)
        # Every pixel is on the sheet of the distortion model that has a ray.
        back = scene.camera.unproject(pixels)
        assert scene.camera.project(back) == pytest.approx(pixels, abs=1e-6)


def test_cameras_come_from_the_prior() -> None:
    rng = np.random.default_rng(0)
    once = [draw_camera(rng) for _ in range(400)]
    twice = [draw_camera(rng, width=2.0) for _ in range(400)]
    log_focal = [np.log(camera.fx / max(size)) for camera, size in once]
    assert np.mean(log_focal) == pytest.approx(-0.21, abs=0.08)
    assert np.std(log_focal) == pytest.approx(0.40, abs=0.06)

    def offset(drawn: list[tuple[fewcal.Camera, tuple[int, int]]]) -> float:
        return float(np.median([abs(c.cx - (w - 1) / 2) / np.hypot(w, h) for c, (w, h) in drawn]))

    assert offset(once) == pytest.approx(0.0137 * 0.847, rel=0.15)  # the median of |t(1.7)|
    assert offset(twice) == pytest.approx(2 * offset(once), rel=0.3)


def test_absorbed_errors_leave_no_residual_but_move_the_camera() -> None:
    scene = draw_scene(np.random.default_rng(3), 45, 2, "near")
    exact = scene.pixels(scene.board.points)
    errors = np.random.default_rng(4).normal(0, 0.01, exact.shape)
    part = absorbed_part(scene, errors)
    assert absorbed_part(scene, part) == pytest.approx(part, abs=1e-6)
    unknowns = 8 + 2 * 6
    assert (part**2).sum() / 0.01**2 == pytest.approx(unknowns, abs=4 * np.sqrt(2 * unknowns))
    found = fewcal.calibrate([fewcal.View(scene.board.points, seen) for seen in exact + part], scene.size)
    assert found.rms < 0.001
    assert found.camera.fx != pytest.approx(scene.camera.fx, rel=1e-6)


def test_the_lens_beyond_the_model_is_small_and_no_camera_explains_it() -> None:
    scene = draw_scene(np.random.default_rng(5), 0, 1, "near")
    axes = [np.linspace(0, n - 1, 21) for n in scene.size]
    grid = np.stack(np.meshgrid(*axes), -1).reshape(1, -1, 2)
    remainder = lens_remainder(scene, grid, np.random.default_rng(6))[0]
    assert 0.01 < np.sqrt((remainder**2).mean()) < 1
    at = grid[0] - scene.camera.intrinsics[2:]
    assert abs((remainder * at).sum()) < 1e-6 * np.abs(at).sum()
    assert remainder.mean(axis=0) == pytest.approx([0, 0], abs=1e-9)


@pytest.mark.parametrize("name", ERRORS)
def test_errors_are_drawn_anew_and_leave_the_board_alone(name: str) -> None:
    scene = draw_scene(np.random.default_rng(7), 30, 2, "near")
    exact = scene.pixels(scene.board.points)
    first, second = (ERRORS[name](scene, np.random.default_rng(seed)) for seed in (1, 2))
    assert len(first) == 2
    for view, other, ideal in zip(first, second, exact, strict=True):
        assert np.array_equal(view.object_points, scene.board.points)
        assert not np.array_equal(view.image_points, other.image_points)
        assert 0.01 < np.std(view.image_points - ideal) < 20


def test_a_bend_moves_tilted_boards_more() -> None:
    def size(tilt: int) -> float:
        scenes = [draw_scene(np.random.default_rng(seed), tilt, 1, "near") for seed in range(20)]
        moved = [
            real(s, np.random.default_rng(1), bend=LARGE_BEND)[0].image_points - s.pixels(s.board.points)
            for s in scenes
        ]
        return float(np.median([np.std(error) for error in moved]))

    assert size(65) > 1.5 * size(0)


def test_scores_count_reported_deviations() -> None:
    scene = draw_scene(np.random.default_rng(8), 45, 2, "near")
    found = fewcal.calibrate(assumed(scene, np.random.default_rng(9)), scene.size)
    std, camera = found.std, found.camera
    assert std is not None
    assert found.covariance is not None
    told = compare(found, replace(scene, camera=camera), np.random.default_rng(0))
    assert told[:7] == pytest.approx([0.0] * 7, abs=1e-6)
    tangential = np.array([0, 0, -std["p1"], 2 * std["p2"], 0])
    other = replace(
        camera, fx=camera.fx - 2 * std["fx"], cx=camera.cx + 3 * std["cx"],
        distortion=camera.distortion + tangential,
    )  # fmt: skip
    told = compare(found, replace(scene, camera=other), np.random.default_rng(0))
    assert told[:6] == pytest.approx([2.0, -3.0, 0.0, 0.0, 1.0, -2.0], abs=1e-9)
    # A rotation takes over most of a shift of the principal point.
    shifted = replace(camera, cx=camera.cx + 5.0)
    error = turned_errors(camera, shifted, scene.size)[1]
    assert np.sqrt((error**2).sum(axis=1).mean()) < 2.0
    fixed = fixed_score(
        camera, np.eye(8) * 0 + np.diag([0, 0, 1, 1, 0, 0, 0, 0.0]), shifted, camera.intrinsics[2:]
    )
    assert abs(fixed) <= 5.0 + 1e-6
    assert np.isfinite(turned_score(camera, found.covariance, scene, np.random.default_rng(0)))


def test_the_prior_alone_leaves_the_focal_length_open() -> None:
    wide = fewcal.Camera(300.0, 300.0, 639.5, 479.5)  # where the mean of the distortion stays what it is
    assert prior_focal_std(wide, (1280, 960)) == pytest.approx(0.40)
    usual = fewcal.Camera(1000.0, 1000.0, 639.5, 479.5, [-0.1, 0.0, 0.0, 0.0, 0.0])
    assert 0.1 < prior_focal_std(usual, (1280, 960)) < 0.40


def test_a_draw_can_be_repeated() -> None:
    job = ("assumed", 30, 1)
    assert run(job) == run(job)
    assert run(job) != run(("assumed", 30, 5))
    assert all(np.isfinite(getattr(run(job), quantity)) for quantity in QUANTITIES)


@pytest.mark.parametrize("kind", ARRANGEMENTS)
def test_the_verdict_names_each_arrangement(kind: str) -> None:
    assert named(reasons_for((kind, 0))) == {kind}


def test_a_small_run_prints_what_it_saves(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    command = [sys.executable, str(COVERAGE), "--trials", "2", "--scenarios", "iid", "--processes", "1"]
    done = subprocess.run(
        [*command, "--arrangements", "1", "--by", "views", "--out", str(tmp_path), "--plots", str(tmp_path)],
        capture_output=True, encoding="utf-8", timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    with (tmp_path / "coverage.csv").open() as file:
        draws = list(csv.DictReader(file))
    assert len(draws) == 2 * len(TILTS_DEG)
    row = re.search(r"^\| iid \| 14 \| (\S+) (\S+) (\S+) \|", done.stdout, re.MULTILINE)
    assert row is not None, done.stdout
    scores = np.abs([float(draw["fx"]) for draw in draws])
    assert [float(cell) for cell in row.groups()] == pytest.approx(
        [(scores < bound).mean() for bound in (1, 2, 3)], abs=0.005
    )
    assert (tmp_path / "coverage.png").read_bytes().startswith(b"\x89PNG")
