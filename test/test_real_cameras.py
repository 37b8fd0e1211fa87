"""The comparison on real cameras, run on a rendered one: its files, its table and its figure."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from real_cameras import Result, cells, draws, load, projection_error, unsteadiness
from scenes import SIZE, views_at
from what_limits import PARTS, answer, knowing, run

import fewcal

STUDY = Path(__file__).resolve().parent.parent / "experiments" / "real_cameras.py"
CAMERA = fewcal.Camera(1100.0, 1101.0, 645.0, 476.0, [-0.12, 0.03, 0.0, 0.0, 0.0])
TILTS = ((40, 30), (35, 120), (30, -60), (25, 200), (45, 80), (20, 0))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Write the corners of one camera, with noise."""
    rng = np.random.default_rng(0)
    views = views_at(*TILTS, camera=CAMERA)
    images = [view.image_points + rng.normal(0, 0.1, view.image_points.shape) for view in views]
    (tmp_path / "rendered").mkdir()
    np.savez(
        tmp_path / "rendered" / "corners.npz",
        view_ptr=np.cumsum([0, *(len(view) for view in views)]),
        obj=np.concatenate([view.object_points for view in views]),
        img=np.concatenate(images),
        image_size=np.array(SIZE),
        names=np.array([f"{i}" for i in range(len(views))]),
    )
    return tmp_path


def test_corners_are_read_view_by_view(folder: Path) -> None:
    views, size = load(folder / "rendered" / "corners.npz")
    assert size == SIZE
    assert len(views) == len(TILTS)
    assert np.array_equal(views[2].object_points, views_at(*TILTS, camera=CAMERA)[2].object_points)


def test_a_reference_from_few_views_is_known_less_well(folder: Path) -> None:
    corners = folder / "rendered" / "corners.npz"
    of_six = unsteadiness(corners)
    assert 1e-5 < of_six < 0.005
    with np.load(corners) as held:
        data = dict(held)
    np.savez(corners, **{**data, "view_ptr": data["view_ptr"][:4]})
    assert unsteadiness(corners) > 1.5 * of_six


def test_pairs_are_all_or_a_choice() -> None:
    rng: np.random.Generator = np.random.default_rng(0)
    assert len(draws(6, 30, rng)[2]) == 15
    chosen = draws(20, 30, rng)[2]
    assert len(set(chosen)) == 30
    assert draws(3, 30, rng)[1] == [(0,), (1,), (2,)]


def test_a_rotation_is_no_projection_error() -> None:
    assert projection_error(CAMERA, CAMERA, SIZE) == pytest.approx(0, abs=1e-9)
    longer = fewcal.Camera(CAMERA.fx * 1.01, CAMERA.fy * 1.01, CAMERA.cx, CAMERA.cy, CAMERA.distortion)
    assert 1 < projection_error(longer, CAMERA, SIZE) < 5


def test_a_row_counts_what_the_verdict_flagged() -> None:
    found = [
        Result(0.01, 2.0, 0.5, True),
        Result(0.02, 3.0, 3.5, True),
        Result(0.30, 9.0, 2.5, False),
        Result(0.20, 8.0, 2.5, True),
        Result(np.inf, np.inf, np.nan, False),
    ]
    assert cells(found) == [
        "5", "20.0 / 30.0 %", "8.00 / 9.00", "3", "2", "0.25 0.25 0.75", "0.60", "33.3 %",
    ]  # fmt: skip


def _row(text: str, method: str, views: int) -> list[str]:
    (row,) = (line for line in text.splitlines() if line.startswith(f"| {views} | {method} |"))
    return [cell.strip() for cell in row.strip("|").split("|")]


def test_a_small_run(folder: Path) -> None:
    pytest.importorskip("matplotlib")
    done = subprocess.run(
        [sys.executable, str(STUDY), str(folder), "--pairs", "4", "--plots", str(folder), "--processes", "1",
         "--methods", "map", "opencv-expert"],
        capture_output=True, encoding="utf-8", timeout=300, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    counts: NDArray[np.int_] = np.array(
        [[int(_row(done.stdout, m, n)[2]) for n in (1, 2)] for m in ("map", "opencv-expert")]
    )
    assert counts.tolist() == [[6, 4], [6, 4]]
    median = float(_row(done.stdout, "map", 2)[3].split()[0])
    assert median < 1.0
    assert _row(done.stdout, "map", 2)[5] == "0"
    assert (folder / "real_cameras.png").read_bytes().startswith(b"\x89PNG")


def test_cameras_whose_reference_is_not_known_are_left_out(folder: Path) -> None:
    def study(steady: str) -> str:
        return subprocess.run(
            [sys.executable, str(STUDY), str(folder), "--pairs", "1", "--methods", "map", "--steady", steady],
            capture_output=True, encoding="utf-8", timeout=300, check=True,
        ).stdout  # fmt: skip

    assert "rendered: reference known to 0." in study("0.02")
    assert "\nCameras: 1\n" in study("0.02")
    assert "%, left out\n\nCameras: 0\n" in study("1e-6")


def test_what_is_known_of_a_camera_is_found_again(folder: Path) -> None:
    views, size = load(folder / "rendered" / "corners.npz")
    known = answer(knowing(CAMERA, size, ("centre", "radial", "aspect")), views[:1], size)[0]
    np.testing.assert_allclose(known.intrinsics[2:4], CAMERA.intrinsics[2:4], atol=0.1)
    assert known.fy / known.fx == pytest.approx(CAMERA.fy / CAMERA.fx, abs=1e-4)
    assert answer(knowing(CAMERA, size, ("focal",)), views[:1], size)[0].fx == pytest.approx(1100, rel=1e-3)
    found = run(folder / "rendered" / "corners.npz", pairs=4)
    assert set(found) == {(count, name) for count in (1, 2) for name in PARTS}
    assert found[2, "focal length"][0].focal < found[2, "nothing"][0].focal
