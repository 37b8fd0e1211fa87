"""Calibrate real cameras from single views and pairs, and compare with a calibration on all their views.

    python experiments/real_cameras.py DIR... [--pairs 30] [--methods map opencv-expert ...] [--plots DIR]

DIR holds one folder a camera with a corners.npz: names, view_ptr (V + 1 offsets), obj (M, 3) metres, img
(M, 2) pixels, image_size (w, h). The reference is OpenCV's calibration on all views with k3 fixed at zero.
`--steady 0.02` leaves out cameras whose reference is known to no better than 2 % itself (fx, one sigma, by
the jackknife: how it changes when each view is left out in turn); the distance from those is no error.
Printed for each method, median and 90th percentile: the relative focal error, and the projection error
after the best rotation, over a grid on the image, in thousandths of the image diagonal. Then gross failures
(focal error above 10 %, or no answer), how many of those the verdict had flagged, the share of focal errors
within 1, 2 and 3 reported sigma, the answers called usable, and those of them off by more than 3.
Where mrcal is installed it is among them, with and without the shape of the board among its unknowns; it
takes boards whose points lie on a square lattice.
`--plots` draws the distribution of the projection error, which needs matplotlib.
"""

from __future__ import annotations

import argparse
import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import NamedTuple

# One thread a process: the matrices are small, and the processes share the cores.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import mrcal_camera
import numpy as np
from numpy.typing import NDArray

import fewcal
from fewcal.adjustment import rotation_from_vector

Array = NDArray[np.float64]

EXPERT = (
    cv2.CALIB_FIX_ASPECT_RATIO
    | cv2.CALIB_FIX_PRINCIPAL_POINT
    | cv2.CALIB_ZERO_TANGENT_DIST
    | cv2.CALIB_FIX_K3
)
GROSS = 0.10
GRID = 15


def load(path: Path) -> tuple[list[fewcal.View], tuple[int, int]]:
    """Read a corners.npz."""
    data = np.load(path, allow_pickle=False)
    bounds = itertools.pairwise(data["view_ptr"])
    views = [fewcal.View(data["obj"][a:b], data["img"][a:b]) for a, b in bounds if b - a >= 6]
    width, height = data["image_size"].tolist()
    return views, (width, height)


def opencv(views: list[fewcal.View], size: tuple[int, int], flags: int) -> fewcal.Camera:
    """cv2.calibrateCamera with its own start."""
    objects = [view.object_points.astype(np.float32) for view in views]
    images = [view.image_points.astype(np.float32)[:, None] for view in views]
    try:
        _, K, D, _, _ = cv2.calibrateCamera(objects, images, size, np.eye(3), None, flags=flags)
    except cv2.error as error:
        raise fewcal.DegenerateViews(str(error)) from error
    return fewcal.Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], D.ravel()[:5])


def reference(views: list[fewcal.View], size: tuple[int, int]) -> fewcal.Camera:
    """What the answers are compared with."""
    return opencv(views, size, cv2.CALIB_FIX_K3)


def unsteadiness(path: Path) -> float:
    """Relative sd of fx of a reference, by the jackknife; infinite where a view is indispensable."""
    cv2.setNumThreads(1)
    views, size = load(path)
    try:
        left = [reference(views[:i] + views[i + 1 :], size).fx for i in range(len(views))]
    except fewcal.FewcalError:
        return np.inf
    return float(np.std(left) * np.sqrt(len(left) - 1) / reference(views, size).fx)


Answer = tuple[fewcal.Camera, float | None, bool]
Method = Callable[[list[fewcal.View], tuple[int, int]], Answer]


def ours(method: str) -> Method:
    """One of fewcal's methods."""

    def run(views: list[fewcal.View], size: tuple[int, int]) -> Answer:
        found = fewcal.calibrate(views, size, method=method)
        return found.camera, found.focal_std, found.verdict.usable

    return run


def theirs(flags: int) -> Method:
    """OpenCV, which never says that a result is not usable."""
    return lambda views, size: (opencv(views, size, flags), None, True)


METHODS: dict[str, Method] = {
    "map": ours("map"),
    "zhu2020": ours("zhu2020"),
    "zhang": ours("zhang"),
    "opencv": theirs(0),
    "opencv-expert": theirs(EXPERT),
    "opencv-expert-k1": theirs(EXPERT | cv2.CALIB_FIX_K2),
}
if mrcal_camera.AVAILABLE:
    METHODS |= {
        "mrcal": lambda views, size: (mrcal_camera.calibrate(views, size), None, True),
        "mrcal-flat": lambda views, size: (mrcal_camera.calibrate(views, size, warp=False), None, True),
    }


