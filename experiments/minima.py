"""How often the estimator misses the lowest minimum of its own objective.

    python experiments/minima.py [--trials 240] [--scenarios assumed,real]

Scenes as in coverage.py. The objective where the estimate's own minimum lies is compared with that of the
minimum to which the true camera and poses lead. Printed for each scenario and tilt of the board: how many of
the draws ended higher by more than 0.5, 2 and 10, and how many lower, where the truth leads elsewhere.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from error_bars import TILTS_DEG, Job, scene_of
from numpy.typing import NDArray
from synthetic import Scene

import fewcal
from fewcal.adjustment import Geometry
from fewcal.constraints import Priors
from fewcal.copies import copies
from fewcal.departures import COUNT
from fewcal.least_squares import minimise
from fewcal.map_estimator import estimate_map
from fewcal.parametrisation import ScaleFree
from fewcal.views import ViewStack, stack_views

HIGHER = (0.5, 2.0, 10.0)


def truth(scene: Scene, stack: ViewStack) -> Geometry:
    """The true camera and poses, board and lens without departures."""
    natural = np.concatenate([scene.camera.intrinsics, scene.camera.distortion[:4]])
    theta = np.append(ScaleFree(scene.size).theta(natural), np.zeros(COUNT))
    R, t = scene.poses[:, :3, :3], scene.poses[:, :3, 3]
    position = (R @ stack.centroid[..., None])[..., 0] + t
    return Geometry(theta[None], (R @ stack.plane)[None], position[None])


def missed_by(job: Job) -> float:
    """Objective of the estimate's minimum less that of the truth's; infinite without an answer."""
    scene, views, _, _ = scene_of(job)
    stack = stack_views(views)
    try:
        found = estimate_map(stack, scene.size, Priors(), copies(views, scene.size))
    except fewcal.FewcalError:
        return np.inf
    ends = [minimise(found.adjustment, start).objective[0] for start in (found.geometry, truth(scene, stack))]
    return float(ends[0] - ends[1])


def row(cells: NDArray[np.float64]) -> list[str]:
    """Counts of one scenario and tilt."""
    return [str(len(cells)), *(str((cells > by).sum()) for by in HIGHER), str((cells < -HIGHER[0]).sum())]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=240, help="a scenario and tilt (default 240)")
    parser.add_argument("--scenarios", default="assumed,real", help="comma-separated (default assumed,real)")
    parser.add_argument("--processes", type=int, default=None, help="default: one a core")
    options = parser.parse_args()
    print("| scenario | tilt | n | " + " | ".join(f"higher by {by:g}" for by in HIGHER) + " | lower |")
    print("|---" * (len(HIGHER) + 4) + "|")
    with ProcessPoolExecutor(options.processes) as pool:
        for scenario in options.scenarios.split(","):
            for tilt in TILTS_DEG:
                jobs = [(scenario, tilt, number) for number in range(options.trials)]
                differences = np.array(list(pool.map(missed_by, jobs, chunksize=8)))
                print("| " + " | ".join([scenario, str(tilt), *row(differences)]) + " |", flush=True)


if __name__ == "__main__":
    main()
