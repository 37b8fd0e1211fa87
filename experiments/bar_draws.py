"""How near the error bars of a few draws of the precisions come to those of many, in drawn scenes.

    python experiments/bar_draws.py [--trials 24] [--many 32768]

The scenes are those of coverage.py, `--trials` of each scenario and tilt. Printed for each parameter: by how
much its standard deviation differs, median and 90th percentile.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from unittest.mock import patch

# One thread a process: the matrices are small, and the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from error_bars import TILTS_DEG, Job, scene_of
from numpy.typing import NDArray

import fewcal
from fewcal import precision_draws
from fewcal.posterior import NAMES

Array = NDArray[np.float64]


def log_ratio(job: Job, many: int) -> Array | None:
    """Logarithm (8,) of the standard deviations over those of many draws; None without an answer."""
    scene, views, _, _ = scene_of(job)
    try:
        few = fewcal.calibrate(views, scene.size).std
        with patch.object(precision_draws, "DRAWS", many):
            full = fewcal.calibrate(views, scene.size).std
    except fewcal.FewcalError:
        return None
    assert few is not None
    assert full is not None
    return np.array([np.log(few[name] / full[name]) for name in NAMES])


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=24, help="a scenario and tilt (default 24)")
    parser.add_argument("--scenarios", default="assumed,real", help="comma-separated (default assumed,real)")
    parser.add_argument("--many", type=int, default=32768, help="draws compared with (default 32768)")
    options = parser.parse_args()
    jobs = list(product(options.scenarios.split(","), TILTS_DEG, range(options.trials)))
    with ProcessPoolExecutor() as pool:
        found = list(pool.map(log_ratio, jobs, [options.many] * len(jobs), chunksize=4))
    off = 100 * np.abs(np.expm1([each for each in found if each is not None]))
    print(f"{len(off)} scenes, {precision_draws.DRAWS} draws instead of {options.many}")
    print("", "| parameter | median | 90 % |", "|---|---|---|", sep="\n")
    for name, values in zip(NAMES, off.T, strict=True):
        print(f"| {name} | {np.median(values):.1f} % | {np.percentile(values, 90):.1f} % |")


if __name__ == "__main__":
    main()