def turned_errors(camera: fewcal.Camera, truth: fewcal.Camera, size: tuple[int, int]) -> tuple[Array, Array]:
    """Errors of projected directions after the best rotation, on a grid over the image.

    Returns
    -------
    rays : (N, 3) directions that the true camera sees at the grid's pixels, turned into the other camera
    errors : (N, 2) pixels; NaN where the other camera sees nothing. Empty when it sees hardly any.
    """
    axes = [np.linspace(0, length - 1, GRID) for length in size]
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays = truth.unproject(pixels, folded="nan")
    pixels, rays = pixels[np.isfinite(rays[:, 0])], rays[np.isfinite(rays[:, 0])]
    # Rays that the camera sees at those pixels give a first rotation; Gauss-Newton in the image the best one.
    own = camera.unproject(pixels, folded="nan")
    good = np.isfinite(own[:, 0])
    if good.sum() < len(pixels) // 4:
        return np.empty((0, 3)), np.empty((0, 2))
    u, _, vt = np.linalg.svd(own[good].T @ rays[good])
    R = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    for _ in range(10):
        error = camera.project(rays @ R.T) - pixels
        steps = 1e-6 * np.eye(3)
        J = np.stack(
            [(camera.project(rays @ (rotation_from_vector(s) @ R).T) - pixels - error) / 1e-6 for s in steps],
            -1,
        )
        J, target = J.reshape(-1, 3), -error.ravel()
        seen = np.isfinite(target) & np.isfinite(J).all(axis=1)
        step = np.linalg.lstsq(J[seen], target[seen], rcond=None)[0]
        R = rotation_from_vector(step) @ R
    return rays @ R.T, camera.project(rays @ R.T) - pixels


def projection_error(camera: fewcal.Camera, truth: fewcal.Camera, size: tuple[int, int]) -> float:
    """RMS distance of projected directions after the best rotation, thousandths of the image diagonal."""
    error = turned_errors(camera, truth, size)[1]
    if not len(error):
        return np.inf
    diagonal = float(np.hypot(*size))
    # A direction that does not project counts as one that is off by the whole diagonal.
    squares = np.nan_to_num((error**2).sum(axis=1), nan=np.inf).clip(max=diagonal**2)
    return 1e3 * float(np.sqrt(squares.mean())) / diagonal


def draws(count: int, pairs: int, rng: np.random.Generator) -> dict[int, list[tuple[int, ...]]]:
    """All single views, and all pairs or a random choice of them."""
    both = list(itertools.combinations(range(count), 2))
    if len(both) > pairs:
        both = [both[i] for i in rng.choice(len(both), pairs, replace=False)]
    return {1: [(i,) for i in range(count)], 2: both}


class Result(NamedTuple):
    """What one method made of one draw of views.

    Attributes
    ----------
    focal : float
        Relative error of fx; infinite without an answer.
    projection : float
        See :func:`projection_error`; infinite without an answer.
    z : float
        Focal error over the reported sigma; NaN where none is reported.
    usable : bool
        By the verdict.
    """

    focal: float
    projection: float
    z: float
    usable: bool


Results = dict[tuple[str, int], list[Result]]
"""By method and number of views."""


def measure(method: Method, views: list[fewcal.View], size: tuple[int, int], truth: fewcal.Camera) -> Result:
    """Calibrate, and compare with the reference."""
    try:
        camera, sd, usable = method(views, size)
    except fewcal.FewcalError:
        return Result(np.inf, np.inf, np.nan, False)
    error = abs(camera.fx / truth.fx - 1)
    return Result(error, projection_error(camera, truth, size), error / sd if sd else np.nan, usable)


def run(job: tuple[Path, int, tuple[str, ...]]) -> Results:
    """All draws of one camera: its corners.npz, the number of pairs, and the methods."""
    path, pairs, names = job
    cv2.setNumThreads(1)
    views, size = load(path)
    truth = reference(views, size)
    return {
        (name, count): [measure(METHODS[name], [views[i] for i in draw], size, truth) for draw in chosen]
        for count, chosen in draws(len(views), pairs, np.random.default_rng(0)).items()
        for name in names
    }


