"""False confidence under errors that the estimator does not know of, one kind at a time.

    python experiments/disturbances.py [--trials 200] [--views N] [--only twist,real,...] [--square SD]

Cameras drawn from the prior, boards tilted by up to 60 degrees, one to five views (or `--views` of them) with
independent noise of 0.03 to 0.15 px, and one disturbance for each set. Printed for each: the share of true fx
within 1 and 2 reported standard deviations, the share of sets called usable, and of all sets those called
usable whose fx is off by more than three. "real" is the mixture of synthetic.py. With `--square` the squares
are stated to be square, with a standard deviation of ln(width / height).
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from typing import NamedTuple

# One thread a process: the matrices are small, and the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray
from synthetic import BEND, BOARDS, LARGEST, Scene, draw_camera, place, real, rotation

import fewcal
from fewcal.departures import lens_remainder, radial_terms

Array = NDArray[np.float64]
Generator = np.random.Generator
VIEWS = (1, 2, 2, 2, 3, 5)
"""Number of views, each as likely."""


def bent(scene: Scene, rng: Generator, shape: Callable[[Array, Array], Array], each: bool = False) -> Array:
    """A board lifted by `shape` of its sides from -1 to 1, times a drawn share of its diagonal."""
    points = scene.board.points
    size = np.ptp(points[:, :2], axis=0)
    u, v = ((points[:, :2] - points[:, :2].mean(axis=0)) / (size / 2)).T
    bends = BEND * rng.standard_t(2, len(scene.poses)).clip(-LARGEST, LARGEST)
    lift = np.hypot(*size) * shape(u, v)[:, None] * [0, 0, 1]
    return np.stack(
        [
            scene.camera.project(points + (bend if each else bends[0]) * lift, T)
            for bend, T in zip(bends, scene.poses, strict=True)
        ]
    )


def stretched(scene: Scene, rng: Generator, share: float) -> Array:
    """Squares longer or shorter than wide."""
    return scene.pixels(scene.board.points * [1 + share * rng.choice([-1, 1]), 1, 1])


def sheared(scene: Scene, rng: Generator, share: float) -> Array:
    """Rows that move during the readout of the image, along and across it, otherwise in each view."""
    pixels = scene.pixels(scene.board.points)
    below = pixels[..., 1:] - scene.size[1] / 2
    return np.asarray(pixels + below * rng.normal(0, share, (len(pixels), 1, 2)))


def seventh(scene: Scene, rng: Generator, share: float) -> Array:
    """A radial term of r^7, in half diagonals at the corner of the image."""
    pixels = scene.pixels(scene.board.points)
    centre = scene.camera.intrinsics[2:]
    shift = lens_remainder(
        pixels.swapaxes(1, 2), scene.size, centre, radial_terms(scene.camera, scene.size)
    ).swapaxes(1, 2)
    return np.asarray(pixels + share * rng.choice([-1, 1]) * shift)


def alternating(scene: Scene, _: Generator) -> Array:
    """Every other corner moved by 0.2 px."""
    lattice = np.round((scene.board.points - scene.board.points[0]) / scene.board.square_size)
    odd = lattice.sum(axis=1) % 2
    return np.asarray(scene.pixels(scene.board.points) + 0.2 * np.sqrt(0.5) * odd[:, None])


def outlier(scene: Scene, rng: Generator, least: float, most: float) -> Array:
    """One corner of one view in a wrong place."""
    pixels = scene.pixels(scene.board.points)
    distance, angle = np.exp(rng.uniform(np.log(least), np.log(most))), rng.uniform(0, 2 * np.pi)
    wrong = rng.integers(len(pixels)), rng.integers(pixels.shape[1])
    pixels[wrong] += distance * np.array([np.cos(angle), np.sin(angle)])
    return pixels


def zoomed(scene: Scene, _: Generator, share: float) -> Array:
    """The last of several views through another zoom."""
    pixels, camera = scene.pixels(scene.board.points), scene.camera
    other = replace(camera, fx=share * camera.fx, fy=share * camera.fy)
    if len(pixels) > 1:
        pixels[-1] = other.project(scene.board.points, scene.poses[-1])
    return pixels


def mixed(scene: Scene, rng: Generator) -> Array:
    """Every other view by another camera."""
    pixels, size = scene.pixels(scene.board.points), None
    while size != scene.size:
        other, size = draw_camera(rng)
    for view in range(1, len(pixels), 2):
        T = place(other, scene.size, scene.board, scene.poses[view, :3, :3], 0.5, rng)
        pixels[view] = other.project(scene.board.points, T)
    return pixels


def stabilised(scene: Scene, rng: Generator, share: float) -> Array:
    """Images that a stabiliser has moved, otherwise in each view."""
    pixels = scene.pixels(scene.board.points)
    return np.asarray(pixels + rng.normal(0, share * scene.size[0], (len(pixels), 1, 2)))


DISTURBANCES: dict[str, Callable[[Scene, Generator], Array]] = {
    "nothing": lambda scene, _: scene.pixels(scene.board.points),
    "cubic bend": partial(bent, shape=lambda u, v: u**3 - u + v**3 - v),
    "twist": partial(bent, shape=lambda u, v: u * v),
    "bend of each view": partial(bent, shape=lambda u, v: u**2 + v**2, each=True),
    "squares 0.1 %": partial(stretched, share=1e-3),
    "squares 0.3 %": partial(stretched, share=3e-3),
    "squares 0.5 %": partial(stretched, share=5e-3),
    "squares 2 %": partial(stretched, share=0.02),
    "shear 5e-4": partial(sheared, share=5e-4),
    "shear 2e-3": partial(sheared, share=2e-3),
    "r^7 2 %": partial(seventh, share=0.02),
    "r^7 5 %": partial(seventh, share=0.05),
    "r^7 30 %": partial(seventh, share=0.3),
    "alternating": alternating,
    "zoom of one view 0.8": partial(zoomed, share=0.8),
    "zoom of one view 0.95": partial(zoomed, share=0.95),
    "two cameras": mixed,
    "stabiliser 0.5 %": partial(stabilised, share=0.005),
    "outlier 1 to 5 px": partial(outlier, least=1, most=5),
    "outlier 5 to 100 px": partial(outlier, least=5, most=100),
}
"""By name; "real" comes with its own noise."""


class Draw(NamedTuple):
    """Error of ln fx over its standard deviation, and what the verdict says."""

    z: float
    usable: bool


def run(job: tuple[str, int, int | None, float | None]) -> Draw:
    """Calibrate one drawn set: disturbance, number of the set, number of views, what is stated of squares."""
    name, number, views, square = job
    priors = fewcal.Priors() if square is None else fewcal.Priors(print_stretch=fewcal.Normal(0, square))
    rng = np.random.default_rng([number, 7])
    camera, size = draw_camera(rng)
    board, span = BOARDS[rng.integers(len(BOARDS))], rng.uniform(0.3, 0.85)
    count = int(rng.choice(VIEWS)) if views is None else views
    turns = [rotation(rng.uniform(0, 60), *rng.uniform(0, 360, 2)) for _ in range(count)]
    scene = Scene(camera, size, board, np.stack([place(camera, size, board, R, span, rng) for R in turns]))
    if name == "real":
        seen = real(scene, rng)
    else:
        pixels = DISTURBANCES[name](scene, rng)
        pixels += rng.normal(0, np.exp(rng.uniform(np.log(0.03), np.log(0.15))), pixels.shape)
        seen = [fewcal.View(board.points, one) for one in pixels]
    try:
        found = fewcal.calibrate(seen, size, priors=priors)
    except fewcal.DegenerateViews:
        return Draw(np.inf, False)
    assert found.focal_std is not None
    return Draw(float(np.log(found.camera.fx / camera.fx)) / found.focal_std, found.verdict.usable)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trials", type=int, default=200, help="sets for each disturbance (default 200)")
    parser.add_argument("--views", type=int, help="views of each set (default: one to five)")
    parser.add_argument(
        "--only", default=",".join([*DISTURBANCES, "real"]), help="comma-separated, default all"
    )
    parser.add_argument("--square", type=float, metavar="SD", help="state the squares to be square within SD")
    parser.add_argument("--processes", type=int, default=None, help="default: one a core")
    options = parser.parse_args()
    print("| disturbance | fx within 1, 2 sd | usable | usable and off by > 3 sd |\n|---|---|---|---|")
    with ProcessPoolExecutor(options.processes) as pool:
        for name in options.only.split(","):
            jobs = [(name, number, options.views, options.square) for number in range(options.trials)]
            draws = list(pool.map(run, jobs, chunksize=8))
            z, usable = np.abs([draw.z for draw in draws]), np.array([draw.usable for draw in draws])
            false = 100 * (usable & (z > 3)).mean()
            row = f"{(z < 1).mean():.2f} {(z < 2).mean():.2f} | {usable.mean():.2f} | {false:.1f} %"
            print(f"| {name} | {row} |", flush=True)


if __name__ == "__main__":
    main()
