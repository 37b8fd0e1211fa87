"""How much better `map` would be if a part of each real camera were known beforehand.

    python experiments/what_limits.py DIR [--pairs 30]

DIR, draws and reference are those of real_cameras.py. The parts are given as priors a thousand times narrower
than usual about the reference's value, so that what remains is owed to the others. Printed: focal and
projection error, median and 90th percentile, as real_cameras.py has them.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from real_cameras import Answer, Result, draws, load, measure, quantiles, reference

import fewcal
from fewcal.constraints import Normal, Priors
from fewcal.parametrisation import ScaleFree
from fewcal.radial_prior import RadialPrior

PARTS = {
    "nothing": (),
    "aspect ratio": ("aspect",),
    "radial terms": ("radial",),
    "principal point": ("centre",),
    "principal point, radial terms": ("centre", "radial"),
    "principal point, radial terms, aspect ratio": ("centre", "radial", "aspect"),
    "focal length": ("focal",),
}


def knowing(camera: fewcal.Camera, size: tuple[int, int], parts: tuple[str, ...]) -> Priors:
    """Priors of somebody who knows some parts of a camera."""
    natural = np.concatenate([camera.intrinsics, camera.distortion[:4]])
    _, aspect, x, y, a1, a2, _, _ = ScaleFree(size).theta(natural).tolist()
    priors = Priors()
    if "aspect" in parts:
        priors = replace(priors, log_aspect=Normal(aspect, 2e-6))
    if "centre" in parts:
        priors = replace(priors, principal_point_x=Normal(x, 1e-5), principal_point_y=Normal(y, 1e-5))
    if "radial" in parts:
        covariance = ((1e-8, 0.0), (0.0, 1e-8))
        priors = replace(priors, radial=(RadialPrior(1e3, covariance, terms=(a1, a2)),))
    if "focal" in parts:
        priors = replace(priors, focal_px=(camera.fx, 4e-4 * camera.fx))
    return priors


def answer(priors: Priors, views: list[fewcal.View], size: tuple[int, int]) -> Answer:
    """Calibrate with some priors."""
    found = fewcal.calibrate(views, size, priors=priors)
    return found.camera, found.focal_std, found.verdict.usable


def run(path: Path, pairs: int) -> dict[tuple[int, str], list[Result]]:
    """All draws of one camera, for each part that is known."""
    views, size = load(path)
    truth = reference(views, size)
    results = {}
    for count, chosen in draws(len(views), pairs, np.random.default_rng(0)).items():
        for name, parts in PARTS.items():
            method = partial(answer, knowing(truth, size, parts))
            of = [measure(method, [views[i] for i in draw], size, truth) for draw in chosen]
            results[count, name] = of
    return results


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pairs", type=int, default=30, help="pairs of views a camera at most (default 30)")
    options = parser.parse_args()
    paths = sorted(options.folder.glob("**/corners.npz"))
    if not paths:
        parser.error(f"There is no corners.npz in {options.folder} or a folder in it.")
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        cameras = list(pool.map(partial(run, pairs=options.pairs), paths))
    print("| views | known beforehand | focal error, median / 90 % | projection error, median / 90 % |")
    print("| --- | --- | --- | --- |")
    for count, name in cameras[0]:
        found = [result for camera in cameras for result in camera[count, name]]
        focal = quantiles(100 * np.array([result.focal for result in found]))
        print(f"| {count} | {name} | {focal} % | {quantiles([result.projection for result in found])} |")


if __name__ == "__main__":
    main()