COLUMNS = (
    "views",
    "method",
    "n",
    "focal error, median / 90 %",
    "projection error, median / 90 %",
    "off by > 10 %",
    "of these flagged",
    "z < 1, 2, 3",
    "usable",
    "of these z > 3",
)


def cells(found: Sequence[Result]) -> list[str]:
    """Cells of one row of the table, from the number of draws on."""
    focal, projection, z, usable = (np.array(column, dtype=float) for column in zip(*found, strict=True))
    gross = focal > GROSS
    known = z[np.isfinite(z)]
    false = ((z > 3) & (usable > 0)).sum() / max(usable.sum(), 1)
    return [
        str(len(found)),
        quantiles(100 * focal) + " %",
        quantiles(projection),
        f"{gross.sum()}",
        f"{(gross & (usable == 0)).sum()}",
        " ".join(f"{(known < bound).mean():.2f}" for bound in (1, 2, 3)) if len(known) else "-",
        f"{usable.mean():.2f}",
        f"{100 * false:.1f} %" if len(known) else "-",
    ]


def quantiles(errors: Array) -> str:
    """Median and 90th percentile; "none" where that has no answer."""
    values = np.percentile(errors, (50, 90), method="lower").tolist()
    return " / ".join(f"{value:#.3g}".rstrip(".") if np.isfinite(value) else "none" for value in values)


def table(results: Mapping[tuple[str, int], Sequence[Result]]) -> None:
    """Print markdown."""
    for row in (COLUMNS, ["---"] * len(COLUMNS)):
        print("| " + " | ".join(row) + " |")
    for (name, count), found in sorted(results.items(), key=lambda item: item[0][1]):
        print("| " + " | ".join([str(count), name, *cells(found)]) + " |")
    print(flush=True)


def plot(results: Mapping[tuple[str, int], Sequence[Result]], folder: Path) -> None:
    """Write real_cameras.png: distribution of the projection error, one panel a number of views."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    counts = sorted({count for _, count in results})
    figure, axes = plt.subplots(
        1, len(counts), figsize=(11, 4), sharey=True, layout="constrained", squeeze=False
    )
    for axis, count in zip(axes[0], counts, strict=True):
        for name in [name for name, views in results if views == count]:
            errors = np.sort([result.projection for result in results[name, count]])
            share = np.arange(1, len(errors) + 1) / len(errors)
            axis.step(errors, share, where="post", label=name, lw=2.5 if name == "map" else 1.2)
        axis.set(xscale="log", xlim=(1, 1000), ylim=(0, 1), title=f"{count} view{'s' if count > 1 else ''}")
        axis.set_xlabel("projection error, thousandths of the diagonal")
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("share of draws")
    axes[0, 0].legend()
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "real_cameras.png", dpi=80)


def main() -> None:
    """Print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path, metavar="DIR")
    parser.add_argument("--pairs", type=int, default=30, help="pairs of views a camera at most (default 30)")
    parser.add_argument("--steady", type=float, help="leave out references with a larger sd of fx")
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="default: all")
    parser.add_argument("--each", action="store_true", help="also print a table of each camera")
    parser.add_argument("--processes", type=int, default=os.cpu_count(), help="default: one a core")
    parser.add_argument("--plots", type=Path, help="folder for the figure (default: none is drawn)")
    options = parser.parse_args()
    paths = sorted(path for folder in options.folders for path in folder.glob("**/corners.npz"))
    if not paths:
        parser.error("There is no corners.npz in these folders, nor in a folder in them.")
    together: Results = {}
    with ProcessPoolExecutor(options.processes) as pool:
        if options.steady is not None:
            known = dict(zip(paths, pool.map(unsteadiness, paths), strict=True))
            for path in paths:
                left_out = ", left out" * (known[path] > options.steady)
                print(f"{path.parent.name}: reference known to {100 * known[path]:.2f} %{left_out}")
            paths = [path for path in paths if known[path] <= options.steady]
            print(f"\nCameras: {len(paths)}\n")
        jobs = [(path, options.pairs, tuple(options.methods)) for path in paths]
        for path, results in zip(paths, pool.map(run, jobs), strict=True):
            for key, found in results.items():
                together.setdefault(key, []).extend(found)
            if options.each:
                print(f"{path.parent.name}\n")
                table(results)
    table(together)
    if options.plots:
        plot(together, options.plots)


if __name__ == "__main__":
    main()
