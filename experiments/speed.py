"""Time calibrate() side by side with others on the same corners, and print a markdown table.

    python experiments/speed.py [--rounds 20] [--plots DIR]

Each round calls everybody once, in turn, on the same views of 54 points; the ratio is that of a round, and
its median is printed. cv2.calibrateCamera runs with default flags. scipy.optimize.least_squares minimises the
same residuals from the answer of calibrate() with the focal length moved by 2 %: one minimisation, without
homographies, starts, error bars or verdict. mrcal takes part where it is installed. Then the time that an
import takes on top of numpy and OpenCV. For the paper's trials a second see zhu2020.py.
`--plots` draws the times over the number of views, which needs matplotlib.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

# The matrices are small; threads would only compete.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import mrcal_camera
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

import fewcal
from fewcal.adjustment import Adjustment, Geometry, rotation_from_vector
from fewcal.parametrisation import ScaleFree
from fewcal.views import stack_views

Array = NDArray[np.float64]

SIZE = (1280, 960)
CAMERA = fewcal.Camera(1100.0, 1103.0, 650.0, 470.0, [-0.12, 0.03, 0.0006, -0.0004, 0.0])
BOARD = fewcal.Chessboard(9, 6, 0.025)
NOISE_PX = 0.2
COUNTS = (1, 2, 5, 10, 20)


def scene(count: int) -> list[fewcal.View]:
    """Views of 54 corners tilted by 15 to 45 deg about axes all around, with noise."""
    rng = np.random.default_rng(count)
    views = []
    for i in range(count):
        about = np.radians(20 + 67 * i)
        tilt = np.radians(30 + 15 * np.sin(i)) * np.array([np.cos(about), np.sin(about), 0])
        T = np.eye(4)
        T[:3, :3] = rotation_from_vector(tilt)
        T[:3, 3] = [0, 0, 0.32] - T[:3, :3] @ BOARD.points.mean(axis=0)
        pixels = CAMERA.project(BOARD.points, T)
        views.append(fewcal.View(BOARD.points, pixels + rng.normal(0, NOISE_PX, pixels.shape)))
    return views


def run_opencv(views: list[fewcal.View]) -> Callable[[], object]:
    """cv2.calibrateCamera with default flags."""
    objects = [view.object_points.astype(np.float32) for view in views]
    images = [view.image_points.astype(np.float32)[:, None] for view in views]
    # Typed as if the camera matrix were required, which it is not.
    return lambda: cv2.calibrateCamera(objects, images, SIZE, None, None)  # type: ignore[call-overload]


def run_scipy(views: list[fewcal.View]) -> Callable[[], object]:
    """scipy.optimize.least_squares on the same rows and Jacobians, noise and width of the priors given."""
    answer = fewcal.calibrate(views, SIZE)
    stack, model = stack_views(views), ScaleFree(SIZE)
    poses = np.stack(answer.board_poses)
    rotation = poses[:, :3, :3]
    position = poses[:, :3, 3] + (rotation @ stack.centroid[..., None])[..., 0]
    natural = np.concatenate([answer.camera.intrinsics, answer.camera.distortion[:4]])
    problem = Adjustment(stack, model, fewcal.Priors().rows(SIZE))
    at = Geometry(model.theta(natural)[None], (rotation @ stack.plane)[None], position[None])
    count = len(views)
    # The priors as normal ones, linear about the answer.
    prior, prior_by_camera = (part[0] for part in problem.constraint(at.theta))

    def rows(x: Array) -> tuple[Array, Array]:
        found = problem.rows(problem.retract(at, x[None, :8], x[8:].reshape(1, count, 6)), answer.sigma_px)
        J = np.zeros((found.r.size + len(prior), len(x)))
        for v, (by_camera, by_pose) in enumerate(zip(found.by_camera, found.by_pose, strict=True)):
            part = slice(v * len(by_camera), (v + 1) * len(by_camera))
            J[part, :8], J[part, 8 + 6 * v : 14 + 6 * v] = by_camera, by_pose
        J[found.r.size :, :8] = prior_by_camera
        return np.concatenate([found.r.ravel(), prior + prior_by_camera @ x[:8]]), J

    start = np.zeros(8 + 6 * count)
    start[0] = 0.02
    return lambda: least_squares(lambda x: rows(x)[0], start, lambda x: rows(x)[1], x_scale="jac")


def run_mrcal(views: list[fewcal.View]) -> Callable[[], object]:
    """Mrcal from its own seed, the board flat."""
    return lambda: mrcal_camera.calibrate(views, SIZE, warp=False)


OTHERS = {"cv2.calibrateCamera": run_opencv, "scipy least_squares": run_scipy}
if mrcal_camera.AVAILABLE:
    OTHERS["mrcal"] = run_mrcal


def timed(call: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def race(count: int, rounds: int) -> Array:
    """Seconds of calibrate() and of the others (rounds, 1 + others)."""
    views = scene(count)
    calls = [lambda: fewcal.calibrate(views, SIZE), *(run(views) for run in OTHERS.values())]
    for call in calls:
        call()
    return np.array([[timed(call) for call in calls] for _ in range(rounds)])


def row(count: int, seconds: Array) -> str:
    """One row of the table: medians of times, and of the ratios of calibrate() to the others."""
    cells = [f"{count}", f"{1e3 * np.median(seconds[:, 0]):.2f}"]
    cells += [f"{1e3 * np.median(t):.2f} ({np.median(seconds[:, 0] / t):.2f})" for t in seconds[:, 1:].T]
    return "| " + " | ".join(cells) + " |"


def plot(seconds: Sequence[Array], folder: Path) -> None:
    """Write speed.png: median times over the number of views."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 4), layout="constrained")
    for name, times in zip(("calibrate()", *OTHERS), np.median(seconds, axis=1).T, strict=True):
        axis.plot(COUNTS, 1e3 * times, "o-", label=name, lw=2.5 if name == "calibrate()" else 1.2)
    axis.set(xlabel="views of 54 points", ylabel="ms", xlim=(0, None), ylim=(0, None))
    axis.grid(alpha=0.3)
    axis.legend()
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "speed.png", dpi=80)


def import_seconds(code: str) -> float:
    """Median time of a new interpreter that runs some imports."""
    return float(
        np.median([timed(lambda: subprocess.run([sys.executable, "-c", code], check=True)) for _ in range(7)])
    )


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--rounds", type=int, default=20, help="rounds of calls (default 20)")
    parser.add_argument("--plots", type=Path, help="folder for the figure (default: none is drawn)")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    print("Milliseconds, and in brackets the median ratio of calibrate() to it:\n")
    print("| views | calibrate() | " + " | ".join(OTHERS) + " |\n|---|---" + "|---" * len(OTHERS) + "|")
    seconds = []
    for count in COUNTS:
        seconds.append(race(count, options.rounds))
        print(row(count, seconds[-1]), flush=True)
    if options.plots:
        plot(seconds, options.plots)
    basis = import_seconds("import numpy, cv2")
    print(
        f"\nimport fewcal, on top of numpy and OpenCV: {import_seconds('import cv2, fewcal') - basis:.2f} s"
    )


if __name__ == "__main__":
    main()
