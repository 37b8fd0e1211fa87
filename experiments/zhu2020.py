"""Run the paper's synthetic trials with map, zhu2020 and zhang, and print the counts beside the printed ones.

    python experiments/zhu2020.py [--every 1] [--methods map,zhu2020,zhang] [--quantised]

1350 trials with one view and 1350 with two (sections 5.1.2 to 5.1.4); `--every 9` runs each ninth. A trial
succeeds when more than 70 % of the parameters (fx s u0 fy v0 k1 k2, and three Euler angles and three
translations a view) lie within 30 % of the truth, or within 0.1 where the truth is 0. That is lenient, so
the focal error is printed beside it. The paper does not publish its poses; fewcal.virtual_camera says how
ours are made.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from itertools import islice

# One thread a process: the matrices are small, and the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

import fewcal
from fewcal.virtual_camera import PAPER_CAMERA, Trial, paper_trials

PRINTED = {
    ("zhang", 1, False): 126,
    ("zhu2020", 1, False): 608,
    ("zhang", 2, False): 567,
    ("zhu2020", 2, False): 1350,
    ("zhang", 2, True): 540,
    ("zhu2020", 2, True): 1350,
}
"""Successes of 1350 that the paper prints: method, views, pixels rounded to integers."""


def euler(R: NDArray[np.float64]) -> tuple[float, float, float]:
    """Angles of R = Rz(c) Ry(b) Rx(a), rad."""
    return (
        float(np.arctan2(R[2, 1], R[2, 2])),
        float(-np.arcsin(np.clip(R[2, 0], -1, 1))),
        float(np.arctan2(R[1, 0], R[0, 0])),
    )


def run(job: tuple[str, bool, Trial]) -> tuple[bool, float]:
    """Whether one trial succeeds, and its relative focal error."""
    method, quantised, trial = job
    views = trial.views
    if quantised:
        views = tuple(fewcal.View(view.object_points, np.round(view.image_points)) for view in views)
    camera = PAPER_CAMERA
    try:
        found = fewcal.calibrate(views, camera.image_size, method=method)
    except fewcal.FewcalError:
        return False, np.inf
    estimate = [found.camera.fx, found.skew, found.camera.cx, found.camera.fy, found.camera.cy]
    truth = [camera.fx, camera.s, camera.u0, camera.fy, camera.v0, *camera.pixel_distortion[:2]]
    estimate += found.pixel_distortion[:2].tolist()
    for found_pose, pose in zip(found.board_poses, trial.poses, strict=True):
        estimate += [*euler(found_pose), *found_pose[:3, 3]]
        truth += [*euler(pose), *pose[:3, 3]]
    error, scale = np.abs(np.subtract(estimate, truth)), np.abs(truth)
    good = np.where(scale == 0, error <= 0.1, error <= 0.3 * scale)
    return bool(good.mean() > 0.7), abs(found.camera.fx / camera.fx - 1)


def jobs(method: str, views: int, quantised: bool, every: int) -> Iterator[tuple[str, bool, Trial]]:
    """The trials of one row of the table."""
    return ((method, quantised, trial) for trial in islice(paper_trials(views), 0, None, every))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--every", type=int, default=1, help="run each n-th trial (default all)")
    parser.add_argument("--methods", default="map,zhu2020,zhang", help="comma-separated")
    parser.add_argument(
        "--quantised", action="store_true", help="only two views with pixels rounded to integers"
    )
    options = parser.parse_args()
    cases = [(2, True)] if options.quantised else [(1, False), (2, False)]
    print("method   views            successes  of  printed   focal error median / 90 % / largest")
    with ProcessPoolExecutor() as pool:
        for views, quantised in cases:
            for method in options.methods.split(","):
                work = jobs(method, views, quantised, options.every)
                good, errors = zip(*pool.map(run, work, chunksize=8), strict=True)
                printed = PRINTED.get((method, views, quantised), "-")
                quantiles = np.percentile(errors, (50, 90, 100), method="lower")
                print(
                    f"{method:8s} {views} {'quantised' if quantised else 'exact    '}  {sum(good):12d} "
                    f"{len(good):5d} {printed!s:>7}   " + " / ".join(f"{100 * q:.3g} %" for q in quantiles),
                    flush=True,
                )


if __name__ == "__main__":
    main()
